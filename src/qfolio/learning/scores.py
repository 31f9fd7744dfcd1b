"""Small networks that score each asset beside the others, for policies over many assets."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray


class Hidden(eqx.Module):
    """A layer of tanh units for each asset, over its inputs and their mean over all assets.

    The mean is a set context (Zaheer et al. 2017, "Deep Sets"). The output starts at zero, and the
    biases do not: ranks have mean 0, and without biases opposite ranks would have opposite scores.
    """

    own: Float[Array, "channel unit"]
    context: Float[Array, "channel unit"]
    bias: Float[Array, " unit"]
    output: Float[Array, " unit"]

    def __init__(self, channels: int, units: int, key: PRNGKeyArray) -> None:
        first, second, third = jax.random.split(key, 3)
        self.own = channels**-0.5 * jax.random.normal(first, (channels, units))
        self.context = channels**-0.5 * jax.random.normal(second, (channels, units))
        self.bias = jax.random.normal(third, (units,))
        self.output = jnp.zeros(units)

    def __call__(self, inputs: Float[Array, "*batch asset channel"]) -> Array:
        market = inputs.mean(-2, keepdims=True) @ self.context + self.bias
        return jnp.tanh(inputs @ self.own + market) @ self.output


class Attention(eqx.Module):
    """An attention head across assets (Vaswani et al. 2017); the output starts at zero.

    Each asset compares its inputs with those of all assets, and scores what it gathers from them.
    Its biases are as in ``Hidden``.
    """

    query: Float[Array, "channel unit"]
    key: Float[Array, "channel unit"]
    value: Float[Array, "channel unit"]
    bias: Float[Array, " unit"]
    output: Float[Array, " unit"]

    def __init__(self, channels: int, units: int, key: PRNGKeyArray) -> None:
        first, second = jax.random.split(key)
        parts = channels**-0.5 * jax.random.normal(first, (3, channels, units))
        self.query, self.key, self.value = parts
        self.bias = jax.random.normal(second, (units,))
        self.output = jnp.zeros(units)

    def __call__(self, inputs: Float[Array, "*batch asset channel"]) -> Array:
        scale = self.output.shape[0] ** -0.5
        alike = scale * jnp.einsum("...au,...bu->...ab", inputs @ self.query, inputs @ self.key)
        gathered = jax.nn.softmax(alike, -1) @ (inputs @ self.value)
        return jnp.tanh(gathered + inputs @ self.value + self.bias) @ self.output


NETWORKS: dict[str, type[Hidden] | type[Attention]] = {"hidden": Hidden, "attention": Attention}
"""Networks that score assets, by name."""
