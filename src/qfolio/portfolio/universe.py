"""Orders in a changing universe: assets are listed and delisted, and may be members for a time."""

import dataclasses
from functools import lru_cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from qfolio.portfolio.mandate import checks
from qfolio.portfolio.mandate.feasible import Mandated
from qfolio.portfolio.mandate.limits import feasible

TINY = 1e-9


def spread(
    wanted: Float[Array, " entry"], there: Bool[Array, " asset"], long_only: bool
) -> Float[Array, " entry"]:
    """Moves the target weights of unavailable assets to the available ones, in proportion.

    This turns a policy over all assets into one over those that are available; cash is unchanged.
    Where weights may be negative, the weights of unavailable assets go to cash.
    """
    assets = wanted[1:]
    kept = jnp.where(there, assets, 0.0)
    if long_only:
        kept = kept * (assets.sum() / jnp.maximum(kept.sum(), TINY))
    rest = wanted[:1] + (assets - kept).sum(keepdims=True)
    return jnp.concatenate([rest, kept])


class Patterns(NamedTuple):
    """A mandate's limits where assets come and go, for each distinct set of available assets."""

    low: Any  # (pattern, asset)
    high: Any  # (pattern, asset)
    most: Any  # (pattern, limit), upper bounds of the mandate's linear limits
    of_row: Int[Any, " row"]  # the pattern of each row

    @staticmethod
    def of(mandate: str, tradable: np.ndarray, most: float) -> "tuple[Patterns, list[str]]":
        """The patterns of a table, in float64, and a text on each limit that is relaxed somewhere.

        Assets that are not available have weight 0. Floors and the maximum of cash that cannot be
        met then are relaxed by the smallest total amount; the texts say at how many rows.

        Args:
            mandate: Text of the mandate.
            tradable: Which assets may be bought at each row, of shape (row, asset).
            most: Largest weight of any asset, in addition to the mandate's caps.
        """
        return _patterns(mandate, tradable.tobytes(), tradable.shape, float(most))

    def in_float32(self) -> "Patterns":
        """The same limits in the precision of training."""
        low, high, most = (np.asarray(x, np.float32) for x in self[:3])
        return Patterns(low, high, most, self.of_row)

    def at(self, row: Any, allowed: Mandated) -> Mandated:
        """The weights allowed at a row, or at several."""
        which = self.of_row[row]
        limits = allowed.limits._replace(
            low=self.low[which], high=self.high[which], most=self.most[which]
        )
        return dataclasses.replace(allowed, limits=limits)


@lru_cache(8)
def _patterns(
    mandate: str, tradable: bytes, shape: tuple[int, int], most: float
) -> tuple[Patterns, list[str]]:
    every = np.frombuffer(tradable, bool).reshape(shape)
    distinct, of_row = np.unique(every, axis=0, return_inverse=True)
    of_row, found = of_row.reshape(-1), []
    yields: dict[str, int] = {}
    full = feasible(mandate, np.ones(shape[1], bool), most)  # all patterns share its linear limits
    for i, there in enumerate(distinct):
        low, high = (np.where(there, bound, 0.0) for bound in full.limits[:2])
        limits = full.limits._replace(low=low, high=high)
        made, lowered = checks.relaxed(dataclasses.replace(full, limits=limits))
        found.append((made.limits.low, made.limits.high, made.limits.most))
        for said in lowered:
            name = said.rpartition(" by ")[0]
            yields[name] = yields.get(name, 0) + int((of_row == i).sum())
    low, high, most_of_rows = (np.array(x) for x in zip(*found, strict=True))
    counts = [f"{name} at {count:,} of {shape[0]:,} rows" for name, count in yields.items()]
    return Patterns(low, high, most_of_rows, of_row.astype(np.int32)), counts
