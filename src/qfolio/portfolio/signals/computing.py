"""Computes signals on a table, tries those of a user's own, and scales them across assets."""

import warnings
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from qfolio.core.arrays import Bools, Floats, numbers
from qfolio.core.errors import QfolioError
from qfolio.core.registry import SIGNALS
from qfolio.portfolio.signals.base import ROUNDING, Column, Signal, before
from qfolio.portfolio.signals.reading import COLUMN

CUTS = 12
"""A user's own signal is computed again on a table cut after this many rows of each kind."""

SCALES = ("rank", "z-score", "centered", "raw")
"""How signals are scaled across assets, row by row: ranks from −1 to 1; distances from the mean in
standard deviations, clipped at ±3; distances from the mean; or the numbers themselves."""


def compute(
    signals: Sequence[Signal],
    prices: Floats,
    scale: str = "rank",
    columns: Mapping[str, Floats] | None = None,
    tradable: Bools | None = None,
) -> Floats:
    """Signals of shape (row, asset, signal), NaN where unknown; 0 if one repeats an earlier one.

    prices, columns: of shape (row, asset), NaN where unknown. tradable: which assets are compared
    at each row, likewise (default: all); the others' are unknown, except those that all share.

    Raises QfolioError if the scale or a column is unknown, or if a signal has the wrong shape or
    looks ahead.
    """
    if scale not in SCALES:
        raise QfolioError(f"signal_scale is {scale!r}; it must be one of {', '.join(SCALES)}.")
    values = [
        _column(signal.name, columns or {}) if isinstance(signal, Column)
        else _checked(signal, prices)
        for signal in signals
    ]  # fmt: skip
    there = np.ones(prices.shape, bool) if tradable is None else tradable
    priced = there & ~np.isnan(prices)
    found = [
        _scaled(signal, x, there, priced, signal.scale or scale)
        for signal, x in zip(signals, values, strict=True)
    ]
    # On a monthly table, returns over a day, a week and a month are one signal, not three.
    for place, signal in enumerate(signals):
        if signal in signals[:place]:
            found[place] = np.zeros(prices.shape)
    return np.stack(found, -1) if found else np.zeros((*prices.shape, 0))


def _market_wide(values: Floats, there: Bools) -> Floats | None:
    """The number of each row that all assets which are there share, (row, 1); None if some do not.

    A delisted asset keeps its last number, and does not count.
    """
    known = np.isfinite(values) & there
    if (known.any(1, keepdims=True) & there & ~known).any():
        return None
    high = np.max(values, 1, keepdims=True, initial=-np.inf, where=known)
    low = np.min(values, 1, keepdims=True, initial=np.inf, where=known)
    if (low < high).any():
        return None
    return np.where(low == high, high, np.nan)


def _column(name: str, columns: Mapping[str, Floats]) -> Floats:
    if name not in columns:
        raise QfolioError(
            f"The signal {COLUMN}{name} names no column of the table; also list the column in "
            "--features."
        )
    return columns[name]


def _checked(signal: Signal, prices: Floats) -> Floats:
    """The signal; a user's own is computed again without the latest rows."""
    name = type(signal).__name__
    found = numbers(f"The signal {name}", signal(prices))
    if found.shape != prices.shape:
        raise QfolioError(
            f"The signal {name} has the shape {found.shape}; it must be {prices.shape}, one number "
            "for each row and asset."
        )
    if f"{type(signal).__module__}:{name}" not in SIGNALS.values():
        known = np.isfinite(found)
        if len(prices) > signal.rows and not known.any():
            raise QfolioError(
                f"The signal {name} is unknown at each row and for each asset (NaN or infinite); "
                "it must be a number where prices are known."
            )
        for row in _telling(found, prices):
            with warnings.catch_warnings(action="ignore"):  # of what is not known yet
                then = numbers(f"The signal {name}", signal(prices[: row + 1]))
            same = then.shape == (row + 1, prices.shape[1]) and np.isclose(
                then, found[: row + 1], rtol=0, atol=_unit(then), equal_nan=True
            )
            if not np.all(same):
                if not np.array_equal(signal(prices), found, equal_nan=True):
                    raise QfolioError(
                        f"The signal {name} has other values each time it is computed on the same "
                        "table; draw its random numbers from a generator with a fixed seed."
                    )
                where = f"row {row} or earlier" if row else "row 0"
                raise QfolioError(
                    f"The signal {name} looks ahead: its value at {where} changes when later rows "
                    "are taken away."
                )
    return found


def _telling(found: Floats, prices: Floats) -> NDArray[np.int64]:
    """Rows after which the table is cut: evenly spaced, and where looking ahead shows most.

    There the signal is largest or moves most, the next prices move most, or they begin or end.
    """
    if len(prices) < 2:
        return np.arange(0)

    def largest(values: Floats) -> NDArray[np.int64]:
        size = np.max(abs(values), 1, initial=0, where=np.isfinite(values))
        return np.argsort(-size[: len(prices) - 1], kind="stable")[:CUTS]

    with np.errstate(invalid="ignore"):
        moved, jumped = found - before(found, 1), np.diff(np.log(prices), axis=0)
    ends = np.diff(np.isnan(prices), axis=0).astype(float)
    even = np.linspace(0, len(prices) - 2, CUTS).astype(int)
    each = [even, largest(found), largest(moved), largest(jumped), largest(ends)]
    return np.unique(np.concatenate(each))


def _scaled(signal: Signal, values: Floats, there: Bools, priced: Bools, scale: str) -> Floats:
    """Scaled across the assets that are there; what all those with a price share stays as it is."""
    values = np.where(np.isfinite(values), values, np.nan)  # one alone would silence all
    if signal.shared:
        return values
    if isinstance(signal, Column) and (common := _market_wide(values, priced)) is not None:
        return np.broadcast_to(common, values.shape)
    values = np.where(there, values, np.nan)
    if scale == "rank":
        import pandas as pd

        ranks = pd.DataFrame(np.round(values / _unit(values))).rank(axis=1).to_numpy()
        count = (~np.isnan(values)).sum(1, keepdims=True)
        ranked = 2 * (ranks - 1) / np.maximum(count - 1, 1) - 1
        return np.where(count > 1, ranked, 0 * values)  # one alone has no rank
    if scale in ("z-score", "centered"):
        known, unit = ~np.isnan(values), _unit(values)
        count = np.maximum(known.sum(1, keepdims=True), 1)
        values = values - np.nansum(values, 1, keepdims=True) / count
        if scale == "z-score":
            spread = np.sqrt(np.nansum(values**2, 1, keepdims=True) / count)
            values = np.clip(values / np.where(spread > unit, spread, np.inf), -3, 3)
    return values


def _unit(values: Floats) -> Floats:
    """The least difference between the numbers of a row that is not rounding, shape (row, 1).

    Two assets, for example, always have the same correlation with each other.
    """
    largest = np.max(abs(values), 1, keepdims=True, initial=0, where=np.isfinite(values))
    return ROUNDING * np.where(largest > 0, largest, 1)
