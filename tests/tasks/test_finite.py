import dataclasses
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import qfolio
from optima import soft, value_iteration
from qfolio.core import settings
from qfolio.core.errors import QfolioError
from qfolio.core.registry import find
from qfolio.solvers.finite import finite_horizon, policy_evaluation, policy_iteration
from qfolio.solvers.grid import GridOptimum
from qfolio.tasks.finite import Cliff, FiniteMDP, FrozenLake, Garnet
from qfolio.tasks.grid_pendulum import GridPendulum, interpolated
from qfolio.tasks.pendulum import Pendulum, PendulumState

TWO: dict[str, Any] = {
    # From state 0, action 0 stays or goes on to state 1, action 1 ends; from 1 either goes to 0.
    "transitions": [[[0.5, 0.5, 0], [0, 0, 1]], [[1, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 0, 0]]],
    "rewards": [[1.0, 2.0], [0.0, 3.0], [9.0, 9.0]],
    "terminal": [2],
}


def test_values_by_hand():
    optimum = FiniteMDP(**TWO).optimum()
    # Staying in: V0 = 1 + γ (V0 + V1) / 2, V1 = 3 + γ V0.
    v0 = (1 + 0.5 * 0.9 * 3) / (1 - 0.5 * 0.9 - 0.5 * 0.81)
    exact = [[v0, 2.0], [0.9 * v0, 3 + 0.9 * v0], [0.0, 0]]
    np.testing.assert_allclose(optimum.action_values(0.9), exact, rtol=1e-12)
    # For γ = 0 ending pays more.
    np.testing.assert_allclose(optimum.action_values(0.0), [[1, 2], [0, 3], [0, 0]])


def test_finite_horizon_by_hand():
    model = FiniteMDP(**TWO).optimum().model
    np.testing.assert_allclose(finite_horizon(model, 1)[0], [2, 3, 0])
    # Two steps: from 0, 1 + (2 + 3)/2; from 1, 3 + 2.
    np.testing.assert_allclose(finite_horizon(model, 2)[0], [3.5, 5, 0])


@pytest.mark.parametrize("epsilon", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("task", [Cliff(), Cliff(slippery=True), FrozenLake(), Garnet(30)])
def test_value_and_policy_iteration_agree_and_fulfil_bellman(task, epsilon):
    model = task.optimum().model
    by_value = value_iteration(model, 0.95, epsilon)
    by_policy = policy_iteration(model, 0.95, epsilon)
    np.testing.assert_allclose(by_value, by_policy, atol=1e-8)
    following = model.rewards + 0.95 * soft(by_policy, epsilon)[model.successors]
    np.testing.assert_allclose((model.transitions * following).sum(-1), by_policy, atol=1e-9)


def test_the_soft_optimum_is_the_best_soft_policy():
    task, epsilon = Garnet(4, 2, 2, seed=3), 0.3
    model = task.optimum().model
    every = [
        policy_evaluation(model, epsilon / 2 + (1 - epsilon) * np.eye(2)[list(actions)], 0.9)
        for actions in np.ndindex(2, 2, 2, 2)
    ]
    np.testing.assert_allclose(np.max(every, 0), policy_iteration(model, 0.9, epsilon), rtol=1e-10)


def test_policy_evaluation_is_what_a_simulation_earns():
    task = Garnet(6, 3, 2, seed=1)
    model, discount = task.optimum().model, 0.8
    policy = np.random.default_rng(0).dirichlet(np.ones(3), size=6)

    def episode(key):
        def step(carry, key):
            state, weight = carry
            action_key, task_key = jax.random.split(key)
            action = jax.random.categorical(action_key, jnp.log(jnp.array(policy))[state])
            after = task.step(state, action, task_key)
            return (after.state, weight * discount), weight * after.reward

        start, keys = jnp.array(2, jnp.int32), jax.random.split(key, 60)
        return jax.lax.scan(step, (start, jnp.array(1.0)), keys)[1].sum()

    returns = jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(0), 20_000))
    value = (policy * policy_evaluation(model, policy, discount)).sum(-1)[2]
    assert abs(returns.mean() - value) < 4 * returns.std() / 20_000**0.5


@pytest.mark.parametrize(
    ("name", "task", "options"),
    [
        ("CliffWalking-v1", Cliff(), {}),
        ("CliffWalking-v1", Cliff(slippery=True), {"is_slippery": True}),
        ("FrozenLake-v1", FrozenLake(), {}),
        ("FrozenLake-v1", FrozenLake(slippery=False), {"is_slippery": False}),
        ("FrozenLake-v1", FrozenLake(8), {"map_name": "8x8"}),
    ],
)
def test_the_tables_are_gymnasiums(name, task, options):
    env = gymnasium.make(name, **options).unwrapped
    # By state and action: probability and reward of each next state, and whether it is the end.
    for state in np.flatnonzero(~task.terminal):
        for action in range(4):
            theirs: dict[tuple, float] = {}
            ours: dict[tuple, float] = {}
            for p, after, reward, ended in env.P[state][action]:
                key = (int(after), float(reward), bool(ended))
                theirs[key] = theirs.get(key, 0.0) + p
            tables = task.transitions, task.successors, task.rewards
            for p, after, reward in zip(*(table[state, action] for table in tables), strict=True):
                key = (int(after), float(reward), bool(task.terminal[after]))
                ours[key] = ours.get(key, 0.0) + p
            assert theirs == pytest.approx(ours)
    np.testing.assert_array_equal(task.start, env.initial_state_distrib)
    assert (task.states, task.actions.n) == (env.observation_space.n, env.action_space.n)


def test_known_optima():
    keys = jax.random.split(jax.random.key(0), 3)
    np.testing.assert_allclose(Cliff().optimum().returns(keys), -13)
    np.testing.assert_allclose(FrozenLake(slippery=False).optimum().returns(keys), 1)
    # Gymnasium's registry: "optimum = 0.74" and "optimum = 0.91" within the time limit.
    assert FrozenLake().optimum().expected()[0] == pytest.approx(0.74, abs=0.005)
    assert FrozenLake(8).optimum().expected()[0] == pytest.approx(0.91, abs=0.005)


def test_what_the_best_policy_earns_is_what_it_is_expected_to():
    task = FrozenLake(horizon=12)
    optimum = task.optimum()
    returns = optimum.returns(jax.random.split(jax.random.key(2), 20_000))
    assert set(returns) == {0.0, 1.0}
    exact = optimum.expected()[0]
    assert 0.05 < exact < 0.3  # the clock matters
    assert abs(returns.mean() - exact) < 4 * returns.std() / 20_000**0.5


def test_steps_follow_the_table():
    task = Garnet(5, 2, 3, seed=4)
    n = 30_000
    keys = jax.random.split(jax.random.key(1), n)
    after = jax.jit(jax.vmap(lambda key: task.step(jnp.array(3), jnp.array(1), key)))(keys)
    frequency = np.bincount(after.state, minlength=5) / n
    exact = np.bincount(task.successors[3, 1], task.transitions[3, 1], minlength=5)
    np.testing.assert_allclose(frequency, exact, atol=0.02)
    assert frequency[exact == 0].sum() == 0
    np.testing.assert_allclose(after.reward, task.rewards[3, 1, 0], rtol=1e-6)
    start = FiniteMDP(**TWO, start=[0.3, 0.7, 0.0])
    assert np.mean(jax.vmap(start.reset)(keys)) == pytest.approx(0.7, abs=0.02)


def test_an_episode_ends_in_a_terminal_state():
    task = FiniteMDP(**TWO)
    step = task.step(jnp.array(0), jnp.array(1), jax.random.key(0))
    assert (int(step.state), float(step.reward), bool(step.terminated)) == (2, 2.0, True)
    assert not task.step(jnp.array(1), jnp.array(1), jax.random.key(0)).terminated


def test_rewards_of_outcomes_and_changed_settings():
    rewards = np.broadcast_to(np.arange(3.0), (3, 2, 3))
    task = FiniteMDP(**{**TWO, "rewards": rewards})
    np.testing.assert_allclose(task.optimum().action_values(0.0), [[0.5, 2], [0.0, 0], [0.0, 0]])
    longer = dataclasses.replace(task, horizon=7)
    np.testing.assert_array_equal(longer.successors, task.successors)
    assert longer.horizon == 7


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"transitions": np.ones((2, 2))}, "must be (state, action, next state)"),
        ({"transitions": np.full((3, 2, 2), 0.5)}, "3 states and 2 next states"),
        ({"transitions": np.full((3, 2, 3), 0.5)}, "of state 0 and action 0 .* sum to 1.5"),
        ({"transitions": np.full((3, 2, 3), [2.0, -1.0, 0.0])}, "one is negative"),
        ({"transitions": [["a"]]}, "transitions must be an array of numbers"),
        ({"transitions": np.full((3, 2, 3), np.nan)}, "not finite"),
        ({"rewards": np.zeros((2, 2))}, "rewards has the shape (2, 2); it must be (3, 2)"),
        ({"terminal": [3]}, "state numbers from 0 to 2"),
        ({"terminal": [0.5]}, "state numbers from 0 to 2"),
        ({"start": [1, 0]}, "for each of the 3 states"),
        ({"start": [1, 1, 0]}, "start must be probabilities that sum to 1; they sum to 2"),
        ({"start": [0, 0, 1]}, "cannot start in a terminal state"),
        ({"terminal": [0, 1, 2]}, "cannot start in a terminal state"),
        ({"successors": np.full((3, 2, 3), 3)}, "whole numbers from 0 to 2"),
        ({"successors": np.zeros((3, 2, 1), int)}, "in the shape of transitions"),
        ({"horizon": 0}, "horizon is 0"),
    ],
)
def test_what_is_wrong_with_arrays(changes, message):
    with pytest.raises(QfolioError, match=message.replace("(", r"\(").replace(")", r"\)")):
        FiniteMDP(**{**TWO, **changes})


@pytest.mark.parametrize(
    ("name", "chosen", "message"),
    [
        ("finite/frozen-lake", {"size": 5}, "size is 5; it must be 4 or 8"),
        ("finite/random", {"n_states": 3, "branching": 4}, "from 1 to n_states"),
        ("finite/cliff", {"height": 3}, "no setting 'height'"),
        ("pendulum/grid", {"torques": 0}, "for a table"),
        ("pendulum/grid", {"angles": 1}, "angles is 1"),
    ],
)
def test_wrong_settings(name, chosen, message):
    with pytest.raises(QfolioError, match=message):
        settings.build(find("task", name), chosen)


@pytest.mark.parametrize("discount", [1.0, -0.1])
def test_endless_problems_need_a_discount(discount):
    with pytest.raises(QfolioError, match="below 1"):
        Cliff().optimum().action_values(discount)


def test_settings_come_back():
    for task in (FrozenLake(8), Cliff(slippery=True), Garnet(7, seed=5), GridPendulum(angles=9)):
        again = settings.build(type(task), settings.describe(task))
        assert settings.describe(again) == settings.describe(task)
    assert FrozenLake(8).horizon == 200
    np.testing.assert_array_equal(Garnet(seed=5).rewards, Garnet(seed=5).rewards)
    assert qfolio.FiniteMDP is FiniteMDP


def test_the_pendulum_on_a_grid_has_the_values_of_its_optimum():
    grid = GridOptimum(
        Pendulum(torques=5),
        PendulumState,
        (jnp.linspace(-jnp.pi, jnp.pi, 40, endpoint=False), jnp.linspace(-8.0, 8.0, 41)),
        periodic=(True, False),
    )
    exact, _ = grid.stationary(0.97)
    values = interpolated(grid).optimum().action_values(0.97).max(-1)
    np.testing.assert_allclose(values.reshape(exact.shape), exact, rtol=1e-3, atol=0.02)


def test_the_cells_of_the_pendulum():
    task = GridPendulum(angles=5, speeds=9)
    at = lambda theta, speed: int(task.observe(PendulumState(*jnp.array([theta, speed]))))  # noqa: E731
    assert at(0.0, 0.0) == 4  # upright and still: the middle of the first angle's speeds
    assert at(0.6, 0.9) == 4  # a fifth of a turn and 2 rad/s wide
    assert at(0.7, 0.0) == at(0.7 + 2 * np.pi, 0.0) == 9 + 4
    assert at(-0.7, 8.0) == at(-0.7, 7.1) == 4 * 9 + 8
    assert at(3.1, -8.0) == 2 * 9
    assert at(-3.1, -8.0) == 3 * 9
    states = jax.vmap(task.reset)(jax.random.split(jax.random.key(0), 1000))
    seen = task.observe(states)
    assert seen.min() >= 0
    assert seen.max() < task.states == 45
