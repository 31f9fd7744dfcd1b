"""What DDPG, TD3 and SAC share: a policy and action values, learned from a replay buffer.

The critics regress Q(s, a) towards a Bellman target at the action that the policy takes next; the
actor climbs the critics' gradient in the action. Each algorithm's file says how it does the one and
the other; here stand the networks, the buffer and the settings of all three. docs/actor_critic.md
holds every formula and its place.
"""

import abc
import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from qfolio.core.fields import number, require, sizes, static
from qfolio.core.mdp import Agent, Discrete, Metrics, Task, Transition
from qfolio.learning import networks, optimizer
from qfolio.learning.exploration import uniform
from qfolio.learning.networks import Flat, Network
from qfolio.learning.replay import Discount, Experience, Replay, join, require_replay, warm_up
from qfolio.learning.targets import Scale, huber_loss, possible_values, td_target

Weights = TypeVar("Weights", bound=PyTree)


class Critics(eqx.Module):
    """Networks side by side, each with its own estimate of Q(s, a).

    They read an observation and an action, or an observation alone where actions are numbered.
    """

    networks: Network  # with a leading critic axis
    scale: Scale = eqx.field(static=True)  # of what the networks give

    def __init__(
        self, make: Callable[[PRNGKeyArray], Network], n: int, scale: Scale, key: PRNGKeyArray
    ) -> None:
        self.networks = jax.vmap(make)(jax.random.split(key, n))
        self.scale = scale

    def __call__(self, observation: PyTree, action: Array) -> Float[Array, "critic batch"]:
        """Q(s, a) of each critic."""
        if jnp.issubdtype(action.dtype, jnp.integer):
            return jnp.take_along_axis(self.every(observation), action[None, :, None], -1)[..., 0]
        return self._values(lambda network: network((observation, action))[:, 0])

    def every(self, observation: PyTree) -> Float[Array, "critic batch action"]:
        """Q(s, ·) of each critic, where actions are numbered."""
        return self._values(lambda network: network(observation))

    def _values(self, read: Callable[[Any], Array]) -> Array:
        return self.scale.values(jax.vmap(read)(self.networks))

    def errors(
        self, q: Float[Array, "critic batch"], goal: Float[Array, " batch"]
    ) -> Float[Array, "critic batch"]:
        """How far off the networks' outputs were, when they said ``q``."""
        return self.scale.outputs(q) - self.scale.outputs(goal)


def critic_loss(
    critics: Critics,
    batch: Experience,
    goal: Float[Array, " batch"],
    huber: Float[Array, ""] | float,
) -> tuple[Float[Array, ""], Metrics]:
    """Mean Huber loss of the errors to one goal, summed over the critics; and what to report."""
    q = critics(batch.observation, batch.action)
    loss = huber_loss(critics.errors(q, goal), huber).mean(1).sum()
    return loss, {"loss": loss, "q": q.mean()}


class Batch(NamedTuple):
    """What a gradient step learns from."""

    steps: Experience
    discount: Discount  # of what follows them
    rewards: Float[Array, "2"]  # the lowest and the highest that there ever were


class ActorCriticState(eqx.Module):
    """All that an agent learns and remembers."""

    learned: Any  # what gradient steps change; its actor explores
    replay: Replay
    steps: Int[Array, ""]  # of each environment
    rewards: Float[Array, "2"]  # the lowest and the highest that there ever were


class ActorCritic(Agent):
    """Settings, buffer and gradient steps; an algorithm adds what it learns and how it explores."""

    network: str = static("flat")  # the actor's: over everything observed; mlp, cnn, rnn: by asset
    hidden: tuple[int, ...] = sizes(256, 256)  # of actor and critics
    num_envs: int = static(1)  # stepped side by side
    episode_steps: int = static(0)  # training episodes are cut here; 0: the task's horizon
    batch_size: int = static(256)
    gradient_steps: int = static(1)  # gradient steps per step of all environments
    n_steps: int = static(1)  # whose rewards a target adds up
    replay_capacity: int = static(100_000)  # transitions
    learning_starts: int = static(1000)  # transitions by random actions before learning
    tau: float = number(0.005)  # how far targets go towards the online networks each time
    discount: float = number(0.99)
    learning_rate: float = number(1e-3)
    learning_rate_final: float = number(1.0)  # share of it that is left at the end of the cosine
    learning_rate_steps: float = number(1e5)  # gradient steps of the cosine
    actor_learning_rate_ratio: float = number(0.3)  # the actor's, as a share of the critics'
    reward_scale: float = number(1.0)  # the critics learn values of scaled rewards
    input_gain: float = number(0.0)  # of the first layer, observations taken to ±1; 0: as it is
    huber_delta: float = number(math.inf)  # |error of a critic| beyond which its loss is linear
    value_rescaling: bool = static(False)  # critics learn roots of values: small ones weigh more

    def __check_init__(self) -> None:
        require_replay(self)
        require(self, "episode_steps", lambda x: 0 <= x < 2**31, "at least 0")
        require(self, "actor_learning_rate_ratio", lambda x: 0 <= x <= 1e9, "from 0 to 10⁹")
        require(self, "huber_delta", lambda x: x >= 1e-30, "greater than 0")
        require(self, "discount tau", lambda x: 0 <= x <= 1, "between 0 and 1")
        optimizer.require_schedule(self)
        networks.require_network(self)

    @abc.abstractmethod
    def begin(self, task: Task, observation: PyTree, key: PRNGKeyArray) -> Any:
        """What gradient steps will change; ``observation`` is an example."""

    @abc.abstractmethod
    def explore(self, learned: Any, observation: PyTree, key: PRNGKeyArray) -> Array:
        """Actions for a batch of observations, with exploration."""

    @abc.abstractmethod
    def update(self, learned: Any, batch: Batch, key: PRNGKeyArray) -> tuple[Any, Metrics]:
        """One gradient step of all that learns."""

    def init(self, task: Task, key: PRNGKeyArray) -> ActorCriticState:
        observation = task.observe(task.reset(key))
        action = uniform(task.actions, key, 1)[0]
        row = Experience.like(observation, action, with_last=self.n_steps > 1)
        learned = self.begin(task, observation, key)
        replay = Replay.empty(row, self.replay_capacity, self.num_envs, self.n_steps)
        none = jnp.array([jnp.inf, -jnp.inf])
        return ActorCriticState(learned, replay, jnp.array(0, jnp.int32), none)

    def warm_up(self) -> int:
        return warm_up(self)

    def act(self, state: ActorCriticState, observation: PyTree, key: PRNGKeyArray) -> Array:
        random_key, key = jax.random.split(key)
        random = uniform(state.learned.actor.actions, random_key, self.num_envs)
        action = self.explore(state.learned, observation, key)
        return jnp.where(state.steps < self.warm_up(), random, action)

    def observe(self, state: ActorCriticState, rollout: Transition) -> ActorCriticState:
        step = Experience.of(rollout, with_last=self.n_steps > 1)
        lowest, highest = state.rewards
        rewards = jnp.stack(
            [jnp.minimum(lowest, step.reward.min()), jnp.maximum(highest, step.reward.max())]
        )
        replay = state.replay.add(self.row(step, state.steps))
        return eqx.tree_at(
            lambda s: (s.replay, s.steps, s.rewards), state, (replay, state.steps + 1, rewards)
        )

    def row(self, step: Experience, steps: Int[Array, ""]) -> PyTree:
        """What the buffer keeps of a step of all environments, the ``steps``-th."""
        return step

    def learn(
        self, task: Task, state: ActorCriticState, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[ActorCriticState, Metrics]:
        state = self.observe(state, rollout)
        learned, metrics = self.practise(state.learned, state.replay, state.rewards, key)
        return eqx.tree_at(lambda s: s.learned, state, learned), metrics

    def practise(
        self, learned: Any, replay: Replay, rewards: Float[Array, "2"], key: PRNGKeyArray
    ) -> tuple[Any, Metrics]:
        """``updates`` gradient steps on batches from a buffer."""

        def update(learned: Any, key: PRNGKeyArray) -> tuple[Any, Metrics]:
            sample_key, key = jax.random.split(key)
            index = replay.draw(sample_key, self.batch_size)
            batch = Batch(*join(replay, index, self.discount), rewards)
            return self.update(learned, batch, key)

        learned, metrics = optimizer.repeat(update, learned, self.gradient_steps, key)
        return learned, {**metrics, "q": metrics["q"] / self.reward_scale}

    def carry_over(self, state: ActorCriticState, fresh: ActorCriticState) -> ActorCriticState:
        return eqx.tree_at(lambda s: (s.replay, s.rewards), state, (fresh.replay, fresh.rewards))

    def weights(self, state: ActorCriticState) -> Any:
        return state.learned.actor

    def goal(
        self, batch: Batch, following: Float[Array, " batch"], bonus: Array | float = 0.0
    ) -> Float[Array, " batch"]:
        """Bellman target, where what follows is brought to what the rewards so far allow.

        bonus: what each later step is worth besides its reward.
        """
        rewards = self.reward_scale * batch.rewards
        rewards = rewards + jnp.stack([jnp.minimum(bonus, 0.0), jnp.maximum(bonus, 0.0)])
        following = jnp.clip(following, *possible_values(rewards, self.discount))
        steps = batch.steps
        return td_target(
            self.reward_scale * steps.reward, steps.terminal, following, batch.discount
        )

    def descend(
        self,
        loss: Callable[..., tuple[Float[Array, ""], Metrics]],
        weights: Weights,
        adam: optimizer.Optimizer,
        rate: Float[Array, ""],
        *others: Any,
    ) -> tuple[Weights, optimizer.Optimizer, Metrics]:
        """One step down the gradient in ``weights`` of ``loss(weights, *others)``."""
        gradient, metrics = jax.grad(loss, has_aux=True)(weights, *others)
        return *optimizer.descend(self, weights, gradient, adam, rate), metrics

    def build(
        self, task: Task, observation: PyTree, outputs: networks.Outputs, key: PRNGKeyArray
    ) -> Network:
        """A network over observations alone."""
        return networks.build(
            self.network, task, observation, self.hidden, outputs, key, self.input_gain
        )

    def build_critics(
        self, task: Task, observation: PyTree, count: int, key: PRNGKeyArray
    ) -> Critics:
        """Critics over everything that is observed and an action."""
        assert not isinstance(task.actions, Discrete)
        action = uniform(task.actions, key, 1)[0]
        seen = sum(jnp.size(leaf) for leaf in jax.tree.leaves(observation))
        scale = jnp.broadcast_to(jnp.array(task.observation_scale), (seen,))
        gain = jnp.where(self.input_gain > 0, self.input_gain / scale, 1.0)
        gains = jnp.append(gain, jnp.full(action.shape, 1 / task.actions.unit))
        make = lambda key: Flat((observation, action), self.hidden, 1, key, gains)  # noqa: E731
        return Critics(make, count, Scale(self.value_rescaling), key)
