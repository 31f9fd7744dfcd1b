"""What DDPG, TD3 and SAC share: a policy and action values, learned from a replay buffer.

The critics regress Q(s, a) towards a Bellman target at the action that the policy takes next; the
actor ascends the critics' gradient in the action. Each algorithm's file defines these two steps;
this file holds the networks, the buffer and the settings that all three share.
docs/algorithms/actor_critic.md lists every formula and its place.
"""

import abc
import dataclasses
import math
from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from qfolio.core.fields import Group, constant, number, require, require_counts, sizes, static
from qfolio.core.mdp import Actions, Agent, Discrete, Metrics, Task, Transition
from qfolio.learning import networks, optimizer
from qfolio.learning.exploration import OrnsteinUhlenbeck, uniform
from qfolio.learning.networks import Flat, LateAction, Network, NetworkConfig
from qfolio.learning.normalization import Moments, NormalizationConfig, Normalizer, normalized
from qfolio.learning.optimizer import CosineSchedule
from qfolio.learning.positions import OrderValue, Values
from qfolio.learning.replay import Discount, Experience, Replay, ReplayConfig, cut, join
from qfolio.learning.targets import Scalar, Scale, huber_loss, possible_values, td_target


class Critics(eqx.Module):
    """Networks side by side, each with its own estimate of Q(s, a).

    They read an observation and an action, or an observation alone if actions are numbered. states:
    the number of states, if beside an action an observation is the number of one.
    """

    networks: Callable[[PyTree], Array]  # with a leading critic axis
    scale: Scale = eqx.field(static=True)  # of the networks' outputs
    states: int | None = eqx.field(static=True, default=None)

    def __init__(
        self,
        make: Callable[[PRNGKeyArray], Network],
        n: int,
        scale: Scale,
        key: PRNGKeyArray,
        states: int | None = None,
    ) -> None:
        self.networks = jax.vmap(make)(jax.random.split(key, n))
        self.scale, self.states = scale, states

    def __call__(self, observation: PyTree, action: Array) -> Float[Array, "critic batch"]:
        """Q(s, a) of each critic."""
        if jnp.issubdtype(action.dtype, jnp.integer):
            return jnp.take_along_axis(self.every(observation), action[None, :, None], -1)[..., 0]
        if self.states is not None:
            observation = networks.one_hot(observation, self.states)
        return self._values(lambda network: network((observation, action))[:, 0])

    def every(self, observation: PyTree) -> Float[Array, "critic batch action"]:
        """Q(s, ·) of each critic, for numbered actions."""
        return self._values(lambda network: network(observation))

    def _values(self, read: Callable[[Any], Array]) -> Array:
        return self.scale.values(jax.vmap(read)(self.networks))

    def errors(
        self, q: Float[Array, "critic batch"], target: Float[Array, " batch"]
    ) -> Float[Array, "critic batch"]:
        """Errors of the networks' outputs for ``q``, in their scale."""
        return self.scale.outputs(q) - self.scale.outputs(target)


def critic_loss(
    critics: Critics,
    batch: Experience,
    target: Float[Array, " batch"],
    huber_delta: Scalar,
    weight_decay: float = 0.0,
) -> tuple[Float[Array, ""], Metrics]:
    """Mean Huber loss of all critics' errors against one target, summed over critics; and metrics.

    weight_decay: the loss adds half of it times the sum of all squared weights.
    """
    q = critics(batch.observation, batch.action)
    loss = huber_loss(critics.errors(q, target), huber_delta).mean(1).sum()
    metrics = {"loss": loss, "q": q.mean()}
    if weight_decay:
        loss += weight_decay / 2 * sum((x**2).sum() for x in jax.tree.leaves(critics))
    return loss, metrics


Draw = Callable[[PRNGKeyArray], tuple[Experience, Discount]]
"""Draws a batch of steps, and the discount of the values that follow them."""


class Batch(NamedTuple):
    """The batch of a gradient step."""

    steps: Experience
    discount: Discount  # of the value that follows them
    rewards: Float[Array, "2"]  # the lowest and the highest so far


class Actor(eqx.Module):
    """A policy: a network, and the kind of actions that its outputs define."""

    network: Callable[[PyTree], Array]
    actions: Actions
    observations: Moments | None = None  # for normalization; None during training

    def seen(self, observation: PyTree) -> PyTree:
        """Observations as the network reads them."""
        return normalized(self.observations, observation)


class Learned(eqx.Module):
    """What gradient steps change."""

    actor: Actor
    critics: Critics
    target_critics: Critics
    actor_adam: optimizer.Optimizer
    critic_adam: optimizer.Optimizer


L = TypeVar("L", bound=Learned)


class ActorCriticState(eqx.Module, Generic[L]):
    """The state of an actor-critic agent."""

    learned: L  # from normalized observations and rewards
    replay: Replay  # with observations and rewards that are not normalized
    steps: Int[Array, ""]  # of each environment
    rewards: Float[Array, "2"]  # the lowest and the highest so far
    normalizer: Normalizer
    noise: OrnsteinUhlenbeck | None  # of exploration; None: independent at each step


State = TypeVar("State", bound=ActorCriticState)


class ActorCritic(Agent, Generic[L]):
    """Settings, buffer and gradient steps; an algorithm adds what it learns and how it explores."""

    network: str = static("flat")  # the actor's; with positions, the critics' as well
    hidden: tuple[int, ...] = sizes(256, 256)  # units of each hidden layer of actor and critics
    num_envs: int = static(1)  # environments stepped side by side
    episode_steps: int = static(0)  # longest training episode; 0: the task's horizon
    batch_size: int = static(256)  # transitions per gradient step
    gradient_steps: int = static(1)  # gradient steps per step of all environments
    n_steps: int = static(1)  # steps of the return in a target
    replay_capacity: int = static(100_000)  # transitions that the replay buffer holds
    learning_starts: int = static(1000)  # transitions by random actions before learning
    tau: float = number(0.005)  # targets' step towards the online networks
    discount: float = number(0.99)  # γ, the discount per step
    learning_rate: float = number(1e-3)  # Adam's step size for the critics, at the start
    learning_rate_final: float = number(1.0)  # share of learning_rate at the end of its cosine
    learning_rate_steps: float = number(1e5)  # gradient steps of that cosine
    actor_learning_rate_ratio: float = number(0.3)  # the actor's step size over the critics'
    reward_scale: float = number(1.0)  # rewards are multiplied by it before learning
    input_gain: float = number(0.0)  # gain of the first layer on inputs scaled to ±1; 0: unscaled
    normalize_observations: bool = static(False)  # by their running mean and standard deviation
    normalize_rewards: bool = static(False)  # by the running deviation of discounted returns
    noise_theta: float = constant(1.0)  # mean reversion of the noise; 1: independent at each step
    huber_delta: float = number(math.inf)  # |error of a critic| beyond which its loss is linear
    value_rescaling: bool = static(False)  # critics learn roots of values: small ones weigh more
    clip_bootstrap: bool = static(True)  # clips next values to what rewards so far allow

    _replay = Group(ReplayConfig)
    _networks = Group(NetworkConfig)
    _normalization = Group(NormalizationConfig)
    _schedule = Group(CosineSchedule)

    def __check_init__(self) -> None:
        self._replay.check()
        self._networks.check()
        self._normalization.check(self.input_gain)
        self._schedule.check()
        require_counts(self, "gradient_steps")
        require(self, "actor_learning_rate_ratio", lambda x: 0 <= x <= 1e9, "from 0 to 10⁹")
        require(self, "huber_delta", lambda x: x >= 1e-30, "greater than 0")
        require(self, "discount tau noise_theta", lambda x: 0 <= x <= 1, "between 0 and 1")
        require(self, "reward_scale", lambda x: 1e-30 <= x <= 1e30, "from 1e-30 to 1e30")

    @abc.abstractmethod
    def begin(self, task: Task, observation: PyTree, key: PRNGKeyArray) -> L:
        """The networks and optimizers before training; ``observation`` is an example."""

    @abc.abstractmethod
    def explore(self, state: ActorCriticState[L], observation: PyTree, key: PRNGKeyArray) -> Array:
        """Actions for a batch of observations, with exploration."""

    @abc.abstractmethod
    def update(self, learned: L, batch: Batch, key: PRNGKeyArray) -> tuple[L, Metrics]:
        """One gradient step of all that learns."""

    def init(self, task: Task, key: PRNGKeyArray) -> ActorCriticState[L]:
        state = task.reset(key)
        observation = task.observe(state)
        action = uniform(task.actions, key, 1)[0]
        row = Experience.like(state, observation, action, with_last=self.n_steps > 1)
        learned = self.begin(task, observation, key)
        none = jnp.array([jnp.inf, -jnp.inf])
        noise = None
        if self.noise_theta < 1:
            shape = (self.num_envs, action.size)
            noise = OrnsteinUhlenbeck.begin(jax.random.split(key, 3)[2], shape)
        normalizer = self._normalization.begin(task, observation, self.num_envs)
        zero = jnp.array(0, jnp.int32)
        return ActorCriticState(learned, self._replay.empty(row), zero, none, normalizer, noise)

    def warm_up(self) -> int:
        return self._replay.warm_up

    def act(self, state: ActorCriticState[L], observation: PyTree, key: PRNGKeyArray) -> Array:
        random_key, key = jax.random.split(key)
        random = uniform(state.learned.actor.actions, random_key, self.num_envs)
        action = self.explore(state, state.normalizer.observation(observation), key)
        return jnp.where(state.steps < self.warm_up(), random, action)

    def observe(self, state: State, rollout: Transition) -> State:
        step = Experience.of(rollout, with_last=self.n_steps > 1)
        lowest, highest = state.rewards
        rewards = jnp.stack(
            [jnp.minimum(lowest, step.reward.min()), jnp.maximum(highest, step.reward.max())]
        )
        noise = state.noise
        if noise is not None:
            noise = noise.step(self.noise_theta, (rollout.terminated | rollout.truncated)[-1])
        return dataclasses.replace(
            state,
            replay=state.replay.add(self.row(state, step)),
            steps=state.steps + 1,
            rewards=rewards,
            normalizer=state.normalizer.update(rollout, self.discount),
            noise=noise,
        )

    def row(self, state: ActorCriticState[L], step: Experience) -> PyTree:
        """The rows to store for a step of all environments, made in ``state``."""
        return step

    def learn(
        self, task: Task, state: ActorCriticState[L], rollout: Transition, key: PRNGKeyArray
    ) -> tuple[ActorCriticState[L], Metrics]:
        state = self.observe(state, rollout)
        replay, now = state.replay, state.normalizer

        def draw(key: PRNGKeyArray) -> tuple[Experience, Discount]:
            steps, discount = join(replay, replay.draw(key, self.batch_size), self.discount)
            steps = steps.recalled(task)
            steps = steps._replace(
                observation=now.observation(steps.observation),
                next_observation=now.observation(steps.next_observation),
                reward=now.reward(steps.reward),
            )
            return steps, discount

        learned, metrics = self.practise(state.learned, draw, now.reward(state.rewards), key)
        metrics["q"] *= now.unit
        return dataclasses.replace(state, learned=learned), metrics

    def practise(
        self, learned: L, draw: Draw, rewards: Float[Array, "2"], key: PRNGKeyArray
    ) -> tuple[L, Metrics]:
        """``gradient_steps`` gradient steps, each on a batch from ``draw``."""

        def update(learned: L, key: PRNGKeyArray) -> tuple[L, Metrics]:
            draw_key, key = jax.random.split(key)
            return self.update(learned, Batch(*draw(draw_key), rewards), key)

        learned, metrics = optimizer.repeat(update, learned, self.gradient_steps, key)
        return learned, {**metrics, "q": metrics["q"] / self.reward_scale}

    def cut(self, state: State) -> State:
        noise = state.noise
        if noise is not None:
            noise = noise.step(self.noise_theta, jnp.ones(self.num_envs, bool))
        return dataclasses.replace(
            state, replay=cut(state.replay), normalizer=state.normalizer.cut(), noise=noise
        )

    def carry_over(self, state: State, fresh: State) -> State:
        where: Any = lambda s: (s.replay, s.rewards, s.noise, s.normalizer)  # noqa: E731
        parts = (fresh.replay, fresh.rewards, fresh.noise, state.normalizer.cut())
        return eqx.tree_at(where, state, parts, is_leaf=lambda x: x is None)

    def weights(self, state: ActorCriticState[L]) -> PyTree:
        return state.normalizer.attached(state.learned.actor)

    def target(
        self,
        batch: Batch,
        following: Float[Array, " batch"],
        bonus: tuple[Scalar, Scalar] = (0.0, 0.0),
    ) -> Float[Array, " batch"]:
        """Bellman target; ``clip_bootstrap`` clips the next value to what past rewards allow.

        bonus: the least and the most that a later step may add to its reward.
        """
        if self.clip_bootstrap:
            each = self.reward_scale * batch.rewards + jnp.stack([jnp.asarray(x) for x in bonus])
            following = jnp.clip(following, *possible_values(each, self.discount))
        steps = batch.steps
        return td_target(
            self.reward_scale * steps.reward, steps.terminal, following, batch.discount
        )

    def regress(
        self,
        learned: L,
        batch: Experience,
        target: Float[Array, " batch"],
        weight_decay: float = 0.0,
    ) -> tuple[L, Metrics]:
        """A step of the critics towards the target."""
        critics, adam, metrics = optimizer.minimize(
            critic_loss,
            learned.critics,
            learned.critic_adam,
            self._schedule(learned.critic_adam.count),
            batch,
            target,
            self.huber_delta,
            weight_decay,
        )
        return eqx.tree_at(lambda x: (x.critics, x.critic_adam), learned, (critics, adam)), metrics

    def build(
        self, task: Task, observation: PyTree, outputs: networks.Outputs, key: PRNGKeyArray
    ) -> Network:
        """A network over observations alone."""
        return networks.build(self._networks, task, observation, outputs, key)

    def build_critics(
        self, task: Task, observation: PyTree, count: int, key: PRNGKeyArray, *, late: bool = False
    ) -> Critics:
        """``count`` critics over the whole observation and an action.

        late: the action enters at the second layer.
        """
        assert not isinstance(task.actions, Discrete)
        action = uniform(task.actions, key, 1)[0]
        if task.states is not None:
            observation = networks.one_hot(observation[None], task.states)[0]
        seen = sum(jnp.size(leaf) for leaf in jax.tree.leaves(observation))
        scale = jnp.broadcast_to(jnp.array(task.observation_scale), (seen,))
        gain = jnp.where(self.input_gain > 0, self.input_gain / scale, 1.0)
        both, unit = (observation, action), task.actions.unit
        gains = jnp.append(gain, jnp.full(action.shape, 1 / unit))

        def make(key: PRNGKeyArray) -> Network:
            if self.network == "positions":
                return OrderValue(Values(observation))
            if late:
                return LateAction(both, self.hidden, key, gain, 1 / unit)
            return Flat(both, self.hidden, 1, key, gains)

        return Critics(make, count, Scale(self.value_rescaling), key, task.states)
