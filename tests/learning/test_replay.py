import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from equinox import filter_jit as jit

from qfolio.core.errors import QfolioError
from qfolio.core.mdp import Transition
from qfolio.learning.priorities import FAN, ImportanceSchedule, Priorities
from qfolio.learning.replay import Experience, Replay, ReplayConfig, cut, join
from qfolio.learning.targets import n_step
from qfolio.portfolio.task import Portfolio

from planted import ASSETS, planted


def filled(capacity, writes, width=2, **options):
    replay = Replay.empty(jnp.array(0), capacity, width, **options)
    for i in range(writes):
        replay = jit(replay.add)(jnp.asarray(np.arange(i * width, (i + 1) * width)))
    return replay


def chi_square(counts, expected):
    return ((counts - expected) ** 2 / expected).sum()


def test_keeps_the_latest_rows():
    np.testing.assert_array_equal(filled(6, 5).rows[:, 0], [6, 7, 8, 9, 4, 5])


def test_rows_of_several_steps_are_appended_in_their_order():
    replay = jit(filled(8, 1).extend)(jnp.arange(2, 6))
    np.testing.assert_array_equal(replay.rows[:, 0], [0, 1, 2, 3, 4, 5, 0, 0])


@pytest.mark.parametrize(("writes", "rows"), [(0, [0, 0]), (1, [0, 1]), (3, [4, 5]), (4, [6, 7])])
def test_the_latest_rows_are_those_written_last(writes, rows):
    np.testing.assert_array_equal(filled(6, writes).latest(), rows)


def test_rounds_the_capacity_up_to_whole_writes():
    assert len(filled(5, 0).rows) == 6


def test_samples_only_what_was_written():
    sample = jit(filled(1000, 3).sample)(jax.random.key(0), 500)
    assert set(sample.tolist()) == {0, 1, 2, 3, 4, 5}


def test_samples_a_full_buffer_uniformly():
    sample = np.asarray(jit(filled(8, 9).sample)(jax.random.key(1), 8000))
    counts = np.bincount(sample, minlength=18)
    assert counts[:10].sum() == 0
    # Eight cells of 1,000 expected draws each: chi-square with 7 degrees of freedom, p = 0.001.
    assert chi_square(counts[10:], 1000) < 24.3


def test_rows_come_back_as_they_were():
    row = {"flag": jnp.array(True), "matrix": jnp.zeros((2, 3)), "number": jnp.array(0)}
    rows = {
        "flag": jnp.array([True, False]),
        "matrix": jnp.arange(12.0).reshape(2, 2, 3) / 7,
        "number": jnp.array([2**24, -3]),
    }
    replay = Replay.empty(row, 4, 2).add(rows)
    again = replay.unpack(replay.rows[:2])
    for name, array in rows.items():
        np.testing.assert_array_equal(again[name], array)
        assert again[name].dtype == array.dtype


@pytest.mark.parametrize("prioritized", [False, True])
@pytest.mark.parametrize("writes", [3, 4, 5, 9, 10])
def test_only_rows_with_steps_after_them_are_drawn(prioritized, writes):
    """Of 2 × 5 rows, all but the newest two writes, and those equally often."""
    replay = filled(10, writes, steps=3, prioritized=prioritized)
    drawn = np.asarray(jit(replay.sample)(jax.random.key(2), 2000))
    ready = np.arange(2 * max(0, writes - 5), 2 * (writes - 2))
    counts = np.bincount(drawn, minlength=2 * writes)
    assert counts.sum() == counts[ready].sum()
    assert chi_square(counts[ready], 2000 / len(ready)) < 20.5  # 5 degrees of freedom at most


@pytest.mark.parametrize("writes", [3, 5, 8])
def test_the_rows_ahead_are_the_next_steps_of_the_same_environment(writes):
    replay = filled(10, writes, steps=3)
    index = jit(replay.draw)(jax.random.key(3), 50)
    ahead = np.asarray(jit(replay.ahead)(index))
    first = np.asarray(jit(replay.at)(index))
    np.testing.assert_array_equal(ahead, first + np.array([[0], [2], [4]]))


def test_returns_over_steps_by_hand():
    """Goes on; ends at once; ends at the second step; ends with the last."""
    reward = jnp.array([[1.0, 1.0, 1.0, 1.0], [2.0, 2.0, 2.0, 2.0], [4.0, 4.0, 4.0, 4.0]])
    last = jnp.array([[0, 1, 0, 0], [0, 0, 1, 0], [0, 1, 0, 1]], bool)
    total, stop = jit(n_step)(reward, last, 0.5)
    np.testing.assert_allclose(total, [1 + 1 + 1, 1, 1 + 1, 1 + 1 + 1])
    assert stop.tolist() == [2, 0, 1, 2]


def test_steps_are_joined_up_to_the_end_of_their_episode():
    """A termination leaves nothing to follow; a truncation leads to its own next observation."""
    row = Experience.like((), jnp.zeros(1), jnp.array(0), with_last=True)
    replay = Replay.empty(row, 6, 2, steps=3)
    ends = [[False, False], [True, True], [False, False]]
    terminal = [[False, False], [True, False], [False, True]]
    for i in range(3):
        observation = jnp.array([[2.0 * i], [2.0 * i + 1]])
        action = jnp.array([2 * i, 2 * i + 1], jnp.int32)
        replay = jit(replay.add)(
            Experience(
                observation,
                action,
                jnp.ones(2),
                observation + 100,
                jnp.array(terminal[i]),
                jnp.array(ends[i]),
            )
        )
    joined, discount = jit(join)(replay, jnp.array([0, 1]), 0.5)
    np.testing.assert_array_equal(joined.observation[:, 0], [0, 1])
    np.testing.assert_array_equal(joined.action, [0, 1])
    np.testing.assert_allclose(joined.reward, [1.5, 1.5])
    np.testing.assert_array_equal(joined.next_observation[:, 0], [102, 103])
    assert joined.terminal.tolist() == [True, False]
    np.testing.assert_allclose(discount, [0.25, 0.25])


@pytest.mark.parametrize("width", [1, 2])
def test_steps_are_not_joined_across_a_cut(width):
    row = Experience.like((), jnp.zeros(1), jnp.array(0), with_last=True)
    replay = Replay.empty(row, 3 * width, width, steps=2)
    never = jnp.zeros(width, bool)
    for i in range(4):  # the last write overwrites the first
        seen = jnp.full((width, 1), 1.0 * i)
        action = jnp.zeros(width, jnp.int32)
        step = Experience(seen, action, jnp.ones(width), seen + 1, never, never)
        replay = jit(replay.add)(step)
        if i in (0, 2):
            replay = jit(cut)(replay)
    joined, discount = jit(join)(replay, jnp.array([width, 2 * width]), 0.5)
    np.testing.assert_array_equal(joined.observation[:, 0], [1, 2])
    np.testing.assert_array_equal(joined.next_observation[:, 0], [3, 3])
    np.testing.assert_array_equal(joined.reward, [1.5, 1])
    np.testing.assert_array_equal(discount, [0.25, 0.5])
    assert not joined.terminal.any()


def test_the_last_step_is_kept_where_it_is_asked_for():
    shape = (1, 2)
    rollout = Transition(
        None, jnp.zeros(shape), jnp.zeros(shape, jnp.int32), jnp.zeros(shape), None,
        jnp.zeros(shape), jnp.array([[True, False]]), jnp.array([[False, True]]),
    )  # fmt: skip
    assert Experience.of(rollout).last is None
    kept = Experience.of(rollout, with_last=True)
    assert kept.last is not None
    assert (kept.last.tolist(), kept.terminal.tolist()) == ([True, True], [True, False])
    ended = Experience.of(rollout, time_limit_terminal=True)
    assert ended.terminal.tolist() == [True, True]


def test_positions_are_stored_and_recalled_as_the_views_that_were_seen():
    """A view of 40 rows and 6 assets has 240 numbers and more, a position far fewer."""
    task = Portfolio.of(
        planted(200), window=40, horizon=8, anchor="equal-weight", signals="high:20"
    )
    states = jax.vmap(task.reset)(jax.random.split(jax.random.key(0), 5))
    seen = jax.vmap(task.observe)(states)
    action = jnp.full((5, ASSETS + 1), 1 / (ASSETS + 1))
    after = jax.vmap(task.step)(states, action, jax.random.split(jax.random.key(1), 5))
    no = jnp.zeros(5, bool)
    following = jax.vmap(task.observe)(after.state)
    step = Transition(states, seen, action, after.reward, after.state, following, no, no)
    rows = Experience.of(jax.tree.map(lambda x: x[None], step))
    replay = jit(Replay.empty(jax.tree.map(lambda x: x[0], rows), 10, 5).add)(rows)
    assert replay.rows.shape[1] < 40
    again = replay.at(jnp.arange(5)).recalled(task)
    assert eqx.tree_equal(again.observation, seen)
    assert eqx.tree_equal(again.next_observation, following)


def config(**changes):
    given = {"num_envs": 2, "batch_size": 8, "n_steps": 1, "replay_capacity": 16,
             "learning_starts": 0}  # fmt: skip
    return ReplayConfig(**given | changes)


def test_a_buffer_must_hold_what_learning_needs():
    config(learning_starts=16).check()
    config(n_steps=8).check()
    for changes in ({"learning_starts": 17}, {"n_steps": 9}):
        with pytest.raises(QfolioError, match="replay_capacity is 16, less than learning_starts"):
            config(**changes).check()


@pytest.mark.parametrize(
    ("changes", "steps"),
    [({"learning_starts": 10}, 4), ({"learning_starts": 11}, 5), ({"n_steps": 5}, 4), ({}, 0)],
)
def test_a_warm_up_ends_before_the_step_that_fills_the_buffer(changes, steps):
    assert config(**changes).warm_up == steps


def priorities_of(values):
    index, values = np.arange(len(values)), np.asarray(values, np.float32)
    return jit(Priorities.empty(len(values)).set)(jnp.asarray(index), jnp.asarray(values))


@pytest.mark.parametrize("capacity", [1, FAN, FAN + 1, FAN**2, 300, 5000])
def test_every_level_holds_the_sums_of_the_next(capacity):
    rng = np.random.default_rng(0)
    expected, priorities = np.zeros(capacity), Priorities.empty(capacity)
    for _ in range(20):
        index = rng.permutation(capacity)[:40]
        expected[index] = rng.random(len(index)).astype(np.float32)
        values = jnp.asarray(expected[index].astype(np.float32))
        priorities = jit(priorities.set)(jnp.asarray(index), values)
    leaves = np.asarray(priorities.levels[-1]).reshape(-1)
    np.testing.assert_array_equal(leaves[:capacity], expected)
    np.testing.assert_allclose(priorities.total, expected.sum(), rtol=1e-5)
    for above, below in zip(priorities.levels, priorities.levels[1:], strict=False):
        flat = np.asarray(above).reshape(-1)
        np.testing.assert_allclose(flat[: len(below)], np.asarray(below).sum(1), rtol=1e-6)
        assert not flat[len(below) :].any()
    assert priorities.levels[0].shape == (1, FAN)


def test_rows_are_found_where_the_running_sum_exceeds_the_mass():
    values = np.random.default_rng(1).integers(0, 4, 700)  # sums are exact
    mass = np.arange(values.sum()) + 0.5
    found = jit(priorities_of(values).find)(jnp.array(mass, jnp.float32))
    np.testing.assert_array_equal(found, np.searchsorted(np.cumsum(values), mass, side="right"))


def test_rows_are_drawn_in_proportion():
    values = np.array([0.0, 1.0, 2.0, 0.0, 5.0, *[0.0] * 30, 8.0])
    priorities = priorities_of(values)
    keys = jax.random.split(jax.random.key(4), 500)
    drawn = jit(jax.vmap(lambda key: priorities.draw(key, 8)))(keys)
    counts = np.bincount(np.asarray(drawn).ravel(), minlength=len(values))
    expected = 4000 * values / values.sum()
    assert counts[values == 0].sum() == 0
    # 3 degrees of freedom, p = 0.001; stratified draws vary less than independent ones.
    assert chi_square(counts[values > 0], expected[values > 0]) < 16.3


def test_draws_are_stratified():
    """With as many draws as equal rows, each is drawn once."""
    drawn = jit(priorities_of(np.ones(64)).draw)(jax.random.key(5), 64)
    assert sorted(drawn.tolist()) == list(range(64))


def test_no_row_of_zero_is_drawn_whatever_rounding_does():
    rng = np.random.default_rng(2)
    values = np.where(rng.random(5000) < 0.5, 0, rng.random(5000) ** 8).astype(np.float32)
    priorities = priorities_of(values)
    ends = np.linspace(0.0, 1.00001, 20_001, dtype=np.float32) * float(priorities.total)
    assert (values[np.asarray(jit(priorities.find)(jnp.asarray(ends)))] > 0).all()


def test_new_rows_have_the_highest_priority_there_was():
    replay = filled(8, 2, prioritized=True)
    priorities = jit(replay.priorities.set)(jnp.array([0, 1]), jnp.array([5.0, 0.5]))
    priorities = jit(priorities.set)(jnp.array([0]), jnp.array([0.1]))
    replay = Replay(replay.rows, replay.position, replay.size, priorities, replay.like, 2, 1)
    replay = jit(replay.add)(jnp.array([4, 5]))
    assert replay.priorities is not None
    found = jit(replay.priorities.of)(jnp.arange(8))
    np.testing.assert_allclose(found, [0.1, 0.5, 1, 1, 5, 5, 0, 0])


def test_importance_weights_by_hand():
    """(N P)^−β over the largest in the batch: rows of 1, 2 and 4 of 8."""
    priorities = priorities_of([1.0, 2.0, 4.0, 1.0])
    index = jnp.array([0, 1, 2])
    weights = jit(priorities.importance)
    np.testing.assert_allclose(weights(index, 1.0), [1, 1 / 2, 1 / 4])
    np.testing.assert_allclose(weights(index, 0.5), [1, 2**-0.5, 1 / 2], rtol=1e-6)
    np.testing.assert_allclose(weights(index, 0.0), [1, 1, 1])


def test_priorities_follow_the_errors():
    """A row without an error can be drawn again."""
    off = jnp.array([16.0, 1 / 16, 0.0])
    found = jit(priorities_of(np.ones(3)).update)(jnp.arange(3), off, 0.25)
    np.testing.assert_allclose(found.of(jnp.arange(3)), [2, 0.5, 1e-6**0.25], rtol=1e-5)


@pytest.mark.parametrize(("updates", "exponent"), [(0, 0.4), (50, 0.7), (100, 1.0), (200, 1.0)])
def test_the_exponent_of_importance_rises_to_1(updates, exponent):
    assert float(ImportanceSchedule(0.4, 100.0)(jnp.array(updates))) == pytest.approx(exponent)
