"""Types for markets: an agent's observation, and the numbering of its discrete actions."""

from typing import NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from qfolio.core.mdp import Discrete

SEARCHED = "searched"
"""Name of what a market finds by a search that has no derivative, such as the limits that bind.

``jax.checkpoint`` can keep it, so that the backward pass need not search again.
"""


class View(NamedTuple):
    """An observation of a market: the features of each asset and the weights held.

    choices: the weights that each action of a menu of signals orders.
    """

    features: Float[Array, "*batch asset time channel"]
    holding: Float[Array, "*batch asset"]  # weights, without cash
    anchor: Float[Array, "*batch asset"] | None = None  # weights to depart from, if any
    choices: Float[Array, "*batch action asset"] | None = None


class MenuActions(Discrete):
    """Numbered actions; the first ``pooled`` concern the whole market.

    The others come in ``each`` blocks of one action per asset.
    """

    pooled: int = eqx.field(static=True, kw_only=True)
    each: int = eqx.field(static=True, kw_only=True)
