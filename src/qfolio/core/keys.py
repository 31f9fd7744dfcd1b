"""A rule for random keys: what is drawn from a key and what from its parts must be independent."""

import jax
from jaxtyping import PRNGKeyArray


def apart(key: PRNGKeyArray) -> PRNGKeyArray:
    """A key for draws that are independent of those from ``key`` and from ``split(key)``.

    ``jax.random.fold_in(key, i)`` with a small i is no such key: it is the i-th of ``split(key)``.
    """
    return jax.random.fold_in(key, 2**32 - 1)
