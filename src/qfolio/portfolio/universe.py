"""Orders in a universe in motion, whose assets are listed, delisted, and members for a time."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from qfolio.core.errors import QfolioError
from qfolio.portfolio.mandate.feasible import CappedSimplex

TINY = 1e-9


def require_support(mandate: str, menu: str) -> None:
    """Raises QfolioError for a setting of the task that needs all assets at every row."""
    grid = menu and not menu.startswith("signals")
    found = "a mandate" if mandate else f"menu={menu}" if grid else ""
    if found:
        raise QfolioError(
            f"The assets of this table come and go, and {found} needs all of them at every row; "
            "leave it out, or read the table without ended=cash-out and members."
        )


class Present(CappedSimplex):
    """Weights of the assets that are there, those with a limit above 0."""

    def project(
        self, wanted: Float[Array, " entry"], held: Float[Array, " entry"]
    ) -> Float[Array, " entry"]:
        """What is wanted of the others goes to those that are there, in proportion.

        A policy over all assets so becomes one over those that are there; cash stays as it is.
        """
        assets = wanted[1:]
        kept = jnp.where(self.limits > 0, assets, 0.0)
        kept = kept * (assets.sum() / jnp.maximum(kept.sum(), TINY))
        rest = wanted[:1] + (assets - kept).sum(keepdims=True)
        return super().project(jnp.concatenate([rest, kept]), held)
