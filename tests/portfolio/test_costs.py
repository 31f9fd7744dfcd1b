"""The cost model against its equation, on numpy and on jax."""

from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.core.mdp import Position
from qfolio.portfolio.backtest.simulation import simulate
from qfolio.portfolio.costs import (
    CostModel,
    Proportional,
    drift,
    newton_steps,
    remainder_factor,
    traded,
    with_cash,
)
from qfolio.portfolio.task import Portfolio

from tables import price_table, random_walk

COSTS = (0.0, 0.0001, 0.001, 0.0025, 0.01, 0.05, 0.2)


def weights(seed: int, *shape: int, holes: bool = True) -> np.ndarray:
    """Random weights, a third of them zero."""
    generator = np.random.default_rng(seed)
    raw = generator.gamma(0.7, size=shape)
    if holes:
        raw *= generator.random(shape) > 1 / 3
    raw[..., 0] += 1e-3  # never all zero
    return raw / raw.sum(-1, keepdims=True)


def left_over(
    remainder: np.ndarray, before: np.ndarray, after: np.ndarray, cost: float
) -> np.ndarray:
    """Cash after the trade minus what should be there: zero at the remainder factor."""
    change = remainder[..., None] * after[..., 1:] - before[..., 1:]
    sold, bought = np.maximum(-change, 0).sum(-1), np.maximum(change, 0).sum(-1)
    return before[..., 0] + (1 - cost) * sold - bought / (1 - cost) - remainder * after[..., 0]


def by_bisection(before: np.ndarray, after: np.ndarray, cost: float) -> np.ndarray:
    low, high = np.zeros(before.shape[:-1]), np.ones(before.shape[:-1])
    for _ in range(60):
        middle = (low + high) / 2
        too_low = left_over(middle, before, after, cost) > 0
        low, high = np.where(too_low, middle, low), np.where(too_low, high, middle)
    return (low + high) / 2


def slow_case(cost: float, turning: int, decay: float) -> tuple[np.ndarray, np.ndarray, float]:
    """A trade that keeps Newton busy, and its remainder factor.

    Everything in one asset goes to another and to as many more as are said to turn, of which
    nearly enough is held already: each looks bought until the step that brings mu below it.
    """
    share = 1 / (turning + 1)
    remainder = 1 / (turning * share + share / (1 - cost) ** 2)
    spread = 1 / (1 - cost) - (1 - cost)
    ratio = decay * spread * share / (1 - cost + spread * share)
    distance = 0.999 * (1 - remainder) * ratio ** np.arange(turning)
    before = np.array([0, 0, 0, *(share * (remainder + distance))])
    before[1] = 1 - before.sum()  # with this, no cash is left over at the remainder factor
    return before, np.array([0, 0, share, *[share] * turning]), remainder


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0], 0.9975),
        ([0.0, 1.0, 0.0], [1.0, 0.0, 0.0], 0.9975),
        ([0.0, 1.0, 0.0], [0.0, 0.0, 1.0], 0.99500625),
    ],
)
def test_whole_wealth_moves(before: list[float], after: list[float], expected: float) -> None:
    held, wanted = np.array(before), np.array(after)
    remainder = remainder_factor(held, wanted, 0.0025)
    assert remainder == pytest.approx(expected, abs=1e-15)
    sold, bought = 1 - held[0], remainder * (1 - wanted[0])
    assert traded(held, wanted, remainder) == pytest.approx(sold + bought, abs=1e-15)


def test_hand_computed_trade() -> None:
    # 100 in A, 100 in cash, to 30% A, 50% B, 20% cash at 10%: of a wealth of 200·mu is
    # 60·mu in A, so 100 − 60·mu is sold; 100·mu is bought for 100·mu/.9; cash is left 40·mu:
    # 100 + .9(100 − 60·mu) − 100·mu/.9 = 40·mu, so mu = 190/(40 + 54 + 111.11…).
    remainder = remainder_factor(np.array([0.5, 0.5, 0.0]), np.array([0.2, 0.3, 0.5]), 0.1)
    assert remainder == pytest.approx(190 / (94 + 1000 / 9), abs=1e-15)


@pytest.mark.parametrize("cost", COSTS)
@pytest.mark.parametrize("assets", [1, 2, 7, 30])
def test_agrees_with_bisection(assets: int, cost: float) -> None:
    before, after = weights(assets, 400, assets + 1), weights(assets + 99, 400, assets + 1)
    before[:100] = 0.999 * after[:100] + 0.001 * before[:100]  # many a ratio near 1
    before, after = np.vstack([before, after]), np.vstack([after, before])
    np.testing.assert_allclose(
        remainder_factor(before, after, cost), by_bisection(before, after, cost), rtol=0, atol=1e-15
    )


@pytest.mark.parametrize("cost", COSTS[1:])
@pytest.mark.parametrize("decay", [0.7, 0.92, 0.98])
@pytest.mark.parametrize("turning", [1, 3, 5, 8, 10, 12])
def test_steps_suffice_where_newton_is_slow(turning: int, decay: float, cost: float) -> None:
    before, after, remainder = slow_case(cost, turning, decay)
    assert remainder_factor(before, after, cost) == pytest.approx(remainder, abs=3e-16)
    short = remainder_factor(before.astype(np.float32), after.astype(np.float32), cost)
    assert short == pytest.approx(remainder, abs=2e-7)


def test_slow_cases_are_slow() -> None:
    before, after, remainder = slow_case(0.2, 8, 0.7)
    few = remainder_factor(before, after, np.array(0.2), highest=0.0025)  # a false promise
    assert few > remainder + 1e-9
    assert newton_steps(10, 0.0025, np.float64) == 5


def test_number_of_steps() -> None:
    assert [newton_steps(20, c, np.float32) for c in (0.0, 0.001, 0.01, 0.2)] == [1, 2, 3, 7]
    assert [newton_steps(20, c, np.float64) for c in (0.0, 0.001, 0.01, 0.2)] == [1, 5, 6, 12]
    assert [newton_steps(n, 0.2, np.float64) for n in (1, 2, 5)] == [1, 2, 5]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_no_trade_and_no_cost_are_free_to_the_last_bit(dtype: type[np.floating]) -> None:
    before, after = weights(1, 500, 21).astype(dtype), weights(2, 500, 21).astype(dtype)
    for kind in (np.asarray, jnp.asarray):
        held, wanted = kind(before), kind(after)
        assert (remainder_factor(held, held, 0.01) == 1).all()
        assert (traded(held, held, remainder_factor(held, held, 0.01)) == 0).all()
        assert (remainder_factor(held, wanted, 0.0) == 1).all()
        assert (remainder_factor(held, wanted, 0.01) < 1).all()


def test_order_of_assets_does_not_matter() -> None:
    before, after = weights(3, 50, 9), weights(4, 50, 9)
    order = np.append(0, np.random.default_rng(5).permutation(8) + 1)
    np.testing.assert_allclose(
        remainder_factor(before[:, order], after[:, order], 0.02),
        remainder_factor(before, after, 0.02),
        rtol=1e-15,
    )


def test_costs_differ_by_row() -> None:
    before, after = weights(6, 3, 4, 8), weights(7, 3, 4, 8)
    cost = np.array([[0.0], [0.01], [0.1]])
    together = remainder_factor(before, after, cost)
    for row, c in enumerate(cost[:, 0]):
        np.testing.assert_allclose(
            together[row], remainder_factor(before[row], after[row], float(c)), rtol=1e-15
        )


def test_jax_compiled_and_mapped_equals_numpy() -> None:
    before, after = weights(8, 6, 5, 11), weights(9, 6, 5, 11)
    cost = np.linspace(0, 0.2, 6)
    expected = remainder_factor(before, after, cost[:, None])
    mapped = jax.jit(jax.vmap(remainder_factor))
    with jax.enable_x64(True):
        found = mapped(jnp.asarray(before), jnp.asarray(after), jnp.asarray(cost))
        assert found.dtype == jnp.float64
        np.testing.assert_allclose(found, expected, rtol=1e-15)
    short = mapped(*(jnp.asarray(a, jnp.float32) for a in (before, after, cost)))
    assert short.dtype == jnp.float32
    np.testing.assert_allclose(short, expected, rtol=3e-7)
    x = np.random.default_rng(0).lognormal(sigma=0.1, size=(6, 5, 10))
    np.testing.assert_allclose(
        jax.jit(drift)(*(jnp.asarray(a, jnp.float32) for a in (before, x))),
        drift(before, x), rtol=1e-5,
    )  # fmt: skip


@pytest.mark.parametrize("assets", [1, 3, 8])
def test_derivatives_against_finite_differences(assets: int) -> None:
    cost = np.resize(COSTS[1:], 600)
    before, after = weights(assets, 2, len(cost), assets + 1, holes=False)
    along = weights(assets + 9, 2, *before.shape, holes=False) - [before, after]  # of sum 0
    h = 1e-6

    def moved(step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return before + step * along[0], after + step * along[1], cost + step * cost

    with jax.enable_x64(True):
        derive = jax.jit(jax.vmap(jax.grad(remainder_factor, (0, 1, 2))))
        gradient = derive(*moved(0.0))
    derivative = sum(
        (np.asarray(g) * t).reshape(len(cost), -1).sum(-1)
        for g, t in zip(gradient, (*along, cost), strict=True)
    )
    difference = (remainder_factor(*moved(h)) - remainder_factor(*moved(-h))) / (2 * h)
    excess = before - remainder_factor(before, after, cost)[:, None] * after
    smooth = (np.abs(excess[:, 1:]) > 1e-4).all(-1)  # no kink between the two
    assert smooth.sum() > 400
    np.testing.assert_allclose(derivative[smooth], difference[smooth], rtol=1e-6, atol=1e-9)


def test_holding_on_has_no_gradient() -> None:
    held = jnp.array([0.2, 0.5, 0.3, 0.0])
    before, after = jax.grad(remainder_factor, (0, 1))(held, held, 0.01)
    np.testing.assert_array_equal(before, 0)
    np.testing.assert_array_equal(after, 0)


def test_drift() -> None:
    # 20 of cash, 30·2 = 60 and 50·.4 = 20 make 100.
    drifted = drift(np.array([0.2, 0.3, 0.5]), np.array([2.0, 0.4]))
    np.testing.assert_allclose(drifted, [0.2, 0.6, 0.2], rtol=1e-15)
    unmoved = drift(weights(1, 4, 3, 6), np.ones((3, 5)))
    np.testing.assert_allclose(unmoved, weights(1, 4, 3, 6), rtol=1e-15)


@dataclass(frozen=True)
class WithInterest(CostModel):
    """A user's own: cash earns 1% a row, and each trade costs a fee whatever its size."""

    cost: float = 0.0
    fee: float = 0.001

    def trade(self, before, after, context):
        remainder, paid = Proportional(self.cost).trade(before, after, context)
        trades = abs(after - before).sum(-1) > 1e-6
        return remainder - self.fee * trades, {**paid, "fee": self.fee * trades}

    def carry(self, relatives, context):
        growth = with_cash(relatives)
        xp = growth.__array_namespace__()
        interest = xp.asarray(1.01**context.rows, dtype=growth.dtype)
        cash = xp.broadcast_to(interest, growth.shape[:-1])[..., None]
        return xp.concat([cash, growth[..., 1:]], axis=-1)


@pytest.mark.parametrize("lag", [0, 1, 3])
def test_training_and_replay_charge_what_a_model_of_ones_own_says(lag: int) -> None:
    """By hand: shares keep their number, cash earns, and who waits for a trade earns on."""
    values = random_walk(30, 2, volatility=0.02)
    model = f"{__name__}:WithInterest"
    task = Portfolio.of(
        price_table(values), window=5, horizon=10, lag=lag, cost=0.01, cost_model=model
    )
    assert task.costs == WithInterest(cost=0.01)
    state = Position(task.first_decision, task.hold(jnp.array([1.0, 0, 0])))
    decisions = np.random.default_rng(1).dirichlet(np.ones(3), 12)
    rewards = []
    for decision in decisions:
        step = task.step(state, jnp.asarray(decision, jnp.float32), jax.random.key(0))
        rewards.append(float(step.reward))
        state = step.state
    replay = simulate(values, decisions, first=5, cost=WithInterest(cost=0.01), lag=lag)
    np.testing.assert_allclose(rewards, replay.growth, atol=3e-6)
    # The first trade, out of cash, by hand.
    moved = np.append(1.01**lag, values[5 + lag] / values[5])
    wanted = decisions[0] * moved / (decisions[0] @ moved)
    left = remainder_factor(np.array([1.0, 0, 0]), wanted, 0.01) - 0.001
    grown = wanted @ np.append(1.01, values[6 + lag] / values[5 + lag])
    assert replay.returns[0] == pytest.approx(left * grown - 1, abs=1e-12)
    assert replay.cost[0] == pytest.approx(1 - left, abs=1e-12)


@dataclass(frozen=True)
class Wrong(WithInterest):
    """A model of a user's own with one mistake."""

    mistake: ClassVar[str] = ""

    def trade(self, before, after, context):
        left, paid = super().trade(before, after, context)
        kinds: dict[str, Any] = {
            "alone": left,
            "scalar": (float(left[0]), paid),
            "gain": (left * 1.01, paid),
            "unknown": (left * float("nan"), paid),
            "always": (left - 0.001, {**paid, "more": 0.001 + 0 * left}),
            "sum": (left, {"fee": 0 * left}),
            "small": (np.where(abs(after - before).sum(-1) == 1, 1.01, left), paid),
        }
        return kinds.get(self.mistake, (left, paid))

    def carry(self, relatives, context):
        growth = super().carry(relatives, context)
        kinds = {"short": growth[..., 1:], "lost": -growth, "joined": growth.reshape(-1)}
        return kinds.get(self.mistake, growth)


@pytest.mark.parametrize(
    ("mistake", "says"),
    [
        ("alone", "Wrong.trade must return the share of wealth that remains, and its costs by ki"),
        (
            "scalar",
            r"Wrong.trade must return numbers of shape \(...\) for weights of shape \(..., N",
        ),
        ("gain", "Wrong.trade must return shares of wealth above 0 and at most 1."),
        ("unknown", "Wrong.trade must return shares of wealth above 0 and at most 1."),
        ("always", "Wrong.trade must return exactly 1 where nothing is traded."),
        ("sum", "Wrong.trade must return costs that sum to 1 minus the share of wealth that rem"),
        ("short", "Wrong.carry must return growth factors of cash and of each of 3 assets, of s"),
        ("lost", "Wrong.carry must return positive growth factors."),
        ("small", "Wrong.trade must return shares of wealth above 0 and at most 1."),
        ("joined", "Wrong.carry must return growth factors of cash and of each of 3 assets, of s"),
    ],
)
def test_a_model_of_ones_own_is_tried(mistake, says, monkeypatch):
    prices = price_table(random_walk(30))
    monkeypatch.setattr(Wrong, "mistake", mistake)
    with pytest.raises(QfolioError, match=says):
        Portfolio.of(prices, window=5, horizon=10, cost_model=f"{__name__}:Wrong")
