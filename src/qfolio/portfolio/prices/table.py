"""Price tables: read, checked cell by cell, and then converted to numbers.

A gap is an error until the user chooses how to treat it. Gaps are only filled forward: a price
filled from a later one would leak the future to an agent.
"""

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.text import amount, hint, quote
from qfolio.portfolio.prices import folder, reading
from qfolio.portfolio.prices.checks import Choices, cells, examine
from qfolio.portfolio.prices.columns import text_columns
from qfolio.portfolio.prices.findings import Finding, Findings, day, listing
from qfolio.portfolio.prices.frequency import periods_per_year
from qfolio.portfolio.prices.grid import Grid
from qfolio.portfolio.prices.members import membership
from qfolio.portfolio.prices.series import series
from qfolio.portfolio.prices.vocabulary import is_cash

DEFAULT_SOURCE = "skfolio: 20 US stocks"
DEFAULT_NOTE = (
    "20 US stocks, chosen in hindsight from those still listed in 2022 (survivors): strategies "
    "that hold them look better than they could have been at the time."
)
CAVEATS = 3
"""Warnings that a table's note has in full."""

DEFAULT_TRIALS = 250
"""Earlier trials on the default table, as docs/results/real_prices.md lists them."""


@dataclass(frozen=True, eq=False, repr=False)
class Prices:
    """A checked price table; its arrays are read-only.

    Attributes:
        dates: datetime64[s] of shape (rows,), strictly increasing.
        assets: Names of the columns, each different.
        values: Prices, float64 of shape (rows, assets), finite and positive; NaN only before an
            asset's first row, if loaded with late="join". After an asset's last row, its payout.
        features: float64 of shape (rows, assets, channels); NaN only before an asset's first row.
        feature_names: Names of the channels.
        source: The origin of the table.
        note: A caveat for readers of results on the table.
        market: float64 of shape (rows, names), finite: columns that all assets share, such as a
            cash rate, which agents do not see.
        market_names: Names of these columns.
        listed: Whether an asset has a price, bool of shape (rows, assets); None if none ends.
        members: Whether an asset may be bought, of the same shape; None if all assets may be as
            long as they are listed.
        levels: Whether ``values`` were cumulated from returns, so that they are no share prices.

    Raises:
        QfolioError: The arrays break one of these rules.
    """

    dates: np.ndarray
    assets: tuple[str, ...]
    values: np.ndarray
    features: np.ndarray = field(default_factory=lambda: np.empty(0))
    feature_names: tuple[str, ...] = ()
    source: str = ""
    note: str = ""
    market: np.ndarray = field(default_factory=lambda: np.empty(0))
    market_names: tuple[str, ...] = ()
    listed: np.ndarray | None = None
    members: np.ndarray | None = None
    levels: bool = False

    def __post_init__(self) -> None:
        dates = np.array(self.dates, dtype="datetime64[s]")
        values = np.array(self.values, dtype=np.float64, order="C")
        assets, channels = tuple(self.assets), tuple(self.feature_names)
        shape = (len(dates), len(assets))
        features = np.array(self.features, dtype=np.float64, order="C")
        if not channels and not features.size:
            features = features.reshape(*shape, 0)
        if values.shape != shape or features.shape != (*shape, len(channels)):
            raise QfolioError(
                f"prices of shape {values.shape} and features of shape {features.shape} do not fit "
                f"{shape[0]} dates, {shape[1]} assets and {len(channels)} feature names."
            )
        shared = tuple(self.market_names)
        market = np.array(self.market, dtype=np.float64, order="C")
        if market.ndim == 1:
            market = market.reshape(len(dates), len(shared) if not market.size else 1)
        if market.shape != (len(dates), len(shared)) or not np.isfinite(market).all():
            raise QfolioError(
                f"columns of the market of shape {market.shape} do not fit {len(dates)} dates and "
                f"{len(shared)} names, or are not finite."
            )
        if len(set(assets)) < len(assets) or len({*channels, *shared}) < len(channels + shared):
            raise QfolioError("names of assets, features and columns must not repeat.")
        if any(map(is_cash, assets)):
            raise QfolioError("an asset cannot be called cash, which is money; rename the column.")
        if np.isnat(dates).any() or (np.diff(dates) <= np.timedelta64(0, "s")).any():
            raise QfolioError("dates must increase from row to row.")
        started = np.logical_or.accumulate(~np.isnan(values), axis=0)
        if not (np.isfinite(values) & (values > 0))[started].all():
            raise QfolioError("prices must be finite and positive from an asset's first row on.")
        if np.isinf(features).any() or np.isnan(features[started]).any():
            raise QfolioError("features must be finite from an asset's first row on.")
        arrays = {"dates": dates, "values": values, "features": features, "market": market}
        for name, mask in self.masks.items():
            arrays[name] = np.array(mask, dtype=bool)
            if arrays[name].shape != shape:
                raise QfolioError(f"{name} has the shape {mask.shape}; it must be {shape}.")
        if "listed" in arrays and (arrays["listed"] >= started).all():  # as in the first rows
            del arrays["listed"]
            object.__setattr__(self, "listed", None)
        for name, array in arrays.items():
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        object.__setattr__(self, "assets", assets)
        object.__setattr__(self, "feature_names", channels)
        object.__setattr__(self, "market_names", shared)

    def __len__(self) -> int:
        return len(self.dates)

    def __repr__(self) -> str:
        what = f"{amount(len(self), 'row')} of {amount(len(self.assets), 'asset')}"
        when = f", {day(self.dates[0])} to {day(self.dates[-1])}" if len(self) else ""
        return f"<Prices: {what}{when}>"

    @property
    def masks(self) -> dict[str, np.ndarray]:
        """``listed`` and ``members`` by name, without those that are None."""
        both = {"listed": self.listed, "members": self.members}
        return {name: mask for name, mask in both.items() if mask is not None}

    @cached_property
    def tradable(self) -> np.ndarray | None:
        """Whether an asset may be bought at a row, bool of shape (rows, assets).

        None if assets neither end nor have a membership: then each may be from its first row on.
        """
        masks = list(self.masks.values())
        return np.logical_and.reduce([~np.isnan(self.values), *masks]) if masks else None

    @property
    def known(self) -> np.ndarray:
        """The prices, with NaN before an asset's first row and after its last."""
        return self.values if self.listed is None else np.where(self.listed, self.values, np.nan)

    @property
    def haircut(self) -> float | None:
        """The share of a holding that is lost when its asset ends, found from the payout.

        None if no asset ends.
        """
        if self.listed is None or self.listed[-1].all():
            return None
        ended = np.flatnonzero(~self.listed[-1] & self.listed.any(axis=0))
        last = len(self) - 1 - self.listed[::-1, ended].argmax(axis=0)
        paid = self.values[last + 1, ended] / self.values[last, ended]
        return round(float(1 - paid.min()), 8)

    @property
    def relatives(self) -> np.ndarray:
        """Price relatives price[k] / price[k-1], k = 1 … rows-1, of shape (rows-1, assets).

        NaN up to and including an asset's first row; see ``first_rows``.
        """
        return np.asarray(self.values[1:] / self.values[:-1])

    @property
    def first_rows(self) -> np.ndarray:
        """The row of each asset's first price, of shape (assets,); ``rows`` if there is none."""
        priced = ~np.isnan(self.values)
        return np.where(priced.any(axis=0), priced.argmax(axis=0), len(self))

    @property
    def periods_per_year(self) -> float:
        """Rows per year, from the dates; see ``frequency.periods_per_year``."""
        return periods_per_year(self.dates)

    @property
    def month(self) -> int:
        """Rows in a month, at least 1."""
        return max(1, round(self.periods_per_year / 12))

    @property
    def digest(self) -> str:
        """16 hexadecimal digits, different for tables of different content."""
        return self.sha256[:16]

    @property
    def sha256(self) -> str:
        """SHA-256 of the content, in hexadecimal digits."""
        names = repr((self.assets, self.feature_names, self.values.shape))
        sha = hashlib.sha256(names.encode("utf-8", "surrogatepass"))
        sha.update(self.dates.astype("<i8").tobytes())
        for array in (self.values, self.features):
            sha.update(np.where(np.isnan(array), np.nan, array).astype("<f8").tobytes())
        if self.market_names:
            sha.update(repr(self.market_names).encode("utf-8", "surrogatepass"))
            sha.update(self.market.astype("<f8").tobytes())
        for name, mask in self.masks.items():
            sha.update(name.encode() + mask.astype("u1").tobytes())
        return sha.hexdigest()

    def select(self, assets: Sequence[str]) -> "Prices":
        """The table of these assets, in this order. Raises QfolioError for unknown ones."""
        places = {name: j for j, name in enumerate(self.assets)}
        for name in assets:
            if name not in places:
                raise QfolioError(f"there is no asset {quote(name)}{hint(name, self.assets)}.")
        columns = [places[name] for name in assets]
        return self._part(slice(None), columns)

    def exactly(self, assets: Sequence[str], whose: str) -> "Prices":
        """The table of these assets, in this order; raises QfolioError if it has any others.

        whose: what has these assets, for the message.
        """
        missing = [name for name in assets if name not in self.assets]
        unknown = [name for name in self.assets if name not in assets]
        if missing or unknown:
            said = [f"lacks {listing(missing)}"] * bool(missing)
            said += [f"has {listing(unknown)}, which {whose} does not know"] * bool(unknown)
            raise QfolioError(
                f"The price table {' and '.join(said)}; it must have the {len(assets)} assets of "
                f"{whose}, and no others."
            )
        return self.select(assets)

    def between(self, start: int | None, stop: int | None) -> "Prices":
        """The rows from ``start`` to ``stop`` − 1, as in a slice of Python."""
        return self._part(slice(start, stop), slice(None))

    def to_frame(self) -> Any:
        """The prices as a pandas data frame, dates in its index."""
        import pandas as pd

        index = pd.DatetimeIndex(self.dates, name="date")
        return pd.DataFrame(self.values.copy(), index=index, columns=list(self.assets))

    def _part(self, rows: slice, columns: Any) -> "Prices":
        return Prices(
            self.dates[rows], tuple(np.array(self.assets, dtype=object)[columns]),
            self.values[rows][:, columns], self.features[rows][:, columns], self.feature_names,
            self.source, self.note, self.market[rows], self.market_names, levels=self.levels,
            **{name: mask[rows][:, columns] for name, mask in self.masks.items()},
        )  # fmt: skip


def load(
    source: Any = None,
    *,
    missing: str = "error",
    late: str = "error",
    ended: str = "gap",
    delisting_haircut: float = 0.0,
    members: Any = None,
    features: Sequence[str] = (),
    columns: Sequence[str] = (),
    returns: str | None = None,
    date: str | None = None,
) -> Prices:
    """Read and check a price table.

    Args:
        source: Path of a CSV or Parquet file, or of a folder of such files, each with one or more
            assets; a data frame that narwhals knows (pandas, polars, pyarrow, …); None for
            skfolio's 20 US stocks, 1990 to 2022, which need no download; or Prices, which are
            returned as they are. A table is wide (a column of dates, then a column per asset) or
            long (columns of dates, assets and prices, found by their names, such as date, ticker
            and close, with rows in any order). Columns of bars (open, high, low, close, volume) may
            have a header on two levels, as in yfinance's downloads; their adjusted close is used,
            or their close if there is none.
        missing: How to treat missing prices after an asset's first: "error", "drop-asset", or
            "forward-fill" (the last known price is kept; likewise for features). Applied before
            ``late``.
        late: How to treat assets that start later than the table: "error", "drop-asset", "trim"
            (the table starts with the last of them) or "join" (they are NaN before their first
            row).
        ended: How to treat prices that end before the table does: "gap" (as missing prices) or
            "cash-out" (the asset is delisted: a holding becomes cash at the last price).
        delisting_haircut: Share of a holding that is lost when it is cashed out, from 0 to 1.
        members: Which assets may be bought at each date: a file or data frame with a column of
            dates and one of 0 or 1 for each asset, each row of which holds until the next, or with
            the columns asset, from and to (default: all).
        features: Columns that hold features: in a long table one number for each asset and date,
            in a wide table one for the whole market, or, under a header on two levels, a kind such
            as Volume, which has a column per asset.
        columns: Columns that hold one number for the whole market, such as a cash rate; agents do
            not see them. "NAME=FILE" reads one from a file with a column of dates and one of
            numbers, each of which holds until the next.
        returns: "percent" or "fraction" if the table holds simple returns from the row before,
            "relative" if it holds new price over old; they are cumulated to prices that start at
            100 (default: it holds prices).
        date: Column of dates (default: found by its name).

    Raises:
        QfolioError: The table has errors (the first are named), or there is no table.
    """
    if isinstance(source, Prices):
        return source
    prices, findings = inspect(
        source, missing=missing, late=late, ended=ended, delisting_haircut=delisting_haircut,
        members=members, features=features, columns=columns, returns=returns, date=date,
    )  # fmt: skip
    return accepted(prices, findings, source)


def accepted(prices: Prices | None, findings: Sequence[Finding], source: Any) -> Prices:
    """The prices that ``inspect`` found in a source (None: the default table).

    Their note has the warnings.

    Raises QfolioError with the errors if it found none.
    """
    if prices is None:
        raise _refusal(findings, source)
    doubts = [finding for finding in findings if finding.severity == "warning"]
    if source is None or not doubts:  # the default table's have been looked at
        return prices
    rest = sum(finding.count for finding in doubts[CAVEATS:])
    said = [f"{finding}." for finding in doubts[:CAVEATS]]
    said += [f"And {amount(rest, 'more warning')}."] * bool(rest)
    return replace(prices, note=" ".join([*filter(None, [prices.note]), *said]))


def _refusal(findings: Sequence[Finding], source: Any) -> QfolioError:
    """The errors among the findings on a source."""
    errors = [finding for finding in findings if finding.severity == "error"]
    shown = "; ".join(str(finding) for finding in errors[:2])
    rest = sum(finding.count for finding in errors[2:])
    more = f"; and {rest:,} more" if rest else ""
    advice = " ".join(dict.fromkeys(f.advice for f in errors[:2] if f.advice))
    label = f"{quote(Path(source).name)}: " if isinstance(source, str | Path) else ""
    return QfolioError(f"{label}{shown}{more}.{' ' * bool(advice)}{advice}")


def inspect(source: Any = None, **choices: Any) -> tuple[Prices | None, list[Finding]]:
    """The prices, and all errors, warnings and notes on a table, by row and column.

    The arguments are ``load``'s. Of each kind, at most five cells are named, the first
    ones of errors and the latest ones of warnings; the others are counted.

    Returns:
        The prices (None if a finding is an error), and the findings.

    Raises:
        QfolioError: There is no table to check: no such file, not text, or rows of unequal length.
    """
    label, note, others = "", "", Findings()
    if source is None:
        from skfolio.datasets import load_sp500_dataset

        source, label, note = load_sp500_dataset(), DEFAULT_SOURCE, DEFAULT_NOTE
    chosen = Choices(**choices)
    if joined := isinstance(source, str | Path) and os.path.isdir(source):
        label = Path(source).resolve().name
        channels = (*chosen.features, *chosen.own_columns)
        source, others = folder.join(Path(source), partial(_cells, chosen), channels)
        chosen = replace(chosen, returns=None, date="date")
    table = reading.read(source, lambda names: text_columns(names, chosen.date))
    content, findings = examine(table, chosen)
    if joined:  # its rows are not those of any file
        findings = Findings([*(finding.without_rows() for finding in findings), *others])
    if findings.bad or not content:
        return None, findings
    for name, file in chosen.series.items():
        numbers = series(file, name, content["dates"], findings)
        content["market"] = np.column_stack([content["market"], numbers])
        content["market_names"] += (name,)
    levels = choices.get("returns") is not None
    prices = Prices(**content, source=label or table.source, note=note, levels=levels)
    if chosen.members is not None:
        prices = replace(prices, members=membership(chosen.members, prices.dates, prices.assets))
    return prices, findings


def _cells(chosen: Choices, file: Path) -> tuple[Grid, Findings]:
    """The cells of a file of a folder; raises QfolioError with its errors."""
    grid, findings = cells(
        reading.read(file, lambda names: text_columns(names, chosen.date)), chosen
    )
    if grid is None or findings.bad:
        raise _refusal(findings, file)
    return grid, findings


def describe(prices: Prices) -> dict[str, Any]:
    """A description of a table for reports, as JSON values."""
    return {
        "source": prices.source,
        "rows": len(prices),
        "assets": len(prices.assets),
        "first": day(prices.dates[0]) if len(prices) else None,
        "last": day(prices.dates[-1]) if len(prices) else None,
        "periods_per_year": prices.periods_per_year,
        "features": list(prices.feature_names),
        "columns": list(prices.market_names),
        "late_assets": int((prices.first_rows > 0).sum()),
        "delisted_assets": 0 if prices.listed is None else int((~prices.listed[-1]).sum()),
        "has_members": prices.members is not None,
        "levels": prices.levels,
        "digest": prices.digest,
        "note": prices.note,
    }


def trials_on(source: str) -> int:
    """Number of known earlier trials on prices from a source."""
    return DEFAULT_TRIALS if source == DEFAULT_SOURCE else 0
