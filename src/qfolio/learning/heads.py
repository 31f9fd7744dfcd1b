"""Special last layers of a network: dueling streams, and noisy weights."""

import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from qfolio.core.errors import QfolioError
from qfolio.core.mdp import Task
from qfolio.learning import networks
from qfolio.learning.encoders import MLP
from qfolio.learning.targets import Scalar


class NoisyMLP(MLP):
    """Layers whose weights have noise of a learned scale (Fortunato et al. 2018, section 3).

    The noise is factorized: a weight's noise is the product of one number for its input and one for
    its output. The module itself uses the mean weights; ``draw`` returns it with noise.
    """

    weight_scales: list[Float[Array, "inputs outputs"]]
    bias_scales: list[Float[Array, " outputs"]]

    def __init__(self, mlp: MLP, scale: Scalar) -> None:
        """Noise starts at ``scale``/√inputs."""
        self.weights, self.biases, self.activation = mlp.weights, mlp.biases, mlp.activation
        starts = [scale / math.sqrt(len(weight)) for weight in mlp.weights]
        fill = lambda x, start: jnp.full_like(x, start)  # noqa: E731
        self.weight_scales = list(map(fill, mlp.weights, starts))
        self.bias_scales = list(map(fill, mlp.biases, starts))

    def draw(self, key: PRNGKeyArray) -> "NoisyMLP":
        """The same layers with noise on their weights and biases."""
        weights, biases = [], []
        for i, (weight, scale) in enumerate(zip(self.weights, self.weight_scales, strict=True)):
            inputs, outputs = weight.shape
            normal = jax.random.normal(jax.random.fold_in(key, i), (inputs + outputs,))
            noise = jnp.sign(normal) * jnp.sqrt(jnp.abs(normal))
            weights.append(weight + scale * noise[:inputs, None] * noise[inputs:])
            biases.append(self.biases[i] + self.bias_scales[i] * noise[inputs:])
        return eqx.tree_at(lambda m: (m.weights, m.biases), self, (weights, biases))


class Streams(eqx.Module):
    """Shared layers that split into streams; the streams' outputs are concatenated.

    Dueling networks have one stream for a state's value and one for its actions' advantages (Wang
    et al. 2016, figure 1).
    """

    trunk: MLP | None
    streams: list[MLP]

    def __init__(self, mlp: MLP, first: int, noise: Scalar | None, key: PRNGKeyArray) -> None:
        """Splits the last two layers of ``mlp``, or only its last if it has fewer than three.

        first: outputs of the first stream; 0 for a single stream. noise: the initial scale of the
        noise on the streams' weights, or None.
        """
        shared = max(len(mlp.weights) - 2, min(len(mlp.weights) - 1, 1))
        layers = lambda m: (m.weights, m.biases)  # noqa: E731
        cut = (mlp.weights[:shared], mlp.biases[:shared])
        self.trunk = eqx.tree_at(layers, mlp, cut) if shared else None
        *hidden, total = [weight.shape[1] for weight in mlp.weights[shared:]]
        inputs = mlp.weights[shared].shape[0]
        self.streams = []
        for outputs in (first, total - first) if first else (total,):
            key, stream_key = jax.random.split(key)
            sizes = (inputs, *hidden, outputs)
            plain = MLP(sizes, stream_key)
            self.streams.append(plain if noise is None else NoisyMLP(plain, noise))

    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch outputs"]:
        if self.trunk is not None:
            x = jax.nn.relu(self.trunk(x))
        return jnp.concatenate([stream(x) for stream in self.streams], axis=-1)


class HeadConfig(NamedTuple):
    """The last layers of a network of action values."""

    atoms: int  # numbers for each action
    dueling: bool  # a stream for the state's value and one for advantages
    noise: Scalar | None  # initial scale of the noise on these layers; None: no noise


def build(
    config: networks.NetworkConfig,
    head: HeadConfig,
    task: Task,
    observation: PyTree,
    key: PRNGKeyArray,
) -> networks.Network:
    """A network of action values: ``atoms`` numbers for each action.

    If it is dueling, the numbers of the state's value come first. Raises QfolioError if the kind of
    network does not fit the task or these settings.
    """
    atoms, dueling, noise = head
    if config.network == "positions" and (dueling or noise is not None or atoms > 1):
        raise QfolioError(
            "network=positions gives plain action values; set dueling=false, noisy=false and "
            "values=expected."
        )
    pooled, each, _ = networks.outputs_of(task.actions, observation)
    outputs = networks.Outputs((pooled + dueling) * atoms, each * atoms, atoms)
    network = networks.build(config, task, observation, outputs, key)
    if not dueling and noise is None:
        return network
    shared = isinstance(network, networks.PerAsset)
    last = (lambda n: n.network.head) if shared else (lambda n: n.mlp)
    streams = Streams(last(network), atoms * dueling, noise, key)
    return eqx.tree_at(last, network, streams)


def read(
    head: HeadConfig, network: networks.Network, observation: PyTree
) -> Float[Array, "batch action atom"]:
    """The outputs for each action of a network that ``build`` made."""
    outputs = network(observation)
    z = outputs.reshape(outputs.shape[0], -1, head.atoms)
    return duel(z) if head.dueling else z


def draw_noise(network: PyTree, key: PRNGKeyArray) -> PyTree:
    """The network with one draw of noise on all its noisy layers."""
    is_noisy = lambda x: isinstance(x, NoisyMLP)  # noqa: E731
    leaves, structure = jax.tree.flatten(network, is_leaf=is_noisy)
    drawn = [
        leaf.draw(jax.random.fold_in(key, i)) if is_noisy(leaf) else leaf
        for i, leaf in enumerate(leaves)
    ]
    return jax.tree.unflatten(structure, drawn)


def duel(z: Float[Array, "batch outputs atom"]) -> Float[Array, "batch action atom"]:
    """Action values from a state's value, which comes first, and its actions' advantages.

    Advantages are centered on their mean over the actions (Wang et al. 2016, eq. 9).
    """
    value, advantage = z[:, :1], z[:, 1:]
    return value + advantage - advantage.mean(1, keepdims=True)
