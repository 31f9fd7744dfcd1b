"""Agents and commands on made-up tables of any number of assets."""

from collections.abc import Callable
from pathlib import Path

from made_up import table, written
from qfolio.core import settings
from qfolio.core.population import Population
from qfolio.experiments.described import agent_of
from qfolio.experiments.presets import preset
from qfolio.portfolio.task import Portfolio
from race import Contestant

AGENTS = ("tilts", "dqn", "pathwise", "ppo", "sac")
"""Presets of each kind of learning."""

ROWS = 1300
"""Five years and a look-back."""


def population(name: str, assets: int) -> Population:
    """One agent with a preset's settings on a made-up table."""
    given = preset("fast", "portfolio", name)
    task = Portfolio.of(table(assets, ROWS), **settings.convert(Portfolio, dict(given.task)))
    return Population(task, agent_of(name, given.settings), [0])


def decisions(steps: Contestant, assets: int) -> Contestant:
    """A contestant whose steps count once for each asset."""
    return lambda seconds: assets * steps(seconds)


Command = Callable[[Path], list[str]]
"""Makes a table in a folder and returns the arguments of qfolio."""


def prices(assets: int, rows: int) -> Command:
    """Reads a table."""
    return lambda folder: ["prices", str(written(table(assets, rows), folder / "table.csv"))]


def backtest(assets: int, rows: int, *options: str, daily: bool = True) -> Command:
    """A backtest of a table, in the folder ``out``."""

    def arguments(folder: Path) -> list[str]:
        path = written(table(assets, rows, daily=daily), folder / "table.csv")
        return ["backtest", str(path), *options, "--out", str(folder / "out")]

    return arguments
