"""Networks as plain matrix products over batches."""

from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


class MLP(eqx.Module):
    """Fully connected layers with ReLU between them and none after the last.

    Weights and biases start uniform in ±1/√inputs (LeCun et al. 1998, section 4.6, up to √3); the
    first layer's weights are multiplied by ``input_gain``, one factor for each input.
    """

    weights: list[Float[Array, "inputs outputs"]]
    biases: list[Float[Array, " outputs"]]

    def __init__(
        self,
        sizes: tuple[int, ...],
        key: PRNGKeyArray,
        input_gain: Float[Array, "*inputs"] | float = 1.0,
    ) -> None:
        self.weights, self.biases = [], []
        for inputs, outputs in pairwise(sizes):
            key, weight_key, bias_key = jax.random.split(key, 3)
            bound = inputs**-0.5
            shape = (inputs, outputs)
            self.weights.append(jax.random.uniform(weight_key, shape, minval=-bound, maxval=bound))
            self.biases.append(
                jax.random.uniform(bias_key, (outputs,), minval=-bound, maxval=bound)
            )
        self.weights[0] = jnp.broadcast_to(input_gain, sizes[:1])[:, None] * self.weights[0]

    def __call__(self, x: Float[Array, "batch inputs"]) -> Float[Array, "batch outputs"]:
        *hidden, last = zip(self.weights, self.biases, strict=True)
        for weight, bias in hidden:
            x = jax.nn.relu(x @ weight + bias)
        weight, bias = last
        return x @ weight + bias
