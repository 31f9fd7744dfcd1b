"""The folder of a backtest.

It holds config.json (settings, written once), prices.safetensors (the table, which may have grown
since), strategies.safetensors (the user's own strategies, if there are any),
policies/AGENT/FOLD.safetensors (weights, written as soon as a group of folds is trained; for the
latest policy, the whole learning state, with latest-N.safetensors after its Nth update),
training/AGENT/FOLD.csv (a row for each training episode) and, at the end, returns.csv, weights.csv,
summary.json, why.json (what explains the agents) and the report. ledger/ has the allocations.
"""

import csv
import math
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np

from qfolio.core.config import (
    AgentName,
    Config,
    agent_folder,
    read_config,
    require_agent_names,
    write_config,
)
from qfolio.core.errors import QfolioError
from qfolio.core.files import (
    read_arrays,
    read_json,
    read_tree,
    require_there,
    write_arrays,
    write_bytes,
    write_csv,
    write_json,
    write_tree,
)
from qfolio.core.mdp import Agent
from qfolio.core.registry import BASELINES, name_of
from qfolio.core.text import shell
from qfolio.experiments.budget import Budget, seed_range
from qfolio.experiments.described import recorded
from qfolio.experiments.presets import Preset
from qfolio.experiments.records import Records
from qfolio.portfolio.backtest.own import KINDS, Own
from qfolio.portfolio.few_rows import fitted
from qfolio.portfolio.mandate.mandate import Mandate
from qfolio.portfolio.prices.stored import from_arrays, to_arrays
from qfolio.portfolio.prices.table import Prices

EQUAL_WEIGHT = "equal-weight"
"""The benchmark, unless another is named."""

TOGETHER = "-together"
"""Suffix of an agent's ensemble: the mean of all its seeds, which is the policy for tomorrow."""

RISK_FREE = "risk_free"
"""The column of returns.csv with the returns of cash, if it earns any."""

MOST_TRIALS = 10**9
"""Largest number of earlier trials on a table."""

STRATEGIES = "strategies.safetensors"

MOST_WEIGHTS = 10_000_000
"""Numbers in weights.csv, about 80 MB, beyond which it has fewer rows."""


def followed(agent: str, names: Container[str]) -> str:
    """The strategy that ``allocate`` follows: all seeds of an agent together, or its only one."""
    together = f"{agent}{TOGETHER}"
    return together if together in names else agent


def rows_written(dates: np.ndarray, numbers: int) -> np.ndarray:
    """The rows of weights.csv: all, or the last of each day or month; numbers: those in a row."""
    last = np.arange(len(dates))
    for unit in ("D", "M"):
        if len(last) * numbers <= MOST_WEIGHTS:
            break
        units = dates.astype(f"datetime64[{unit}]")
        last = np.flatnonzero(np.append(units[1:] > units[:-1], True))
    return last


class AgentConfig(msgspec.Struct, kw_only=True, frozen=True):
    """An agent of the backtest, with the settings of its task."""

    agent: str
    settings: dict[str, Any]
    task: dict[str, Any]
    episodes: int
    shortened: int = 0  # its preset's horizon, if that was too long for a fold

    @staticmethod
    def of(
        name: str,
        agent: Preset | Agent,
        episodes: int | None,
        task: Mapping[str, Any],
        rows: int,
        lag: int,
    ) -> "AgentConfig":
        """The configuration of an agent; episodes and task are those of one without a preset.

        rows: the fewest that a fold trains on.

        Raises QfolioError if there are no episodes.
        """
        if isinstance(agent, Preset):
            chosen = fitted(agent, rows, lag)
            horizons = [each.task.get("horizon", 0) for each in (agent, chosen)]
            return AgentConfig(
                agent=chosen.agent,
                settings=recorded(chosen.build()),
                task=dict(chosen.task),
                episodes=chosen.episodes,
                shortened=horizons[0] if horizons[1] < horizons[0] else 0,
            )
        if episodes is None:
            raise QfolioError(
                f"{name} has no preset; give episodes, the length of its training in a fold."
            )
        return AgentConfig(
            agent=name_of(agent),
            settings=recorded(agent),
            task=dict(task),
            episodes=episodes,
        )


class BacktestConfig(Config, frozen=True):
    """The configuration of a backtest."""

    kind: ClassVar[str] = "backtest"
    format: ClassVar[int] = 2

    prices: dict[str, Any]
    assets: list[str]
    feature_names: list[str]
    train: str
    test: str
    expanding: bool
    lag: int
    cost: float
    cap: float
    cost_model: str
    baselines: list[str]
    seeds: int
    seed: int
    trials: Annotated[int, msgspec.Meta(ge=0, le=MOST_TRIALS)]
    command: str
    agents: Annotated[dict[AgentName, AgentConfig], msgspec.Meta(min_length=1)]
    device: str
    versions: dict[str, str]
    started: str
    calendar: str = ""
    title: str = ""
    strategies: tuple[str, ...] = ()
    benchmark: str = EQUAL_WEIGHT
    mandate: Mandate | None = None

    def __post_init__(self) -> None:
        seed_range(self.seeds, self.seed)
        require_agent_names(self.agents)
        if not {"source", "rows", "first", "last", "digest"} <= self.prices.keys():
            raise QfolioError("the description of prices is incomplete.")
        for name, entry in self.agents.items():
            Budget(entry.episodes)
            if name in BASELINES:
                raise QfolioError(
                    f"an agent cannot have the name of the baseline {name}; give it another."
                )
            if f"{name}{TOGETHER}" in self.agents:
                raise QfolioError(
                    f"{name}{TOGETHER} is what all seeds of {name} hold together; give that agent "
                    "another name."
                )


class BacktestFolder:
    """Reads and writes a backtest's files."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, config: BacktestConfig, prices: Prices, own: Mapping[str, Own]) -> None:
        """Writes the configuration, the prices and the user's own strategies."""
        write_config(self.path / "config.json", config)
        self.write_prices(prices)
        if own:
            write_arrays(self.path / STRATEGIES, _own_arrays(own))

    def write_prices(self, prices: Prices, trained: Sequence[tuple[int, int]] = ()) -> None:
        """Writes the table; trained: as ``Backtest`` takes it."""
        begun = {"trained": np.array(trained)} if trained else {}
        write_arrays(self.path / "prices.safetensors", to_arrays(prices) | begun)

    def grow(self, prices: Prices, trained: Sequence[tuple[int, int]]) -> None:
        """Replaces the table by a longer one; the backtest is unfinished until it has run."""
        for name in ("summary.json", "why.json"):
            (self.path / name).unlink(missing_ok=True)
        self.write_prices(prices, trained)

    def read_config(self) -> BacktestConfig:
        """The configuration; raises QfolioError if the folder holds no backtest of this version."""
        return read_config(self.path / "config.json", BacktestConfig)

    def read_prices(self, config: BacktestConfig) -> tuple[Prices, list[tuple[int, int]]]:
        """The table, and ``trained`` as ``write_prices`` takes it.

        Raises QfolioError if it is damaged or does not begin with the rows of the configuration.
        """
        path = self.path / "prices.safetensors"
        arrays = read_arrays(path)
        try:
            prices = from_arrays(
                arrays,
                tuple(config.assets),
                feature_names=tuple(config.feature_names),
                source=str(config.prices["source"]),
                note=str(config.prices.get("note", "")),
                market_names=tuple(config.prices.get("columns", ())),
                levels=bool(config.prices.get("levels", False)),
            )
            first = prices.between(0, int(config.prices["rows"]))
        except (KeyError, TypeError, ValueError, QfolioError) as error:
            raise QfolioError(f"{path} is damaged ({error}); restore it, or start over.") from None
        if first.digest != config.prices["digest"]:
            raise QfolioError(f"{path} does not belong to config.json beside it; restore both.")
        return prices, [(int(n), int(rows)) for n, rows in arrays.get("trained", ())]

    def policies(self, agent: str) -> list[str]:
        """The names of an agent's policies."""
        return [path.stem for path in self._policies(agent).glob("*.safetensors")]

    def policy_file(self, agent: str, name: str) -> Path:
        return self._policies(agent) / f"{name}.safetensors"

    def read_own(self, config: BacktestConfig) -> dict[str, Own]:
        """The user's own strategies; raises QfolioError if they are damaged."""
        if not config.strategies:
            return {}
        arrays = read_arrays(self.path / STRATEGIES)
        try:
            return {
                name: Own(kind, arrays[f"{name}/dates"].astype("datetime64[s]"), values)
                for name in config.strategies
                for kind in KINDS
                if (values := arrays.get(f"{name}/{kind}")) is not None
            }
        except KeyError:
            raise QfolioError(
                f"{self.path / STRATEGIES} does not belong to config.json beside it; restore both."
            ) from None

    def has_policy(self, agent: str, fold: str) -> bool:
        return self.policy_file(agent, fold).exists()

    def write_policy(self, agent: str, fold: str, tree: Any) -> None:
        write_tree(self.policy_file(agent, fold), tree)

    def read_policy(self, agent: str, fold: str, template: Any) -> Any:
        return read_tree(self.policy_file(agent, fold), template)

    def write_records(self, agent: str, fold: str, rows: Records) -> None:
        """Writes the training episodes of a fold; raises QfolioError if the folder is gone."""
        require_there(self.path)
        write_bytes(self._records(agent, fold), rows.csv(header=True))

    def read_records(self, agent: str, fold: str) -> Records:
        """The training episodes of a fold; none if their table is missing."""
        return Records.read(self._records(agent, fold))

    def write_returns(self, days: Sequence[str], columns: dict[str, np.ndarray]) -> None:
        """Writes returns.csv, with a column per strategy and seed, and one of cash if given."""
        rows = zip(days, *(column.tolist() for column in columns.values()), strict=True)
        write_csv(self.path / "returns.csv", ["date", *columns], rows)

    def read_returns(self) -> tuple[list[str], dict[str, np.ndarray]]:
        """The days, and the returns by column; raises QfolioError if returns.csv is damaged.

        A file that lost whole rows is noticed, too: summary.json has their number.
        """
        path, summary = self.path / "returns.csv", self.path / "summary.json"
        try:
            header, *rows = csv.reader(path.read_text("utf-8").splitlines())
            table = np.array([row[1:] for row in rows], dtype=float)
            columns = dict(zip(header[1:], table.T, strict=True))
            if summary.exists() and len(rows) != read_json(summary)["periods"]:
                raise ValueError
        except (OSError, csv.Error, KeyError, TypeError, ValueError):
            raise self._damaged(path) from None
        return [row[0] for row in rows], columns

    def write_weights(
        self,
        dates: np.ndarray,
        days: Sequence[str],
        assets: Sequence[str],
        weights: dict[str, np.ndarray],
    ) -> None:
        """Writes weights.csv: each strategy's weights after each row's trade, cash first.

        If these are too many, only those of the last row of each day or month are written. days:
        the dates as text.
        """
        rows = rows_written(dates, len(weights) * (1 + len(assets)))
        lines = (
            (days[row], name, *numbers)
            for name, table in weights.items()
            for row, numbers in zip(rows, table[rows].round(6).tolist(), strict=True)
        )
        header = ["date", "strategy", "cash", *assets]
        write_csv(self.path / "weights.csv", header, lines)

    def write_summary(self, summary: dict[str, Any]) -> None:
        write_json(self.path / "summary.json", summary)

    def read_measures(self) -> dict[str, dict[str, float]]:
        """The measures of each strategy (means over seeds); empty before there is a summary."""
        path = self.path / "summary.json"
        if not path.exists():
            return {}
        try:
            return {
                name: {key: _number(x["mean"]) for key, x in strategy["measures"].items()}
                for name, strategy in read_json(path)["strategies"].items()
                if strategy["kind"] != "rebalancing"
            }
        except (AttributeError, KeyError, QfolioError, TypeError, ValueError):
            raise self._damaged(path) from None

    def write_why(self, content: dict[str, Any]) -> None:
        write_json(self.path / "why.json", content)

    def read_why(self) -> dict[str, Any]:
        """The content of why.json; raises QfolioError if it is missing or not a JSON object."""
        path = self.path / "why.json"
        try:
            return read_json(path)
        except QfolioError:
            raise self._damaged(path) from None

    def _damaged(self, path: Path) -> QfolioError:
        """The error of a file that a finished backtest can write again."""
        return QfolioError(
            f"{path} is missing or damaged; write it again with qfolio backtest --resume "
            f"{shell(self.path)}."
        )

    def _records(self, agent: str, fold: str) -> Path:
        return self.path / "training" / agent_folder(agent) / f"{fold}.csv"

    def _policies(self, agent: str) -> Path:
        return self.path / "policies" / agent_folder(agent)


def _own_arrays(own: Mapping[str, Own]) -> dict[str, np.ndarray]:
    return {
        f"{name}/{part}": array
        for name, each in own.items()
        for part, array in (
            ("dates", each.dates.astype("datetime64[s]").astype(np.int64)),
            (each.kind, each.values),
        )
    }


def _number(value: float | None) -> float:
    """A number of a JSON file, in which those that are not finite are null."""
    return math.nan if value is None else float(value)
