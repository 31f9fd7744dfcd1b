"""Networks as plain matrix products over batches."""

from itertools import pairwise

import equinox as eqx
import jax
from jaxtyping import Array, Float, PRNGKeyArray


class MLP(eqx.Module):
    """Fully connected layers with ReLU between them and none after the last.

    Weights and biases start uniform in ±1/√inputs (LeCun et al. 1998, section 4.6, up to √3).
    """

    weights: list[Float[Array, "inputs outputs"]]
    biases: list[Float[Array, " outputs"]]

    def __init__(self, sizes: tuple[int, ...], key: PRNGKeyArray) -> None:
        self.weights, self.biases = [], []
        for inputs, outputs in pairwise(sizes):
            key, weight_key, bias_key = jax.random.split(key, 3)
            bound = inputs**-0.5
            shape = (inputs, outputs)
            self.weights.append(jax.random.uniform(weight_key, shape, minval=-bound, maxval=bound))
            self.biases.append(
                jax.random.uniform(bias_key, (outputs,), minval=-bound, maxval=bound)
            )

    def __call__(self, x: Float[Array, "batch inputs"]) -> Float[Array, "batch outputs"]:
        *hidden, last = zip(self.weights, self.biases, strict=True)
        for weight, bias in hidden:
            x = jax.nn.relu(x @ weight + bias)
        weight, bias = last
        return x @ weight + bias
