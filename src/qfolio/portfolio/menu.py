"""Menus of allocations, for agents that choose among a few instead of giving weights."""

from math import comb
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from qfolio.core import simplex
from qfolio.core.errors import QfolioError
from qfolio.core.market import MenuActions
from qfolio.core.mdp import Discrete
from qfolio.learning.trading import RATE, Trading, ratio

MOST = 2000
"""Largest number of allocations of a menu."""

LARGEST = 30.0
"""Tilts are cut here, where one asset has nearly all of the weight, so that exp is finite."""


class Signalled(NamedTuple):
    """The anchor that a menu of signals tilts, and the signals."""

    anchor: Float[Array, " asset"]
    signals: Float[Array, "asset signal"]  # from −1 to 1 if they are ranks


class Menu(eqx.Module):
    """A menu of allocations: each mixes a share of the holding with a target.

    limits: largest weight of each asset; assets with 0 are left out of the equal weights.
    signals: number of signals. text: a kind and a size, such as

    - "grid:10": all weights in tenths;
    - "tilts:0.1": no order, all cash, equal weights, and for every asset all in it, and a tenth of
      the holding moved into it;
    - "overweight:0.1": no order, all cash, equal weights, and for every asset equal weights with a
      tenth of the wealth moved into it;
    - "signals:1": the fraction ``RATE`` of the way to a band around the anchor, and, for
      every signal, of the way to the anchor times exp(signal) or exp(−signal); each invests idle
      cash at once.
    """

    keep: Float[Array, " choice"] | None  # share of the holding
    target: Float[Array, "choice entry"] | None
    tilts: Float[Array, "choice signal"] | None  # instead of both
    actions: Discrete

    def __init__(self, text: str, limits: Float[Array, " asset"], signals: int = 0) -> None:
        kind, _, size = text.partition(":")
        assets = limits.shape[0]
        each = jnp.eye(assets + 1)[1:]
        open_to = jnp.append(0.0, limits > 0)
        cash, equal = jnp.eye(assets + 1)[:1], (open_to / open_to.sum())[None]
        keep = target = tilts = None
        try:
            value = float(size)
        except ValueError:
            value = -1.0
        if kind == "grid" and value >= 1 and value.is_integer():
            if comb(int(value) + assets, assets) > MOST:
                raise QfolioError(
                    f"menu={text} has more than {MOST:,} allocations of {assets} assets; "
                    "use a coarser grid, or menu=tilts:0.1."
                )
            target = jnp.asarray(simplex.grid(assets + 1, int(value)), jnp.float32)
            keep, self.actions = jnp.zeros(len(target)), Discrete(len(target))
        elif kind == "tilts" and 0 < value < 1:
            target = jnp.concatenate([cash, cash, equal, each, each])
            keep = jnp.zeros(len(target)).at[0].set(1.0).at[-assets:].set(1 - value)
            self.actions = MenuActions(len(target), pooled=3, each=2)
        elif kind == "overweight" and 0 < value < 1:
            target = jnp.concatenate([cash, cash, equal, (1 - value) * equal + value * each])
            keep = jnp.zeros(len(target)).at[0].set(1.0)
            self.actions = MenuActions(len(target), pooled=3, each=1)
        elif kind == "signals" and 0 < value <= 10:
            if not signals:
                raise QfolioError(
                    f"menu={text} tilts by signals; set some, such as signals=momentum:1y-1m."
                )
            one = jnp.eye(signals)
            tilts = value * jnp.concatenate([jnp.zeros((1, signals)), one, -one])
            self.actions = MenuActions(len(tilts), pooled=len(tilts), each=0)
        else:
            raise QfolioError(
                f"menu is {text!r}; it must be like grid:10, tilts:0.1, overweight:0.1 or "
                "signals:1."
            )
        self.keep, self.target, self.tilts = keep, target, tilts

    def weights(
        self,
        held: Float[Array, " entry"],
        choice: Int[Array, ""],
        signalled: Signalled | None = None,
    ) -> Float[Array, " entry"]:
        """The allocation of a choice, given the weights held; only signals need ``signalled``."""
        if self.tilts is None:
            assert self.keep is not None
            assert self.target is not None
            return self.keep[choice] * held + (1 - self.keep[choice]) * self.target[choice]
        assert signalled is not None
        assets, anchor = held[1:], signalled.anchor
        target = self.tilted(signalled, self.tilts[choice])
        # What ``Trading`` without a band orders; under a vmap over choices, few numbers for all.
        idle = anchor.sum() - assets.sum()
        kept = (1 - RATE) * (1 + ratio(jnp.minimum(idle, 0.0), assets.sum()))
        bought = RATE + (1 - RATE) * ratio(jnp.maximum(idle, 0.0), anchor.sum())
        towards = simplex.with_rest(kept * assets + bought * target[1:])
        stay = Trading.resting()(assets, simplex.with_rest(anchor), anchor)
        return jnp.where(choice == 0, stay, towards)

    @staticmethod
    def tilted(signalled: Signalled, tilt: Float[Array, " signal"]) -> Float[Array, " entry"]:
        """The anchor times exp(signals·tilt), with the anchor's sum."""
        anchor, signals = signalled.anchor, signalled.signals
        # What all assets share cancels, however large it is.
        signals = signals - ratio(anchor @ signals, anchor.sum())
        # The other order would give all choices' weights by asset, to be transposed.
        weights = anchor * jnp.exp(jnp.clip(tilt @ signals.T, -LARGEST, LARGEST))
        return simplex.with_rest(weights * ratio(anchor.sum(), weights.sum()))
