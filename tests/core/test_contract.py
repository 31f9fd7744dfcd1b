"""Tasks and agents that do not return what training needs are refused before the first step."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.agents.dqn import DQN
from qfolio.core.errors import QfolioError, one_line
from qfolio.core.fields import static
from qfolio.core.mdp import Discrete, Step, Task
from qfolio.core.population import Population
from qfolio.core.training import begin

from planted import Known


class Walk(Task):
    horizon: int = static(5)

    actions = Discrete(2)

    def reset(self, key):
        return jnp.zeros(3)

    def observe(self, state):
        return state

    def step(self, state, action, key):
        return Step(state + action, -state[0], jnp.array(False))


class Learner(Known):
    num_envs: int = static(2)

    def init(self, task, key):
        return jnp.zeros(2)

    def learn(self, task, state, rollout, key):
        return state + rollout.reward.mean(), {"reward": rollout.reward.mean()}

    def policy(self, weights, observation):
        return jnp.full(len(observation), weights.argmax())


def begun(task, agent):
    jax.eval_shape(lambda: begin(task, agent, jnp.uint32(0)))


def changed(base, name, method):
    """An object of a subclass ``Own`` with another method."""
    return type("Own", (base,), {name: method})()


NO = jnp.array(False)


@pytest.mark.parametrize(
    ("name", "method", "says"),
    [
        ("reset", lambda self: jnp.zeros(3), "Own.reset must be a method that takes self and key."),
        ("reset", lambda self, key: "start", "Own.reset returns str; it must return arrays, "),
        ("observe", lambda self, state: None, "Own.observe returns None; it must be an array "),
        ("observe", lambda self, s: jax.random.key(0), r"Own.observe returns key<fry>\[\]; it "),
        ("step", lambda self, s, a, k: (s, s[0], NO),
         r"Own.step returns \(float32\[3\], float32\[\], bool\[\]\); it must be Step\(state, "),
        ("step", lambda self, s, a, k: Step((s, s), s[0], NO),
         r"returns \(float32\[3\], float32\[3\]\) as state; it must be float32\[3\], like that of "
         "Own.reset."),
        ("step", lambda self, s, a, k: Step(s.astype(int), s[0], NO),
         r"Own.step returns int32\[3\] as state; it must be float32\[3\], like that of Own.reset."),
        ("step", lambda self, s, a, k: Step(s, -s, NO),
         r"Own.step returns float32\[3\] as reward; it must be float32\[\]."),
        ("step", lambda self, s, a, k: Step(s, (s[0],), NO),  # type: ignore[arg-type]
         r"Own.step returns \(float32\[\],\) as reward; it must be float32\[\]."),
        ("step", lambda self, s, a, k: Step(s, s[0] * 1j, NO),
         r"Own.step returns complex64\[\] as reward; it must be float32\[\]."),
        ("step", lambda self, s, a, k: Step(s, s[0], s[0]),
         r"returns float32\[\] as terminated; it must be bool\[\]."),
        ("measure", lambda self, step: {"held": step.observation},
         r"Own.measure returns {held: float32\[3\]} as metrics; it must be a dict of names and "),
        ("measure", lambda self, step: {"return": step.reward},
         "Own.measure returns the metric 'return', a name that the records already have; rename "),
        ("measure", lambda self, step: {3: step.reward}, "Own.measure returns the metric 3; a name "
         "must be text that no spreadsheet reads as a formula."),
        ("measure", lambda self, step: {"": step.reward}, "returns the metric ''; a name must"),
        ("measure", lambda self, step: {"-x": step.reward}, "returns the metric '-x'; a name must"),
        ("measure", lambda self, step: {"reward": step.reward},
         "Learner.learn and Own.measure both return a metric 'reward'; rename one of them."),
        ("states", 2, r"Own.observe returns float32\[3\]; it must be a whole number below its "),
        ("states", 2.0, "states of Own is 2.0; it must be a whole number."),
        ("observation_scale", (1.0, 2.0),
         r"observation_scale of Own is \(1.0, 2.0\); it must be a positive number, or one for each "
         "of the 3 numbers of an observation."),
        ("observation_scale", (1.0, 0.0, 2.0), "must be a positive number, or one for each of the"),
        ("observation_scale", "wide", "observation_scale of Own returns 'wide'; it must"),
        ("actions", 2, "actions of Own is 2; it must be Discrete, Simplex or Box."),
    ],
)  # fmt: skip
def test_tasks(name, method, says):
    with pytest.raises(QfolioError, match=says):
        begun(changed(Walk, name, method), Learner())


@pytest.mark.parametrize(
    ("name", "method", "says"),
    [
        ("init", lambda self, key: jnp.zeros(2), "must be a method that takes self, task and key."),
        ("act", lambda self, s, o, k: s.argmax(), r"Own.act returns int32\[\]; it must be int32\["),
        ("act", lambda self, s, o, k: s, r"Own.act returns float32\[2\]; it must be int32\[2\]."),
        ("observe", lambda self, s, r: None, r"returns None; it must be float32\[2\], like that of "
         "Own.init."),
        ("learn", lambda self, t, s, r, k: s, r"returns float32\[2\]; it must be the next state, "),
        ("learn", lambda self, t, s, r, k: (s[:1], {}),
         r"Own.learn returns float32\[1\] as state; it must be float32\[2\], like that of Own.ini"),
        ("learn", lambda self, t, s, r, k: (s, {"reward": r.reward}),
         r"Own.learn returns {reward: float32\[1,2\]} as metrics; it must be a dict of names and "),
        ("learn", lambda self, t, s, r, k: (s, {"episode": s[0]}),
         "Own.learn returns the metric 'episode', a name that the records already have; rename "),
        ("monitor", lambda self, state: {"reward": state[0]},
         "Own.learn and Own.monitor both return a metric 'reward'; rename one of them."),
        ("measure", lambda self, task, step: {"reward": step.reward},
         "Own.learn and Own.measure both return a metric 'reward'; rename one of them."),
        ("monitor", lambda self, state: None, "Own.monitor returns None as metrics; it must be "),
        ("weights", lambda self, state: None, "Own.weights returns None; it must be an array, or "),
        ("weights", lambda self, state: jax.random.key(0),
         r"Own.weights returns key<fry>\[\]; it must be arrays of numbers, without random keys."),
        ("policy", lambda self, w, o: jnp.zeros(2, int), r"returns int32\[2\]; it must be int32\["),
        ("action_values", lambda self, w, o: w, r"returns float32\[2\]; it must be float32\[3,2"),
        ("warm_up", 0, "Own.warm_up must be a method that takes self."),
        ("warm_up", lambda self: None, r"Own.warm_up\(\) is None; it must be a whole number."),
        ("warm_up", lambda self: 5, "Own warms up for 5 steps, but stores nothing then; define "),
        ("rollout_steps", 0, "rollout_steps of Own is 0; it must be from 1 to "),
    ],
)  # fmt: skip
def test_agents(name, method, says):
    with pytest.raises(QfolioError, match=says):
        begun(Walk(), changed(Learner, name, method))


def test_the_place_in_a_large_state_is_named():
    class Own(Learner):
        def init(self, task, key):
            return {"table": jnp.zeros((9, 9)), "count": 0}

        def learn(self, task, state, rollout, key):
            return state | {"count": state["count"] + 0.5}, {}

        def policy(self, weights, observation):
            return jnp.zeros(len(observation), int)

    with pytest.raises(QfolioError, match=r"float32\[\] as state at \['count'\]; it must be int32"):
        begun(Walk(), Own())


def test_plain_numbers_and_arrays_of_numpy_are_enough():
    """What is returned is an array as soon as it is compiled."""

    class Plain(Walk):
        def reset(self, key):
            return {"cell": 0.0, "rest": np.zeros(2)}

        def observe(self, state):
            return {"cell": state["cell"], "one": 1.0}

        def step(self, state, action, key):
            outcome: Any = 1.0, False
            return Step(state, *outcome)

    small = DQN(hidden=(4,), batch_size=4, replay_capacity=50, learning_starts=4)
    population = Population(Plain(), small, [0])
    population.advance(10)
    assert population.healthy == [True]


def test_a_reward_may_be_a_whole_number():
    counting = changed(Walk, "step", lambda self, s, a, k: Step(s, jnp.int32(2), NO))
    population = Population(counting, Learner(), [0])
    population.advance(10)
    assert population.weights()[0].tolist() == [20, 20]  # the sum of the mean rewards


def test_an_error_in_own_code_stays_as_it_is():
    def step(self, state, action, key):
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine") as caught:
        begun(changed(Walk, "step", step), Learner())
    assert one_line(caught.value).startswith("KeyError: 'mine' (test_contract.py, line ")


@pytest.mark.parametrize(
    "use",
    [bool, int, float, np.asarray, range, lambda x: x[None][x[None] > 0]],
    ids=["if", "int", "float", "numpy", "for", "mask"],
)
def test_python_cannot_take_values_of_compiled_code(use):
    def step(self, state, action, key):
        use(state.sum().astype(jnp.int32))

    with pytest.raises((TypeError, IndexError)) as caught:
        begun(changed(Walk, "step", step), Learner())
    said = one_line(caught.value)
    assert "use jax.numpy, jnp.where or jax.lax (test_contract.py, line " in said
    assert len(said) < 230


def test_a_place_in_a_library_is_not_where_to_look():
    with pytest.raises(TypeError) as caught:
        jnp.reshape(jnp.zeros(3), 4)
    assert "(test_contract.py, line " in one_line(caught.value)


def test_a_choice_among_no_actions():
    with pytest.raises(QfolioError, match="n of Discrete is 0; it must be from 1 to "):
        Discrete(0)
