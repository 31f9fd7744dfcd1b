"""Agents on environments of Gymnasium, stepped from Python."""

import dataclasses
import gc
import json
import os
import subprocess
import sys
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.agents.dqn import DQN
from qfolio.agents.ppo import PPO
from qfolio.core import registry, settings
from qfolio.core.errors import QfolioError
from qfolio.core.evaluation import start_keys
from qfolio.core.host import Environments, HostPopulation
from qfolio.core.population import Population
from qfolio.experiments import presets
from qfolio.experiments.budget import Budget
from qfolio.experiments.run import Run, train
from qfolio.tasks.gymnasium import GymnasiumTask
from qfolio.tasks.pendulum import Pendulum

from populations import assert_same, first_member, stored, train_to
from probes import RewardDelay
from shell import qfolio


class Tiny(gymnasium.Env):
    """What a test needs of an environment, in one number of steps since the start."""

    observation_space = gymnasium.spaces.Box(-10, 10, (2,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.observe(), {}

    def observe(self):
        return np.array([1.0 - self.t, self.t], np.float32)

    def step(self, action):
        self.t += 1
        return self.observe(), *self.outcome(action), {}


class Delay(Tiny):
    """Two steps, of which the second pays 1: the probe ``RewardDelay``."""

    def outcome(self, action):
        return float(self.t == 2), self.t == 2, False


class Endless(Tiny):
    """Pays 1 for ever and is always the same, cut by the time limit or by itself."""

    def __init__(self, cut=10**9):
        self.cut = cut

    def observe(self):
        return np.ones(2, np.float32)

    def outcome(self, action):
        return 1.0, False, self.t >= self.cut


class Numbered(Tiny):
    """States 5 and 6, drawn at the reset; actions 7 and 8, of which the next number is right."""

    observation_space = gymnasium.spaces.Discrete(2, start=5)
    action_space = gymnasium.spaces.Discrete(2, start=7)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = int(self.np_random.integers(5, 7))
        return self.state, {}

    def step(self, action):
        assert self.action_space.contains(action)
        return self.state, float(action == self.state + 2), True, False, {}


class Aim(Tiny):
    """Two numbers within bounds of their own: the reward says how far they are from (1, 30)."""

    action_space = gymnasium.spaces.Box(*np.array([[0, 10], [4, 50]], np.float32))

    def outcome(self, action):
        assert self.action_space.contains(np.float32(action)), action
        return -abs(action[0] - 1) - abs(action[1] - 30) / 10, self.t == 2, False


class Narrow(Aim):
    """Bounds that rounding would exceed: −0.4 + (0.3 − −0.4) is above 0.3 in float32."""

    action_space = gymnasium.spaces.Box(*np.array([[-0.4, -0.7], [0.3, 0.1]], np.float32))


class Vast(Aim):
    """Bounds whose range is no number in single precision."""

    action_space = gymnasium.spaces.Box(-3e38, 3e38, (2,), np.float32)


class Shares(Tiny):
    """Whole numbers of three shares, at most five."""

    action_space = gymnasium.spaces.Box(0, 5, (3,), np.int32)

    def outcome(self, action):
        assert self.action_space.contains(action), action
        return float(-abs(action - 2).sum()), False, False


class Signed(Tiny):
    """A whole number of eight bits, whose range is wider than they are."""

    action_space = gymnasium.spaces.Box(-100, 100, (1,), np.int8)

    def outcome(self, action):
        assert self.action_space.contains(action), action
        return float(action[0]), False, False


class Named(Tiny):
    observation_space = gymnasium.spaces.Dict({"x": gymnasium.spaces.Discrete(2)})


class Unbounded(Tiny):
    action_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float32)


class Unmade(Tiny):
    def __init__(self):
        raise OSError("no license")


class Spaceless(gymnasium.Env):
    """Forgets to say what it shows."""

    action_space = gymnasium.spaces.Discrete(2)


class Faulty(Tiny):
    """Does at its second step, or at its start, what no environment should."""

    def __init__(self, fault):
        self.fault = fault

    def reset(self, *, seed=None, options=None):
        seen, info = super().reset(seed=seed)
        if self.fault == "fails to start":
            raise RuntimeError("no license")
        if self.fault == "starts with NaN":
            seen = np.array([np.nan, 0], np.float32)
        return seen, info

    def step(self, action):
        self.t += 1
        seen, reward = self.observe(), 1.0
        if self.t == 2:
            if self.fault == "raises":
                raise KeyError("missing")
            if self.fault == "old interface":
                return seen, reward, False, {}
            seen = {"NaN": seen * np.nan, "longer": np.ones(3), "number": 1.0}.get(self.fault, seen)
            rewards: dict[str, Any] = {
                "no reward": np.nan, "rewards": np.ones(1), "huge": 1e300, "none": None,
                "text": "much",
            }  # fmt: skip
            reward = rewards.get(self.fault, reward)
        return seen, reward, False, False, {}


KINDS = (
    Delay, Endless, Numbered, Aim, Narrow, Vast, Shares, Signed, Named, Unbounded, Unmade,
    Spaceless, Faulty,
)  # fmt: skip
ENVIRONMENTS = {kind: f"Test{kind.__name__}-v0" for kind in KINDS}
for _kind, _id in ENVIRONMENTS.items():
    gymnasium.register(_id, entry_point=_kind, max_episode_steps=4)

SMALL = DQN(
    hidden=(8,), num_envs=2, batch_size=4, replay_capacity=64, learning_starts=4,
    target_update_interval=1, tau=0.1, learning_rate=3e-3, episode_steps=0,
)  # fmt: skip


def task(kind, **options):
    return GymnasiumTask(ENVIRONMENTS[kind], **options)


def trained(task, agent, seeds, steps, kind=HostPopulation):
    return train_to(kind(task, agent, seeds), steps)


def test_it_learns_what_the_compiled_loop_learns():
    """On the same environment, from the same seeds, through another program."""
    host = trained(task(Delay), SMALL, [3, 4], 60).fetch()
    compiled = trained(RewardDelay(), SMALL, [3, 4], 60, Population).fetch()
    assert host.episodes.tolist() == compiled.episodes.tolist() == [60, 60]
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5),
        (host.agent, host.tally, host.steps),
        (compiled.agent, compiled.tally, compiled.steps),
    )


@pytest.mark.slow
def test_rollouts_are_those_of_the_compiled_loop():
    agent = PPO(
        hidden=(8,), num_envs=2, rollout_length=8, batch_size=8, epochs=2, learning_rate=1e-2
    )
    host = trained(task(Delay), agent, [1], 48).fetch()
    compiled = trained(RewardDelay(), agent, [1], 48, Population).fetch()
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4),
        (host.agent, host.tally),
        (compiled.agent, compiled.tally),
    )


def test_environments_are_closed_when_they_are_no_longer_used(monkeypatch):
    closed = []
    monkeypatch.setattr(Delay, "close", lambda self: closed.append(self), raising=False)
    population = trained(task(Delay), SMALL, [0], 8)
    made = len(closed)
    population.restore(population.fetch())
    gc.collect()
    assert len(closed) == made + SMALL.num_envs


def test_transitions_end_before_the_reset():
    rows = stored(trained(task(Delay), SMALL, [0], 4))
    np.testing.assert_array_equal(rows.observation[:8, 1], [0, 0, 1, 1, 0, 0, 1, 1])
    np.testing.assert_array_equal(rows.next_observation[:8, 1], [1, 1, 2, 2, 1, 1, 2, 2])
    np.testing.assert_array_equal(rows.reward[:8], [0, 0, 1, 1, 0, 0, 1, 1])
    np.testing.assert_array_equal(rows.terminal[:8], [False, False, True, True] * 2)


@pytest.mark.parametrize("options", [{}, {"kwargs": '{"cut": 3}'}, {"horizon": 2}])
def test_what_is_cut_is_not_the_end(options):
    """The time limit of the registry, the environment's own, and one that is asked for."""
    population = HostPopulation(task(Endless, **options), SMALL, [0])
    records = population.advance(12)
    records = population.advance(12) if not records.finished.any() else records
    assert not stored(population).terminal.any()
    length = {"": 4, "kwargs": 3, "horizon": 2}[next(iter(options), "")]
    assert set(records.returns[records.finished]) == {length}


def test_bootstraps_through_the_time_limit():
    agent = DQN(
        hidden=(16,), num_envs=4, batch_size=32, replay_capacity=1000, learning_starts=40,
        discount=0.8, target_update_interval=1, tau=0.05, learning_rate=3e-3,
        learning_rate_final=0.0, learning_rate_steps=1400.0, episode_steps=0,
    )  # fmt: skip
    weights = trained(task(Endless), agent, [0], 1500).weights()
    values = agent.action_values(first_member(weights), jnp.ones((1, 2)))
    assert values is not None
    np.testing.assert_allclose(values, [[5.0, 5.0]], rtol=0.02)


def test_a_seed_is_one_result_alone_and_among_others():
    agent = DQN(hidden=(8,), num_envs=3, batch_size=8, learning_starts=6, replay_capacity=99)
    together = trained(task(Numbered), agent, range(3), 150)
    alone = trained(task(Numbered), agent, [1], 150)
    again = trained(task(Numbered), agent, [1], 150)
    assert_same(alone.fetch(), again.fetch())
    assert_same(alone.fetch(), jax.tree.map(lambda x: x[1:2], together.fetch()))
    rows = together.fetch().agent.replay.rows
    assert not np.array_equal(rows[0], rows[1])
    keys = start_keys(12)
    assert_same(together.evaluate(keys).returns[1:2], alone.evaluate(keys).returns)


def test_numbers_that_do_not_begin_at_zero():
    numbered = task(Numbered)
    assert (numbered.states, numbered.actions.n, numbered.horizon) == (2, 2, 4)
    agent = DQN(
        hidden=(16,), num_envs=4, batch_size=32, replay_capacity=500, learning_starts=40,
        learning_rate=1e-2, epsilon_decay=0.98, episode_steps=0,
    )  # fmt: skip
    population = trained(numbered, agent, [0], 300)
    assert set(stored(population).observation.tolist()) == {0, 1}
    np.testing.assert_array_equal(population.evaluate(start_keys(25)).returns, np.ones((1, 25)))


@pytest.mark.slow
def test_coordinates_reach_from_bound_to_bound():
    facts = task(Aim).facts
    given = facts.given(np.array([[-1, -1], [1, 1], [0, 0.5], [-9, 9]], np.float32))
    np.testing.assert_allclose(given, [[0, 10], [4, 50], [2, 40], [0, 50]])
    agent = PPO(
        num_envs=8, rollout_length=16, batch_size=64, epochs=8, hidden=(16,), learning_rate=1e-2,
        learning_rate_final=0.0, learning_rate_steps=960.0, discount=0.5, initial_std=0.5,
    )  # fmt: skip
    population = trained(task(Aim), agent, [0], 16 * 60)
    assert population.evaluate(start_keys(3)).returns.min() > -0.3  # of two steps; at first −4


@pytest.mark.parametrize("kind", [Narrow, Vast])
def test_rounding_does_not_lead_beyond_a_bound(kind):
    given = task(kind).facts.given(np.array([[-1, -1], [1, 1], [0, 0]], np.float32))
    low, high = kind.action_space.low, kind.action_space.high
    np.testing.assert_array_equal(given[:2], [low, high])
    np.testing.assert_allclose(given[2], low / 2 + high / 2, atol=1e-7)


def test_every_graded_episode_is_that_of_its_seed():
    """Fewer starts than lanes, as many, and more: the first are the same."""
    population = trained(task(Numbered), SMALL, [0, 1], 4)
    many = population.evaluate(start_keys(23)).returns
    assert many.shape == (2, 23)
    for few in (1, 10, 12):
        assert_same(population.evaluate(start_keys(few)).returns, many[:, :few])


def test_short_episodes_of_training_leave_grades_alone():
    """An episode pays 1 at each of its four steps, of which training takes two."""
    agent = dataclasses.replace(SMALL, episode_steps=2)
    population = trained(task(Endless), agent, [0], 8)
    assert population.episodes == 8
    np.testing.assert_array_equal(population.evaluate(start_keys(3)).returns, np.full((1, 3), 4))


@pytest.mark.parametrize("kind", [Numbered, Aim, Shares])
def test_a_policy_acts_in_the_environment_as_it_is_graded(kind):
    """With states and actions that do not begin at 0, with bounds, and with whole numbers."""
    ppo = PPO(num_envs=2, rollout_length=8, batch_size=16, epochs=1, hidden=(8,))
    run = train(task(kind), SMALL if kind is Numbered else ppo, steps=200, seeds=2, seed=3)
    keys = start_keys(5)
    graded = run.population.evaluate(keys).returns
    env = gymnasium.make(ENVIRONMENTS[kind])
    for member, seed in enumerate((3, 4)):
        policy = run.policy(seed)
        for start, number in enumerate(np.asarray(jax.random.key_data(keys))[:, -1].tolist()):
            (seen, _), over, earned = env.reset(seed=number), False, 0.0
            while not over:
                seen, reward, terminated, truncated, _ = env.step(policy(seen))
                over, earned = terminated or truncated, earned + reward
            assert earned == pytest.approx(graded[member, start], rel=1e-5)
    with pytest.raises(QfolioError, match="seed is 5; the first of this run is 3, and the last 4"):
        run.policy(5)
    if kind is Aim:
        with pytest.raises(QfolioError, match=r"shape \(3,\); that of gym:TestAim-v0 is \(2,\)"):
            run.policy()(np.zeros(3))


def test_a_policy_keeps_what_it_was_made_with():
    run = train(Pendulum(horizon=20), DQN(hidden=(8,), learning_starts=10), episodes=2)
    policy, seen = run.policy(), np.array([1.0, 0.0, 0.5])
    with pytest.raises(QfolioError, match=r"shape \(4, 3\); that of pendulum is \(3,\)"):
        policy(np.zeros((4, 3)))  # a batch
    weights = run.first_weights()
    values = run.agent.action_values(weights, seen[None].astype(np.float32))
    assert values is not None
    assert policy(seen) == values.argmax()
    before = run.population.fetch()
    zeros = jax.tree.map(np.zeros_like, before)
    run.population.restore(zeros)
    assert policy(seen) == values.argmax()


def test_it_goes_on_from_a_checkpoint_in_new_episodes(tmp_path):
    numbered = task(Delay)
    run = Run.create(numbered, SMALL, steps=33, seeds=2, out=tmp_path / "run")
    run.train()
    assert run.config.episodes is None
    assert (run.done("steps"), run.population.steps) == (34, 17)  # whole steps of two environments
    assert run.population.fetch().tally.steps.tolist() == [[1, 1], [1, 1]]
    again = Run.open(tmp_path / "run")
    assert again.population.fetch().tally.steps.tolist() == [[0, 0], [0, 0]]
    assert_same(again.population.fetch().agent, run.population.fetch().agent)
    again.train(Budget(steps=60))
    assert again.done("steps") == 60
    assert again.config.steps == 60
    twice = Run.open(tmp_path / "run")
    assert twice.budget == Budget(steps=60)
    summary = twice.summary()
    assert (summary["optimum"], summary["regret_per_seed"]) == (None, None)
    assert summary["return_per_seed"] == [1.0, 1.0]


def test_returns_do_not_reach_from_a_cut_episode_into_a_new_one():
    agent = dataclasses.replace(SMALL, n_steps=2)
    ends = lambda population: stored(population).last.reshape(-1, 2)[:8, 0].tolist()  # noqa: E731
    population = trained(task(Endless), agent, [0], 6)
    state = population.fetch()
    population.advance(2)
    assert ends(population) == [False, False, False, True, False, False, False, True]
    population.restore(state)
    assert ends(population)[5] == False  # noqa: E712 (only if training goes on)
    population.advance(2)
    assert ends(population) == [False, False, False, True, False, True, False, False]


def test_environments_that_begin_again_do_not_repeat_themselves():
    """Each of these episodes is a step in a state that is drawn at its start."""
    population = trained(task(Numbered), SMALL, [0], 16)
    population.restore(population.fetch())
    states = stored(train_to(population, 32)).observation
    assert set(states.tolist()) == {0, 1}
    assert not np.array_equal(states[:32], states[32:])


def test_what_was_learned_outlives_an_exception_of_an_environment(monkeypatch):
    """It fails in the second member's fourth step, when both have learned since the last chunk."""
    agent = dataclasses.replace(SMALL, n_steps=2)
    population = trained(task(Endless), agent, [0, 1], 6)
    outcomes = iter([(1.0, False, False)] * 14)
    monkeypatch.setattr(Endless, "outcome", lambda *args: next(outcomes))
    with pytest.raises(QfolioError, match="step 2 of an episode: StopIteration"):
        population.advance(20)
    kept = population.fetch()
    assert (kept.steps.tolist(), population.steps) == ([10, 9], 9)
    assert kept.tally.steps.tolist() == [[0, 0], [0, 0]]
    monkeypatch.undo()
    assert population.evaluate(start_keys(3)).returns.tolist() == [[4.0] * 3] * 2
    population.advance(2)
    assert population.fetch().steps.tolist() == [12, 11]
    ends = stored(population).last.reshape(-1, 2)[:12, 0]
    assert ends.tolist() == [i in (3, 7, 9) for i in range(12)]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GymnasiumTask(json.loads("3")), "id is 3; it must be the ID of an environment"),
        (lambda: GymnasiumTask("CartPoll-v1"), "no environment 'CartPoll-v1'; did you mean CartP"),
        (lambda: GymnasiumTask("Nowhere/X-v0"), "Nowhere"),
        (lambda: GymnasiumTask("no_such_module:X-v0"), "no_such_module cannot be imported"),
        (lambda: task(Named), "observations of TestNamed-v0 are Dict.*FlattenObservation"),
        (lambda: task(Spaceless), "observations of TestSpaceless-v0 are None, but agents need"),
        (lambda: task(Unbounded), "actions of TestUnbounded-v0 .* bounds"),
        (lambda: task(Endless, kwargs='{"cuts": 3}'), "cannot be made with kwargs"),
        (
            lambda: GymnasiumTask("FrozenLake-v1", kwargs='{"map_name": "9x9"}'),
            r"""FrozenLake-v1 cannot be made with kwargs={"map_name": "9x9"}: KeyError: '9x9' \(""",
        ),
        (lambda: task(Unmade), r"TestUnmade-v0 cannot be made: OSError: no license \(test_host"),
        (lambda: task(Endless, kwargs='{"max_episode_steps": 3}'), "set horizon instead, as in"),
        (lambda: task(Endless, kwargs='{"id": "X"}'), "kwargs sets id; the task names the envir"),
        (lambda: task(Endless, kwargs="cut=3"), "^kwargs is cut=3; it must be a JSON object"),
        (lambda: task(Endless, kwargs={"cut": 3}), "kwargs is {'cut': 3}; it must be JSON"),
        (lambda: task(Delay, horizon=-1), "horizon is -1"),
        (lambda: Population(task(Delay), SMALL, [0]).advance(4), "cannot be compiled"),
        (lambda: HostPopulation(task(Aim), SMALL, [0]), "dqn"),
    ],
)  # fmt: skip
def test_it_says_what_is_wrong(make, message):
    with pytest.raises(QfolioError, match=message):
        make()


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("NaN", "step 2 of an episode: its observation is not finite"),
        ("no reward", "step 2 of an episode: its reward is not finite"),
        ("huge", "step 2 of an episode: its reward is not finite in single precision"),
        ("none", "step 2 of an episode: its reward is None, which is no number"),
        ("text", "step 2 of an episode: its reward is the text 'much', which is no number"),
        ("rewards", r"step 2 of an episode: its reward has the shape \(1,\); it must be one num"),
        ("starts with NaN", "the start of an episode: its observation is not finite"),
        ("longer", r"step 2 .* has the shape \(3,\) and its observation space \(2,\)"),
        ("number", r"step 2 .* has the shape \(\) and its observation space \(2,\)"),
        ("raises", r"step 2 of an episode: KeyError: 'missing' \(test_host.py, line \d+\)"),
        ("old interface", r"step 2 of an episode: its step returned 4 values; wanted are obs"),
        ("fails to start", r"the start of an episode: RuntimeError: no license"),
    ],
)  # fmt: skip
def test_a_fault_of_an_environment_is_told_as_its_own(fault, says):
    faulty = task(Faulty, kwargs=json.dumps({"fault": fault}))
    environments = Environments(faulty, limit=4, count=2)
    with pytest.raises(QfolioError, match=f"^gym:TestFaulty-v0 failed at {says}"):  # noqa: PT012
        for index in range(2):
            environments.reset(index)
        for _ in range(2):
            environments.step(np.zeros(2, np.int32))


@pytest.mark.parametrize("state", [4, 7, 5.5])
def test_a_number_that_is_no_state_is_told(state):
    environments = Environments(task(Numbered), limit=4, count=1)
    with pytest.raises(QfolioError, match=rf"is {state} and .* the whole numbers from 5 to 6$"):
        environments._seen(state)


def test_whole_numbers_are_given_where_actions_are_whole():
    environments = Environments(task(Shares), limit=4, count=2)
    for index in range(2):
        environments.reset(index)
    found = environments.step(np.array([[-1, -0.15, 2], [0.7, 0, 1]], np.float32))
    np.testing.assert_array_equal(found.reward, [-5, -5])  # of 0, 2, 5 and of 4, 2, 5
    environments = Environments(task(Signed), limit=4, count=4)
    for index in range(4):
        environments.reset(index)
    found = environments.step(np.array([[-1], [-0.5], [0], [1]], np.float32))
    np.testing.assert_array_equal(found.reward, [-100, -50, 0, 100])


def test_an_environment_that_is_registered_anew_is_read_anew():
    """As in a notebook whose cell is run again."""

    class Wider(Delay):
        observation_space = gymnasium.spaces.Box(-10, 10, (3,), np.float32)

    gymnasium.register("TestAgain-v0", entry_point=Delay, max_episode_steps=4)
    before = GymnasiumTask("TestAgain-v0")
    assert (before.horizon, before.observation[0]) == (4, (2,))
    gymnasium.registry.pop("TestAgain-v0")
    gymnasium.register("TestAgain-v0", entry_point=Wider, max_episode_steps=9)
    after = GymnasiumTask("TestAgain-v0")
    assert (after.horizon, after.observation[0]) == (9, (3,))


def test_an_agent_trains_with_what_is_registered_now():
    """Programs of equal settings are shared, unless these mean another environment."""

    class More(Endless):
        action_space = gymnasium.spaces.Discrete(3)

    for kind in (Endless, More):
        gymnasium.registry.pop("TestShared-v0", None)
        gymnasium.register("TestShared-v0", entry_point=kind, max_episode_steps=4)
        population = trained(GymnasiumTask("TestShared-v0"), SMALL, [0], 40)
        assert set(stored(population).action[:80].tolist()) == set(range(kind.action_space.n))


def test_an_agent_that_diverges_is_not_the_environments_fault():
    wild = PPO(hidden=(8,), num_envs=2, rollout_length=4, batch_size=8, learning_rate=1e30,
               max_grad_norm=1e30)  # fmt: skip
    with pytest.raises(QfolioError, match="loss of seed 0 is no longer finite"):
        trained(task(Aim), wild, [0], 200)


def test_without_gymnasium_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    with pytest.raises(QfolioError, match=r'pip install "qfolio\[gym\]"'):
        GymnasiumTask("Unseen-v0")


def test_what_an_environment_needs_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "Box2D", None)
    for name in [name for name in sys.modules if name.startswith("gymnasium.envs.box2d")]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(QfolioError, match=r'pip install "qfolio\[box2d\]"'):
        GymnasiumTask("LunarLander-v3", kwargs='{"gravity": -9.0}')


def test_a_folder_imports_nothing(tmp_path, monkeypatch):
    """A run of a stranger may name a module; opening it must not run that."""
    (tmp_path / "theirs.py").write_text("raise AssertionError('was run')")
    monkeypatch.syspath_prepend(tmp_path)
    Run.create(task(Delay), SMALL, steps=4, out=tmp_path / "run")
    path = tmp_path / "run" / "config.json"
    config = json.loads(path.read_text())
    config["task"], config["task_settings"]["id"] = "gym:theirs:X-v0", "theirs:X-v0"
    path.write_text(json.dumps(config))
    with pytest.raises(QfolioError, match="module theirs"):
        Run.open(tmp_path / "run")


def test_names_and_presets():
    assert registry.find("task", "gym:CartPole-v1") is GymnasiumTask
    assert registry.name_of(task(Delay)) == "gym:TestDelay-v0"
    with pytest.raises(QfolioError, match="gym:CartPole-v1"):
        registry.find("task", "xyz")
    unknown = presets.preset("fast", "gym:TestDelay-v0", "dqn")
    assert unknown.build() == DQN()
    assert settings.build(GymnasiumTask, unknown.task) == task(Delay)
    for agent in ("ppo", "a2c", "sac", "td3", "ddpg"):
        assert presets.preset("fast", "gym:TestDelay-v0", agent).settings["normalize_observations"]
    for name, agent in presets.PRESETS:
        if name.startswith(registry.GYM):
            assert presets.preset("fast", name, agent).task["id"] == name.removeprefix("gym:")


TINY = ["--set", "hidden=8", "num_envs=2", "batch_size=8", "learning_starts=16"]


@pytest.mark.slow
def test_the_command_trains_reports_and_goes_on(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "run"
    start = ["train", "gym:CartPole-v1", "--agent", "dqn", "--seeds", "2", "--out", folder]
    assert qfolio(monkeypatch, *start, "--steps", "300", "--no-compare", *TINY) == 0
    config = json.loads((folder / "config.json").read_text())
    assert (config["task"], config["steps"]) == ("gym:CartPole-v1", 300)
    report = (folder / "report.html").read_text()
    assert "DQN on CartPole-v1" in report
    assert "--steps 300" in report
    assert "optimum" not in report
    assert qfolio(monkeypatch, "train", "--resume", folder, "--steps", "400", "--no-compare") == 0
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["env_steps"] == 400
    capsys.readouterr()
    assert qfolio(monkeypatch, "evaluate", folder, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["starts"] == 100
    assert result["return_per_seed"] == summary["return_per_seed"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["gym:CartPoll-v1"], "did you mean CartPole-v1"),
        (["gym:CartPole-v1", "--steps", "9", "--episodes", "9"], "give one of them"),
        (["gym:CartPole-v1", "--steps", "0"], "steps is 0"),
        (["gym:Pendulum-v1", "--agent", "dqn"], "dqn"),
        (["gym:Blackjack-v1"], "FlattenObservation"),
    ],
)
def test_wrong_input_gets_one_sentence(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert qfolio(monkeypatch, "train", *arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.optimized
@pytest.mark.parametrize("agent", [pytest.param("dqn", marks=pytest.mark.long), "ppo"])
def test_the_pole_is_balanced(agent):
    preset = presets.preset("fast", "gym:CartPole-v1", agent)
    run = Run.create(
        GymnasiumTask(**preset.task), preset.build(), seeds=1, seed=100, budget=preset.budget
    )
    run.train()
    assert run.grade()["return_per_seed"] == [500.0]


@pytest.mark.optimized
@pytest.mark.parametrize(
    ("task", "returns"),
    [
        ("MountainCarContinuous-v0", 85.0),
        pytest.param("Pendulum-v1", -170.0, marks=pytest.mark.long),
    ],
)
def test_actions_with_bounds_are_learned(task, returns):
    """Within a third of the budget.

    The first by exploration that persists: with independent noise it stays at 0.
    """
    preset = presets.preset("fast", f"gym:{task}", "sac")
    third = preset.steps // 3
    run = Run.create(GymnasiumTask(**preset.task), preset.build(), seeds=1, seed=100, steps=third)
    run.train()
    assert run.grade()["return_per_seed"][0] > returns


def test_training_does_not_depend_on_the_number_of_threads():
    code = (
        "import hashlib, jax; from qfolio import DQN; from qfolio.core.host import HostPopulation\n"
        "from qfolio.tasks.gymnasium import GymnasiumTask\n"
        "agent = DQN(hidden=(256,), batch_size=256, learning_starts=256, replay_capacity=999)\n"
        "population = HostPopulation(GymnasiumTask('CartPole-v1'), agent, [0])\n"
        "while population.steps < 320:\n"
        "    population.advance(64)\n"
        "weights = jax.tree.leaves(population.weights())\n"
        "print(hashlib.sha256(b''.join(x.tobytes() for x in weights)).hexdigest())\n"
    )
    learned = {
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True,
            env=os.environ | {"NPROC": threads, "XLA_FLAGS": ""},
        ).stdout
        for threads in ("1", "8")
    }  # fmt: skip
    assert len(learned) == 1
