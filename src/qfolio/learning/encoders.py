"""Parts of networks: layers, and encoders that read a window or an image.

An encoder maps batches of observations of one shape (…, channel) to rows of ``width`` numbers.
"""

import math
from collections.abc import Callable
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from qfolio.core.errors import QfolioError

Gain = Float[Array, "*inputs"] | float
"""Factors of an encoder's first weights, one for each channel or for all."""

ACTIVATIONS = {"relu": jax.nn.relu, "tanh": jnp.tanh, "silu": jax.nn.silu}
"""Activations by name; networks keep the name, because jax's functions cannot be pickled."""

INITIALIZATIONS = ("uniform", "orthogonal")
"""Names of the ways to initialize layers."""


class MLP(eqx.Module):
    """Fully connected layers with an activation between them and none after the last.

    Weights and biases start uniform in ±1/√inputs (LeCun et al. 1998, section 4.6, but for a factor
    of √3), or ``orthogonal``: weights times √2 (the last layer's times 1), and biases of 0 (Saxe et
    al. 2014). ``input_gain`` multiplies the first layer's weights: one factor for each input.
    """

    weights: list[Float[Array, "inputs outputs"]]
    biases: list[Float[Array, " outputs"]]
    activation: str = eqx.field(static=True)

    def __init__(
        self,
        sizes: tuple[int, ...],
        key: PRNGKeyArray,
        input_gain: Float[Array, "*inputs"] | float = 1.0,
        activation: str = "relu",
        initialization: str = "uniform",
    ) -> None:
        self.weights, self.biases, self.activation = [], [], activation
        for inputs, outputs in pairwise(sizes):
            key, weight_key, bias_key = jax.random.split(key, 3)
            bound = inputs**-0.5
            self.weights.append(uniform(weight_key, (inputs, outputs), bound))
            self.biases.append(uniform(bias_key, (outputs,), bound))
            if initialization == "orthogonal":
                last = len(self.weights) == len(sizes) - 1
                draw = jax.nn.initializers.orthogonal(1.0 if last else math.sqrt(2))
                self.weights[-1] = draw(weight_key, (inputs, outputs))
                self.biases[-1] = jnp.zeros(outputs)
        self.weights[0] = jnp.broadcast_to(input_gain, sizes[:1])[:, None] * self.weights[0]

    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        *hidden, last = zip(self.weights, self.biases, strict=True)
        activate = ACTIVATIONS[self.activation]
        for weight, bias in hidden:
            x = activate(x @ weight + bias)
        weight, bias = last
        return x @ weight + bias


class CNN(eqx.Module):
    """A convolution along time or over an image, then one layer over all its outputs.

    Filters cover three rows of a window (time, channel), or 3 × 3 pixels of an image (height,
    width, channel). There are ``width`` / 8 filters (16 for 128, as in MinAtar, Young & Tian 2019),
    and at least 2. On a CPU, small convolutions are faster as one matrix product over copied
    neighborhoods than XLA's own (docs/concepts/networks.md).

    Raises QfolioError if the window or the image is smaller than a filter.
    """

    first: MLP
    second: MLP
    dimensions: int = eqx.field(static=True)

    SIZE = 3

    def __init__(
        self, shape: tuple[int, ...], width: int, key: PRNGKeyArray, gain: Gain = 1.0
    ) -> None:
        *space, channels = shape
        if min(space) < self.SIZE:
            raise QfolioError(
                f"A CNN needs windows of {self.SIZE} rows or more; this one has {space[0]}."
                if len(space) == 1
                else f"A CNN needs images of {self.SIZE} × {self.SIZE} pixels or more; "
                f"these have {' × '.join(map(str, space))}."
            )
        self.dimensions = len(space)
        first, second = jax.random.split(key)
        narrow = max(2, width // 8)
        neighbors = self.SIZE**self.dimensions
        gains = jnp.tile(jnp.broadcast_to(gain, (channels,)), neighbors)
        self.first = MLP((neighbors * channels, narrow), first, gains)
        places = math.prod(n - self.SIZE + 1 for n in space)
        self.second = MLP((places * narrow, width), second)

    def __call__(self, x: Float[Array, "*shape channel"]) -> Float[Array, "*batch width"]:
        for axis in range(x.ndim - 1 - self.dimensions, x.ndim - 1):
            count = x.shape[axis] - self.SIZE + 1
            shifted = [lax.slice_in_dim(x, i, i + count, axis=axis) for i in range(self.SIZE)]
            x = jnp.concatenate(shifted, axis=-1)
        found = jax.nn.relu(self.first(x))
        return self.second(found.reshape(*found.shape[: -1 - self.dimensions], -1))


class RNN(eqx.Module):
    """A gated recurrent unit along time (Cho et al. 2014); the output is its last state."""

    inputs: MLP
    state: Float[Array, "width gates"]

    def __init__(
        self, shape: tuple[int, ...], width: int, key: PRNGKeyArray, gain: Gain = 1.0
    ) -> None:
        inputs, state = jax.random.split(key)
        self.inputs = MLP((shape[-1], 3 * width), inputs, gain)
        self.state = uniform(state, (width, 3 * width), width**-0.5)

    def __call__(self, x: Float[Array, "*batch time channel"]) -> Float[Array, "*batch width"]:
        def step(state: Array, gate: Array) -> Array:
            reset, update, new = jnp.split(gate, 3, axis=-1)
            own_reset, own_update, own_new = jnp.split(state @ self.state, 3, axis=-1)
            update = jax.nn.sigmoid(update + own_update)
            candidate = jnp.tanh(new + jax.nn.sigmoid(reset + own_reset) * own_new)
            return update * state + (1 - update) * candidate

        start = jnp.zeros((*x.shape[:-2], self.state.shape[0]))
        return _last(step, start, self.inputs(x))


class LSTM(eqx.Module):
    """Long short-term memory along time (Hochreiter & Schmidhuber 1997); gives its last output.

    It has a forget gate (Gers et al. 2000) that starts open, by an addition of 1 to its bias.
    """

    inputs: MLP
    state: Float[Array, "width gates"]

    def __init__(
        self, shape: tuple[int, ...], width: int, key: PRNGKeyArray, gain: Gain = 1.0
    ) -> None:
        inputs, state = jax.random.split(key)
        layer = MLP((shape[-1], 4 * width), inputs, gain)
        open_gate = layer.biases[0].at[width : 2 * width].add(1.0)
        self.inputs = eqx.tree_at(lambda layer: layer.biases[0], layer, open_gate)
        self.state = uniform(state, (width, 4 * width), width**-0.5)

    def __call__(self, x: Float[Array, "*batch time channel"]) -> Float[Array, "*batch width"]:
        def step(carry: tuple[Array, Array], gate: Array) -> tuple[Array, Array]:
            output, cell = carry
            gates = jnp.split(gate + output @ self.state, 4, axis=-1)
            write, keep, show = map(jax.nn.sigmoid, gates[:3])
            cell = keep * cell + write * jnp.tanh(gates[3])
            return show * jnp.tanh(cell), cell

        start = jnp.zeros((*x.shape[:-2], self.state.shape[0]))
        return _last(step, (start, start), self.inputs(x))[0]


def _last(
    step: Callable[[PyTree, Array], PyTree],
    start: PyTree,
    inputs: Float[Array, "*batch time gates"],
) -> PyTree:
    """The state after all inputs."""
    rows = jnp.moveaxis(inputs, -2, 0)
    return lax.scan(lambda state, row: (step(state, row), None), start, rows)[0]


class Window(MLP):
    """A single layer over all numbers of a window."""

    def __init__(self, shape: tuple[int, ...], width: int, key: PRNGKeyArray) -> None:
        super().__init__((math.prod(shape), width), key)

    def __call__(self, x: Float[Array, "*batch time channel"]) -> Float[Array, "*batch width"]:
        return super().__call__(x.reshape(*x.shape[:-2], -1))


def uniform(key: PRNGKeyArray, shape: tuple[int, ...], bound: float) -> Array:
    """Numbers drawn uniformly from ±``bound``."""
    return jax.random.uniform(key, shape, minval=-bound, maxval=bound)
