"""Matrix products whose rounding does not depend on the number of threads.

On a CPU, XLA gives a matrix product to YNNPACK, unless the product sums over the first axis of its
left factor, as the gradient of a layer's weights does. Such a product goes to Eigen, which adds up
a long sum in as many parts as there are threads. So results would depend on the number of cores.
"""

from functools import cache
from math import prod
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend.core import Primitive
from jax.interpreters import mlir
from jaxtyping import Array

SHORT = 64
"""Most terms of a sum that Eigen leaves whole. For such a product Eigen is faster than YNNPACK with
copies of the factors."""

PRODUCT, AS_IT_IS = lax.dot_general_p, Primitive("product_as_it_is")


@cache
def register() -> None:
    """Has jax arrange long products on a CPU as YNNPACK takes them."""
    try:
        usual = mlir._platform_specific_lowerings["cpu"][PRODUCT].rule
    except (AttributeError, KeyError):  # a later jax; tests then show what depends on the cores
        return
    arranged = mlir.lower_fun(_arranged, multiple_results=False)

    def lower(context: Any, *factors: Any, **how: Any) -> Any:
        rule = arranged if _is_long(*context.avals_in, **how) else usual
        return rule(context, *factors, **how)

    mlir.register_lowering(AS_IT_IS, usual, platform="cpu")
    mlir.register_lowering(PRODUCT, lower, platform="cpu")


@AS_IT_IS.def_abstract_eval
def _kind(*factors: Any, **how: Any) -> jax.core.ShapedArray:
    found = jax.eval_shape(lambda *factors: PRODUCT.bind(*factors, **how), *factors)
    return jax.core.ShapedArray(found.shape, found.dtype)


def _is_long(*factors: Any, dimension_numbers: Any, **_: Any) -> bool:
    (summed, _), _ = dimension_numbers
    terms = prod(factors[0].shape[i] for i in summed)
    known = all(isinstance(length, int) for x in factors for length in x.shape)  # not of an export
    divided = any(axis is not None for x in factors for axis in x.sharding.spec)
    return known and not divided and factors[0].dtype == jnp.float32 and terms > SHORT


def _arranged(*factors: Array, dimension_numbers: Any, **how: Any) -> Array:
    """The product of factors as YNNPACK takes them, however XLA may turn them.

    XLA moves transpositions into a product, from which barriers keep it. It exchanges the factors
    if the result is transposed, as for the gradient of weights. If the left factor has to be
    transposed, both are therefore made to sum over their last axis.
    """
    summed, batch = dimension_numbers
    count = len(batch[0])
    orders = [
        [*ours, *(i for i in range(x.ndim) if i not in {*ours, *sums}), *sums]
        for x, sums, ours in zip(factors, summed, batch, strict=True)
    ]
    if orders[0] == list(range(len(orders[0]))):
        barred = map(lax.optimization_barrier, factors)
        found = AS_IT_IS.bind(*barred, dimension_numbers=dimension_numbers, **how)
        return found if max(summed[1]) == len(orders[1]) - 1 else lax.optimization_barrier(found)
    rests, matrices = [], []
    for factor, order in zip(factors, orders, strict=True):
        factor = lax.transpose(factor, order)
        last = factor.ndim - len(summed[0])
        ours, rest, terms = factor.shape[:count], factor.shape[count:last], factor.shape[last:]
        rests.append(rest)
        matrix = factor.reshape(*ours, prod(rest), prod(terms))
        matrices.append(lax.optimization_barrier(matrix))
    numbers = (((count + 1,), (count + 1,)), (tuple(range(count)),) * 2)
    found = AS_IT_IS.bind(*matrices, dimension_numbers=numbers, **how)
    return found.reshape(*found.shape[:count], *rests[0], *rests[1])
