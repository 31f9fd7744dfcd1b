import itertools
import os

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.agents.a2c import A2C
from qfolio.agents.dqn import DQN
from qfolio.agents.ppo import PPO
from qfolio.agents.sac import SAC
from qfolio.core import faults
from qfolio.core.contract import learning_of
from qfolio.core.devices import Members, configure, places
from qfolio.core.errors import QfolioError
from qfolio.core.fields import number, static
from qfolio.core.mdp import Agent, Discrete, Step
from qfolio.core.population import Population, Rehearsal, programs_of
from qfolio.core.training import advance, begin, chunk_steps
from qfolio.tasks.pendulum import Pendulum

import probes
from planted import Known
from populations import assert_same, stored, train_to
from probes import Endless, Explosive, OneState, Probe, RewardDelay


def trained(task, agent, seeds, steps):
    population = Population(task, agent, seeds)
    records = []
    for end in steps:
        while population.steps < end:
            records.append(population.advance(end - population.steps))
    return population, records


def test_a_seed_alone_equals_the_seed_among_others(task, agent):
    together, _ = trained(task, agent, range(5), [150])
    for seed in (0, 3):
        alone, _ = trained(task, agent, [seed], [150])
        assert_same(alone.fetch(), jax.tree.map(lambda x, s=seed: x[s : s + 1], together.fetch()))


@pytest.mark.parametrize(
    "agent",
    [
        PPO(hidden=(64, 64), num_envs=4, rollout_length=16, batch_size=32, epochs=4,
            normalize_observations=True),
        SAC(hidden=(64, 64), num_envs=2, learning_starts=32, batch_size=32),
    ],
    ids=["PPO", "SAC"],
)  # fmt: skip
def test_a_seed_alone_equals_the_seed_among_others_in_a_continuous_task(agent):
    """A program for three members of a place is another one than that for two or one."""
    task, seeds = Pendulum(), range(2 * len(places()) + 1)
    together, _ = trained(task, agent, seeds, [256])
    alone, _ = trained(task, agent, [1], [256])
    assert alone._programs is not together._programs
    assert_same(alone.fetch(), jax.tree.map(lambda x: x[1:2], together.fetch()))


def test_members_of_another_number_share_programs(task, agent):
    """A smaller population that comes first leaves no member of a larger one out."""
    small, large = (Population(task, agent, range(count), room=5) for count in (1, 5))
    for population in (small, large):
        train_to(population, 120)
    assert small._programs is large._programs
    assert_same(large.fetch(), trained(task, agent, range(5), [120])[0].fetch())
    first = jax.tree.map(lambda leaf: leaf[:1], large.fetch())
    assert_same(small.fetch(), first)


def test_a_reward_that_is_defined_again_is_the_one_that_trains(monkeypatch):
    """Programs of equal settings are shared, unless these mean another class."""
    task, agent = probes.Rewarded(horizon=5), A2C(hidden=(2,), num_envs=1)

    def one_return():
        return trained(task, agent, [0], [5])[1][0].returns[0, 4, 0]

    before = learning_of(task, agent)
    assert one_return() == 5
    monkeypatch.setattr(probes, "Bonus", type("Bonus", (probes.Bonus,), {"value": 2.0}))
    assert one_return() == 10
    assert learning_of(task, agent) is not before


def test_a_rehearsal_compiles_what_a_population_runs(task, agent):
    """And nothing else: no state is made, and training is the same to the bit."""
    expected, _ = trained(task, agent, range(3), [120])
    programs_of.cache_clear()
    rehearsal = Rehearsal(task, agent, range(3))
    assert rehearsal._programs.keys() == {"begin", "collect", "learn"}
    assert not any(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(rehearsal._states))
    population, _ = trained(task, agent, range(3), [120])
    assert population._programs is rehearsal._programs
    assert population.seconds_compile == 0
    assert_same(population.fetch(), expected.fetch())


@pytest.mark.parametrize(
    "agent",
    [
        DQN(hidden=(17,), num_envs=2, batch_size=8, replay_capacity=200, learning_starts=20),
        PPO(hidden=(17,), num_envs=2, rollout_length=5, batch_size=5),
    ],
    ids=["DQN", "PPO"],
)
def test_learning_is_traced_once(agent, monkeypatch):
    """It takes most of the time before the first step."""
    traced, learn = [], type(agent).learn

    def counted(*args):
        traced.append(args)
        return learn(*args)

    monkeypatch.setattr(type(agent), "learn", counted)
    trained(Endless(), agent, [0, 1], [50])
    assert len(traced) == 1


def test_different_seeds_differ(task, agent):
    population, _ = trained(task, agent, range(3), [60])
    weights = agent.weights(population.fetch().agent).mlp.weights[0]
    assert not np.array_equal(weights[0], weights[1])
    assert not np.array_equal(weights[1], weights[2])


def test_pauses_change_nothing(task, agent):
    paused, _ = trained(task, agent, [0, 1], [3, 10, 11, 90, 150])
    straight, _ = trained(task, agent, [0, 1], [150])
    assert_same(paused.fetch(), straight.fetch())


def test_restoring_goes_on_bit_for_bit(task, agent):
    first, _ = trained(task, agent, [0, 1, 2], [77])
    second = Population(task, agent, [0, 1, 2])
    second.restore(first.fetch())
    straight, _ = trained(task, agent, [0, 1, 2], [150])
    second.advance(150 - 77)
    assert_same(second.fetch(), straight.fetch())


class Drawn(OneState):
    """Its state has a random key."""

    horizon: int = static(3)

    def reset(self, key):
        return key

    def step(self, state, action, key):
        return Step(key, jax.random.uniform(state), jnp.array(False))


class Drawing(Known):
    """Its state has a random key."""

    def init(self, task, key):
        return {"key": key, "weights": jnp.zeros(())}

    def act(self, state, observation, key):
        return jax.random.randint(state["key"], (self.num_envs,), 0, 2)

    def learn(self, task, state, rollout, key):
        return {"key": key, "weights": state["weights"] + rollout.reward.sum()}, {}

    def weights(self, state):
        return state["weights"]

    def policy(self, weights, observation):
        return jnp.zeros(len(observation), jnp.int32)


def test_states_may_hold_random_keys():
    first, _ = trained(Drawn(), Drawing(), [0, 1], [7])
    second = Population(Drawn(), Drawing(), [0, 1])
    second.restore(first.fetch())
    straight, _ = trained(Drawn(), Drawing(), [0, 1], [20])
    assert_same(train_to(second, 20).fetch(), straight.fetch())
    assert second.weights()[0] != second.weights()[1]


def test_a_restored_training_goes_on_for_several_chunks():
    """Also with empty arrays, such as the deviations of a policy that chooses."""
    agent = PPO(hidden=(4,), num_envs=2, rollout_length=4, batch_size=8)
    first, _ = trained(RewardDelay(), agent, [0, 1], [8])
    second = Population(RewardDelay(), agent, [0, 1])
    second.restore(first.fetch())
    second.advance(8)
    second.advance(8)
    straight, _ = trained(RewardDelay(), agent, [0, 1], [24])
    assert any(leaf.size == 0 for leaf in jax.tree.leaves(second.fetch().agent))
    assert_same(second.fetch(), straight.fetch())


def test_transitions_end_before_the_reset():
    """The buffer of a task whose every transition is known: 0 → 1 → end."""
    agent = DQN(
        hidden=(4,), num_envs=2, batch_size=4, replay_capacity=8, learning_starts=4,
        episode_steps=0,
    )  # fmt: skip
    population, _ = trained(RewardDelay(), agent, [0], [4])
    rows = stored(population)
    np.testing.assert_array_equal(rows.observation[:, 1], [0, 0, 1, 1, 0, 0, 1, 1])
    np.testing.assert_array_equal(rows.next_observation[:, 1], [1, 1, 2, 2, 1, 1, 2, 2])
    np.testing.assert_array_equal(rows.reward, [0, 0, 1, 1, 0, 0, 1, 1])
    np.testing.assert_array_equal(rows.terminal, [False, False, True, True] * 2)


def test_records_are_the_finished_episodes(task, agent):
    _, records = trained(task, agent, [0], [100])
    finished = np.concatenate([r.finished[0, :100] for r in records])
    assert finished.sum() == 8  # two environments, four episodes of 25 steps
    returns = np.concatenate([r.returns[0][r.finished[0]] for r in records])
    assert (returns < 0).all()
    metrics = {k: v[0][records[-1].finished[0]] for k, v in records[-1].metrics.items()}
    assert set(metrics) == {"loss", "epsilon", "max_q"}
    assert all(np.isfinite(v).all() for v in metrics.values())
    decayed = agent.epsilon_decay ** np.array([0, 0, 2, 2, 4, 4, 6, 6])
    np.testing.assert_allclose(metrics["epsilon"], decayed, rtol=1e-5)


def test_the_return_of_a_record_is_the_sum_of_rewards(task, agent):
    """Against the rewards in the buffer, which the first episode still fills in order."""
    population, records = trained(task, agent, [0], [25])
    rewards = stored(population).reward[:50].reshape(25, 2)
    last = records[-1]
    np.testing.assert_allclose(last.returns[0][last.finished[0]], rewards.sum(0), rtol=1e-5)


class Many(Endless):
    """Four steps, with so many actions that two keys hardly choose the same."""

    horizon: int = static(4)

    @property
    def actions(self):
        return Discrete(2**20)


class Keyed(Agent):
    """Acts by its key alone, and reports whether it learns with the same one."""

    num_envs: int = static(1)
    episode_steps: int = static(0)

    discount = None

    def warm_up(self):
        return 2

    def init(self, task, key):
        return jnp.array(0.0)

    def act(self, state, observation, key):
        return jax.random.randint(key, (1,), 0, 2**20)

    def observe(self, state, rollout):
        return state

    def learn(self, task, state, rollout, key):
        same = (self.act(state, None, key) == rollout.action[-1]).mean()
        return state, {"same": same, "learned": jnp.array(1.0)}

    def weights(self, state):
        return state

    def policy(self, weights, observation):
        return jnp.zeros(len(observation), jnp.int32)


def test_learning_has_a_key_of_its_own_and_metrics_are_means_over_its_steps():
    """The first two of the first episode's four steps are only observed."""
    _, records = trained(Many(), Keyed(), [0], [8])
    found = records[-1]
    assert found.finished.sum() == 2
    for name, mean in {"same": 0.0, "learned": 1.0}.items():
        np.testing.assert_array_equal(found.metrics[name][found.finished], [mean, mean])


def test_training_episodes_can_be_cut_shorter(task):
    agent = DQN(hidden=(4,), num_envs=2, batch_size=4, learning_starts=4, episode_steps=5)
    population, _ = trained(task, agent, [0], [20])
    assert population.episodes == 8
    assert not stored(population).terminal.any()


@pytest.mark.parametrize(
    ("horizon", "rollout", "steps"),
    [(28, 1, 420), (500, 1, 500), (200, 64, 1600), (200, 2048, 2048), (997, 32, 416)],
)
def test_chunks_stay_short(horizon, rollout, steps):
    """Whole episodes and rollouts where few of them fit; curves and Ctrl-C wait for a chunk."""
    agent = PPO(num_envs=1, rollout_length=rollout, batch_size=rollout)
    assert chunk_steps(RewardDelay(horizon=horizon), agent) == steps


def test_warm_up_stores_and_does_not_learn(task, agent):
    population = Population(task, agent, [0])
    before = agent.weights(population.fetch().agent)
    population.advance(1000)  # stops where learning begins
    after = population.fetch()
    assert after.steps == agent.warm_up() == 9
    assert after.agent.replay.size == 18
    assert_same(agent.weights(after.agent), before)


def test_steps_left_ends_with_whole_episodes(task, agent):
    population = Population(task, agent, [0])
    assert population.steps_left(3) == 50
    while population.steps_left(3):
        population.advance(population.steps_left(3))
    assert (population.steps, population.episodes) == (50, 4)


def test_steps_left_counts_those_of_all_environments(task, agent):
    population = Population(task, agent, [0])
    assert population.steps_left(steps=61) == 31
    population.advance(population.steps_left(steps=61))  # the warm-up
    assert population.steps_left(steps=61) == 31 - agent.warm_up()
    population.advance(population.steps_left(steps=61))
    assert (population.steps, population.steps_left(steps=61)) == (31, 0)


class Blind(RewardDelay):
    """Sees nothing from its second step on."""

    def observe(self, state):
        return super().observe(state) / (state < 0.5)


class Uncounted(RewardDelay):
    """Numbers more states than it says there are."""

    states = 1

    def observe(self, state):
        return state.astype(int)


class Torn(Probe):
    """From time to time it pays nothing at all."""

    horizon: int = static(5)
    reset, observe = OneState.reset, OneState.observe

    def step(self, state, action, key):
        reward = jnp.where(jax.random.bernoulli(key, 0.01), jnp.nan, 1.0)
        return Step(state, reward, jnp.array(False))


class Flickering(Probe):
    """From time to time it shows nothing at all."""

    horizon: int = static(5)
    reset = OneState.reset

    def observe(self, state):
        return jnp.where(state > 0.99, jnp.nan, state)[None]

    def step(self, state, action, key):
        return Step(jax.random.uniform(key), 1.0 * action, jnp.array(False))


@pytest.mark.parametrize(
    ("task", "changes", "says"),
    [
        (Torn(), {}, "With seed 4, the reward of Torn is not finite at step . of an episode; ch"),
        (Flickering(), {}, "the observation of Flickering is not finite after step . of an episod"),
        (Uncounted(), {}, "observation of Uncounted is not from 0 to 0 after step 1"),
        (Endless(), {"learning_rate": 1e30}, "loss of seed 4, 5 is no longer finite"),
        (Explosive(), {}, "reward of Explosive is not finite at step 42 of an episode"),
        (Blind(), {}, "observation of Blind is not finite after step 1 of an episode"),
    ],
)
def test_an_infinite_loss_stops_training(task, changes, says):
    """And what the task has done is not put down to the learning rate."""
    agent = DQN(hidden=(4,), num_envs=2, batch_size=8, learning_starts=4, **changes)
    population = Population(task, agent, [4, 5])
    population.advance(1000)  # warm-up
    with pytest.raises(QfolioError, match=says):
        population.advance(1000)


class Overflowing(Endless):
    """Rewards that are infinite where its payment is."""

    payment: float = number(1.0)

    def step(self, state, action, key):
        return Step(state, jnp.asarray(self.payment), jnp.array(False))


def test_a_fault_is_sought_in_the_task_of_the_member_that_failed():
    agent = DQN(hidden=(4,), num_envs=2, batch_size=8, learning_starts=4)
    tasks = [Overflowing(), Overflowing(payment=float("inf"))]
    population = Population(tasks, agent, [4, 5])
    population.advance(1000)  # warm-up
    with pytest.raises(QfolioError, match="With seed 5, the reward of Overflowing is not finite"):
        population.advance(1000)


def test_a_fault_is_sought_with_one_state_in_memory(task, agent, monkeypatch):
    """A large replay buffer may not fit in memory twice."""
    given, compiled = [], jax.jit

    def jit(function, **options):
        program = compiled(function, **options)

        def call(*args, **changes):
            if function.__name__ == "train":
                given.append(args[1])
            return program(*args, **changes)

        return call

    with monkeypatch.context() as patched:
        patched.setattr(faults.jax, "jit", jit)
        assert faults.find(task, agent, 0, 1000) is None
    assert len(given) > 1
    assert all(leaf.is_deleted() for state in given for leaf in jax.tree.leaves(state))


def test_no_fault_is_found_where_memory_is_too_small(task, agent, monkeypatch):
    """The error that led to the search is told."""

    def exhausted(*args):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory")

    monkeypatch.setattr(faults, "begin", exhausted)
    assert faults.find(task, agent, 0) is None


def test_a_fault_is_not_sought_for_long(task, agent, monkeypatch):
    """Before the error of a learning that failed late, nothing is said."""
    seconds = itertools.count(0, 2)
    monkeypatch.setattr(faults, "perf_counter", lambda: next(seconds))
    assert faults.find(task, agent, 0, 100_000) is None
    assert next(seconds) <= 14


def test_hyperparameters_can_differ_between_members(task, agent):
    """A sweep is a vmap over agents: one compiled program serves all configurations."""

    def weights_after(rate):
        varied = eqx.tree_at(lambda a: a.learning_rate, agent, rate)
        state = begin(task, varied, jnp.array(0, jnp.uint32))
        state, _ = advance(task, varied, state, jnp.array(15), learning=True)
        return state.agent.online.mlp.weights[0]

    slow, fast = jax.vmap(weights_after)(jnp.array([1e-3, 1e-2]))
    assert not np.allclose(slow, fast)


def test_lockstep_members_learn_the_same(task, agent, monkeypatch):
    """On a GPU members are stepped in lockstep (vmap); only the rounding may differ."""
    one_by_one, _ = trained(task, agent, [0, 1, 2], [30])
    monkeypatch.setattr("qfolio.core.devices.LOCKSTEP", {"cpu"})
    lockstep, _ = trained(task, agent, [0, 1, 2], [30])
    assert lockstep._programs is not one_by_one._programs  # or this would compare like with like
    expected, actual = (p.fetch().agent.online.mlp.weights for p in (one_by_one, lockstep))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), expected, actual)


def test_sums_are_left_to_compiled_loops():
    rows = jnp.ones((2, 64, 64))
    program = Members(1).compile(lambda x: (x**2).sum(-1), rows).on(jax.devices()[0])
    assert "ynn_fusion" not in str(program.as_text())


def lowered_product() -> str:
    return jax.jit(lambda x: x @ x).lower(jnp.ones((4, 4))).as_text()


def test_products_are_as_precise_on_any_device():
    assert "precision = [HIGHEST, HIGHEST]" in lowered_product()


def test_a_precision_that_the_user_chose_is_kept(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", os.environ["XLA_FLAGS"])
    jax.config.update("jax_default_matmul_precision", "tensorfloat32")
    try:
        configure()
        assert "precision = [HIGH, HIGH]" in lowered_product()
    finally:
        jax.config.update("jax_default_matmul_precision", "highest")


def test_a_version_of_xla_that_lacks_the_option_compiles_without_it(task, agent, monkeypatch):
    monkeypatch.setattr("qfolio.core.devices.PRODUCTS_ONLY", {"xla_no_such_option": True})
    programs_of.cache_clear()
    population, _ = trained(task, agent, [0], [30])
    assert population.steps == 30


def test_small_loops_are_compiled_whole():
    loop = jax.jit(lambda x: jax.lax.fori_loop(0, 50, lambda i, x: jnp.sin(x) * 2, x))
    program = loop.lower(jnp.ones(1000)).compile().as_text()
    assert program is not None
    assert "small_call" in program
    assert " while(" not in program.split("ENTRY")[1]
