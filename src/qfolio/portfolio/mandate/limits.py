"""The limits of a mandate for a table's assets: as a text, and as arrays made from it."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import msgspec
import numpy as np
from jaxtyping import Bool, Float

from qfolio.core.errors import QfolioError
from qfolio.portfolio.mandate.feasible import Bound, Mandated
from qfolio.portfolio.mandate.mandate import Mandate
from qfolio.portfolio.mandate.projection import Limits


def mandate_text(given: Any, assets: Sequence[str]) -> str:
    """The text of a mandate.

    given: what ``Mandate.of`` takes, such a text, or nothing.
    """
    if not given:
        return ""
    if isinstance(given, str) and given.startswith("["):
        _, mandate = parse(given)
        return mandate.text(assets)
    return Mandate.of(given).text(assets)


@lru_cache(64)
def parse(text: str) -> tuple[list[str], Mandate]:
    """The assets and the mandate of a text. Raises QfolioError if the text is none."""
    try:
        return msgspec.json.decode(text, type=tuple[list[str], Mandate])
    except msgspec.MsgspecError as error:
        raise QfolioError(
            f"The setting mandate is not the text of a mandate ({error}); give a file or a "
            "dictionary to Portfolio.of."
        ) from None


def feasible(text: str, usable: Bool[np.ndarray, " asset"], most: float = 1.0) -> Mandated:
    """The set of weights that a mandate allows, in float64.

    usable: assets that can be traded; the others have weight 0, and no floor. most: the largest
    weight of each asset, beside its cap; 1 adds no cap if the mandate allows debts.
    """
    assets, mandate = parse(text)
    can = usable & ~np.isin(assets, mandate.assets.forbidden)
    cap = _by_asset(mandate.assets.cap, assets, 1.0)
    floor = _by_asset(mandate.assets.floor, assets, 0.0)
    long = mandate.cash.min >= 0 and bool(floor.min() >= 0)
    most = most if long or most < 1 else np.inf
    high, low = np.where(can, np.minimum(cap, most), 0.0), np.where(can, floor, 0.0)
    rows, limits, bounds = [], [], []

    def limit(row: np.ndarray, at_most: float, bound: Bound) -> None:
        rows.append(row)
        limits.append(at_most)
        bounds.append(bound)

    ones = np.ones(len(assets))
    limit(ones, 1 - mandate.cash.min, Bound("cash", "minimum"))
    if mandate.cash.max < 1 or floor.min() < 0:
        limit(-ones, mandate.cash.max - 1, Bound("cash", "maximum"))
    for column, value, group in mandate.every_group:
        members = 1.0 * np.isin(assets, group.assets)
        if group.cap is not None:
            limit(members, group.cap, Bound(f"{column} {value}", "cap"))
        if group.floor is not None:
            limit(-members, -group.floor, Bound(f"{column} {value}", "floor"))
    trading, exposure = mandate.trading, mandate.exposure.gross
    most_gross = float(np.maximum(abs(cap), abs(floor)).sum())
    return Mandated(
        Limits(
            low,
            high,
            np.array(rows),
            np.array(limits),
            np.array(exposure or np.inf),
            np.array(trading.turnover or np.inf),
        ),
        tuple(bounds),
        trading.holdings or 0,
        trading.smallest_trade,
        1.0 if long else min(exposure or most_gross, most_gross),
        long,
        mandate.risk.volatility or np.inf,
        mandate.risk.tracking_error or np.inf,
    )


def buyable(text: str) -> Bool[np.ndarray, " asset"]:
    """The assets of which a mandate allows a weight above 0."""
    return feasible(text, np.ones(len(parse(text)[0]), bool)).buyable


def lots(text: str) -> Float[np.ndarray, " asset"] | None:
    """Shares of each asset that are traded together (default: 1); None if there is no such rule."""
    if not text or (lot := parse(text)[1].trading.lot) is None:
        return None
    return _by_asset(lot, parse(text)[0], 1.0)


def largest_weight(text: str) -> float:
    """The highest cap of an asset, at most 1, for those that neither borrow nor sell short."""
    assets, mandate = parse(text)
    return min(1.0, float(_by_asset(mandate.assets.cap, assets, 1.0).max()))


def reach(text: str, most: float = 1.0) -> float:
    """The largest size of an asset's weight, of either sign; most: as for ``feasible``."""
    low, high, *_ = feasible(text, np.ones(len(parse(text)[0]), bool), most).limits
    return float(abs(np.array([low, high])).max())


def _by_asset(given: float | dict[str, float], assets: Sequence[str], default: float) -> np.ndarray:
    if isinstance(given, dict):
        return np.array([given.get(name, default) for name in assets])
    return np.full(len(assets), given)
