"""What a type checker says of a user's script, and of one with mistakes."""

from pathlib import Path

import pytest

mypy = pytest.importorskip("mypy.api")

ROOT = Path(__file__).parents[2]

SCRIPT = '''
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray, PyTree

import qfolio
from qfolio.core.fields import number, static
from qfolio.core.mdp import Actions, Agent, Discrete, Metrics, Step, Task, Transition


class Coin(Task):
    """Pays 1 for action 1, of two."""

    horizon: int = static(1)
    pay: float = number(1.0)

    @property
    def actions(self) -> Discrete:
        return Discrete(2)

    def reset(self, key: PRNGKeyArray) -> Array:
        return jnp.zeros(())

    def observe(self, state: Array) -> Array:
        return jnp.ones(1)

    def step(self, state: Array, action: Array, key: PRNGKeyArray) -> Step:
        return Step(state, self.pay * action, jnp.array(True))


class Means(NamedTuple):
    total: Array
    visits: Array


class Bandit(Agent):
    """The action with the best mean so far."""

    num_envs: int = static(4)
    episode_steps: int = static(0)
    discount: float = number(0.0)
    epsilon: float = number(0.1)

    def init(self, task: Task, key: PRNGKeyArray) -> Means:
        assert isinstance(task.actions, Discrete)
        return Means(jnp.zeros(task.actions.n), jnp.zeros(task.actions.n))

    def act(self, state: Means, observation: PyTree, key: PRNGKeyArray) -> Array:
        best = (state.total / jnp.maximum(state.visits, 1)).argmax()
        drawn = jax.random.uniform(key, (self.num_envs,)) < self.epsilon
        return jnp.where(drawn, 1 - best, best).astype(jnp.int32)

    def learn(
        self, task: Task, state: Means, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[Means, Metrics]:
        action, reward = rollout.action[0], rollout.reward[0]
        return Means(state.total.at[action].add(reward), state.visits.at[action].add(1)), {}

    def weights(self, state: Means) -> Array:
        return state.total

    def policy(self, weights: Array, observation: PyTree) -> Array:
        return jnp.full(len(observation), weights.argmax())


run = qfolio.train(Coin(pay=2.0), Bandit(epsilon=0.2), episodes=8)
again: Any = qfolio.train(
    qfolio.Pendulum(torques=3), qfolio.DQN(hidden=(64,), learning_rate=1e-3), episodes=1
)
actions: Actions = qfolio.Pendulum().actions
qfolio.SAC(clip_bootstrap=False), qfolio.PPO(saturation_penalty=0.0), qfolio.Portfolio.of
'''

WRONG = """
import qfolio

qfolio.DQN(hiden=(64,))
qfolio.DQN(hidden=64)
qfolio.Pendulum(torque=3)
qfolio.PPO(clip_range="wide")
"""


@pytest.mark.slow  # the checker reads jax and equinox
def test_a_users_script_is_checked(tmp_path, monkeypatch):
    monkeypatch.setenv("MYPYPATH", str(ROOT / "src"))
    (tmp_path / "script.py").write_text(SCRIPT)
    (tmp_path / "wrong.py").write_text(WRONG)
    files = [str(tmp_path / name) for name in ("script.py", "wrong.py")]
    config = ["--config-file", str(ROOT / "pyproject.toml"), "--cache-dir", str(tmp_path / "cache")]
    out, err, _ = mypy.run([*config, *files])
    assert not err
    found = [line.partition("wrong.py:")[2] for line in out.splitlines() if "error:" in line]
    assert [line.partition(":")[0] for line in found] == ["4", "5", "6", "7"], out
    for line, word in zip(found, ("hiden", "hidden", "torque", "clip_range"), strict=True):
        assert word in line or "arg-type" in line, out


def test_the_script_runs():
    names: dict[str, object] = {}
    cut = SCRIPT.index("again: Any")
    exec(compile(SCRIPT[:cut], "script.py", "exec"), names)
    weights = names["run"].population.weights()  # type: ignore[attr-defined]
    assert weights[0].argmax() == 1
