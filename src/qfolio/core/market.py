"""The vocabulary of markets: what an agent may see of one, and how it numbers its choices."""

from typing import NamedTuple

import equinox as eqx
from jaxtyping import Array, Float

from qfolio.core.mdp import Discrete


class View(NamedTuple):
    """What an agent may see of a market: what is known of each asset, and what it holds."""

    features: Float[Array, "*batch asset time channel"]
    holding: Float[Array, "*batch asset"]  # weights, without cash


class MenuActions(Discrete):
    """Numbered choices, of which the first ``pooled`` concern the whole market.

    The others come in ``each`` blocks of one choice per asset.
    """

    pooled: int = eqx.field(static=True, kw_only=True)
    each: int = eqx.field(static=True, kw_only=True)
