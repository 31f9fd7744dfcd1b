"""A function of single items, computed only for those that need it, many of them side by side.

Under ``vmap``, a condition computes both of its branches for all items of a batch, and a loop runs
until the last item is done. Here, the items that need the function are gathered into small blocks,
and each block is computed by itself: what most items do not need costs them nothing, and an item
that takes long keeps few others waiting.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Int, PyTree

Own = TypeVar("Own")

Result = TypeVar("Result")

BLOCK = 32
"""Items computed side by side: a multiple of the lanes of a processor's vectors."""


def where_needed(
    function: Callable[[Own, PyTree], Result],
    needed: Bool[Array, ""] | bool,
    own: Own,
    shared: PyTree,
) -> Result:
    """``function(own, shared)`` if it is needed, and zeros if not. It has no derivative.

    own: what differs between the items of a batch. shared: what many of them have in common; at
    most a block of its copies is in memory.
    """
    leaves, structure = jax.tree.flatten(shared)
    given = (jnp.asarray(needed), jax.tree.map(jnp.asarray, own), [jnp.asarray(x) for x in leaves])
    needed, own, leaves = jax.tree.map(lambda x: x[None], given)

    def one(own: Own, leaves: list[Array]) -> Result:
        return function(own, jax.tree.unflatten(structure, leaves))

    where = [jnp.zeros(1, jnp.int32)] * len(leaves)
    return jax.tree.map(lambda x: x[0], _over_lanes(one)(needed, own, leaves, where))


def _over_lanes(function: Callable[[Own, list[Array]], Result]) -> Callable[..., Result]:
    """The function over a leading axis of lanes, of which what is shared has fewer.

    The result's arguments are: which lanes need it; what lanes have of their own; the leaves of
    what they share; and, for each leaf, where each lane finds its own in the leaf.
    """

    @custom_vmap
    def over_lanes(
        needed: Bool[Array, " lane"],
        own: Own,
        leaves: list[Array],
        where: list[Int[Array, " lane"]],
    ) -> Result:
        lanes = needed.shape[0]
        size = min(BLOCK, lanes)
        count = needed.sum()
        first = jnp.argsort(~needed)  # is stable
        order = jnp.where(jnp.arange(lanes) < count, first, lanes)
        order = jnp.concatenate([order, jnp.full(-lanes % size, lanes)])

        def block(state: tuple[Array, Result]) -> tuple[Array, Result]:
            start, found = state
            to = lax.dynamic_slice_in_dim(order, start, size)
            of = jnp.where(to < lanes, to, first[0])  # the last block repeats an item
            mine = jax.tree.map(lambda x: x[of], own)
            common = [len(x) == 1 for x in leaves]
            theirs = [
                x[0] if one else x[at[of]] for x, at, one in zip(leaves, where, common, strict=True)
            ]
            made = jax.vmap(function, (0, [None if one else 0 for one in common]))(mine, theirs)
            put = lambda every, some: every.at[to].set(some, mode="drop")  # noqa: E731
            return start + size, jax.tree.map(put, found, made)

        shape = jax.eval_shape(function, *jax.tree.map(lambda x: x[0], (own, leaves)))
        none = jax.tree.map(lambda x: jnp.zeros((lanes, *x.shape), x.dtype), shape)
        begin = jnp.zeros_like(count), none
        return lax.while_loop(lambda state: state[0] < count, block, begin)[1]

    @over_lanes.def_vmap
    def of_batch(size: int, batched: Any, *given: Any) -> tuple[Result, Any]:
        needed, own, leaves, where = given
        lanes = needed.shape[-1]

        def joined(x: Array, batched: bool) -> Array:
            every = x if batched else jnp.broadcast_to(x, (size, *x.shape))
            return every.reshape(-1, *every.shape[2:])

        of_needed, of_own, of_leaves, _ = batched
        copy = jnp.arange(size)[:, None]
        for i, apart in enumerate(of_leaves):
            there = jnp.broadcast_to(where[i], (size, lanes))
            if apart:
                there = there + copy * leaves[i].shape[1]
                leaves[i] = joined(leaves[i], True)
            where[i] = there.reshape(-1)
        needed, own = jax.tree.map(joined, (needed, own), (of_needed, of_own))
        found = over_lanes(needed, own, leaves, where)
        split = jax.tree.map(lambda x: x.reshape(size, lanes, *x.shape[1:]), found)
        return split, jax.tree.map(lambda _: True, split)

    return over_lanes
