"""From a finished run to the numbers that its report shows."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from qfolio.evaluation import play, start_keys
from qfolio.report.data import Curve, Episode, Maps, ReportData
from qfolio.runs import CURVE_STARTS, Run
from qfolio.tasks.pendulum import Pendulum, PendulumState
from qfolio.training import episode_steps

EPISODE_START = 53
"""Which of the fixed starts the animation shows: one that hangs and has to be swung up."""


def report_data(
    run: Run, summary: dict[str, Any], contrast: Run | None, command: str
) -> ReportData:
    """Collects everything ``write_report`` needs. The maps and the episode are the first seed's."""
    rows = run.metrics if episode_steps(run.task, run.agent) == run.task.horizon else []
    solution = run.task.optimum()
    optimum = np.nan
    if solution is not None:
        optimum = float(solution.returns(start_keys())[:CURVE_STARTS].mean())
    pendulum = run.task if isinstance(run.task, Pendulum) else None
    return ReportData(
        title=f"{summary['agent'].upper()} on the {summary['task']}",
        command=command,
        summary=summary,
        config=run.config,
        curve=_curve(run),
        comparison=_curve(contrast) if contrast is not None and contrast.evaluations else None,
        training_episodes=np.array([row["episode"] for row in rows]),
        training_returns=np.array([row["return"] for row in rows]),
        optimum=optimum,
        maps=_maps(run, pendulum) if pendulum else None,
        episode=greedy_episode(run, pendulum) if pendulum else None,
    )


def greedy_episode(run: Run, task: Pendulum, start: int = EPISODE_START) -> Episode:
    """The first seed's greedy episode from a fixed start."""
    weights = run.first_weights()
    episode = jax.jit(lambda: play(task, run.agent, weights, start_keys()[start]))()
    return Episode(
        states=np.stack([episode.states.theta, episode.states.theta_dot], axis=-1),
        torques=np.asarray(task.torque(episode.actions)),
        rewards=np.asarray(episode.rewards),
    )


def _curve(run: Run) -> Curve:
    seeds = run.config["seeds"]
    rows = run.evaluations[: len(run.evaluations) // seeds * seeds]
    table = {
        name: np.array([row[name] for row in rows]).reshape(-1, seeds)
        for name in ("episode", "return", "overestimation")
    }
    label = "double DQN" if getattr(run.agent, "double", False) else "without double DQN"
    return Curve(label, table["episode"].mean(1), table["return"], table["overestimation"])


def _maps(run: Run, task: Pendulum) -> Maps | None:
    theta = np.linspace(-np.pi, np.pi, 200, endpoint=False)
    theta_dot = np.linspace(-task.max_speed, task.max_speed, 201)
    grid = PendulumState(*jnp.meshgrid(jnp.array(theta), jnp.array(theta_dot), indexing="ij"))
    observation = task.observe(grid).reshape(-1, 3)
    values = run.agent.action_values(run.first_weights(), observation)
    if values is None:
        return None
    shape = (len(theta), len(theta_dot))
    discount = float(run.agent.discount)
    exact_value, exact_action = task.optimum().stationary(discount)
    return Maps(
        theta=theta,
        theta_dot=theta_dot,
        value=np.asarray(values.max(-1)).reshape(shape),
        policy=np.asarray(task.torque(values.argmax(-1))).reshape(shape),
        exact_value=exact_value[::2, ::2],  # the solver's grid is twice as fine
        exact_policy=np.asarray(task.torque(jnp.array(exact_action)))[::2, ::2],
        discount=discount,
    )
