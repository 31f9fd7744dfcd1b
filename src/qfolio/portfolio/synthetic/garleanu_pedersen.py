"""Decaying signals with quadratic costs; ``solvers/garleanu_pedersen.py`` solves it."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from qfolio.core.fields import number, require, static
from qfolio.core.market import View
from qfolio.core.mdp import Box, Policy, Position
from qfolio.portfolio.synthetic.base import Synthetic
from qfolio.solvers.garleanu_pedersen import garleanu_pedersen


class Factor(NamedTuple):
    factor: Float[Array, ""]
    weight: Float[Array, ""]  # (1 − ρ)ᵗ


class GarleanuPedersen(Synthetic):
    """A position in one asset with a fading signal, quadratic risk and quadratic trading costs.

    Gârleanu & Pedersen (2013): the return is loading · f, f' = (1 − φ)f + ε; holding x costs
    ½γσ²x² of risk, a trade Δx costs ½λσ²Δx². Rewards include their discount, so that the return is
    the paper's objective.
    """

    loading: float = number(1.0)
    phi: float = number(0.25)
    noise: float = number(0.066)
    risk_aversion: float = number(1.0)
    cost_scale: float = number(5.0)
    variance: float = number(0.04)
    rho: float = number(0.01)
    horizon: int = static(300)

    def __check_init__(self) -> None:
        require(self, "phi", lambda x: 0 < x <= 1, "above 0 and at most 1")
        require(self, "rho", lambda x: 0 < x < 1, "above 0 and below 1")
        positive = "noise risk_aversion cost_scale variance"
        require(self, positive, lambda x: 1e-6 <= x <= 1e6, "from 1e-6 to 1e6")

    @property
    def actions(self) -> Box:
        return Box(1)

    @property
    def spread(self) -> Float[Array, ""] | float:
        """Standard deviation of the factor."""
        return self.noise / (1 - (1 - self.phi) ** 2) ** 0.5

    def reset_market(self, key: PRNGKeyArray) -> Factor:
        return Factor(self.spread * jax.random.normal(key), jnp.array(1.0))

    def next_market(self, market: Factor, key: PRNGKeyArray) -> Factor:
        factor = (1 - self.phi) * market.factor + self.noise * jax.random.normal(key)
        return Factor(factor, (1 - self.rho) * market.weight)

    def draw_holding(self, key: PRNGKeyArray) -> Float[Array, " asset"]:
        return jax.random.normal(key, (1,))

    def observe(self, state: Position) -> View:
        return View((state.market.factor / self.spread).reshape(1, 1, 1), state.holding)

    def settle(
        self, market: Factor, next_market: Factor, holding: Array, action: Array
    ) -> tuple[Float[Array, ""], Float[Array, " asset"]]:
        trade = action[0] - holding[0]
        cost = self.cost_scale * self.variance * trade**2 / 2
        risk = self.risk_aversion * self.variance * action[0] ** 2 / 2
        gain = self.loading * market.factor * action[0] - risk
        return market.weight * ((1 - self.rho) * gain - cost), action

    def best(self) -> Policy:
        of_position, of_factor, *_ = garleanu_pedersen(
            self.phi, self.risk_aversion, self.cost_scale, self.loading, self.variance, self.rho
        )
        return lambda state: of_position * state.holding + of_factor * state.market.factor

    def rule(self, policy: Policy) -> dict[str, float]:
        """Least-squares coefficients of the policy over two standard deviations."""
        x, f = np.meshgrid(np.linspace(-2, 2, 21), np.linspace(-2, 2, 21) * self.spread)
        points = np.column_stack([x.ravel(), f.ravel()]).astype(np.float32)
        at = lambda p: policy(Position(Factor(p[1], jnp.array(1.0)), p[:1]))[0]  # noqa: E731
        targets = np.asarray(jax.jit(jax.vmap(at))(jnp.asarray(points)))
        coefficients = np.linalg.lstsq(points, targets, rcond=None)[0]
        return {"of the position": float(coefficients[0]), "of the factor": float(coefficients[1])}

    def scenes(self) -> list[tuple[str, Any]]:
        values = (-1.0, 0.0, 1.0)
        names = [f"{k:+.0f} σ" if k else "0" for k in values]
        states = [Factor(jnp.array(k * self.spread), jnp.array(1.0)) for k in values]
        return list(zip(names, states, strict=True))
