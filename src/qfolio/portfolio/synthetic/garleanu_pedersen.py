"""Decaying signals with quadratic costs; ``solvers/garleanu_pedersen.py`` solves it."""

import abc
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


class Factors(NamedTuple):
    """The factors, and the discount of the current step."""

    factors: Float[Array, " factor"]
    weight: Float[Array, ""]  # (1 − ρ)ᵗ


class Tables(NamedTuple):
    """The parameters of a market of several assets and factors, named as in the solver."""

    phi: Float[Any, " factor"]
    loading: Float[Any, "asset factor"]
    noise: Float[Any, " factor"]  # standard deviations of independent ε
    covariance: Float[Any, "asset asset"]
    cost: Float[Any, "asset asset"]

    @property
    def spread(self) -> Float[Any, " factor"]:
        """Standard deviation of each factor."""
        return self.noise / (1 - (1 - self.phi) ** 2) ** 0.5


class QuadraticCosts(Synthetic):
    """Positions in assets with decaying signals, quadratic risk and quadratic trading costs.

    Gârleanu & Pedersen (2013): mean returns are B f, with f' = (1 − φ)f + ε; a position x costs
    ½γ x'Σx for its risk, and a trade Δx costs ½Δx'ΛΔx. Rewards include their discount, so that
    their sum is the paper's objective.
    """

    risk_aversion: float = number(1.0)  # γ: price of variance
    rho: float = number(0.01)  # discount rate, per step
    horizon: int = static(300)  # steps of an episode

    def __check_init__(self) -> None:
        require(self, "rho", lambda x: 0 < x < 1, "above 0 and below 1")
        require(self, "risk_aversion", lambda x: 1e-6 <= x <= 1e6, "from 1e-6 to 1e6")

    @property
    @abc.abstractmethod
    def tables(self) -> Tables:
        """The market's parameters."""

    @property
    def actions(self) -> Box:
        return Box(len(self.tables.loading))

    def reset_market(self, key: PRNGKeyArray) -> Factors:
        spread = jnp.asarray(self.tables.spread)
        return Factors(spread * jax.random.normal(key, spread.shape), jnp.array(1.0))

    def next_market(self, market: Factors, key: PRNGKeyArray) -> Factors:
        shocks = jax.random.normal(key, market.factors.shape)
        factors = (1 - self.tables.phi) * market.factors + self.tables.noise * shocks
        return Factors(factors, (1 - self.rho) * market.weight)

    def draw_holding(self, key: PRNGKeyArray) -> Float[Array, " asset"]:
        return jax.random.normal(key, (self.actions.n,))

    def observe(self, state: Position) -> View:
        # Each asset has channels of its own, so that a network shared by all can tell them apart.
        scaled = state.market.factors / self.tables.spread
        blocks = jnp.einsum("ij,k->ijk", jnp.eye(self.actions.n), scaled)
        return View(blocks.reshape(self.actions.n, 1, -1), state.holding)

    def settle(
        self, market: Factors, next_market: Factors, holding: Array, action: Array
    ) -> tuple[Float[Array, ""], Float[Array, " asset"]]:
        tables, trade = self.tables, action - holding
        cost = trade @ jnp.asarray(tables.cost) @ trade / 2
        risk = self.risk_aversion * action @ jnp.asarray(tables.covariance) @ action / 2
        gain = action @ jnp.asarray(tables.loading) @ market.factors - risk
        return market.weight * ((1 - self.rho) * gain - cost), action

    def best(self) -> Policy:
        phi, loading, _, covariance, cost = self.tables
        rule = garleanu_pedersen(phi, self.risk_aversion, cost, loading, covariance, self.rho)
        previous, factors = (jnp.asarray(x, jnp.float32) for x in rule[:2])
        return lambda state: previous @ state.holding + factors @ state.market.factors

    def coefficients(self, policy: Policy) -> Float[np.ndarray, "asset entry"]:
        """Least-squares coefficients of a policy in positions and factors.

        They are fitted to positions from −2 to 2, and factors within two standard deviations.
        """
        n, spread = self.actions.n, np.asarray(self.tables.spread)
        points = np.random.default_rng(2013).uniform(-2, 2, (500, n + len(spread)))
        points[:, n:] *= spread
        one = jnp.array(1.0)
        at = lambda p: policy(Position(Factors(p[n:], one), p[:n]))  # noqa: E731
        targets = np.asarray(jax.jit(jax.vmap(at))(jnp.asarray(points, jnp.float32)))
        return np.linalg.lstsq(points, targets, rcond=None)[0].T

    def scenes(self) -> list[tuple[str, Any]]:
        """The first factor at its mean and a standard deviation either side; the others at 0."""
        values = (-1.0, 0.0, 1.0)
        names = [f"{k:+.0f} σ" if k else "0" for k in values]
        first = np.eye(len(self.tables.phi))[0] * self.tables.spread
        states = [Factors(jnp.asarray(k * first, jnp.float32), jnp.array(1.0)) for k in values]
        return list(zip(names, states, strict=True))


class GarleanuPedersen(QuadraticCosts):
    """One asset and one signal; costs are ``cost_scale`` times the variance."""

    loading: float = number(1.0)  # mean return for a factor of 1
    phi: float = number(0.25)  # share of the factor that decays in a step
    noise: float = number(0.066)  # standard deviation of the factor's shocks, per step
    cost_scale: float = number(5.0)  # trading cost Λ, as a multiple of the variance
    variance: float = number(0.04)  # variance of the return, per step

    def __check_init__(self) -> None:
        require(self, "loading", lambda x: -1e6 <= x <= 1e6, "from -1e6 to 1e6")
        # Of a smaller one, float32 could not tell the factor's spread.
        require(self, "phi", lambda x: 1e-5 <= x <= 1, "from 1e-5 to 1")
        require(self, "noise cost_scale variance", lambda x: 1e-6 <= x <= 1e6, "from 1e-6 to 1e6")

    @property
    def tables(self) -> Tables:
        table = lambda x: jnp.reshape(x, (1, 1))  # noqa: E731
        phi, noise = jnp.reshape(self.phi, (1,)), jnp.reshape(self.noise, (1,))
        cost = self.cost_scale * self.variance
        return Tables(phi, table(self.loading), noise, table(self.variance), table(cost))

    def rule(self, policy: Policy) -> dict[str, float]:
        of_position, of_factor = self.coefficients(policy)[0]
        return {"of the position": float(of_position), "of the factor": float(of_factor)}


class Signals(QuadraticCosts):
    """Three assets that differ in liquidity, and four signals that decay at different rates.

    The costs are not proportional to the covariance, so that no two portfolios of the assets are
    traded equally fast, and a position in one asset depends on those in the others.
    """

    cost_scale: float = number(1.0)  # factor on all costs

    def __check_init__(self) -> None:
        require(self, "cost_scale", lambda x: 1e-6 <= x <= 1e6, "from 1e-6 to 1e6")

    @property
    def tables(self) -> Tables:
        volatility = np.array([0.2, 0.15, 0.3])
        correlation = np.array([[1.0, 0.5, 0.3], [0.5, 1.0, 0.1], [0.3, 0.1, 1.0]])
        loading = np.array([[1.0, 0.0, 0.5, 0.3], [0.5, -0.5, 0.0, 0.4], [0.0, 1.0, -0.8, 0.5]])
        return Tables(
            phi=np.array([0.05, 0.15, 0.4, 0.8]),
            loading=loading,
            noise=np.array([0.03, 0.05, 0.1, 0.15]),
            covariance=correlation * np.outer(volatility, volatility),
            cost=self.cost_scale * np.diag([0.1, 0.2, 1.0]),
        )

    def rule(self, policy: Policy) -> dict[str, float]:
        coefficients = self.coefficients(policy)
        columns = [f"position {i}" for i in (1, 2, 3)] + [f"factor {k}" for k in (1, 2, 3, 4)]
        return {
            f"{i + 1}: of {column}": float(coefficients[i, j])
            for i in range(3)
            for j, column in enumerate(columns)
        }
