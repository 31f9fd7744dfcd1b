"""Which assets are members of a universe at each date, such as the constituents of an index."""

from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.text import hint, quote
from qfolio.portfolio.prices.cells import is_missing, label, numbers
from qfolio.portfolio.prices.dates import read_dates
from qfolio.portfolio.prices.findings import day, listing
from qfolio.portfolio.prices.layout import Table
from qfolio.portfolio.prices.reading import read
from qfolio.portfolio.prices.records import date_column, in_order
from qfolio.portfolio.prices.vocabulary import ASSET_NAMES, plain

SPANS = ("from", "to")
TRUTH = {"true": 1, "false": 0}


def membership(source: Any, dates: np.ndarray, assets: tuple[str, ...]) -> np.ndarray:
    """Whether an asset is a member at each date, bool of shape (rows, assets).

    Args:
        source: A file or a data frame, with a column of dates and one of 0 or 1 for each asset
            (a row holds until the next one), or with the columns asset, from and to (both days are
            included; an empty one leaves the span open).
        dates: Dates of the price table, ascending, of shape (rows,).
        assets: Assets of the price table.

    Raises:
        QfolioError: The source cannot be read, or does not say when each asset is a member.
    """
    table = read(
        source, lambda names: set(range(len(names))) if _spans(names) else {date_column(names)}
    )
    try:
        _require_kind(table.names)
        found = _of_spans if _spans(table.names) else _of_rows
        return found(table, dates, assets)
    except QfolioError as error:
        raise QfolioError(f"The members in {quote(table.source)}: {error}") from None


def _spans(names: tuple[str, ...]) -> bool:
    return set(SPANS) <= {plain(name) for name in names}


def _require_kind(names: tuple[str, ...]) -> None:
    """Raises QfolioError if there is a column of assets, but not both ends of their spans."""
    kind = next((name for name in names if plain(name) in ASSET_NAMES), None)
    if kind is not None and not _spans(names):
        raise QfolioError(
            f"there is a column {quote(kind)}, but not both from and to; the columns are "
            f"{listing(names)}."
        )


def _of_rows(table: Table, dates: np.ndarray, assets: tuple[str, ...]) -> np.ndarray:
    when = date_column(table.names)
    _require_all([name for j, name in enumerate(table.names) if j != when], assets)
    since = _dates(table, when)
    if np.isnat(since).any():
        raise QfolioError("a row has no date; give each row one.")
    if not len(since):
        raise QfolioError("the table has no rows.")
    order = in_order(since, table)
    latest = np.searchsorted(since[order], dates, side="right") - 1
    known = np.empty((len(since), len(assets)), bool)
    for j, name in enumerate(assets):
        column = table.names.index(name)
        cells = [TRUTH.get(str(cell).strip().lower(), cell) for cell in table.columns[column]]
        values, wrong = numbers(np.array(cells, object))
        if (bad := wrong | ~np.isin(values, (0, 1))).any():
            row = table.first_row + int(bad.argmax())
            raise QfolioError(f"{quote(name)} is neither 0 nor 1 in row {row}; write one of them.")
        known[:, j] = values == 1
    return np.where((latest >= 0)[:, None], known[order][np.maximum(latest, 0)], False)


def _of_spans(table: Table, dates: np.ndarray, assets: tuple[str, ...]) -> np.ndarray:
    names = [plain(name) for name in table.names]
    place = next((j for j, name in enumerate(names) if name in ASSET_NAMES), None)
    if place is None:
        raise QfolioError("there is no column of assets besides from and to; name it asset.")
    labels = [label(cell) for cell in table.columns[place].tolist()]
    _require_all(labels, assets)
    begin, end = (_dates(table, names.index(name)) for name in SPANS)
    if (swapped := end < begin.astype("datetime64[D]")).any():
        i = int(swapped.argmax())
        raise QfolioError(
            f"row {table.first_row + i} goes from {day(begin[i])} to {day(end[i])}, which is "
            "earlier; exchange the two, or correct them."
        )
    members = np.zeros((len(dates), len(assets)), bool)
    for i, name in enumerate(labels):
        if name in assets:
            after = np.isnat(begin[i]) | (dates >= begin[i])
            until = np.isnat(end[i]) | (dates.astype("datetime64[D]") <= end[i])
            members[:, assets.index(name)] |= after & until
    return members


def _dates(table: Table, column: int) -> np.ndarray:
    """A column's dates, NaT where a cell is empty."""
    cells = table.columns[column]
    moments, complaints, _ = read_dates(cells)
    for i, said in complaints.items():
        if not is_missing(cells[i]):
            row = table.first_row + i
            raise QfolioError(f"{quote(table.names[column])} in row {row}: {said}.")
    return moments


def _require_all(named: Any, assets: tuple[str, ...]) -> None:
    """The members may be those of a larger universe, but every asset must be named."""
    for name in assets:
        if name not in named:
            raise QfolioError(
                f"they do not name {quote(name)}{hint(name, list(named))}; add it, or remove the "
                "asset from the prices."
            )
