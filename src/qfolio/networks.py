"""Networks as plain matrix products over batches."""

from itertools import pairwise
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from qfolio.errors import QfolioError
from qfolio.mdp import Actions, Discrete, Simplex, Task, View


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
            self.weights.append(_uniform(weight_key, (inputs, outputs), bound))
            self.biases.append(_uniform(bias_key, (outputs,), bound))
        self.weights[0] = jnp.broadcast_to(input_gain, sizes[:1])[:, None] * self.weights[0]

    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        *hidden, last = zip(self.weights, self.biases, strict=True)
        for weight, bias in hidden:
            x = jax.nn.relu(x @ weight + bias)
        weight, bias = last
        return x @ weight + bias


class Flat(eqx.Module):
    """An MLP over everything that is observed, in one row of numbers.

    An observation that is one of ``states`` numbers becomes a row with a one at its place.
    """

    mlp: MLP
    states: int | None = eqx.field(static=True)

    def __init__(
        self, observation: PyTree, hidden: tuple[int, ...], outputs: int, key: PRNGKeyArray,
        input_gain: Float[Array, "*inputs"] | float = 1.0, states: int | None = None,
    ) -> None:  # fmt: skip
        self.states = states
        batch = jax.tree.map(lambda x: jnp.asarray(x)[None], observation)
        inputs = jax.eval_shape(lambda: _rows(batch, states)).shape[1]
        self.mlp = MLP((inputs, *hidden, outputs), key, input_gain)

    def __call__(self, observation: PyTree) -> Float[Array, "batch outputs"]:
        return self.mlp(_rows(observation, self.states))


def _rows(observation: PyTree, states: int | None) -> Float[Array, "batch inputs"]:
    if states is not None:
        observation = jax.nn.one_hot(observation, states)
    leaves = jax.tree.leaves(observation)
    return jnp.concatenate([leaf.reshape(leaf.shape[0], -1) for leaf in leaves], axis=1)


class Reading(NamedTuple):
    """What a shared network makes of the windows alone."""

    joined: Float[Array, "*batch asset width"]
    direct: Float[Array, "*batch asset outputs"]


class Shared(eqx.Module):
    """One network for all assets of a market, so that the order of the columns does not matter.

    An encoder reads each asset's own window. What it found is joined with the mean over all assets
    and with the holding, and goes through the remaining layers, asset by asset (ensemble of
    identical independent evaluators, Jiang et al. 2017, section 5; the mean over assets: Zaheer et
    al. 2017, "Deep Sets"). A linear path from window and holding to the outputs lies beside it.
    Outputs of the whole market are means over the assets.
    """

    encoder: "MLP | CNN | RNN"
    join: Float[Array, "inputs width"]
    head: MLP
    linear: Float[Array, "numbers outputs"]
    pooled: int = eqx.field(static=True)

    def __init__(
        self,
        kind: str,
        view: View,
        hidden: tuple[int, ...],
        pooled: int,
        each: int,
        key: PRNGKeyArray,
    ) -> None:
        """``pooled`` outputs for the market and ``each`` for every asset."""
        time, channels = view.features.shape[-2:]
        keys = jax.random.split(key, 3)
        width, *rest = hidden
        self.encoder = _ENCODERS[kind](time, channels, width, keys[0])
        joined = rest[0] if rest else width
        inputs = 2 * width + 2
        self.join = _uniform(keys[1], (inputs, joined), inputs**-0.5)
        self.head = MLP((joined, *rest[1:], pooled + each), keys[2])
        self.linear = jnp.zeros((time * channels + 1, pooled + each))
        self.pooled = pooled

    def __call__(
        self, view: View
    ) -> tuple[Float[Array, "batch pooled"], Float[Array, "batch asset each"]]:
        return self.answer(self.read(view.features), view.holding)

    def read(self, features: Float[Array, "*batch asset time channel"]) -> Reading:
        """All that does not depend on the holding, once for many holdings."""
        found = jax.nn.relu(self.encoder(features))
        width = found.shape[-1]
        of_window, of_market = self.join[:width], self.join[width : 2 * width]
        joined = found @ of_window + (found.mean(-2) @ of_market)[..., None, :]
        flat = features.reshape(*features.shape[:-2], -1)
        return Reading(joined, flat @ self.linear[:-1])

    def answer(
        self, reading: Reading, holding: Float[Array, "*batch asset"]
    ) -> tuple[Float[Array, "*batch pooled"], Float[Array, "*batch asset each"]]:
        own = holding[..., None]
        of_own, of_all = self.join[-2], self.join[-1]
        joined = reading.joined + own * of_own + own.sum(-2, keepdims=True) * of_all
        output = self.head(jax.nn.relu(joined)) + reading.direct + own * self.linear[-1]
        return output[..., : self.pooled].mean(-2), output[..., self.pooled :]


class PerAsset(eqx.Module):
    """A ``Shared`` network's outputs in one row: the market's, then every asset's first, ….

    Of an action's values and of a policy's weights alike.
    """

    network: Shared

    def __call__(self, view: View) -> Float[Array, "batch outputs"]:
        market, each = self.network(view)
        blocks = jnp.swapaxes(each, -1, -2)  # all assets' first choice, then their second, …
        return jnp.concatenate([market, blocks.reshape(*market.shape[:-1], -1)], -1)


class CNN(eqx.Module):
    """Two convolutions along time: the first over three rows, the second over all that is left."""

    first: MLP
    second: MLP

    ROWS = 3

    def __init__(self, time: int, channels: int, width: int, key: PRNGKeyArray) -> None:
        if time < self.ROWS:
            raise QfolioError(f"A CNN needs windows of {self.ROWS} rows or more; here: {time}.")
        first, second = jax.random.split(key)
        narrow = max(2, width // 8)
        self.first = MLP((self.ROWS * channels, narrow), first)
        self.second = MLP(((time - self.ROWS + 1) * narrow, width), second)

    def __call__(self, x: Float[Array, "*batch time channel"]) -> Float[Array, "*batch width"]:
        count = x.shape[-2] - self.ROWS + 1
        rows = jnp.concatenate([x[..., i : i + count, :] for i in range(self.ROWS)], axis=-1)
        found = jax.nn.relu(self.first(rows))
        return self.second(found.reshape(*found.shape[:-2], -1))


class RNN(eqx.Module):
    """A gated recurrent unit along time (Cho et al. 2014); its last state."""

    inputs: MLP
    state: Float[Array, "width gates"]

    def __init__(self, time: int, channels: int, width: int, key: PRNGKeyArray) -> None:
        inputs, state = jax.random.split(key)
        self.inputs = MLP((channels, 3 * width), inputs)
        self.state = _uniform(state, (width, 3 * width), width**-0.5)

    def __call__(self, x: Float[Array, "*batch time channel"]) -> Float[Array, "*batch width"]:
        gates = jnp.moveaxis(self.inputs(x), -2, 0)

        def step(state: Array, gate: Array) -> tuple[Array, None]:
            reset, update, new = jnp.split(gate, 3, axis=-1)
            own_reset, own_update, own_new = jnp.split(state @ self.state, 3, axis=-1)
            update = jax.nn.sigmoid(update + own_update)
            candidate = jnp.tanh(new + jax.nn.sigmoid(reset + own_reset) * own_new)
            return update * state + (1 - update) * candidate, None

        start = jnp.zeros((*x.shape[:-2], self.state.shape[0]))
        return lax.scan(step, start, gates)[0]


class _Window(MLP):
    """An MLP of one layer over a window's numbers."""

    def __init__(self, time: int, channels: int, width: int, key: PRNGKeyArray) -> None:
        super().__init__((time * channels, width), key)

    def __call__(self, x: Float[Array, "*batch time channel"]) -> Float[Array, "*batch width"]:
        return super().__call__(x.reshape(*x.shape[:-2], -1))


_ENCODERS: dict[str, Any] = {"mlp": _Window, "cnn": CNN, "rnn": RNN}

SHARED = tuple(_ENCODERS)
"""Kinds of networks that assets share."""

KINDS = ("flat", *SHARED)

Network = Flat | PerAsset


class Outputs(NamedTuple):
    """How many numbers a network gives: of the whole, and of each asset in a market."""

    pooled: int
    each: int = 0


def outputs_of(actions: Actions) -> Outputs:
    """A number for each action, each weight or each coordinate."""
    if isinstance(actions, Simplex):
        return Outputs(1, 1)
    if isinstance(actions, Discrete) and actions.each:
        return Outputs(actions.pooled, actions.each)
    return Outputs(actions.n)


def build(
    kind: str,
    task: Task,
    observation: PyTree,
    hidden: tuple[int, ...],
    outputs: Outputs,
    key: PRNGKeyArray,
    input_gain: Float[Array, ""] | float = 0.0,
) -> Network:
    """A network from batches of the task's observations to rows of numbers.

    kind: ``flat``, or for markets one that assets share. observation: an example. input_gain: of
    the first layer of ``flat``, with observations taken to ±1; 0 takes them as they are.
    """
    if kind == "flat":
        # Small weights on a bounded observation make a function too smooth for some tasks.
        scale = jnp.array(task.observation_scale)
        gain = jnp.where(input_gain > 0, input_gain / scale, 1.0)
        assets = observation.holding.shape[-1] if isinstance(observation, View) else 0
        count = outputs.pooled + assets * outputs.each
        return Flat(observation, hidden, count, key, gain, task.states)
    if not isinstance(observation, View):
        raise QfolioError(
            f"network={kind} is shared by the assets of a market; for {type(task).__name__} take "
            "network=flat."
        )
    if isinstance(task.actions, Discrete) and not task.actions.each:
        raise QfolioError(
            f"network={kind} is shared by assets and needs a menu with choices for each, such as "
            "menu=tilts:0.1; otherwise take network=flat."
        )
    return PerAsset(Shared(kind, observation, hidden, outputs.pooled, outputs.each, key))


def _uniform(key: PRNGKeyArray, shape: tuple[int, ...], bound: float) -> Array:
    return jax.random.uniform(key, shape, minval=-bound, maxval=bound)
