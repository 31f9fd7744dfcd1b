"""The band and the slopes of the pathwise gradient."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equinox import filter_jit as jit

from qfolio.agents.pathwise import Band, Paths, Pathwise, PathwiseState, Slopes
from qfolio.core.errors import QfolioError
from qfolio.core.evaluation import start_keys
from qfolio.core.mdp import Position
from qfolio.core.training import advance, begin, chunk_steps
from qfolio.learning.networks import Shared
from qfolio.portfolio.synthetic.no_trade import NoTrade

AGENT = Pathwise(
    rollout_length=40,
    num_envs=16,
    hidden=(8, 8),
    bootstrap=True,
    learning_rate=0.01,
    slope_learning_rate_ratio=3.0,
    max_grad_norm=1e-4,
    reward_scale=100.0,
)


def started(*biases: float) -> PathwiseState:
    """A band whose edges are ``biases`` away from the first ones."""
    state = jit(AGENT.init)(NoTrade(horizon=40), jax.random.key(0))
    last = lambda s: s.policy.network.head.biases[-1]  # noqa: E731
    return eqx.tree_at(last, state, jnp.array(biases))


def edges(policy: Band, holdings: np.ndarray) -> tuple[jax.Array, jax.Array]:
    reading = policy.network.read(jnp.ones((len(holdings), 1, 1, 1)))
    return policy.edges(reading, jnp.asarray(holdings, jnp.float32)[:, None])


def test_the_first_band_is_narrow_and_around_equal_weights():
    low, high = edges(started(0, 0).policy, np.array([0.0, 1.0]))
    np.testing.assert_allclose(low, 0.5 - 1 / 16, atol=1e-3)
    np.testing.assert_allclose(high, 0.5 + 1 / 16, atol=1e-3)


@pytest.mark.parametrize("biases", [(-1.0, 1.0), (-1.0, -1.0), (1.0, 1.0), (1.0, -1.0)])
def test_a_gradient_reaches_both_edges_wherever_they_are(biases):
    """Edges have a gradient if some of the holdings that rollouts start from trade to them."""
    task, state = NoTrade(), started(*biases)
    starts = jax.vmap(task.reset)(start_keys(512))
    views = jax.vmap(task.observe)(starts)

    def traded(policy):
        return (policy(views) * jnp.arange(512)[:, None])[:, 1].sum()

    gradient = jax.grad(traded)(state.policy).network.head.biases[-1]
    assert np.all(abs(gradient) > 1e-3)
    low, high = edges(state.policy, np.linspace(0, 1, 5))
    assert np.all((low > 0) & (low <= high) & (high < 1))


@pytest.mark.slow
def test_a_band_that_almost_never_trades_becomes_narrow():
    task = NoTrade(cost=0.0, horizon=40)
    state = begin(task, AGENT, jnp.array(0, jnp.uint32))
    state = eqx.tree_at(lambda s: s.agent, state, started(-1.0, 1.0))
    low, high = edges(state.agent.policy, np.array([0.5]))
    assert high - low > 0.95
    train = jit(lambda state, steps: advance(task, AGENT, state, steps, learning=True)[0])
    for _ in range(15):
        state = train(state, jnp.array(chunk_steps(task, AGENT)))
    low, high = edges(state.agent.policy, np.array([0.5]))
    assert high - low < 0.5


def test_the_slopes_see_the_place_in_the_band():
    """Holdings beyond an edge are worth what the edge is worth."""
    state = started(0, 0)
    assert state.slopes is not None
    network = state.slopes.network
    random = Shared(
        "mlp", jax.tree.map(lambda x: x[0], _view([0.5])), (4, 4), 0, 1, jax.random.key(1)
    )
    slopes = Slopes(eqx.tree_at(lambda n: n.linear, random, network.linear))
    found = np.asarray(slopes(state.policy, _view([0.0, 0.2, 0.45, 0.55, 0.8, 1.0])))[:, 0]
    assert found[0] == found[1]
    assert found[4] == found[5]
    assert found[1] != found[2] != found[3]


def test_paths_start_anywhere_and_in_the_band_and_so_do_their_images():
    task, policy = NoTrade(), started(-1 / 16, 1 / 16).policy
    market = jax.vmap(lambda key: 0.02 * jax.random.normal(key))(start_keys(90)).reshape(3, 30)
    start = jax.vmap(task.draw_holding)(start_keys(30))
    paths = Paths(market[:2], market[1:], jnp.ones((2, 30, 1, 1, 1)), start)
    spread = paths.spread(task, policy, jax.random.key(0))
    weights, before = spread.start.weights[:, 1], start.weights[:, 1]
    np.testing.assert_array_equal(weights[::2], before[::2])
    low, high = edges(policy, np.array([0.0, 1.0]))
    assert np.all((weights[1::2] >= low.min()) & (weights[1::2] <= high.max()))
    assert np.std(weights[1::2]) > (high - low).max() / 5
    assert not np.all((before[1::2] >= low.min()) & (before[1::2] <= high.max()))
    np.testing.assert_allclose(spread.start.weights.sum(1), 1, rtol=1e-6)

    both = spread.with_images(task)
    assert both.shape == (2, 60)
    np.testing.assert_array_equal(both.start.weights[:30], both.start.weights[30:])
    np.testing.assert_array_equal(both.market[1], both.next_market[0])
    mean = (task.rate - task.volatility**2 / 2) * task.dt
    np.testing.assert_allclose(both.next_market.mean(), mean, atol=1e-7)


@pytest.mark.parametrize(
    "settings",
    [
        {"num_envs": 0}, {"num_envs": 10**20}, {"rollout_length": 2**31},
        {"gradient_steps": 2**31}, {"episode_steps": 2**31}, {"tail": -1}, {"max_grad_norm": 0.0},
        {"slope_learning_rate_ratio": float("inf")}, {"simplex_penalty": -1.0},
        {"simplex_penalty": float("inf")},
    ],
)  # fmt: skip
def test_settings_out_of_range_are_named(settings):
    with pytest.raises(QfolioError, match=next(iter(settings))):
        Pathwise(**settings)


def test_networks_that_assets_do_not_share_are_refused():
    with pytest.raises(QfolioError, match="network is flat; it must be one of mlp, cnn, rnn, lstm"):
        Pathwise(network="flat")


def test_a_rollout_needs_a_second_decision_to_learn_slopes():
    with pytest.raises(QfolioError, match="must be 2 or more"):
        Pathwise(bootstrap=True, rollout_length=20, tail=19)


def _view(holdings):
    task = NoTrade()
    hold = lambda w: Position(jnp.array(0.0), task.hold(jnp.stack([1 - w, w])))  # noqa: E731
    return jax.vmap(lambda w: task.observe(hold(w)))(jnp.asarray(holdings, jnp.float32))
