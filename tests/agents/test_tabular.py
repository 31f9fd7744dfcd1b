import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equinox import filter_jit as jit

from qfolio.agents.dqn import DQN
from qfolio.agents.dyna_q import Counts, DynaQ
from qfolio.agents.tabular import DoubleQ, ExpectedSarsa, Move, QLearning, Sarsa, step_share
from qfolio.core.errors import QfolioError
from qfolio.core.fields import static
from qfolio.core.mdp import Discrete, Step, Task, Transition
from qfolio.core.population import Population
from qfolio.experiments.presets import preset
from qfolio.experiments.run import train
from qfolio.tasks.finite import Cliff, FiniteMDP, FrozenLake, Garnet
from qfolio.tasks.grid_pendulum import GridPendulum
from qfolio.tasks.pendulum import Pendulum

from populations import first_member, train_to
from shell import qfolio

KINDS = [QLearning, Sarsa, ExpectedSarsa, DoubleQ, DynaQ]
DISCOUNT = 0.9


def anywhere(task, **changes):
    """The task with episodes that start in any state, so that every entry is visited."""
    return FiniteMDP(
        task.transitions, task.rewards, terminal=task.terminal, successors=task.successors,
        **{"horizon": 20, **changes},
    )  # fmt: skip


class Longer(Task):
    """A walk over more cells than it says there are."""

    horizon: int = static(8)
    actions = Discrete(2)
    states = 3

    def reset(self, key):
        return jnp.array(0, jnp.int32)

    def observe(self, state):
        return state

    def step(self, state, action, key):
        return Step(state + 1, jnp.array(1.0), jnp.array(False))


@pytest.mark.parametrize("kind", KINDS)
def test_states_beyond_the_last_are_refused(kind):
    """They would share the entries of the last one without a word."""
    with pytest.raises(QfolioError, match="observation of Longer is not from 0 to 2 after step 3"):
        train(Longer(), kind(), steps=400)


class Beyond(Longer):
    """It begins in a cell that it does not have, and goes back to the others."""

    def reset(self, key):
        return jnp.array(5, jnp.int32)

    def step(self, state, action, key):
        return Step(jnp.maximum(state - 4, 0), jnp.array(1.0), jnp.array(False))


@pytest.mark.parametrize("kind", KINDS)
def test_a_start_beyond_the_last_state_is_refused(kind):
    """What is learned of it would be dropped without a word."""
    with pytest.raises(QfolioError, match="observation of Beyond is not from 0 to 2 at the start"):
        train(Beyond(), kind(), steps=400)


def trained(task, agent, steps, seeds=(100,)):
    """Learned action values (seed, state, action)."""
    population = train_to(Population(task, agent, seeds), steps)
    states = jnp.arange(task.states)
    return np.array(
        [agent.action_values(jnp.asarray(table), states) for table in population.weights()]
    )


def error(task, values, exact):
    """The largest error of any action value, of the largest value; terminal states aside.

    Of the cliff, only what can be reached: nothing leads onto the cliff itself.
    """
    reached = task.start > 0
    for _ in range(task.states):
        reached[task.successors[reached][task.transitions[reached] > 0]] = True
    reached &= ~task.terminal
    return np.abs(values - exact)[:, reached].max((1, 2)) / np.abs(exact[reached]).max()


# One step of each formula, from a table Q(s, a) = 10 s + a.

STEP = {"state": 1, "action": 0, "reward": 2.0, "next_state": 3}


def transition(terminated=False, truncated=False, **changes):
    step = {**STEP, **changes}
    row = lambda x: jnp.asarray(np.array([[x]]))  # noqa: E731
    numbers = {"state": row(0), "next_state": row(0), "observation": row(step["state"])}
    return Transition(
        **numbers, action=row(step["action"]), reward=row(step["reward"]),
        next_observation=row(step["next_state"]), terminated=row(terminated),
        truncated=row(truncated),
    )  # fmt: skip


def after(agent, *steps, seed=0):
    """What the agent's tables became, and how far that is from where they were.

    steps: transitions to learn from, or other functions of the agent's state.
    """
    task = Garnet(5, 2, 2)
    state = jit(agent.init)(task, jax.random.key(0))
    before = 10.0 * np.arange(5.0)[:, None] + np.arange(2.0)
    count = state.tables.shape[0]
    before = np.stack([before + 100 * i for i in range(count)])
    cells = np.array(state.cells)
    cells[..., 0] = before
    state = type(state)(**{**vars(state), "cells": jnp.asarray(cells)})
    for i, step in enumerate(steps):
        if isinstance(step, Transition):
            state, _ = jit(agent.learn)(task, state, step, jax.random.key(seed + i))
        else:
            state = step(state)
    return np.asarray(state.tables), np.asarray(state.tables) - before


@pytest.mark.parametrize("ended", [{}, {"truncated": True}])
def test_q_learning_by_hand(ended):
    tables, change = after(QLearning(discount=0.9, learning_rate=0.1), transition(**ended))
    # Q(1, 0) = 10, towards 2 + 0.9 · max(30, 31), whether the clock ran out or not.
    assert tables[0, 1, 0] == pytest.approx(10 + 0.1 * (2 + 0.9 * 31 - 10))
    assert (change != 0).sum() == 1


@pytest.mark.parametrize("kind", [QLearning, ExpectedSarsa, DoubleQ])
def test_nothing_follows_the_end(kind):
    _, change = after(kind(learning_rate=0.1), transition(terminated=True))
    (place,) = np.argwhere(change)
    assert tuple(place[1:]) == (1, 0)
    assert change[tuple(place)] == pytest.approx(0.1 * (2 - 10 - 100 * place[0]))


def test_expected_sarsa_by_hand():
    agent = ExpectedSarsa(discount=0.9, learning_rate=0.1, epsilon_start=0.2)
    mean = 0.8 * 31 + 0.2 * 30.5
    assert after(agent, transition())[0][0, 1, 0] == pytest.approx(10 + 0.1 * (2 + 0.9 * mean - 10))


def test_sarsa_by_hand():
    agent = Sarsa(discount=0.9, learning_rate=0.1)
    _, change = after(agent, transition())
    assert not change.any()  # it waits for the next action
    following = transition(state=3, action=0, next_state=4)
    tables, change = after(agent, transition(), following)
    assert tables[0, 1, 0] == pytest.approx(10 + 0.1 * (2 + 0.9 * 30 - 10))
    assert (change != 0).sum() == 1


def test_sarsa_at_the_end_of_an_episode():
    agent = Sarsa(discount=0.9, learning_rate=0.1, epsilon_start=0.0)
    fresh = transition(state=0, action=0)
    tables, _ = after(agent, transition(terminated=True), fresh)
    assert tables[0, 1, 0] == pytest.approx(10 + 0.1 * (2 - 10))
    # The new episode's action is not that of the state which the clock cut: the policy's is.
    tables, _ = after(agent, transition(truncated=True), fresh)
    assert tables[0, 1, 0] == pytest.approx(10 + 0.1 * (2 + 0.9 * 31 - 10))


def test_sarsa_after_a_cut():
    """As after a truncation: the action of a new episode says nothing about the old one."""
    agent = Sarsa(discount=0.9, learning_rate=0.1, epsilon_start=0.0)
    tables, _ = after(agent, transition(), agent.cut, transition(state=0, action=0))
    assert tables[0, 1, 0] == pytest.approx(10 + 0.1 * (2 + 0.9 * 31 - 10))


def test_sarsa_does_not_wait_for_an_action_on_other_data():
    agent = Sarsa()
    fresh = jit(agent.init)(Cliff(), jax.random.key(0))
    assert not agent.carry_over(agent.cut(fresh), fresh).last.truncated.any()


def test_double_q_by_hand():
    agent = DoubleQ(discount=0.9, learning_rate=0.1)
    learned = set()
    for seed in range(6):
        _, change = after(agent, transition(), seed=seed)
        (place,) = np.argwhere(change)
        own, other = place[0], 1 - place[0]
        learned.add(own)
        # It selects action 1 in state 3, and the other table says what that is worth.
        goal = 2 + 0.9 * (31 + 100 * other)
        assert change[tuple(place)] == pytest.approx(0.1 * (goal - 10 - 100 * own))
    assert learned == {0, 1}


def test_double_q_selects_and_values_with_different_tables():
    state = DoubleQ().init(Garnet(5, 2, 2), jax.random.key(0))
    cells = state.cells.at[:, 3, :, 0].set(jnp.array([[1.0, 2.0], [7.0, 5.0]]))
    state = type(state)(cells, state.episodes)
    for seed in range(6):
        after, _ = jit(DoubleQ(discount=1.0, learning_rate=1.0).learn)(
            Garnet(5, 2, 2), state, transition(reward=0.0), jax.random.key(seed)
        )
        learned = np.asarray(after.tables[:, 1, 0])
        assert learned.tolist() in ([5.0, 0.0], [0.0, 1.0])


def test_step_sizes():
    agent = QLearning(discount=0.0, learning_rate=1.0, learning_rate_decay=1.0)
    rewards = [3.0, 5.0, 10.0]
    tables, _ = after(agent, *(transition(reward=r) for r in rewards))
    assert tables[0, 1, 0] == pytest.approx(np.mean(rewards))  # 1/n: the sample mean


def test_environments_that_visit_the_same_entry():
    rate = jnp.full(4, 0.1)
    share = step_share(jnp.array([5, 2, 5, 5]), rate)
    np.testing.assert_allclose(share, [(1 - 0.9**3) / 3, 0.1, *[(1 - 0.9**3) / 3] * 2], rtol=1e-5)
    state = QLearning(num_envs=2, discount=0.0, learning_rate=0.5).init(
        Garnet(5, 2, 2), jax.random.key(0)
    )
    two = jnp.array([1, 1])
    never = jnp.zeros(2, bool)
    move = Move(two, two, jnp.array([2.0, 4.0]), two, never, never)
    agent = QLearning(num_envs=2, discount=0.0, learning_rate=0.5)
    state = agent.update(state, move, jnp.zeros(2))
    assert state.tables[0, 1, 1] == pytest.approx(0.75 * 3)
    assert state.cells[0, 1, 1, 1] == 2


def test_the_model_of_dyna_q():
    model = Counts.empty(entries=4, outcomes=2)
    add = lambda *steps: model.add(*(jnp.array(x) for x in zip(*steps, strict=True)))  # noqa: E731
    for step in [(2, 7, 1.0), (2, 7, 2.0), (2, 9, 5.0)]:
        model = add(step)
    # 10 states: 10 is the end. Of two steps of one entry the last counts.
    model = add((1, 3, 9.0), (1, 10, 4.0))
    assert int(model.entries) == 2
    assert model.seen[:2].tolist() == [2, 1]
    moves = model.imagine(6000, (10, 2), jax.random.key(0))
    ended = np.asarray(moves.terminated)
    assert ended.mean() == pytest.approx(0.5, abs=0.03)
    assert set(moves.state[ended].tolist()) == {0}
    assert set(moves.action[ended].tolist()) == {1}
    others, pay = np.asarray(moves.next_state)[~ended], np.asarray(moves.reward)[~ended]
    assert (others == 7).mean() == pytest.approx(2 / 3, abs=0.03)
    assert set(pay[others == 7]) == {1.5}
    assert set(pay[others == 9]) == {5.0}
    # No room for a third outcome: the rarest gives way.
    model = add((2, 3, 0.5))
    assert model.table[2].tolist() == [[7, 2, 3], [3, 1, 0.5]]


@pytest.mark.parametrize(
    ("kind", "environments"), [(ExpectedSarsa, 1), (DoubleQ, 1), (Sarsa, 3), (DynaQ, 3)]
)
def test_values_of_a_process_without_chance_are_exact(kind, environments):
    """Cut after five steps, from anywhere: the end, the cut and the coin are all in it."""
    moves = np.eye(4)[[[1, 0], [2, 0], [3, 1], [0, 0]]]
    task = FiniteMDP(moves, [[0, 1], [0, 0], [5, 0], [0, 0]], terminal=[3], horizon=5)
    agent = kind(num_envs=environments, discount=DISCOUNT, learning_rate=0.5,
                 epsilon_start=0.3, epsilon_end=0.3)  # fmt: skip
    soft = 0.3 if kind in (Sarsa, ExpectedSarsa) else 0.0
    exact = task.optimum().action_values(DISCOUNT, soft)
    if kind is Sarsa:  # the next action is chance
        agent = Sarsa(num_envs=environments, discount=DISCOUNT, learning_rate=1.0,
                      learning_rate_decay=0.1, epsilon_start=0.3, epsilon_end=0.3)  # fmt: skip
    values = trained(task, agent, 30_000 if kind is Sarsa else 4000)
    np.testing.assert_allclose(values[0], exact, rtol=0.02 if kind is Sarsa else 1e-4)


def process(kind, **changes):
    """An agent for values of stochastic processes; ε is 0.5 where it is part of what is learned."""
    epsilon = 0.5 if kind in (Sarsa, ExpectedSarsa) else 1.0
    settings = {"num_envs": 32, "discount": DISCOUNT, "learning_rate": 1.0}
    return kind(**{**settings, "epsilon_start": epsilon, "epsilon_end": epsilon, **changes})


@pytest.mark.parametrize(
    ("task", "kind", "steps", "decay"),
    [
        (Cliff(), ExpectedSarsa, 1.5e6, 0.3),
        (Cliff(), DynaQ, 1e6, 0.3),
        *(
            pytest.param(*case, marks=pytest.mark.optimized)
            for case in [
                (Garnet(), Sarsa, 20e6, 0.1),
                (FrozenLake(), DoubleQ, 10e6, 0.1),
            ]
        ),
    ],
)
def test_values_within_a_hundredth(task, kind, steps, decay):
    agent = process(kind, learning_rate_decay=decay)
    values = trained(anywhere(task), agent, int(steps) // 32)
    exact = task.optimum().action_values(DISCOUNT, 0.5 if agent.epsilon_start < 1 else 0.0)
    assert error(task, values, exact).max() < 0.01


@pytest.mark.optimized
def test_planning_saves_real_steps():
    task = Garnet()
    exact = task.optimum().action_values(DISCOUNT)

    def worst(kind, steps):
        agent = process(kind, num_envs=1, learning_rate_decay=0.1)
        return error(task, trained(anywhere(task), agent, steps, (100, 101)), exact).max()

    assert worst(DynaQ, 5000) < worst(QLearning, 15_000)


@pytest.mark.parametrize(("kind", "path"), [(QLearning, 13), (Sarsa, 17)])
def test_along_the_cliff_or_around_it(kind, path):
    """Who learns what exploring costs keeps away from the cliff (Sutton & Barto, example 6.6)."""
    run = train(Cliff(), kind(epsilon_end=0.1), episodes=1000, seeds=1, seed=100)
    result = run.grade(4)
    assert result["return_mean"] == -path
    assert result["regret_per_seed"] == pytest.approx([path / 13 - 1])


@pytest.mark.parametrize(
    ("task", "chosen"),
    [
        ("finite/frozen-lake", ["horizon=9"]),
        pytest.param(
            "pendulum/grid", ["angles=9", "speeds=9", "horizon=20"], marks=pytest.mark.slow
        ),
    ],
)
def test_the_command_trains_and_reports(task, chosen, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "run"
    arguments = ["train", task, "--agent", "sarsa", "--episodes", 64, "--seeds", 2, "--out", folder]
    assert qfolio(monkeypatch, *arguments, "--set", *chosen) == 0
    assert "optimum" in capsys.readouterr().out
    assert (folder / "report.html").stat().st_size > 10_000
    assert len((folder / "metrics.csv").read_text().splitlines()) > 2 * 64


@pytest.mark.optimized
def test_the_pendulum_in_a_table():
    chosen = preset("fast", "pendulum/grid", "q-learning")
    run = train(GridPendulum(), chosen.build(), episodes=chosen.episodes, seeds=2, seed=100)
    assert max(run.grade()["regret_per_seed"]) < 0.04


def test_double_q_learning_against_the_bias_of_a_maximum():
    """Sutton & Barto (2018), example 6.7: going left looks good by luck alone."""
    states, actions, right = 5, 10, 1
    moves = np.zeros((states, actions, states))
    pay = np.zeros((states, actions, states))
    moves[0, ::2, 1] = 1  # left, to where any of ten actions pays −0.1 ± 1
    moves[0, right::2, 4] = 1  # right, to the end
    moves[1, :, 2] = moves[1, :, 3] = 0.5
    pay[1, :, 2], pay[1, :, 3] = 0.9, -1.1
    task = FiniteMDP(moves, pay, start=[1, 0, 0, 0, 0], terminal=[2, 3, 4], horizon=3)
    settings = {"discount": 1.0, "learning_rate": 0.1, "epsilon_start": 1.0, "epsilon_end": 1.0}
    worth = lambda kind: trained(task, kind(**settings), 4000, (100, 101))[:, 0, ::2].mean()  # noqa: E731
    assert worth(QLearning) > 0.1  # it is −0.1
    assert worth(DoubleQ) < 0.0


@pytest.mark.parametrize("kind", KINDS)
def test_tasks_without_numbers_are_refused(kind):
    with pytest.raises(QfolioError, match="Pendulum has none; use a task that has, such as pend"):
        kind().init(Pendulum(), jax.random.key(0))


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        (QLearning, {"learning_rate": 1.5}, "learning_rate is 1.5"),
        (QLearning, {"num_envs": 0}, "num_envs is 0"),
        (Sarsa, {"epsilon_start": -0.1}, "epsilon_start is -0.1"),
        (DoubleQ, {"learning_rate_decay": -1.0}, "learning_rate_decay is -1"),
        (DynaQ, {"planning_steps": 0}, "planning_steps is 0; .* q-learning"),
        (DynaQ, {"discount": 1.1}, "discount is 1.1"),
    ],
)
def test_wrong_settings(kind, changes, message):
    with pytest.raises(QfolioError, match=message):
        kind(**changes)


@pytest.mark.slow
def test_a_network_learns_on_numbered_states():
    task = FiniteMDP(
        np.eye(3)[[[1, 0], [2, 0], [2, 2]]], [[0, 0.5], [1.0, 0], [0.0, 0]], terminal=[2], horizon=6
    )
    agent = DQN(
        hidden=(32,), num_envs=4, batch_size=32, replay_capacity=1000, learning_starts=100,
        discount=DISCOUNT, target_update_interval=1, tau=0.05, learning_rate=3e-3,
        learning_rate_steps=1500.0, learning_rate_final=0.0, epsilon_end=0.5,
    )  # fmt: skip
    weights = first_member(train_to(Population(task, agent, [0]), 1500).weights())
    values = agent.action_values(weights, jnp.arange(2))
    assert values is not None
    exact = task.optimum().action_values(DISCOUNT)[:2]
    np.testing.assert_allclose(values, exact, rtol=0.02, atol=0.01)
