"""Collects the data of a report from a finished run."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jaxtyping import Array, PyTree

from qfolio.core.arrays import Floats
from qfolio.core.evaluation import greedy, greedy_episode, start_keys
from qfolio.core.mdp import Agent, Box, Policy, Position
from qfolio.core.training import episode_steps
from qfolio.experiments.grading import curve_optimum
from qfolio.experiments.presets import changes, preset
from qfolio.experiments.records import Records
from qfolio.experiments.run import Run
from qfolio.portfolio.market import Market
from qfolio.portfolio.synthetic.ar1 import Ar1
from qfolio.portfolio.synthetic.base import OneAsset, Synthetic
from qfolio.portfolio.synthetic.no_trade import NoTrade
from qfolio.report.contrast import contrast_of
from qfolio.report.data import Curve, Episode, Maps, MarketData, ReportData, Responses, Weights
from qfolio.report.rendering import typeset
from qfolio.report.words import agent_name, words_of
from qfolio.solvers.followed import FollowedOptimum
from qfolio.solvers.grid import GridOptimum
from qfolio.tasks.pendulum import Pendulum, PendulumState

_HELD = 201
"""Number of weights or positions at which a policy is drawn."""

EPISODE_START = 53
"""Index of the animation's fixed start state: the pendulum hangs and must be swung up."""


def report_data(
    run: Run, summary: dict[str, Any], contrast: Run | None, command: str
) -> ReportData:
    """Collects everything ``write_report`` needs. The maps and the episode are the first seed's."""
    solution, best = run.task.optimum(), curve_optimum(run.population)
    pendulum = run.task if isinstance(run.task, Pendulum) else None
    known = solution if isinstance(solution, FollowedOptimum) else None
    exact = solution if isinstance(solution, GridOptimum) else None
    # In a market, training episodes have other random paths, so their returns are not comparable.
    whole = known is None and episode_steps(run.task, run.agent) == run.task.horizon
    episodes = run.metrics if whole else Records()
    variant = contrast_of(run.agent)
    names = ("greedy return", "") if variant is None else (variant.name, variant.variant_name)
    agent, task, unit = summary["agent"], summary["task"], run.budget.unit
    name, changed = _changes(run)
    return ReportData(
        title=f"{agent_name(agent)} {words_of(task).where}",
        command=command,
        summary=summary,
        config=msgspec.to_builtins(run.config),
        curve=_curve(run, names[0], unit),
        comparison=_curve(contrast, names[1], unit) if contrast and contrast.evaluations else None,
        training_done=_done(run, unit, episodes.column("episode").astype(float)),
        training_returns=episodes.column("return"),
        optimum=np.nan if best is None else best,
        maps=_maps(run, pendulum, exact) if pendulum and exact else None,
        episode=pendulum_episode(run, pendulum) if pendulum else None,
        market=_market(run, summary, known) if known else None,
        unit=unit,
        preset=name,
        changes=changed,
    )


def pendulum_episode(run: Run, task: Pendulum, start: int = EPISODE_START) -> Episode:
    """The first seed's greedy episode from a fixed start."""
    weights = run.first_weights()
    episode = jax.jit(lambda: greedy_episode(task, run.agent, weights, start_keys()[start]))()
    return Episode(
        states=np.stack([episode.states.theta, episode.states.theta_dot], axis=-1),
        torques=np.asarray(task.torque(episode.actions)),
        rewards=np.asarray(episode.rewards),
    )


def _curve(run: Run, label: str, unit: str) -> Curve:
    done = _evaluated(run, "episode" if unit == "episodes" else "env_steps").mean(1)
    return Curve(label, done, _evaluated(run, "return"), _evaluated(run, "overestimation"))


def _done(run: Run, unit: str, episodes: Floats) -> Floats:
    """Episodes of a seed in the unit of the budget: its steps, from the learning curve's."""
    if unit == "episodes":
        return episodes
    known = (_evaluated(run, name).mean(1) for name in ("episode", "env_steps"))
    return np.interp(episodes, *known)


def _changes(run: Run) -> tuple[str | None, dict[str, tuple[Any, Any]]]:
    """The preset of a run, and the budget, seeds and settings that differ from it."""
    config = run.config
    found = changes(config, type(run.task))
    if found is None:
        return None, {}
    name, settings = found
    own = preset(name, config.task, config.agent)
    now, before = (f"{budget.amount} {budget.unit}" for budget in (run.budget, own.budget))
    # Groups of seeds count steps, in whole rollouts.
    rollout = run.agent.rollout_steps * run.agent.num_envs
    planned = -(-own.budget.env_steps(run.task, run.agent) // rollout) * rollout
    same = run.budget.amount == planned and run.budget.unit != own.budget.unit
    plan: dict[str, tuple[Any, Any]] = {
        "budget": (before if same else now, before),
        "seeds": (config.seeds, own.seeds),
    }
    return name, {key: pair for key, pair in plan.items() if pair[0] != pair[1]} | settings


def _evaluated(run: Run, name: str) -> Floats:
    """A column of the learning curve, of shape (point, seed)."""
    return np.array([row[name] for row in run.evaluations], float).reshape(-1, run.config.seeds)


def _market(run: Run, summary: dict[str, Any], solution: FollowedOptimum) -> MarketData:
    task = run.task
    words = words_of(summary["task"])
    growth = isinstance(task, Market) and task.reward == "log"
    years = task.horizon * task.dt if isinstance(task, NoTrade) else None
    return MarketData(
        about=words.about,
        meaning=words.meaning,
        rule=words.rule,
        measure="log growth" if growth else "return",
        horizon=task.horizon,
        period="" if not growth else "year" if years else "step",
        periods=years or float(task.horizon),
        policy=_policy(run, summary["rule"], solution.policy, words.scene),
    )


def _policy(
    run: Run, rule: dict[str, Any] | None, best: Policy, scene: str
) -> Responses | Weights | None:
    if isinstance(run.task, Synthetic) and run.task.scenes():
        return responses(run.task, run.agent, run.population.weights(), best, scene)
    return constant_weights(rule) if rule and rule["exact"] else None


def constant_weights(rule: dict[str, Any]) -> Weights:
    """The constant weights in a summary's rule."""
    return Weights(
        names=tuple(name.removeprefix("weight of ") for name in rule["exact"]),
        exact=np.array(list(rule["exact"].values())),
        learned=np.array([list(seed.values()) for seed in rule["per_seed"]]),
    )


def responses(
    task: Synthetic, agent: Agent, members: PyTree, best: Policy, scene: str = "{}"
) -> Responses:
    """Targets of the learned policies and the best one by holding, in each scene of a market.

    members: weights of the agents, with a leading axis. scene: format of a scene's name.
    """
    names, markets = zip(*task.scenes(), strict=True)
    scenes = jax.tree.map(lambda *leaves: jnp.stack(leaves), *markets)
    # Between its levels, an exact policy would have to round.
    held = jnp.linspace(*task.drawn, task.levels if isinstance(task, Ar1) else _HELD)

    def wanted(policy: Policy, market: Any, held: Array) -> Array:
        if isinstance(task, OneAsset):
            holding = task.hold(jnp.stack([1 - held, held]))
            return policy(Position(market, holding))[1]
        assert isinstance(task.actions, Box)
        return policy(Position(market, jnp.eye(task.actions.n)[0] * held))[0]  # of the first asset

    def table(policy: Policy) -> Array:
        each = jax.vmap(partial(wanted, policy), (None, 0))
        return jax.vmap(each, (0, None))(scenes, held)

    learned = jax.jit(jax.vmap(lambda weights: table(greedy(task, agent, weights))))
    return Responses(
        scenes=tuple(scene.format(typeset(name)) for name in names),
        held=np.asarray(held),
        exact=np.asarray(jax.jit(lambda: table(best))()),
        learned=np.asarray(learned(members)),
        weights=isinstance(task, OneAsset),
        region=task.region()[:2] if isinstance(task, NoTrade) else None,
    )


def _maps(run: Run, task: Pendulum, optimum: GridOptimum) -> Maps:
    theta = np.linspace(-np.pi, np.pi, 200, endpoint=False)
    theta_dot = np.linspace(-task.max_speed, task.max_speed, 201)
    grid = np.meshgrid(theta.astype(np.float32), theta_dot.astype(np.float32), indexing="ij")
    observation = task.observe(PendulumState(*(jnp.array(x.ravel()) for x in grid)))
    agent, weights = run.agent, run.first_weights()
    values = agent.action_values(weights, observation)
    torque = task.torque(agent.policy(weights, observation))
    assert agent.discount is not None
    assert isinstance(optimum.task, Pendulum)
    discount = float(agent.discount)
    exact_value, exact_action = optimum.stationary(discount)
    return Maps(
        theta=theta,
        theta_dot=theta_dot,
        value=None if values is None else np.asarray(values.max(-1)).reshape(grid[0].shape),
        policy=np.asarray(torque).reshape(grid[0].shape),
        exact_value=exact_value[::2, ::2],  # the solver's grid is twice as fine
        exact_policy=np.asarray(optimum.task.torque(jnp.array(exact_action)))[::2, ::2],
        discount=discount,
    )
