"""Types for markets: an agent's observation, and the numbering of its discrete actions."""

from typing import NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from qfolio.core.mdp import Discrete

SEARCHED = "searched"
"""Name of results that a market finds by a search without a derivative, such as which limits bind.

``jax.checkpoint`` can keep them, so that the backward pass need not search again.
"""


class View(NamedTuple):
    """An observation of a market: the features of each asset and the weights held."""

    features: Float[Array, "*batch asset time channel"]
    holding: Float[Array, "*batch asset"]  # weights, without cash
    anchor: Float[Array, "*batch asset"] | None = None  # weights to depart from, if any
    choices: Float[Array, "*batch action asset"] | None = None  # weights that each action orders


class MenuActions(Discrete):
    """Numbered actions; the first ``pooled`` concern the whole market.

    The others come in ``each`` blocks of one action per asset.
    """

    pooled: int = eqx.field(static=True, kw_only=True)
    each: int = eqx.field(static=True, kw_only=True)
