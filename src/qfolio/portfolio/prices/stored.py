"""A price table as named arrays, for the files of a backtest and of its ledger."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from qfolio.portfolio.prices.table import Prices


def to_arrays(prices: Prices) -> dict[str, np.ndarray]:
    """The numbers of a table; its names are stored elsewhere."""
    return {
        "dates": prices.dates.astype("datetime64[s]").astype(np.int64),
        "values": prices.values,
        "features": prices.features,
        "market": prices.market,
        **prices.masks,
    }


def from_arrays(arrays: Mapping[str, np.ndarray], assets: tuple[str, ...], **names: Any) -> Prices:
    """The table of such arrays; names: its other names and remarks, as ``Prices`` takes them.

    Raises KeyError, ValueError or QfolioError if the arrays are not those of a table.
    """
    return Prices(
        arrays["dates"].astype("datetime64[s]"),
        assets,
        arrays["values"],
        arrays["features"],
        market=arrays.get("market", np.empty(0)),
        listed=arrays.get("listed"),
        members=arrays.get("members"),
        **names,
    )
