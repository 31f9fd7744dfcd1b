"""A policy's folder: its settings, its weights, and its learning state.

policy.json holds the settings, policy.safetensors the weights and scales for decisions, and
learning.safetensors the whole learning state, for updates.
"""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jaxtyping import PyTree

from qfolio.core import settings
from qfolio.core.config import Config, read_config, write_config
from qfolio.core.errors import QfolioError
from qfolio.core.files import new_folder, read_tree, write_tree
from qfolio.core.mdp import Agent
from qfolio.core.registry import name_of
from qfolio.experiments.described import agent_of, recorded
from qfolio.portfolio.task import Portfolio

if TYPE_CHECKING:
    from qfolio.portfolio.policy import Policy


class PolicyConfig(Config, frozen=True):
    """The configuration of a policy's folder."""

    kind: ClassVar[str] = "policy"
    format: ClassVar[int] = 4

    agent: str
    settings: dict[str, Any]
    task: dict[str, Any]
    assets: Annotated[list[str], msgspec.Meta(min_length=1)]
    features: list[str]
    seeds: Annotated[int, msgspec.Meta(ge=1, lt=2**20)]
    rows: Annotated[int, msgspec.Meta(ge=1, lt=2**31)]
    updates: Annotated[int, msgspec.Meta(ge=0)]
    learned: str
    learns: bool
    periods_per_year: float = 0.0  # rows a year of the prices that it learned from; 0: not known


def save(policy: "Policy", folder: Path) -> None:
    """Writes a policy into a new or empty folder."""
    config = PolicyConfig(
        agent=name_of(policy.agent),
        settings=recorded(policy.agent),
        task=settings.describe(policy.task),
        assets=list(policy.assets),
        features=list(policy.features),
        seeds=policy.seeds,
        rows=policy.rows,
        updates=policy.updates,
        learned=str(policy.learned),
        learns=policy.learner is not None,
        periods_per_year=float(policy.task.year),
    )
    with new_folder(folder, None) as place:
        write_config(place / "policy.json", config)
        kept = jax.tree.map(np.asarray, _kept(policy.task, policy.members))
        write_tree(place / "policy.safetensors", kept)
        if policy.learner is not None:
            write_tree(place / "learning.safetensors", policy.learner)


def read(folder: Path, agent: Agent | None = None) -> dict[str, Any]:
    """The arguments of the ``Policy`` that was saved.

    agent: as for ``Policy.open``.

    Raises QfolioError if the folder holds no policy, or one of another agent.
    """
    path = folder / "policy.json"
    config = read_config(path, PolicyConfig)
    try:
        learned = np.datetime64(config.learned, "s")
    except ValueError:
        raise QfolioError(
            f"{path} is damaged: learned is {config.learned!r}, which is not a date."
        ) from None
    agent = agent_of(config.agent, config.settings, agent)
    task = _blank(config)
    state = state_template(task, agent, config.seeds)
    template = _kept(task, agent.weights(state))
    kept = read_tree(path.with_name("policy.safetensors"), template)
    members = kept.pop("members")
    task = dataclasses.replace(task, **jax.tree.map(jnp.asarray, kept))
    learner = read_tree(path.with_name("learning.safetensors"), state) if config.learns else None
    return {
        "task": task,
        "agent": agent,
        "members": members,
        "assets": config.assets,
        "features": config.features,
        "learner": learner,
        "updates": config.updates,
        "learned": learned,
    }


def state_template(task: Portfolio, agent: Agent, seeds: int) -> PyTree:
    """Shapes of the agents' whole states, with a leading seed axis."""
    state = jax.eval_shape(lambda: agent.init(task, jax.random.key(0)))
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct((seeds, *x.shape), x.dtype), state)


def _kept(task: Portfolio, members: PyTree) -> dict[str, PyTree]:
    """The arrays that a policy needs to decide."""
    return {
        "members": members,
        "center": task.center,
        "scale": task.scale,
        "limits": task.limits,
        "allowed": task.allowed,
    }


def _blank(config: PolicyConfig) -> Portfolio:
    """The task without its prices."""
    chosen = settings.convert(Portfolio, config.task)
    task = Portfolio.blank(len(config.assets), len(config.features), **chosen)
    windows = ("log_relatives", "extra", "anchors", "benchmarks")
    return task.having(
        **{name: jnp.zeros((task.window, *getattr(task, name).shape[1:])) for name in windows},
        first_decision=jnp.array(task.window, jnp.int32),
        last_decision=jnp.array(config.rows - task.lag - 2, jnp.int32),
        year=jnp.array(config.periods_per_year),
    )
