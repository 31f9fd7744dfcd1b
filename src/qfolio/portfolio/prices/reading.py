"""Reads files and data frames as tables of named columns.

Nothing in a file is ever executed or unpickled.
"""

import io
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.files import path_of
from qfolio.core.text import quote
from qfolio.portfolio.prices.delimited import from_text
from qfolio.portfolio.prices.header import name_columns
from qfolio.portfolio.prices.layout import Table, upright

TEXT_FILES = (".csv", ".tsv", ".txt")
PARQUET_FILES = (".parquet", ".pq")


def read(source: Any, texts: Callable[[tuple[str, ...]], set[int]]) -> Table:
    """A file or a data frame as a table.

    Args:
        source: Path of a CSV or Parquet file, or a data frame that narwhals knows.
        texts: Returns, from the column names of a text file, the columns that must stay text,
            because 0700, NA and TRUE may be names of assets.

    Raises:
        QfolioError: The source cannot be read as a table.
    """
    if not isinstance(source, str | Path):
        return upright(_from_frame(source))
    path = path_of("prices", source)
    kind = path.suffix.lower()
    if kind not in ("", *TEXT_FILES, *PARQUET_FILES):
        raise QfolioError(
            f"{quote(path, 300)} is not read: tables come as CSV (.csv, .tsv, .txt) or Parquet "
            "(.parquet); export it as CSV."
        )
    try:
        content = path.read_bytes()
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise QfolioError(f"{quote(path, 300)} cannot be read: {reason}.") from None
    if kind in PARQUET_FILES:
        return upright(_from_parquet(content, path.name))
    return upright(from_text(content, path.name, texts))


# Data frames and Parquet.


def _from_frame(source: Any) -> Table:
    import narwhals as nw
    import pandas as pd

    if isinstance(source, pd.Series):
        source = source.to_frame()
    try:
        if isinstance(source, pd.DataFrame):  # pandas alone has an index and may repeat names
            return _from_pandas(source)
        frame = nw.from_native(source)
        frame = frame.collect() if isinstance(frame, nw.LazyFrame) else frame
        names, series = frame.columns, [frame[name] for name in frame.columns]
    except QfolioError:
        raise
    except TypeError:
        raise QfolioError(
            f"prices come as a path or as a data frame (pandas, polars, pyarrow, …), "
            f"not as {type(source).__name__}."
        ) from None
    except Exception as error:  # each library has exceptions of its own
        raise QfolioError(f"the data frame cannot be read: {quote(error, 200)}.") from None
    return _table(names, [_cells(column) for column in series], "data frame")


def _table(names: Iterable[Any], columns: Iterable[np.ndarray], source: str) -> Table:
    header = name_columns(names)
    return Table(header.names, tuple(columns), 0, source, levels=header.levels)


def _from_pandas(frame: Any) -> Table:
    import narwhals as nw
    import pandas as pd

    if frame.columns.nlevels > 2:
        raise QfolioError(
            f"the data frame has column names on {frame.columns.nlevels} levels; "
            "select one kind of price first, for example frame['Close']."
        )
    names = list(frame.columns)
    series = [frame.iloc[:, j] for j in range(len(names))]
    if not isinstance(frame.index, pd.RangeIndex):
        levels = range(frame.index.nlevels)
        names = [frame.index.names[i] for i in levels] + names
        series = [frame.index.get_level_values(i).to_series() for i in levels] + series
    columns = [_cells(nw.from_native(column, series_only=True)) for column in series]
    return _table(names, columns, "data frame")


def _cells(series: Any) -> np.ndarray:
    zoned = getattr(series.dtype, "time_zone", None) is not None
    array = series.to_numpy()
    if array.dtype.kind in "fiu":
        return np.asarray(array.astype(np.float64))
    if array.dtype.kind == "M" and not zoned:
        return np.asarray(array)
    return np.fromiter(series.to_list(), dtype=object, count=len(series))


def _from_parquet(content: bytes, name: str) -> Table:
    try:
        import pyarrow.parquet
    except ImportError:
        raise QfolioError(
            f'{quote(name)} is a Parquet file; to read it: pip install "qfolio[parquet]"'
        ) from None
    try:
        frame = pyarrow.parquet.ParquetFile(io.BytesIO(content)).read()
    except Exception as error:  # damaged files raise a dozen different kinds
        raise QfolioError(
            f"{quote(name)} is damaged or not a Parquet file ({quote(error, 100)})."
        ) from None
    names = frame.column_names
    if len(set(names)) < len(names):  # narwhals would not take them; the caller names them
        frame = frame.rename_columns([str(j) for j in range(len(names))])
    return _table(names, _from_frame(frame).columns, name)
