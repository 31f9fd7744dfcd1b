"""The benchmark of a backtest, and the user's own strategies by name."""

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from qfolio.core.errors import QfolioError
from qfolio.core.registry import BASELINES, short
from qfolio.core.text import csv_cell, hint, quote
from qfolio.portfolio.backtest.folder import EQUAL_WEIGHT, TOGETHER
from qfolio.portfolio.backtest.own import Own, buy_and_hold
from qfolio.portfolio.backtest.own_tables import read_own
from qfolio.portfolio.mandate.mandate import Mandate
from qfolio.portfolio.prices.table import Prices

BENCHMARK = "benchmark"
"""Name of a benchmark that is given as a data frame or an array."""

_NAME = re.compile(r"[A-Za-z0-9.&%(][\w.&+%()/:, -]{0,59}")


class Field(NamedTuple):
    """The strategies other than agents.

    benchmark: the name of one of them. baselines: names as registered. own: the user's, by name.
    """

    benchmark: str
    baselines: list[str]
    own: dict[str, Own]


def field_of(
    prices: Prices,
    agents: Iterable[str],
    baselines: Sequence[str],
    strategies: Mapping[str, Any],
    benchmark: Any = None,
) -> Field:
    """Read a user's own strategies, and find the benchmark.

    Args:
        prices: The table of the backtest.
        agents: Names of the agents.
        baselines: Names of the baselines; equal weights are added.
        strategies: Sources of the user's own strategies by name, as ``read_own`` takes them.
        benchmark: The name of one of them, of a baseline or of an asset, which is then bought and
            held; or another source (default: equal weights).

    Raises:
        QfolioError: A name cannot be used or is used twice, a source cannot be read, or the
            benchmark is unknown or an agent.
    """
    rules = list(dict.fromkeys([EQUAL_WEIGHT, *baselines]))
    taken = {*agents, *(f"{name}{TOGETHER}" for name in agents), *map(short, rules), *BASELINES}
    own: dict[str, Own] = {}

    def add(name: str, source: Any) -> None:
        plain = csv_cell(name) == name  # as it is in returns.csv
        if not plain or (name not in prices.assets and not _NAME.fullmatch(name)):
            raise QfolioError(
                f"A strategy cannot be called {quote(name)}; begin with a letter or digit, and use "
                "up to 60 letters, digits, spaces and the signs . , : & + - _ / % ( )."
            )
        of_agent = name.rpartition("/")[0] in agents  # a column of returns.csv
        if name in taken or name in own or of_agent or name.startswith(f"{EQUAL_WEIGHT} at "):
            raise QfolioError(
                f"The backtest already has a strategy {name}; give yours another name."
            )
        own[name] = source if isinstance(source, Own) else read_own(name, source, prices)

    for name, source in strategies.items():
        if name in prices.assets:
            raise QfolioError(
                f"The table has an asset {name}; give your strategy of this name another one."
            )
        add(name, source)
    if benchmark is None:
        return Field(EQUAL_WEIGHT, rules, own)
    if not isinstance(benchmark, str | Path):
        add(BENCHMARK, benchmark)
        return Field(BENCHMARK, rules, own)
    name = str(benchmark)
    if name in {*agents, *(f"{agent}{TOGETHER}" for agent in agents)}:
        raise QfolioError(
            f"The benchmark {name} is an agent, and agents are compared with the benchmark; name a "
            "baseline, an asset, a strategy of your own or a file."
        )
    if name in own:
        return Field(name, rules, own)
    if name in prices.assets:
        add(name, buy_and_hold(name, prices))
        return Field(name, rules, own)
    if name in BASELINES or name in rules:
        return Field(short(name), list(dict.fromkeys([*rules, name])), own)
    if not Path(name).exists():
        known = [*own, *BASELINES, *prices.assets]
        raise QfolioError(
            f"The benchmark {quote(name)} is no baseline, asset or strategy of the backtest, and "
            f"no file{hint(name, known)}."
        )
    add(Path(name).stem, Path(name))
    return Field(Path(name).stem, rules, own)


def tracked(mandate: Mandate, benchmark: Any, field: Field, prices: Prices) -> Mandate:
    """The mandate, whose tracking error is against the backtest's benchmark if it names none.

    Args:
        mandate: The mandate.
        benchmark: As ``field_of`` takes it.
        field: What ``field_of`` makes of it.
        prices: The table of the backtest.

    Raises:
        QfolioError: The benchmark is neither an asset nor a baseline.
    """
    risk = mandate.risk
    named = risk.benchmark or mandate.benchmark
    if benchmark is None or risk.tracking_error is None or named is not None:
        return mandate
    name = str(benchmark) if isinstance(benchmark, str | Path) else field.benchmark
    if name not in {*prices.assets, *BASELINES, *field.baselines}:
        raise QfolioError(
            f"The mandate's tracking error cannot be measured against the benchmark {quote(name)}, "
            "which is no asset of the table and no baseline; set risk.benchmark to one, to a "
            'baseline of your own ("module:Name"), or to feature:NAME with its weights.'
        )
    return msgspec.structs.replace(mandate, risk=msgspec.structs.replace(risk, benchmark=name))
