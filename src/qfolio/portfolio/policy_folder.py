"""A policy's folder: its settings, its weights, and its learning state.

policy.json holds the settings, policy.safetensors the weights and scales for decisions, and
learning.safetensors the whole learning state, for updates.
"""

import dataclasses
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from qfolio.core import settings
from qfolio.core.errors import QfolioError
from qfolio.core.files import new_folder, read_json, read_tree, write_json, write_tree
from qfolio.core.mdp import Agent
from qfolio.core.registry import build, name_of
from qfolio.portfolio.policy import Policy
from qfolio.portfolio.task import Portfolio

FORMAT = 3
"""Format of a policy's folder; raised whenever an older folder can no longer be read."""


def save(policy: Policy, folder: Path) -> None:
    """Writes a policy into a new or empty folder."""
    with new_folder(folder) as place:
        write_json(
            place / "policy.json",
            {
                "format": FORMAT,
                "kind": "policy",
                "agent": name_of(policy.agent),
                "settings": settings.describe(policy.agent),
                "task": settings.describe(policy.task),
                "assets": list(policy.assets),
                "features": list(policy.features),
                "seeds": policy.seeds,
                "rows": policy.rows,
                "updates": policy.updates,
                "learned": str(policy.learned),
                "learns": policy.learner is not None,
            },
        )
        kept = jax.tree.map(np.asarray, _kept(policy.task, policy.members))
        write_tree(place / "policy.safetensors", kept)
        if policy.learner is not None:
            write_tree(place / "learning.safetensors", policy.learner)


def read(folder: Path) -> Policy:
    """Reads what ``save`` wrote. Raises QfolioError if the folder holds no policy."""
    path = folder / "policy.json"
    config = read_json(path)
    if config.get("format") != FORMAT or config.get("kind") != "policy":
        raise QfolioError(f"{folder} holds no policy of this version.")
    try:
        agent: Agent = build("agent", config["agent"], config["settings"])
        chosen = settings.convert(Portfolio, config["task"])
        assets, features = tuple(config["assets"]), tuple(config["features"])
        seeds, rows, updates = (int(config[name]) for name in ("seeds", "rows", "updates"))
        learned, learns = np.datetime64(config["learned"], "s"), bool(config["learns"])
        bounds = (len(assets) > 0, 1 <= seeds < 2**20, 1 <= rows < 2**31, updates >= 0)
        if not all(bounds) or not all(isinstance(name, str) for name in assets + features):
            raise ValueError
    except (KeyError, TypeError, ValueError, AttributeError):
        raise QfolioError(f"{path} is damaged: a setting is missing or invalid.") from None
    task = _blank(len(assets), len(features), rows, **chosen)
    state = state_template(task, agent, seeds)
    template = _kept(task, agent.weights(state))
    kept = read_tree(path.with_name("policy.safetensors"), template)
    members = kept.pop("members")
    task = dataclasses.replace(task, **jax.tree.map(jnp.asarray, kept))
    learner = read_tree(path.with_name("learning.safetensors"), state) if learns else None
    return Policy(task, agent, members, assets, features, learner, updates, learned)


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
    }


def _blank(assets: int, features: int, rows: int, **chosen: Any) -> Portfolio:
    """A task of the given number of training rows, without their prices."""
    task = Portfolio(
        log_relatives=jnp.zeros((0, assets)),
        extra=jnp.zeros((0, assets, features)),
        limits=jnp.zeros(assets),
        center=jnp.zeros(1 + features),
        scale=jnp.ones(1 + features),
        first_decision=jnp.array(0, jnp.int32),
        last_decision=jnp.array(0, jnp.int32),
        **chosen,
    )
    shown = (jnp.zeros((task.window, assets)), jnp.zeros((task.window, assets, features)))
    last = jnp.array(rows - task.lag - 2, jnp.int32)
    where = lambda t: (t.log_relatives, t.extra, t.first_decision, t.last_decision)  # noqa: E731
    return eqx.tree_at(where, task, (*shown, jnp.array(task.window, jnp.int32), last))
