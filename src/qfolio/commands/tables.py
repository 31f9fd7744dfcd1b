"""How the commands read price tables: their shared options."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from tyro.conf import arg
from tyro.constructors import PrimitiveConstructorSpec

from qfolio.commands.arguments import File, Name, Names
from qfolio.core.errors import QfolioError
from qfolio.core.text import listed

if TYPE_CHECKING:
    from qfolio.portfolio.prices.table import Prices

Missing = Literal["error", "drop-asset", "forward-fill"]
Late = Literal["error", "drop-asset", "trim", "join"]
Ended = Literal["gap", "cash-out"]
EndedAsBefore = Annotated[
    Ended | None,
    PrimitiveConstructorSpec(  # tyro's own would take the word None
        nargs=1,
        metavar=f"{{{','.join(get_args(Ended))}}}",
        choices=get_args(Ended),
        instance_from_str=lambda words: words[0],
        is_instance=lambda value: value is None or value in get_args(Ended),
        str_from_instance=lambda value: [str(value)],
    ),
]
Returns = Annotated[
    Literal["percent", "fraction", "relative"] | None,
    arg(metavar="percent|fraction|relative", help_behavior_hint=""),
]


@dataclasses.dataclass(frozen=True)
class Reading:
    """How a price table is read.

    Args:
        missing: How to treat missing prices.
        late: How to treat assets that start later than the table.
        ended: How to treat prices that end early: as missing ones, or as a delisting, at which a
            holding becomes cash at the last price.
        delisting_haircut: Share of a holding that is lost when it is cashed out, from 0 to 1.
        members: Table of the assets that may be bought at each date: a column of dates and one of
            0 or 1 for each asset, or the columns asset, from and to (default: all).
        features: Columns that hold features for agents instead of prices.
        columns: Columns that hold a number for the whole market, such as a cash rate, which costs
            may use and agents do not see; NAME=FILE reads one from a file of dates and numbers.
        returns: Unit of the table's numbers, if they are returns over the row before, or relatives
            to it (new price over old); they are cumulated to prices that start at 100 (default:
            they are prices).
        date: Column of dates (default: found by its name).
    """

    missing: Missing = "error"
    late: Late = "error"
    ended: Ended = "gap"
    delisting_haircut: float = 0.0
    members: File = None
    features: Names = ()
    columns: Names = ()
    returns: Returns = None
    date: Name = None

    @property
    def reading(self) -> dict[str, Any]:
        """The options, as ``prices.table.load`` takes them."""
        names = [field.name for field in dataclasses.fields(Reading)]
        return {name: getattr(self, name) for name in names}

    def like(self, table: "Prices") -> "Reading":
        """These options with a table's features and columns, unless others are chosen."""
        features, columns = table.feature_names, table.market_names
        return dataclasses.replace(
            self, features=self.features or features, columns=self.columns or columns
        )

    def load(self, file: Path | None) -> "Prices":
        """Reads a price table, and says what is implausible in it.

        Without a file, the table is the 20 US stocks that come with skfolio.
        """
        from qfolio.commands.console.tables import print_warnings
        from qfolio.portfolio.prices.table import accepted, inspect

        prices, findings = inspect(file, **self.reading)
        table = accepted(prices, findings, file)
        if file is not None:
            print_warnings(file.name, findings)
        return table


READING = Reading()

Read = Annotated[Reading, arg(name="")]
"""The options, without a prefix on the command line."""


@dataclasses.dataclass(frozen=True)
class Latest:
    """How the latest prices of a backtest's assets are read.

    Args:
        missing: How to treat missing prices.
        ended: How to treat prices that end early: as missing ones, or as a delisting (default:
            cash-out, if assets were delisted in the backtest).
        delisting_haircut: Share of a holding that is lost when it is cashed out, from 0 to 1
            (default: that of the delistings in the backtest).
        members: Table of the assets that may be bought at each date (default: all).
        features: Columns that hold features (default: those of the backtest).
        columns: Columns of the whole market; NAME=FILE reads one from a file (default: those of
            the backtest, in --prices).
        date: Column of dates (default: found by its name).
    """

    missing: Missing = "error"
    ended: EndedAsBefore = None
    delisting_haircut: float | None = None
    members: File = None
    features: Names = ()
    columns: Names = ()
    date: Name = None

    @property
    def reading(self) -> dict[str, Any]:
        """The options, as ``Desk.open`` takes them."""
        return dict(vars(self))

    def require_table(self, prices: Path | None, returns: str | None) -> None:
        """Raises QfolioError if there are options, but no table to read with them."""
        given = {**self.reading, "returns": returns}
        usual = {**LATEST.reading, "returns": None}
        names = [f"--{name.replace('_', '-')}" for name in given if given[name] != usual[name]]
        if prices is None and names:
            raise QfolioError(
                "Without --prices, those of the backtest are taken as they were read there; leave "
                f"out {listed(names)}, or give --prices."
            )


LATEST = Latest()

ReadLatest = Annotated[Latest, arg(name="")]
"""The options, without a prefix on the command line."""
