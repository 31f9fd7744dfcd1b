from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from equinox import filter_jit as jit

from qfolio.agents.dqn import DQN
from qfolio.core.population import Population

from populations import first_member, train_to
from probes import Endless, OneState, RewardDelay, TwoStates

DISCOUNT = 0.9

CATEGORICAL = {"values": "categorical", "atoms": 21, "v_min": -2.0, "v_max": 2.0}
QUANTILE = {"values": "quantile", "atoms": 16, "huber_delta": 1.0}
RAINBOW = {
    "double": True, "dueling": True, "n_steps": 3, "prioritized": True, "noisy": True,
}  # fmt: skip
SLOW = pytest.mark.slow
OPTIONS: dict[str, dict[str, Any]] = {
    "plain": {},
    "double": {"double": True},
    "dueling": {"dueling": True},
    "n_steps": {"n_steps": 3},
    "prioritized": {"prioritized": True},
    "categorical": CATEGORICAL,
    "quantile": QUANTILE,
    "roots": {"value_rescaling": True},
    "roots categorical": {**CATEGORICAL, "value_rescaling": True},
    "roots quantile": {**QUANTILE, "value_rescaling": True},
    "noisy": {"noisy": True},
}
RAINBOWS: dict[str, dict[str, Any]] = {
    "rainbow categorical": {**RAINBOW, **CATEGORICAL},
    "rainbow quantile": {**RAINBOW, **QUANTILE},
}


def learned_values(task, observations, steps=1500, **changes):
    settings = {
        "hidden": (32,), "num_envs": 4, "batch_size": 32, "replay_capacity": 1000,
        "learning_starts": 100, "discount": DISCOUNT, "target_update_interval": 1, "tau": 0.05,
        "learning_rate": 3e-3, "learning_rate_steps": 1500.0, "reward_scale": 1.0,
        "epsilon_end": 0.2, "learning_rate_final": 0.0,
    }  # fmt: skip
    agent = DQN(**{**settings, **changes})
    weights = first_member(train_to(Population(task, agent, [0]), steps).weights())
    return np.asarray(jit(agent.action_values)(weights, jnp.array(observations)))


def cases(options, slow):
    return [
        pytest.param(changes, id=name, marks=SLOW if name in slow else ())
        for name, changes in options.items()
    ]


@pytest.mark.parametrize("double", [True, pytest.param(False, marks=SLOW)])
def test_one_state(double):
    values = learned_values(OneState(), [[1.0]], double=double)
    np.testing.assert_allclose(values, [[0.0, 1.0]], atol=0.02)


@pytest.mark.parametrize(
    "changes", cases({"plain": {}, "quantile": QUANTILE, **RAINBOWS}, slow=RAINBOWS)
)
def test_two_states(changes):
    """Each action has a value of its own; Rainbow has all options together."""
    values = learned_values(TwoStates(), [[1.0], [-1.0]], **changes)
    np.testing.assert_allclose(values, [[-1, 1], [1, -1]], atol=0.02)


@pytest.mark.parametrize("changes", cases(OPTIONS, slow=OPTIONS.keys() - {"n_steps"}))
def test_reward_delay(changes):
    """Each option by itself."""
    values = learned_values(RewardDelay(), [[1.0, 0.0], [0.0, 1.0]], **changes)
    np.testing.assert_allclose(values, [[DISCOUNT] * 2, [1.0, 1]], rtol=0.02)


@pytest.mark.parametrize(
    "changes", [{}, pytest.param({"tau": 1.0, "target_update_interval": 10}, marks=SLOW)]
)
def test_a_time_limit_is_not_the_end(changes):
    values = learned_values(Endless(), [[1.0]], steps=3000, learning_rate_steps=3000.0,
                            tau=changes.get("tau", 0.2),
                            target_update_interval=changes.get("target_update_interval", 1),
                            )  # fmt: skip
    np.testing.assert_allclose(values, 1 / (1 - DISCOUNT), rtol=0.02)


@pytest.mark.parametrize(
    ("name", "horizon"),
    [
        ("n_steps", 2),
        pytest.param("n_steps", 1, marks=SLOW),
        pytest.param("rainbow categorical", 2, marks=SLOW),
        pytest.param("rainbow quantile", 1, marks=SLOW),
    ],
)
def test_returns_over_steps_bootstrap_through_a_time_limit(name, horizon):
    """Where the episode is cut before the three steps are over, by the right power of γ."""
    changes = {**(OPTIONS | RAINBOWS)[name], "tau": 0.2, "learning_rate_steps": 3000.0}
    if "v_max" in changes:
        changes |= {"v_min": 0.0, "v_max": 12.0}
    values = learned_values(Endless(horizon), [[1.0]], steps=3000, **changes)
    np.testing.assert_allclose(values, 1 / (1 - DISCOUNT), rtol=0.02)


def test_a_time_limit_taken_for_the_end():
    values = learned_values(Endless(), [[1.0]], time_limit_terminal=True)
    np.testing.assert_allclose(values, 1.0, rtol=0.02)


@pytest.mark.parametrize(
    "changes",
    [
        {"huber_delta": 0.1},
        pytest.param(CATEGORICAL, marks=SLOW),
        pytest.param({**QUANTILE, "huber_delta": 0.1}, marks=SLOW),
    ],
)
def test_scaled_rewards_leave_the_values_alone(changes):
    values = learned_values(RewardDelay(), [[1.0, 0.0]], reward_scale=0.5, **changes)
    np.testing.assert_allclose(values, DISCOUNT, rtol=0.02)


@pytest.mark.parametrize("prioritized", [False, pytest.param(True, marks=SLOW)])
def test_several_updates_a_step(prioritized):
    values = learned_values(
        TwoStates(), [[1.0]], steps=500, gradient_steps=3, prioritized=prioritized, n_steps=2
    )
    np.testing.assert_allclose(values, [[-1, 1]], atol=0.02)
