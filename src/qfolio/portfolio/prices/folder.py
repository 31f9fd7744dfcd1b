"""Joins the tables of a folder, such as one file of bars for each asset, into one."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.text import quote
from qfolio.portfolio.prices.reading import PARQUET_FILES, TEXT_FILES
from qfolio.portfolio.prices.vocabulary import kind


def join(folder: Path, load: Callable[[Path], Any]) -> Any:
    """A long data frame of all tables in a folder.

    load: function that reads the Prices in one of them. An asset that its file does not name takes
    the name of the file.

    Raises:
        QfolioError: A table has errors, or the folder has none.
    """
    import pandas as pd

    known = (*TEXT_FILES, *PARQUET_FILES)
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in known)
    if not files:
        raise QfolioError(f"{quote(folder, 300)} is a folder without tables (.csv or .parquet).")
    parts = []
    for file in files:
        table = load(file)
        for j, name in enumerate(table.assets):
            columns = {
                "date": table.dates,
                "ticker": np.full(len(table), file.stem if kind(name) else name, dtype=object),
                "close": table.known[:, j],
                **dict(zip(table.feature_names, table.features[:, j].T, strict=True)),
                **dict(zip(table.market_names, table.market.T, strict=True)),
            }
            parts.append(pd.DataFrame(columns).dropna(subset="close"))
    return pd.concat(parts, ignore_index=True)
