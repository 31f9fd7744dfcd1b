"""Networks as plain matrix products over batches."""

import math
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from qfolio.core.errors import QfolioError
from qfolio.core.fields import require, require_sizes
from qfolio.core.market import MenuActions, View
from qfolio.core.mdp import Actions, Box, Discrete, Simplex, Task
from qfolio.learning.encoders import (
    ACTIVATIONS,
    CNN,
    INITIALIZATIONS,
    LSTM,
    MLP,
    RNN,
    Window,
    uniform,
)
from qfolio.learning.positions import OrderValue, Tilting, Values
from qfolio.learning.targets import Scalar


class Flat(eqx.Module):
    """An MLP over the whole observation, flattened.

    An observation that is one of ``states`` numbers is one-hot encoded; an ``encoder`` can read
    windows and images first.
    """

    mlp: MLP
    encoder: CNN | RNN | LSTM | None
    states: int | None = eqx.field(static=True)

    def __init__(
        self, observation: PyTree, hidden: tuple[int, ...], outputs: int, key: PRNGKeyArray,
        input_gain: Float[Array, "*inputs"] | float = 1.0, states: int | None = None,
        encoder: CNN | RNN | LSTM | None = None, activation: str = "relu",
        initialization: str = "uniform",
    ) -> None:  # fmt: skip
        self.states, self.encoder = states, encoder
        batch = jax.tree.map(lambda x: jnp.asarray(x)[None], observation)
        inputs = jax.eval_shape(lambda: _rows(batch, states, encoder)).shape[1]
        sizes = (inputs, *hidden, outputs)
        self.mlp = MLP(sizes, key, input_gain, activation, initialization)

    def __call__(self, observation: PyTree) -> Float[Array, "batch outputs"]:
        return self.mlp(_rows(observation, self.states, self.encoder))


class LateAction(eqx.Module):
    """An MLP over an observation; an action enters at its second layer (Lillicrap et al. 2016)."""

    first: Flat  # over the observation alone
    later: Flat

    def __init__(
        self, seen: tuple[PyTree, Array], hidden: tuple[int, ...], key: PRNGKeyArray,
        gain: Float[Array, "*inputs"] | float, action_gain: float,
    ) -> None:  # fmt: skip
        """seen: an observation and an action."""
        (observation, action), (width, *rest) = seen, hidden
        first_key, later_key = jax.random.split(key)
        self.first = Flat(observation, (), width, first_key, gain)
        gains = jnp.append(jnp.ones(width), jnp.full(action.shape, action_gain))
        self.later = Flat((gains[:width], action), tuple(rest), 1, later_key, gains)

    @property
    def mlp(self) -> MLP:
        """The layers that give the output."""
        return self.later.mlp

    def __call__(self, seen: tuple[PyTree, Array]) -> Float[Array, "batch 1"]:
        observation, action = seen
        return self.later((jax.nn.relu(self.first(observation)), action))


def _rows(
    observation: PyTree, states: int | None, encoder: CNN | RNN | LSTM | None
) -> Float[Array, "batch inputs"]:
    if encoder is not None:
        observation = jax.nn.relu(encoder(observation))
    if states is not None:
        observation = one_hot(observation, states)
    leaves = jax.tree.leaves(observation)
    return jnp.concatenate([leaf.reshape(leaf.shape[0], -1) for leaf in leaves], axis=1)


def one_hot(observation: Int[Array, " batch"], states: int) -> Float[Array, "batch state"]:
    """Numbers of states as rows of zeros and a one; of NaN for a number that is no state."""
    there = (observation >= 0) & (observation < states)
    return jnp.where(there[:, None], jax.nn.one_hot(observation, states), jnp.nan)


class Reading(NamedTuple):
    """A shared network's intermediate results from the windows alone."""

    joined: Float[Array, "*batch asset width"]
    direct: Float[Array, "*batch asset outputs"]


class Shared(eqx.Module):
    """One network for all assets of a market, so that the order of the columns does not matter.

    An encoder reads each asset's own window. Its output is joined with the mean over all assets
    and with the holding, and passes through the remaining layers, asset by asset (ensemble of
    identical independent evaluators, Jiang et al. 2017, section 5; the mean over assets: Zaheer et
    al. 2017, "Deep Sets"). A linear path from window and holding to the outputs is added. Outputs
    of the whole market are means over the assets.
    """

    encoder: Window | CNN | RNN | LSTM
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
        window = view.features.shape[-2:]
        keys = jax.random.split(key, 3)
        width, *rest = hidden
        self.encoder = _ENCODERS[kind](window, width, keys[0])
        joined = rest[0] if rest else width
        inputs = 2 * width + 2
        self.join = uniform(keys[1], (inputs, joined), inputs**-0.5)
        self.head = MLP((joined, *rest[1:], pooled + each), keys[2])
        self.linear = jnp.zeros((math.prod(window) + 1, pooled + each))
        self.pooled = pooled

    def __call__(
        self, view: View
    ) -> tuple[Float[Array, "batch pooled"], Float[Array, "batch asset each"]]:
        return self.answer(self.read(view.features), view.holding)

    def read(self, features: Float[Array, "*batch asset time channel"]) -> Reading:
        """What does not depend on the holding, computed once for many holdings."""
        found = jax.nn.relu(self.encoder(features))
        width = found.shape[-1]
        of_window, of_market = self.join[:width], self.join[width : 2 * width]
        joined = found @ of_window + (found.mean(-2) @ of_market)[..., None, :]
        flat = features.reshape(*features.shape[:-2], -1)
        return Reading(joined, flat @ self.linear[:-1])

    def answer(
        self, reading: Reading, holding: Float[Array, "*batch asset"]
    ) -> tuple[Float[Array, "*batch pooled"], Float[Array, "*batch asset each"]]:
        """The outputs for the market and for each asset, from what ``read`` found."""
        own = holding[..., None]
        of_own, of_all = self.join[-2], self.join[-1]
        joined = reading.joined + own * of_own + own.sum(-2, keepdims=True) * of_all
        output = self.head(jax.nn.relu(joined)) + reading.direct + own * self.linear[-1]
        return output[..., : self.pooled].mean(-2), output[..., self.pooled :]


class PerAsset(eqx.Module):
    """A ``Shared`` network's outputs in one row: the market's, all assets' first, their second, ….

    If an action has several numbers (``atoms``), these are adjacent.
    """

    network: Shared
    atoms: int = eqx.field(static=True, default=1)

    def __call__(self, view: View) -> Float[Array, "batch outputs"]:
        market, each = self.network(view)
        choices = each.reshape(*each.shape[:-1], -1, self.atoms)
        blocks = jnp.swapaxes(choices, -2, -3)  # all assets' first choice, then their second, …
        return jnp.concatenate([market, blocks.reshape(*market.shape[:-1], -1)], -1)


_ENCODERS: dict[str, Any] = {"mlp": Window, "cnn": CNN, "rnn": RNN, "lstm": LSTM}

SHARED = tuple(_ENCODERS)
"""Kinds of networks that assets share."""

KINDS = ("flat", *SHARED, "positions")

_READS = {"cnn": (2, 3), "rnn": (2,), "lstm": (2,)}
"""Dimensions of an encoder's input: (time, channel), or (height, width, channel)."""

LINEAR = (Values, OrderValue, Tilting)
"""Networks without layers, which start at zero."""

Network = Flat | LateAction | PerAsset | Values | OrderValue | Tilting

N = TypeVar("N", bound=Network | Shared)


class NetworkConfig(NamedTuple):
    """An agent's settings for its networks, by the names that they have there."""

    network: str  # one of KINDS: flat, an encoder (shared by assets in a market), or positions
    hidden: tuple[int, ...]  # units of each hidden layer
    input_gain: Scalar = 0.0  # of the first layer on observations scaled to ±1; 0: unscaled
    activation: str = "relu"  # of the hidden units; others only in a flat network
    initialization: str = "uniform"  # others only in a flat network

    def check(self) -> None:
        """Raises QfolioError if the settings are invalid."""
        require(self, "network", lambda x: x in KINDS, f"one of {', '.join(KINDS)}")
        require_sizes(self)
        require(self, "input_gain", lambda x: 0 <= x <= 1e9, "from 0 to 10⁹")
        kinds = ", ".join(ACTIVATIONS)
        require(self, "activation", lambda x: x in ACTIVATIONS, f"one of {kinds}")
        kinds = ", ".join(INITIALIZATIONS)
        require(self, "initialization", lambda x: x in INITIALIZATIONS, f"one of {kinds}")
        if self.network != "flat":
            require(self, "activation", lambda x: x == "relu", "relu unless network=flat")
            require(self, "initialization", lambda x: x == "uniform", "uniform unless network=flat")


class Outputs(NamedTuple):
    """How many numbers a network outputs: in all, or in a market for it and for each asset."""

    pooled: int
    each: int = 0
    atoms: int = 1  # how many of these numbers belong to one action

    def size(self, task: Task, observation: PyTree) -> int:
        """All of them; a task that is no market may have weights of assets as actions, too."""
        if isinstance(task.actions, Simplex):
            assets = task.actions.assets
        else:
            assets = observation.holding.shape[-1] if isinstance(observation, View) else 0
        return self.pooled + assets * self.each


def outputs_of(actions: Actions, observation: PyTree) -> Outputs:
    """One output for each action, weight or coordinate, which in a market may be an asset's."""
    if isinstance(actions, Simplex):
        return Outputs(1, 1)
    if isinstance(actions, MenuActions):
        return Outputs(actions.pooled, actions.each)
    seen = observation.holding.shape if isinstance(observation, View) else ()
    if isinstance(actions, Box) and seen == (actions.n,):
        return Outputs(0, 1)
    return Outputs(actions.n)


def saturation(
    actions: Actions, output: Float[Array, "batch output"], reach: float
) -> Float[Array, " batch"]:
    """Squared distance of an actor's outputs beyond ±``reach``; 0 if actions have no bound.

    All outputs beyond it give the same action, and their gradient vanishes.
    """
    if not isinstance(actions, Box) or math.isinf(actions.bound):
        return jnp.zeros(len(output))
    return (jnp.maximum(jnp.abs(output) - reach, 0.0) ** 2).sum(-1)


def last_layer(network: Any) -> Any:
    """Weights and biases of the output layer."""
    if isinstance(network, PerAsset):
        network = network.network
    mlp = network.head if isinstance(network, Shared) else network.mlp
    return mlp.weights[-1], mlp.biases[-1]


def start_at_zero(network: N) -> N:
    """The network with an output layer of zeros: its outputs are the same everywhere."""
    if isinstance(network, LINEAR):
        return network
    return eqx.tree_at(last_layer, network, replace_fn=jnp.zeros_like)


def with_last_layer(network: Network, bound: float) -> Network:
    """The network with its uniform last layer rescaled to ±``bound``."""
    if isinstance(network, LINEAR):
        return network
    factor = bound * math.sqrt(last_layer(network)[0].shape[-2])
    return eqx.tree_at(last_layer, network, replace_fn=lambda x: factor * x)


def build(
    config: NetworkConfig,
    task: Task,
    observation: PyTree,
    outputs: Outputs,
    key: PRNGKeyArray,
) -> Network:
    """A network from batches of the task's observations to rows of numbers.

    An encoder has ``hidden[0]`` outputs, and the remaining layers follow it. The gain has no
    effect on a network that assets share. observation: an example. Raises QfolioError if the kind
    of network does not fit the observation, or there is nothing to observe.
    """
    if not any(map(jnp.size, jax.tree.leaves(observation))):
        raise QfolioError(
            f"Observations of {task.name} hold no number, but a network needs one or more."
        )
    kind, hidden, input_gain, activation, initialization = config
    # Small weights on a bounded observation make a function too smooth for some tasks.
    gain = jnp.where(input_gain > 0, input_gain / jnp.array(task.observation_scale), 1.0)
    if kind == "flat":
        return Flat(
            observation, hidden, outputs.size(task, observation), key, gain, task.states,
            activation=activation, initialization=initialization,
        )  # fmt: skip
    if kind == "positions":
        return _linear(task, observation, outputs)
    if not isinstance(observation, View):
        shape = jnp.shape(observation) if isinstance(observation, Array) else ()
        if kind not in _READS or len(shape) not in _READS[kind]:
            raise QfolioError(_does_not_fit(kind, task, shape))
        encoder_key, key = jax.random.split(key)
        # One gain for each channel, whose range is the same at every time and place.
        gain = jnp.broadcast_to(gain, (math.prod(shape),))[: shape[-1]]
        width, *rest = hidden
        encoder = _ENCODERS[kind](shape, width, encoder_key, gain)
        count = outputs.size(task, observation)
        return Flat(observation, tuple(rest), count, key, encoder=encoder)
    if isinstance(task.actions, Discrete) and not isinstance(task.actions, MenuActions):
        raise QfolioError(
            f"network={kind} is shared by assets and needs a menu with choices for each, such as "
            "menu=tilts:0.1; or use network=flat."
        )
    shared = Shared(kind, observation, hidden, outputs.pooled, outputs.each, key)
    return PerAsset(shared, outputs.atoms)


def _linear(task: Task, observation: PyTree, outputs: Outputs) -> Values | Tilting:
    """Values that are linear in positions or, for an actor of weights, a policy of tilts."""
    fits = isinstance(observation, View) and observation.features.shape[-1] > 1
    weights = isinstance(task.actions, Simplex)
    if not fits or (observation.anchor if weights else observation.choices) is None:
        raise QfolioError(
            "network=positions is for portfolios with signals and a mandate without debts, and "
            "either an anchor (such as anchor=equal-weight) or a menu of signals (such as "
            f"menu=signals:1), which {task.name} has not; set network=flat."
        )
    if weights and outputs.each:
        return Tilting(observation, spread=outputs.each > 1)
    return Values(observation)


def _does_not_fit(kind: str, task: Task, shape: tuple[int, ...]) -> str:
    name = task.name
    if kind not in _READS:
        return (
            f"network={kind} is shared by the assets of a market, but {name} is not a market; use "
            "network=flat."
        )
    images = " or images (height, width, channel)" if 3 in _READS[kind] else ""
    return (
        f"network={kind} reads windows (time, channel){images}, but observations of {name} have "
        f"the shape {shape}; use network=flat."
    )
