"""The folder of a study.

It holds study.json (what is run, the looks taken, and the pooled result at the end), study.csv (a
row for each table, variant and agent), the report, and an ordinary backtest for each table and
variant in tables/TABLE/VARIANT/.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, ClassVar

import msgspec
import numpy as np

from qfolio.core.config import AgentName, Config, read_config, write_config
from qfolio.core.errors import QfolioError
from qfolio.core.files import read_json, write_csv
from qfolio.core.text import shell
from qfolio.portfolio.backtest.folder import RISK_FREE, BacktestFolder, followed
from qfolio.portfolio.study.evidence import TableReturns
from qfolio.portfolio.study.pooling import Pools

FILE = "study.json"

NAME = r"^[\w-]+$"
"""The names of tables, which become folders."""

TableName = Annotated[str, msgspec.Meta(pattern=NAME)]


class Variant(msgspec.Struct, frozen=True):
    """A lag, and a cost as a fraction of the value traded."""

    lag: int
    cost: float

    @property
    def bps(self) -> float:
        """The cost in basis points."""
        return round(1e4 * self.cost, 6)

    @property
    def name(self) -> str:
        """Its name as a folder: lag1-10bp."""
        return f"lag{self.lag}-{self.bps:g}bp"

    @property
    def text(self) -> str:
        """In words: lag 1, 10 bp."""
        return f"lag {self.lag}, {self.bps:g} bp"


class TableConfig(msgspec.Struct, frozen=True, kw_only=True):
    """A table of the study."""

    source: str
    digest: str
    rows: int
    assets: int
    first: str
    last: str
    note: str
    trials: int  # earlier looks at this table, including those of earlier studies


class Look(msgspec.Struct, frozen=True, kw_only=True):
    """Agents whose result on a table was computed; each of them is a look at the table.

    study: when the study was created, which tells studies apart.
    """

    study: str
    table: str
    digest: str
    lag: int
    cost: float
    agents: tuple[str, ...]


class VariantResult(msgspec.Struct, frozen=True, kw_only=True):
    """The pooled evidence at one lag and cost, by agent."""

    variant: Variant
    agents: dict[str, Pools]


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """The result of a study.

    variants: the main one first. looks: number taken by this study. earlier: number of earlier
    looks at its tables. trials: the largest number of looks at any one table, earlier ones
    included. threshold: z that the best of so many trials is expected to reach without skill.
    verdicts: sentences by agent. twins: sentences on tables that hold nearly the same prices.
    """

    variants: list[VariantResult]
    looks: int
    earlier: int
    trials: int
    threshold: float
    verdicts: dict[str, list[str]]
    twins: list[str] = msgspec.field(default_factory=list)


class StudyConfig(Config, frozen=True):
    """The content of study.json."""

    kind: ClassVar[str] = "study"
    format: ClassVar[int] = 2

    tables: Annotated[dict[TableName, TableConfig], msgspec.Meta(min_length=1)]
    left_out: dict[TableName, str]
    variants: Annotated[list[Variant], msgspec.Meta(min_length=1)]
    agents: Annotated[list[AgentName], msgspec.Meta(min_length=1)]
    train: str
    test: str
    command: str
    device: str
    started: str
    twins: list[str] = msgspec.field(default_factory=list)
    earlier: list[Look] = msgspec.field(default_factory=list)
    looks: list[Look] = msgspec.field(default_factory=list)
    result: Result | None = None


class StudyFolder:
    """Reads and writes a study's files."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def write(self, config: StudyConfig) -> None:
        write_config(self.path / FILE, config)

    def read(self) -> StudyConfig:
        """The content of study.json.

        Raises QfolioError if the folder holds no study of this version.
        """
        return read_config(self.path / FILE, StudyConfig)

    def place(self, table: str, variant: Variant) -> Path:
        """The folder of a backtest."""
        return self.table(table) / variant.name

    def table(self, table: str) -> Path:
        """The folder of a table's backtests."""
        return self.path / "tables" / table

    def read_returns(self, table: str, variant: Variant, config: StudyConfig) -> TableReturns:
        """The returns of a finished backtest.

        Raises:
            QfolioError: returns.csv or summary.json is missing or damaged, or the backtest has gone
                on beyond the study's table.
        """
        files = BacktestFolder(self.place(table, variant))
        days, columns = files.read_returns()
        last = config.tables[table].last
        if days and np.datetime64(days[-1]) > np.datetime64(last):
            raise QfolioError(
                f"{files.path} has gone on to {days[-1]}, but the study's table {table} ends on "
                f"{last}; start a study of the longer table in another folder, and count the looks "
                "of this one (--trials)."
            )
        try:
            summary = read_json(files.path / "summary.json")
            kinds = {name: entry["kind"] for name, entry in summary["strategies"].items()}
            reference = summary["reference"]
            baselines = _of_kind("baseline", kinds, columns)
            return TableReturns(
                tuple(days),
                float(summary["periods_per_year"]),
                {agent: _traded(agent, columns) for agent in config.agents},
                {reference: columns[reference], **_of_kind("rebalancing", kinds, columns)},
                baselines,
                None if RISK_FREE in kinds else columns.get(RISK_FREE),
            )
        except (AttributeError, KeyError, QfolioError, StopIteration, TypeError, ValueError):
            raise QfolioError(
                f"{files.path} is damaged; write its tables again with qfolio backtest --resume "
                f"{shell(files.path)}."
            ) from None

    def write_table(self, result: Result) -> None:
        """Writes study.csv, with a row for each table, variant and agent."""
        rows = list(_rows(result))
        write_csv(self.path / "study.csv", rows[0], (row.values() for row in rows))


def _rows(result: Result) -> Iterator[dict[str, Any]]:
    for entry in result.variants:
        for agent, pools in entry.agents.items():
            for table, known in pools.evidence.items():
                row = {
                    "table": table,
                    "lag": entry.variant.lag,
                    "cost_bps": entry.variant.bps,
                    "agent": agent,
                    **msgspec.to_builtins(known),
                }
                for against in ("to_reference", "to_rebalanced"):
                    row |= {f"{against}_{key}": x for key, x in row.pop(against).items()}
                yield row


def _of_kind(
    kind: str, kinds: dict[str, str], columns: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    return {name: columns[name] for name, its in kinds.items() if its == kind}


def _traded(agent: str, columns: dict[str, np.ndarray]) -> np.ndarray:
    """The returns of an agent as it is traded: all seeds together, or its only seed."""
    if (together := followed(agent, columns)) in columns:
        return columns[together]
    (only,) = (name for name in columns if name.rpartition("/")[0] == agent)
    return columns[only]
