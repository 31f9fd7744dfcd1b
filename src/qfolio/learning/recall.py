"""What agents keep of the observations that they learn from later.

The view of a position in a market is many times larger than the position, and is computed from it
at little more than the cost of a copy. So a position is kept instead.
"""

import jax
from jaxtyping import PyTree

from qfolio.core.market import View
from qfolio.core.mdp import Position, Task


def stored(state: PyTree, observation: PyTree) -> PyTree:
    """What is kept of an observation of ``state``, or of a batch of them."""
    small = isinstance(state, Position) and isinstance(observation, View)
    return state if small else observation


def recalled(task: Task, kept: PyTree) -> PyTree:
    """A batch of observations as the agent saw them."""
    return jax.vmap(task.observe)(kept) if isinstance(kept, Position) else kept
