"""Rewards by hand, and where a Sharpe ratio has nothing to divide by."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.core.mdp import Position
from qfolio.portfolio.market import Market
from qfolio.portfolio.rewards import (
    CRRA,
    DifferentialSharpe,
    Log,
    MeanVariance,
    Outcome,
    Reward,
)
from qfolio.portfolio.synthetic.ar1 import Ar1


def outcome(growth):
    return Outcome(jnp.asarray(growth, float), jnp.zeros(()), jnp.array([0.5, 0.5]))


@pytest.mark.parametrize(
    ("reward", "expected"),
    [
        (Log(), np.log(1.02)),
        (CRRA(3.0), (1.02**-2 - 1) / -2),
        (CRRA(1.0), np.log(1.02)),
        (MeanVariance(3.0), 0.02 - 1.5 * 0.02**2),
    ],
)
def test_utilities_of_a_step(reward, expected):
    value, state = reward(reward.init(), outcome(1.02))
    np.testing.assert_allclose(value, expected, rtol=1e-4)
    assert state is None
    assert not reward.path_dependent


def test_differential_sharpe_by_hand():
    """Moody & Saffell (1998): (B ΔA − ½ A ΔB) / (B − A²)^1.5."""
    reward, moments = DifferentialSharpe(0.1), np.array([0.001, 4e-4])
    ratio, after = reward(jnp.asarray(moments), outcome(1.02))
    change = np.array([0.02 - 0.001, 0.02**2 - 4e-4])
    expected = (4e-4 * change[0] - 0.5 * 0.001 * change[1]) / (4e-4 - 1e-6) ** 1.5
    np.testing.assert_allclose(ratio, expected, rtol=1e-3)
    np.testing.assert_allclose(after, moments + 0.1 * change, rtol=1e-4)
    assert reward.path_dependent


@pytest.mark.parametrize("growth", [1.0, 1.01, 0.99])
def test_a_constant_growth_has_a_finite_sharpe_ratio(growth):
    """All in cash, or a constant rate: the variance of what is remembered goes to zero."""
    reward = DifferentialSharpe(0.01)

    def value(growth):
        def step(state, _):
            paid, state = reward(state, outcome(growth))
            return state, paid

        return jax.lax.scan(step, reward.init(), None, length=5000)[1]

    paid = jax.jit(value)(growth)
    assert np.isfinite(paid).all()
    assert abs(paid[-100:]).max() < 0.5  # a common step pays about 1
    slope = jax.jit(jax.grad(lambda growth: value(growth).sum()))(growth)
    assert np.isfinite(slope)


def test_it_depends_on_rounding_nowhere():
    """Ordinary returns are far from the floor, which changes nothing there."""
    gains = np.random.default_rng(0).normal(3e-4, 0.003, 400)
    reward = DifferentialSharpe(0.01)
    state, (mean, square) = reward.init(), (0.0, 1e-4)
    for gain in gains:
        paid, state = reward(state, outcome(1 + gain))
        change = gain - mean, gain**2 - square
        expected = (square * change[0] - mean * change[1] / 2) / (square - mean**2) ** 1.5
        assert float(paid) == pytest.approx(expected, rel=2e-3, abs=1e-2)
        mean, square = mean + 0.01 * change[0], square + 0.01 * change[1]


class Diversified(Reward):
    """A user's own: growth less what is paid and what is concentrated, after a first free step."""

    risk_aversion: float = 0.0

    def init(self):
        return jnp.zeros(())

    def __call__(self, state, outcome):
        fine = outcome.cost + self.risk_aversion * (outcome.weights**2).sum()
        return outcome.growth - 1 - jnp.minimum(state, 1) * fine, state + 1


def test_a_reward_of_ones_own():
    class Rewarded(Ar1):
        reward: str = eqx.field(static=True, default=f"{__name__}:Diversified")
        risk_aversion: float = eqx.field(default=0.5)

    task = Rewarded(cost=0.1)
    assert isinstance(task, Market)
    state, action = task.reset(jax.random.key(0)), jnp.array([0.25, 0.75])
    state = Position(state.market, task.hold(jnp.array([1.0, 0.0])))
    first = task.step(state, action, jax.random.key(1))
    again = Position(state.market, first.state.holding._replace(weights=jnp.array([1.0, 0.0])))
    second = task.step(again, action, jax.random.key(1))
    paid = 1 - 1 / (1 + 0.1 / 0.9 * 0.75)  # buying w costs c/(1−c) of it, out of what is left
    fine = paid + 0.5 * (0.25**2 + 0.75**2)
    np.testing.assert_allclose(first.reward - second.reward, fine, rtol=1e-5)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda state, paid: paid,
         r"Own.__call__ returns float32\[\]; it must be a number, and the next state."),
        (lambda state, paid: (paid * jnp.ones(2), state),
         r"Own.__call__ returns .float32\[2\], float32\[\].; it must be a number, and the next st"),
        (lambda state, paid: (paid, {"last": state}),
         r"Own.__call__ returns {last: float32\[\]} as state; it must be float32\[\], like that of "
         r"Own.init."),
    ],
    ids=["number", "vector", "state"],
)  # fmt: skip
def test_what_a_reward_of_ones_own_must_return(monkeypatch, answer, message):
    class Own(Diversified):
        def __call__(self, state, outcome):
            return answer(state, outcome.cost)

    monkeypatch.setitem(globals(), "Own", Own)

    class Rewarded(Ar1):
        reward: str = eqx.field(static=True, default=f"{__name__}:Own")

    with pytest.raises(QfolioError, match=message):
        Rewarded()
