"""Matrix products whose rounding does not depend on the number of threads.

On a CPU, XLA gives a matrix product to YNNPACK, unless the product sums over the first axis of its
left factor, as the gradient of a layer's weights does. Such a product goes to Eigen, which adds up
a long sum in as many parts as there are threads. So results would depend on the number of cores.
"""

from collections.abc import Iterable
from math import prod
from typing import Any

import jax.numpy as jnp
from jax import lax
from jax.extend.mlir.dialects import stablehlo
from jax.interpreters import mlir

SHORT = 64
"""Most terms of a sum that Eigen leaves whole. It is then faster than copying the factors."""


def register() -> None:
    """Has jax arrange long products on a CPU as YNNPACK takes them."""
    product = lax.dot_general_p
    try:
        lower = mlir._platform_specific_lowerings["cpu"][product].rule
    except (AttributeError, KeyError):  # a later jax; tests then show what depends on the cores
        return

    def arranged(context: Any, *factors: Any, dimension_numbers: Any, **how: Any) -> Any:
        kinds, (summed, _) = context.avals_in, dimension_numbers
        long = prod(kinds[0].shape[i] for i in summed[0]) > SHORT
        if not long or kinds[0].dtype != jnp.float32:
            return lower(context, *factors, dimension_numbers=dimension_numbers, **how)
        orders, numbers = _arrangement(kinds, dimension_numbers)
        # The barriers keep XLA from moving transpositions into the product.
        factors = tuple(_barred(map(stablehlo.transpose, factors, orders)))
        kinds = [
            kind.update(shape=tuple(kind.shape[i] for i in order))
            for kind, order in zip(kinds, orders, strict=True)
        ]
        found = lower(context.replace(avals_in=kinds), *factors, dimension_numbers=numbers, **how)
        if max(numbers[0][1]) == kinds[1].ndim - 1:
            return found
        # XLA would exchange the factors if the result were transposed.
        return _barred(found)

    mlir.register_lowering(product, arranged, platform="cpu")


def _barred(values: Iterable[Any]) -> list[Any]:
    return [stablehlo.OptimizationBarrierOp([value]).results[0] for value in values]


def _arrangement(factors: Any, numbers: Any) -> tuple[list[list[int]], Any]:
    """The orders of the factors' axes, and their numbers then.

    If the left factor does not sum over its last axes, both are made to: then XLA may exchange
    them, as it does for the gradient of weights.
    """
    summed, batch = numbers
    ordered = [
        [*ours, *(i for i in range(x.ndim) if i not in {*ours, *sums}), *sums]
        for x, sums, ours in zip(factors, summed, batch, strict=True)
    ]
    same = [list(range(x.ndim)) for x in factors]
    if ordered[0] == same[0]:
        return same, numbers
    first = tuple(range(len(batch[0])))
    last = [tuple(range(x.ndim - len(summed[0]), x.ndim)) for x in factors]
    return ordered, (tuple(last), (first, first))
