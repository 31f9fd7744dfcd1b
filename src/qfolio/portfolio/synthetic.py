"""Markets whose best policy is known exactly, to grade agents against.

Each is a task with parameters of its own; ``qfolio.solvers.markets`` solves it. ``rule`` reads the
few numbers that say what a policy does (a fraction, the edges of a no-trade region, a trading
rate), so that a learned policy can be set beside the exact one.
"""

import abc
import dataclasses
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from qfolio.core.errors import QfolioError
from qfolio.core.fields import constant, number, require, static
from qfolio.core.mdp import Box, ExogenousTask, Policy, Position, View
from qfolio.portfolio.costs import drift, remainder_factor
from qfolio.portfolio.market import Holding, Market, Relatives
from qfolio.solvers.ar1 import ar1
from qfolio.solvers.garleanu_pedersen import garleanu_pedersen
from qfolio.solvers.kelly import kelly
from qfolio.solvers.merton import growth_optimal
from qfolio.solvers.no_trade import NoTradeRegion, no_trade_region_discrete
from qfolio.solvers.regime import regime
from qfolio.solvers.followed import FollowedOptimum


class Synthetic(ExogenousTask):
    """A market with a known best policy: from a state to target weights, or to a position."""

    def __check_init__(self) -> None:
        require(self, "horizon", lambda x: 1 <= x <= 100_000, "from 1 to 100,000")

    @abc.abstractmethod
    def best(self) -> Policy:
        """The exact policy."""

    @abc.abstractmethod
    def scenes(self) -> list[tuple[str, Any]]:
        """Market states to draw a policy in, with what to call them."""

    def optimum(self) -> FollowedOptimum:
        continuous = dataclasses.replace(self, menu="") if hasattr(self, "menu") else self
        return FollowedOptimum(continuous, self.best())


def _require_cost(task: Any) -> None:
    require(task, "cost", lambda x: 0 <= x <= 0.2, "from 0 to 0.2")


class OneAsset(Market, Synthetic):
    """Cash and one asset."""

    @property
    def limits(self) -> Float[Array, " asset"]:
        return jnp.ones(1)

    def weight(self, policy: Policy, market: Any, weight: float) -> float:
        """The asset's target weight for a holder of ``weight``."""
        held = jnp.array([1 - weight, weight], jnp.float32)
        return float(policy(Position(market, self.hold(held)))[1])


class Kelly(OneAsset):
    """A bet, repeated: the stake becomes ``up`` times itself with ``probability`` or ``down``."""

    up: float = number(1.1)
    down: float = number(0.9)
    probability: float = number(0.53)
    menu: str = static("")
    horizon: int = static(100)

    cost = 0.0

    def __check_init__(self) -> None:
        require(self, "up", lambda x: 1 < x <= 100, "above 1 and at most 100")
        require(self, "down", lambda x: 0.01 <= x < 1, "at least 0.01 and below 1")
        require(self, "probability", lambda x: 0 < x < 1, "between 0 and 1")

    def reset_market(self, key: PRNGKeyArray) -> Float[Array, ""]:
        return jnp.array(1.0)

    def next_market(self, market: Array, key: PRNGKeyArray) -> Float[Array, ""]:
        return jnp.where(jax.random.uniform(key) < self.probability, self.up, self.down)

    def features(self, market: Array) -> Float[Array, "asset time channel"]:
        return jnp.ones((1, 1, 1))

    def relatives(self, market: Array, next_market: Array) -> Relatives:
        return Relatives(jnp.ones(1), next_market[None], next_market[None])

    def best(self) -> Policy:
        fraction, _ = kelly(self.up, self.down, self.probability)
        return lambda state: jnp.array([1 - fraction, fraction], jnp.float32)

    def rule(self, policy: Policy) -> dict[str, float]:
        return {"fraction": self.weight(policy, jnp.array(1.0), 0.5)}

    def scenes(self) -> list[tuple[str, Any]]:
        return [("at any time", jnp.array(1.0))]


class Merton(Market, Synthetic):
    """Three assets whose returns are drawn from a fixed set of log-normal scenarios, with cash.

    The best weights maximise E log(b·x) over the simplex (Merton 1969; with the constraint, the
    conditions of Cover 1984); one asset is not worth holding.
    """

    menu: str = static("")
    horizon: int = static(100)

    cost = 0.0
    means = (0.010, 0.006, 0.001)
    volatilities = (0.12, 0.08, 0.10)
    correlation = 0.3
    scenarios = 500

    @property
    def limits(self) -> Float[Array, " asset"]:
        return jnp.ones(3)

    @staticmethod
    @cache
    def table() -> np.ndarray:
        """Relatives of each scenario, shape (scenario, asset), with just the moments stated."""
        normal = np.random.default_rng(1969).standard_normal((Merton.scenarios, 3))
        normal -= normal.mean(0)
        normal = np.linalg.solve(np.linalg.cholesky(np.cov(normal.T)), normal.T)
        sigma = np.array(Merton.volatilities)
        correlations = np.full((3, 3), Merton.correlation) + (1 - Merton.correlation) * np.eye(3)
        shocks = np.linalg.cholesky(correlations) @ normal * sigma[:, None]
        return np.exp(np.array(Merton.means) - sigma**2 / 2 + shocks.T)

    def reset_market(self, key: PRNGKeyArray) -> Int[Array, ""]:
        return jnp.array(0, jnp.int32)

    def next_market(self, market: Array, key: PRNGKeyArray) -> Int[Array, ""]:
        return jax.random.randint(key, (), 0, self.scenarios, jnp.int32)

    def features(self, market: Array) -> Float[Array, "asset time channel"]:
        return jnp.eye(3)[:, None, :]  # which asset it is: nothing else tells them apart

    def relatives(self, market: Array, next_market: Array) -> Relatives:
        moved = jnp.asarray(self.table(), jnp.float32)[next_market]
        return Relatives(jnp.ones(3), moved, moved)

    def best(self) -> Policy:
        scenarios = np.column_stack([np.ones(self.scenarios), self.table()])
        weights = jnp.asarray(growth_optimal(scenarios).weights, jnp.float32)
        return lambda state: weights

    def rule(self, policy: Policy) -> dict[str, float]:
        state = Position(jnp.array(0), self.hold(jnp.full(4, 0.25)))
        weights = policy(state)
        return {f"weight of asset {i}": float(weights[i]) for i in (1, 2, 3)}

    def scenes(self) -> list[tuple[str, Any]]:
        return []


class Regime(OneAsset):
    """One asset that grows by ``mean`` a step in good times and loses it in bad ones.

    Each regime lasts another step with probability ``stay``; it is seen, and earns at once.
    """

    stay: float = number(0.95)
    mean: float = number(0.002)
    cost: float = constant(0.005)
    menu: str = static("")
    horizon: int = static(250)

    def __check_init__(self) -> None:
        require(self, "stay", lambda x: 0 <= x < 1, "at least 0 and below 1")
        require(self, "mean", lambda x: 0 < x <= 0.5, "above 0 and at most 0.5")
        _require_cost(self)

    def reset_market(self, key: PRNGKeyArray) -> Int[Array, ""]:
        return jax.random.bernoulli(key).astype(jnp.int32)

    def next_market(self, market: Array, key: PRNGKeyArray) -> Int[Array, ""]:
        return jnp.where(jax.random.uniform(key) < self.stay, market, 1 - market)

    def features(self, market: Array) -> Float[Array, "asset time channel"]:
        return (2.0 * market - 1.0).reshape(1, 1, 1)

    def relatives(self, market: Array, next_market: Array) -> Relatives:
        moved = jnp.exp(self.mean * (2.0 * market - 1.0))[None]
        return Relatives(jnp.ones(1), moved, moved)

    def best(self) -> Policy:
        solution = regime(
            (self.stay, self.stay), (-self.mean, self.mean), -np.log1p(-self.cost)
        )
        table = jnp.asarray(solution.policy)

        def policy(state: Position) -> Array:
            # Costs and rewards are linear in the weight: each part of it is a position by itself.
            enters, stays = table[state.market, 0], table[state.market, 1]
            weight = state.holding.weights[1]
            weight = stays * weight + enters * (1 - weight)
            return jnp.stack([1 - weight, weight])

        return policy

    def rule(self, policy: Policy) -> dict[str, float]:
        return {
            f"from {held} in {name} times": self.weight(policy, market, held)
            for name, market in self.scenes()
            for held in (0.0, 1.0)
        }

    def scenes(self) -> list[tuple[str, Any]]:
        return [("bad", jnp.array(0, jnp.int32)), ("good", jnp.array(1, jnp.int32))]


class Ar1Market(NamedTuple):
    signal: Float[Array, ""]
    relative: Float[Array, ""]  # of the step that led here


class Ar1(OneAsset):
    """One asset whose mean return follows a signal: x' = ρx + noise ε, r = drift + slope·x + ση."""

    rho: float = number(0.95)
    noise: float = number(0.3122)
    drift: float = number(0.0002)
    slope: float = number(0.004)
    volatility: float = number(0.01)
    cost: float = constant(0.002)
    menu: str = static("")
    horizon: int = static(252)

    levels = 11
    optimum_discount = 0.97

    def __check_init__(self) -> None:
        require(self, "rho", lambda x: 0 <= x <= 0.999, "from 0 to 0.999")
        require(self, "noise volatility", lambda x: 0 < x <= 10, "above 0 and at most 10")
        _require_cost(self)
        # Five standard deviations of the signal and of the return must leave something.
        worst = abs(self.drift) + 5 * abs(self.slope) * self.spread + 5 * self.volatility
        if worst >= 1:
            raise QfolioError(
                "Returns below −100 % are too likely; lower slope, noise, rho or volatility."
            )

    @property
    def spread(self) -> float:
        """Standard deviation of the signal."""
        return self.noise / (1 - self.rho**2) ** 0.5

    def reset_market(self, key: PRNGKeyArray) -> Ar1Market:
        return Ar1Market(self.spread * jax.random.normal(key), jnp.array(1.0))

    def next_market(self, market: Ar1Market, key: PRNGKeyArray) -> Ar1Market:
        shocks = jax.random.normal(key, (2,))
        gain = self.drift + self.slope * market.signal + self.volatility * shocks[1]
        return Ar1Market(self.rho * market.signal + self.noise * shocks[0], 1 + gain)

    def features(self, market: Ar1Market) -> Float[Array, "asset time channel"]:
        return (market.signal / self.spread).reshape(1, 1, 1)

    def relatives(self, market: Ar1Market, next_market: Ar1Market) -> Relatives:
        moved = next_market.relative[None]
        return Relatives(jnp.ones(1), moved, moved)

    def best(self) -> Policy:
        levels = np.linspace(0, 1, self.levels)
        solution = ar1(
            self.rho, self.noise, self.drift, self.slope, self.volatility, self.cost, levels,
            self.optimum_discount,
        )  # fmt: skip
        weights = jnp.asarray(levels, jnp.float32)
        signals = jnp.asarray(solution.signals, jnp.float32)
        after = jnp.asarray(solution.after, jnp.float32)
        choices = jnp.stack([1 - weights, weights], -1)

        def policy(state: Position) -> Array:
            at = lambda column: jnp.interp(state.market.signal, signals, column)  # noqa: E731
            later = jax.vmap(at, 1)(after)
            held = jnp.broadcast_to(state.holding.weights, choices.shape)
            remainder = remainder_factor(held, choices, self.cost)
            return choices[(jnp.log(remainder) + later).argmax()]

        return policy

    def rule(self, policy: Policy) -> dict[str, float]:
        return {
            f"from {held:.0%} at signal {name}": self.weight(policy, market, held)
            for name, market in self.scenes()
            for held in (0.0, 0.5, 1.0)
        }

    def scenes(self) -> list[tuple[str, Any]]:
        states = [(f"{x:+.1f}", x) for x in (-0.6, -0.2, 0.2, 0.6)]
        return [(name, Ar1Market(jnp.array(x * self.spread), jnp.array(1.0))) for name, x in states]


class NoTrade(OneAsset):
    """One asset with constant drift over cash; proportional costs make it best not to trade within
    a region. The reward is the *expected* log growth of each step, net of costs.

    Rates are a year; ``dt`` years pass in a step.
    """

    rate: float = number(0.02)
    volatility: float = number(0.2)
    cost: float = constant(0.01)
    dt: float = number(1 / 12)
    menu: str = static("")
    horizon: int = static(480)

    NODES = 5

    def __check_init__(self) -> None:
        require(self, "volatility", lambda x: 0.01 <= x <= 2, "from 0.01 to 2")
        require(self, "dt", lambda x: 0.001 <= x <= 1, "from 0.001 to 1 years")
        _require_cost(self)
        if not 0.01 <= self.rate / self.volatility**2 <= 0.99:
            raise QfolioError(
                f"The best weight without costs is {self.rate / self.volatility**2:.3g}; rate and "
                "volatility must leave it between 0.01 and 0.99."
            )

    def reset_market(self, key: PRNGKeyArray) -> Float[Array, ""]:
        return jnp.array(0.0)

    def next_market(self, market: Array, key: PRNGKeyArray) -> Float[Array, ""]:
        return self._log_relative(jax.random.normal(key))

    def _log_relative(self, shock: Array) -> Array:
        mean = (self.rate - self.volatility**2 / 2) * self.dt
        return mean + self.volatility * self.dt**0.5 * shock

    def features(self, market: Array) -> Float[Array, "asset time channel"]:
        return jnp.ones((1, 1, 1))

    def relatives(self, market: Array, next_market: Array) -> Relatives:
        moved = jnp.exp(next_market)[None]
        return Relatives(jnp.ones(1), moved, moved)

    def settle(
        self, market: Array, next_market: Array, holding: Holding, action: Array
    ) -> tuple[Float[Array, ""], Holding]:
        target = self.target(holding.weights, action)
        remainder = remainder_factor(holding.weights, target, self.cost)
        nodes, chances = np.polynomial.hermite_e.hermegauss(self.NODES)
        gains = jnp.expm1(self._log_relative(jnp.asarray(nodes, jnp.float32)))
        weights = jnp.asarray(chances / chances.sum(), jnp.float32)
        growth = (weights * jnp.log1p(target[1] * gains)).sum()
        moved = jnp.exp(next_market)[None]
        return jnp.log(remainder) + growth, self.hold(drift(target, moved))

    def region(self) -> NoTradeRegion:
        """The exact region, for steps of ``dt``."""
        return no_trade_region_discrete(self.rate, self.volatility, self.cost, self.dt)

    def best(self) -> Policy:
        low, high, _ = self.region()

        def policy(state: Position) -> Array:
            weight = jnp.clip(state.holding.weights[1], low, high)
            return jnp.stack([1 - weight, weight])

        return policy

    def rule(self, policy: Policy) -> dict[str, float]:
        """The edges: where a holder of too little, and of too much, stops trading."""
        quiet = jnp.array(0.0)
        return {"low": self.weight(policy, quiet, 0.1), "high": self.weight(policy, quiet, 0.9)}

    def scenes(self) -> list[tuple[str, Any]]:
        return [("at any time", jnp.array(0.0))]


class Factor(NamedTuple):
    factor: Float[Array, ""]
    weight: Float[Array, ""]  # (1 − ρ)ᵗ


class GarleanuPedersen(Synthetic):
    """A position in one asset with a fading signal, quadratic risk and quadratic trading costs.

    Gârleanu & Pedersen (2013): the return is loading · f, f' = (1 − φ)f + ε; holding x costs
    ½γσ²x² of risk, a trade Δx costs ½λσ²Δx². Rewards come weighted by their discount, so that a
    return is the paper's objective.
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
        require(self, "rho", lambda x: 0 < x < 1, "between 0 and 1")
        positive = "noise risk_aversion cost_scale variance"
        require(self, positive, lambda x: 1e-6 <= x <= 1e6, "from 1e-6 to 1e6")

    @property
    def actions(self) -> Box:
        return Box(1)

    @property
    def spread(self) -> float:
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
