import dataclasses
import itertools
import sys
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from qfolio.core.evaluation import start_keys
from qfolio.solvers.grid import GridOptimum
from qfolio.tasks.pendulum import Pendulum, PendulumState


def exact(task: Pendulum) -> Any:
    optimum = task.optimum()
    assert optimum is not None
    return optimum


def test_beats_every_sequence_of_torques():
    """With three torques and five steps all 243 plans can be tried."""
    task = Pendulum(torques=3, horizon=5)
    keys = start_keys(64)
    starts = jax.vmap(task.reset)(keys)
    plans = jnp.array(list(itertools.product(range(3), repeat=5)))

    def total(start, plan):
        def step(state, action):
            after = task.step(state, action, jax.random.key(0))
            return after.state, after.reward

        return jax.lax.scan(step, start, plan)[1].sum()

    every = jax.vmap(lambda s: jax.vmap(lambda p: total(s, p))(plans))(starts)
    returns = exact(task).returns(keys)
    best = np.asarray(every.max(1))
    assert (returns <= best + 1e-3).all()
    np.testing.assert_allclose(returns, best, rtol=2e-3, atol=2e-2)


def test_mean_return_over_the_start_distribution():
    """An independent solution: −136.8 ± 1.1 (standard error) over 4,096 other starts."""
    returns = exact(Pendulum()).returns(start_keys(4096))
    error = returns.std() / np.sqrt(len(returns))
    assert abs(returns.mean() + 136.8) < 2 * np.hypot(error, 1.1)
    # What results are graded against must not move.
    np.testing.assert_allclose(returns[:1024].mean(), -135.0, atol=0.3)


def test_stationary_values_fulfil_the_bellman_equation():
    task, discount = Pendulum(), 0.95
    optimum = exact(task)
    values, actions = optimum.stationary(discount)
    states = PendulumState(*(x.ravel() for x in jnp.meshgrid(*optimum.axes, indexing="ij")))
    step = jax.vmap(task.step, (0, 0, None))
    after = step(states, jnp.array(actions).ravel(), jax.random.key(0))
    ahead = optimum._interpolate(jnp.array(values), *after.state)
    np.testing.assert_allclose(after.reward + discount * ahead, values.ravel(), atol=1e-3)
    upright = np.unravel_index(values.argmax(), values.shape)
    assert abs(optimum.axes[0][upright[0]]) < 0.05
    assert abs(optimum.axes[1][upright[1]]) < 0.05


def test_solutions_come_back_from_disk(tmp_path, monkeypatch):
    monkeypatch.setenv("QFOLIO_CACHE", str(tmp_path))
    task, keys = Pendulum(horizon=3), start_keys(4)
    first = exact(task).returns(keys)
    (file,) = (tmp_path / "optimum").iterdir()
    monkeypatch.setattr("qfolio.solvers.grid.GridOptimum._solve", None)
    np.testing.assert_array_equal(exact(task).returns(keys), first)
    monkeypatch.undo()
    monkeypatch.setenv("QFOLIO_CACHE", str(tmp_path))
    file.write_bytes(b"damaged")
    np.testing.assert_array_equal(exact(task).returns(keys), first)


def test_a_task_of_a_notebook_is_solved_again(tmp_path, monkeypatch):
    """Its class has no file that could tell whether it has changed."""
    monkeypatch.setenv("QFOLIO_CACHE", str(tmp_path))
    monkeypatch.setitem(sys.modules, "notebook", ModuleType("notebook"))

    class Own(Pendulum):
        __module__ = "notebook"

    keys = start_keys(4)
    returns = exact(Own(horizon=3)).returns(keys)
    assert list(tmp_path.iterdir()) == []
    np.testing.assert_array_equal(returns, exact(Pendulum(horizon=3)).returns(keys))


def test_solutions_of_other_grids_and_of_other_arrays_are_not_taken(tmp_path, monkeypatch):
    """A task's text shows the shapes of its arrays, not what they hold."""
    monkeypatch.setenv("QFOLIO_CACHE", str(tmp_path))
    task = Pendulum(torques=2, horizon=2)
    angles = jnp.linspace(-jnp.pi, jnp.pi, 20, endpoint=False)

    def values(task, fastest):
        axes = (angles, jnp.linspace(-fastest, fastest, 21))
        return GridOptimum(task, PendulumState, axes, (True, False)).stationary(0.5)[0]

    wide, narrow = values(task, 8.0), values(task, 1.0)
    assert abs(wide - narrow).max() > 1
    light = eqx.tree_at(lambda t: t.mass, task, np.array([0.5], np.float32))
    heavy = eqx.tree_at(lambda t: t.mass, task, np.array([2.0], np.float32))
    assert repr(light) == repr(heavy)
    assert len(list((tmp_path / "optimum").iterdir())) == 2
    for each in (light, heavy):
        optimum = GridOptimum(each, PendulumState, (angles, angles), (True, True))
        optimum._cached(b"x", lambda: {"x": jnp.zeros(1)})
    assert len(list((tmp_path / "optimum").iterdir())) == 4


def test_a_light_pendulum_has_more_torques_or_no_optimum():
    """So strong a motor changes the speed by more than the grid can tell in one of 11 torques."""
    keys = start_keys(8)
    light = Pendulum(torques=0, horizon=20, mass=0.2)
    optimum = exact(light)
    assert optimum.task.torques == 51
    coarse = dataclasses.replace(light, torques=11)
    assert optimum.returns(keys).mean() > exact(coarse).returns(keys).mean()
    assert exact(Pendulum(torques=0)).task.torques == 11
    assert Pendulum(torques=0, mass=0.1, length=0.2).optimum() is None
    assert Pendulum(torques=5, mass=0.1, length=0.2).optimum() is not None
