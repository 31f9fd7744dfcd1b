from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.core.evaluation import start_keys
from qfolio.tasks.catch import Catch, CatchState
from qfolio.tasks.hidden_pendulum import HiddenPendulum
from qfolio.tasks.pendulum import Pendulum

KEY = jax.random.key(0)


@pytest.mark.parametrize(
    "task", [Catch(), Catch(rows=4, columns=7), Catch(rows=6, columns=6, decoys=1)]
)
def test_enumeration_finds_the_optimum(task):
    """Backward over every row, ball and paddle, by the task's own step."""
    step = jax.jit(jax.vmap(task.step, (0, 0, None)))
    first = int(task.reset(KEY).row)
    cells = np.array(list(product(range(task.columns), range(task.columns), range(3))))
    _, paddle, action = map(jnp.asarray, cells.T)
    value = np.zeros((task.columns, task.columns))
    for row in reversed(range(first, task.rows - 1)):
        columns = np.concatenate([cells[:, :1], np.zeros((len(cells), task.decoys), int)], 1)
        states = CatchState(jnp.asarray(columns), jnp.asarray(np.full(len(cells), row)), paddle)
        after = step(states, action, KEY)
        assert bool(after.terminated.all()) == (row == task.rows - 2) == bool(after.terminated[0])
        following = np.where(after.terminated, 0, value[cells[:, 0], after.state.paddle])
        value = (
            (np.asarray(after.reward) + following).reshape(task.columns, task.columns, 3).max(-1)
        )
    keys = start_keys(64)
    starts = jax.jit(jax.vmap(task.reset))(keys)
    np.testing.assert_array_equal(value[starts.columns[:, 0], starts.paddle], 1.0)
    np.testing.assert_array_equal(task.optimum().returns(keys), 1.0)


def test_with_fewer_rows_no_paddle_is_in_time():
    with pytest.raises(QfolioError, match="more rows"):
        Catch(rows=3, columns=7)
    with pytest.raises(QfolioError, match="would be down in 1 step, before"):
        Catch(rows=3, columns=7, decoys=1)
    with pytest.raises(QfolioError, match="decoys"):
        Catch(columns=4, decoys=4)


def test_the_picture_shows_all_there_is():
    task = Catch(rows=6, columns=5, decoys=2)
    state = CatchState(jnp.array([0, 3, 4]), jnp.array(2), jnp.array(1))
    picture = """
        .....
        ...##
        #..##
        .....
        .....
        .#...
    """
    expected = [[pixel == "#" for pixel in row] for row in picture.split()]
    np.testing.assert_array_equal(task.observe(state)[..., 0], expected)


@pytest.mark.parametrize("task", [Catch(rows=12, columns=11, decoys=3), Catch()])
def test_the_ball_is_known_from_the_first_picture(task):
    """The only pixel above the paddle without one over or under it."""
    starts = jax.jit(jax.vmap(task.reset))(jax.random.split(KEY, 500))
    pictures = np.asarray(jax.jit(jax.vmap(task.observe))(starts))[..., 0]
    lonely = pictures[:, :-1].sum(1) == 1
    np.testing.assert_array_equal(lonely.sum(1), 1)
    np.testing.assert_array_equal(lonely.argmax(1), starts.columns[:, 0])
    share = np.bincount(starts.columns[:, 0], minlength=task.columns) / 500
    np.testing.assert_allclose(share, 1 / task.columns, atol=0.06)


def test_a_paddle_stays_in_the_picture_and_moves_as_told():
    task = Catch()
    step = jax.jit(task.step)
    for paddle, action, expected in ((0, 0, 0), (4, 2, 4), (2, 0, 1), (2, 1, 2), (2, 2, 3)):
        state = CatchState(jnp.array([1]), jnp.array(0), jnp.array(paddle))
        assert int(step(state, jnp.array(action), KEY).state.paddle) == expected
    for ball, reward in ((3, 1.0), (2, -1.0)):
        state = CatchState(jnp.array([ball]), jnp.array(8), jnp.array(2))
        after = step(state, jnp.array(2), KEY)
        assert bool(after.terminated)
        assert float(after.reward) == reward


def test_the_hidden_pendulum_is_the_pendulum():
    hidden, plain = HiddenPendulum(window=3, horizon=40), Pendulum(horizon=40)
    keys = start_keys(16)
    ours, theirs = hidden.optimum(), plain.optimum()
    assert ours is not None
    assert theirs is not None
    np.testing.assert_array_equal(ours.returns(keys), theirs.returns(keys))
    seen, state = hidden.reset(keys[3]), plain.reset(keys[3])
    rows = [np.zeros(2), np.zeros(2)]
    steps = [jax.jit(task.step) for task in (hidden, plain)]
    for action in np.random.default_rng(0).integers(0, 11, 12):
        rows.append(np.asarray(plain.observe(state)[:2]))
        np.testing.assert_allclose(hidden.observe(seen), rows[-3:], atol=1e-6)
        after, expected = (
            step(at, jnp.array(action), KEY) for step, at in zip(steps, (seen, state), strict=True)
        )
        np.testing.assert_allclose(after.reward, expected.reward, atol=1e-6)
        seen, state = after.state, expected.state


def test_the_hidden_pendulum_refuses_what_the_pendulum_does():
    with pytest.raises(QfolioError, match="torques is 1; it must be 0, or from 2 to 1001"):
        HiddenPendulum(torques=1)
    with pytest.raises(QfolioError, match="horizon is 6000"):
        HiddenPendulum(horizon=6000)


def test_no_velocity_is_seen_nor_anything_older_than_the_window():
    task = HiddenPendulum(window=4)
    state = task.reset(KEY)
    faster = state._replace(pendulum=state.pendulum._replace(theta_dot=jnp.array(5.0)))
    np.testing.assert_array_equal(task.observe(faster), task.observe(state))
    older = state._replace(window=state.window.at[0].set(7.0))
    step = jax.jit(lambda s: task.observe(task.step(s, jnp.array(3), KEY).state))
    np.testing.assert_array_equal(step(older), step(state))
