"""The data of the holdings chart: weights relative to the reference over time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qfolio.core.arrays import Floats
from qfolio.portfolio.backtest.statistics.tearsheet import effective_number
from qfolio.report.backtest.data import BacktestData
from qfolio.report.backtest.paths import compact, texts

BLOCKS = 200
"""Maximum number of points in time; each is a mean over consecutive days."""

NAMED = 12
"""Number of assets with a row of their own; the others are added up."""


def holdings(names: list[str], data: BacktestData) -> dict[str, Any]:
    """Return, for each strategy, its weights by block of days: cash, the largest, and the rest.

    The largest assets are those whose weights differ most from the reference's, on average. The
    reference itself is shown in absolute weights, as are all strategies if its weights are unknown.
    A strategy without weights has None.
    """
    days = len(data.dates)
    blocks = np.arange(0, days, math.ceil(days / BLOCKS))
    centers = (blocks + np.append(blocks[1:], days) - 1) // 2
    name = data.assessment.reference
    reference, known = data.strategies[name].weights, data.strategies[name].weighted
    base = _averages(reference, blocks)
    return {
        "dates": texts(data.trades[centers]),
        "reference": names.index(name) if known else None,
        "effective": compact(_averages(effective_number(reference), blocks), 3) if known else None,
        "series": [
            _rows(series.weights, base, data.assets, blocks, not known or each == name)
            if series.weighted
            else None
            for each, series in ((each, data.strategies[each]) for each in names)
        ],
    }


def _rows(
    weights: Floats, base: Floats, assets: tuple[str, ...], blocks: NDArray[np.intp], alone: bool
) -> dict[str, Any]:
    table = _averages(weights, blocks)
    beside = np.zeros_like(table) if alone else base
    size = np.abs(table - beside)[:, 1:].mean(axis=0)
    ranked = (np.argsort(-size, kind="stable") + 1).tolist()
    # A single remaining asset is named instead of called others.
    count = NAMED if len(ranked) > NAMED + 1 else len(ranked)
    top, rest = ranked[:count], ranked[count:]
    groups = [[0], *([asset] for asset in top), *([rest] if rest else [])]
    values = [table[:, group].sum(axis=1) for group in groups]
    active = [
        value - beside[:, group].sum(axis=1) for value, group in zip(values, groups, strict=True)
    ]
    return {
        "names": ["Cash", *(assets[asset - 1] for asset in top)]
        + [f"{len(rest)} others"] * bool(rest),
        "others": bool(rest),  # the last row is a sum
        "values": [compact(value, 3) for value in values],
        "active": [np.round(each, 4).tolist() for each in active],
        "effective": compact(_averages(effective_number(weights), blocks), 3),
    }


def _averages(values: Floats, blocks: NDArray[np.intp]) -> Floats:
    """Means over consecutive days, along the first axis."""
    counts = np.diff(np.append(blocks, len(values)))
    sums = np.add.reduceat(values, blocks, axis=0)
    return np.asarray(sums / counts.reshape(-1, *[1] * (values.ndim - 1)))
