"""Deep Q-network (Mnih et al. 2015), with double Q-learning (van Hasselt et al. 2016).

A Q-network estimates the discounted return of each action. Collecting: actions are ε-greedy on it,
and transitions go into a replay buffer. Training: it regresses, on batches from the buffer, towards
r + γ max_a Q'(s', a), where Q' is a target network that follows it slowly. docs/dqn.md holds every
formula, the place where it stands here, and each deviation from the paper.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from qfolio.errors import QfolioError
from qfolio.mdp import Agent, Metrics, Task, Transition
from qfolio.networks import MLP
from qfolio.replay import Replay


class Experience(NamedTuple):
    """What the buffer keeps of a transition; nothing is bootstrapped behind ``terminal``."""

    observation: Float[Array, "batch observation"]
    action: Int[Array, " batch"]
    reward: Float[Array, " batch"]
    next_observation: Float[Array, "batch observation"]
    terminal: Bool[Array, " batch"]


class DQNState(eqx.Module):
    """All that a DQN agent learns and remembers."""

    online: MLP
    target: MLP
    optimizer: optax.ScaleByAdamState
    replay: Replay
    episodes: Int[Array, ""]  # finished; ε follows it
    steps: Int[Array, ""]  # of each environment; the target network follows them


def _static(default: Any) -> Any:
    """A setting that shapes the program."""
    return eqx.field(static=True, default=default)


def _number(default: float) -> Any:
    """A setting that is an input of the program: members may differ in it."""
    return eqx.field(converter=float, default=default)


class DQN(Agent):
    """A deep Q-network; the defaults are those of the report that qfolio grew out of."""

    hidden: tuple[int, ...] = eqx.field(static=True, converter=tuple, default=(256, 256))
    environments: int = _static(1)  # stepped side by side
    episode_steps: int = _static(0)  # training episodes are cut here; 0: the task's horizon
    batch_size: int = _static(64)
    updates: int = _static(1)  # gradient steps per step of all environments
    replay_capacity: int = _static(50_000)  # transitions
    learning_starts: int = _static(64)  # transitions stored before learning
    double: bool = _static(False)
    time_limit_terminal: bool = _static(False)  # wrong, but often done
    target_period: int = _static(200)  # steps between target updates
    target_rate: float = _number(1.0)  # how far each goes towards the online network; 1 copies it
    discount: float = _number(0.99)
    learning_rate: float = _number(1e-3)
    learning_rate_final: float = _number(1.0)  # share of it that is left at the end of the cosine
    learning_rate_steps: float = _number(1e5)  # gradient steps of the cosine
    epsilon: float = _number(1.0)
    epsilon_end: float = _number(0.01)
    epsilon_decay: float = _number(0.995)  # factor per finished episode
    huber: float = _number(math.inf)  # |TD error| beyond which the loss is linear; inf: squared
    reward_scale: float = _number(1.0)  # the network learns values of scaled rewards
    input_gain: float = _number(0.0)  # of the first layer, observations taken to ±1; 0: as it is

    def __check_init__(self) -> None:
        counts = "environments batch_size updates target_period"
        _require(self, counts, lambda x: 1 <= x < 2**31, "from 1 to 2³¹ − 1")
        _require(self, "replay_capacity", lambda x: 1 <= x <= 2**23, "from 1 to 2²³")
        _require(self, "episode_steps learning_starts", lambda x: 0 <= x < 2**31, "at least 0")
        _require(self, "input_gain", lambda x: 0 <= x <= 1e9, "from 0 to 10⁹")
        scales = "learning_rate learning_rate_steps reward_scale"
        _require(self, scales, lambda x: 1e-30 <= x <= 1e30, "from 1e-30 to 1e30")
        _require(self, "huber", lambda x: x >= 1e-30, "greater than 0")
        fractions = "discount target_rate learning_rate_final epsilon epsilon_end epsilon_decay"
        _require(self, fractions, lambda x: 0 <= x <= 1, "between 0 and 1")
        sizes = lambda x: len(x) > 0 and min(x) >= 1 and max(x) < 2**31  # noqa: E731
        _require(self, "hidden", sizes, "one or more layer sizes")
        if self.learning_starts > self.replay_capacity:
            raise QfolioError(
                f"learning_starts is {self.learning_starts}, more than replay_capacity "
                f"({self.replay_capacity}) can hold; lower the one or raise the other."
            )

    def contrast(self) -> tuple[str, "DQN"]:
        label = "without double DQN" if self.double else "with double DQN"
        return label, dataclasses.replace(self, double=not self.double)

    def init(self, task: Task, key: PRNGKeyArray) -> DQNState:
        observation = task.observe(task.reset(key))
        online = MLP(
            (observation.shape[-1], *self.hidden, task.actions.n),
            key,
            # Small weights on a bounded observation make a Q-function too smooth for the task.
            input_gain=jnp.where(
                self.input_gain > 0, self.input_gain / jnp.array(task.observation_scale), 1.0
            ),
        )
        row = Experience(
            observation=observation,
            action=jnp.array(0, jnp.int32),
            reward=jnp.array(0.0),
            next_observation=observation,
            terminal=jnp.array(False),
        )
        zero = jnp.array(0, jnp.int32)
        return DQNState(
            online=online,
            target=online,
            optimizer=optax.scale_by_adam().init(online),
            replay=Replay.empty(row, self.replay_capacity, self.environments),
            episodes=zero,
            steps=zero,
        )

    def warm_up(self) -> int:
        return max(0, math.ceil(self.learning_starts / self.environments) - 1)

    def epsilon_now(self, state: DQNState) -> Float[Array, ""]:
        return jnp.maximum(self.epsilon_end, self.epsilon * self.epsilon_decay**state.episodes)

    def monitor(self, state: DQNState) -> Metrics:
        return {"epsilon": self.epsilon_now(state)}

    def weights(self, state: DQNState) -> MLP:
        return state.online

    def action_values(
        self, weights: MLP, observation: Float[Array, "batch observation"]
    ) -> Float[Array, "batch action"]:
        """Q(s, ·) in units of the task's reward."""
        return weights(observation) / self.reward_scale

    def policy(
        self, weights: MLP, observation: Float[Array, "batch observation"]
    ) -> Int[Array, " batch"]:
        return weights(observation).argmax(-1)

    def act(
        self, state: DQNState, observation: Float[Array, "batch observation"], key: PRNGKeyArray
    ) -> Int[Array, " batch"]:
        greedy = self.policy(state.online, observation)
        n = state.online.biases[-1].shape[0]
        # One uniform decides both: below ε explore, and where below ε it fell picks the action.
        uniform = jax.random.uniform(key, greedy.shape)
        epsilon = self.epsilon_now(state)
        explored = jnp.minimum(uniform / jnp.maximum(epsilon, 1e-30) * n, n - 1).astype(jnp.int32)
        return jnp.where(uniform < epsilon, explored, greedy)

    def observe(self, state: DQNState, rollout: Transition) -> DQNState:
        step = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rollout)  # time × environments
        terminal = step.terminated
        if self.time_limit_terminal:
            terminal = terminal | step.truncated
        experience = Experience(
            step.observation, step.action, step.reward, step.next_observation, terminal
        )
        finished = (step.terminated | step.truncated).sum(dtype=jnp.int32)
        return eqx.tree_at(
            lambda s: (s.replay, s.episodes, s.steps),
            state,
            (state.replay.add(experience), state.episodes + finished, state.steps + 1),
        )

    def learn(
        self, state: DQNState, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[DQNState, Metrics]:
        state = self.observe(state, rollout)

        def update(carry, key):  # type: ignore[no-untyped-def]
            online, optimizer = carry
            batch = state.replay.sample(key, self.batch_size)
            (loss, max_q), gradient = jax.value_and_grad(self._loss, has_aux=True)(
                online, state.target, batch
            )
            direction, optimizer = optax.scale_by_adam().update(gradient, optimizer)
            rate = self._learning_rate(optimizer.count)
            online = jax.tree.map(lambda w, d: w - rate * d, online, direction)
            return (online, optimizer), (loss, max_q)

        carry = (state.online, state.optimizer)
        if self.updates == 1:
            (online, optimizer), (loss, max_q) = update(carry, key)
        else:
            keys = jax.random.split(key, self.updates)
            (online, optimizer), (loss, max_q) = lax.scan(update, carry, keys)

        due = state.steps % self.target_period == 0
        rate = self.target_rate if self.target_period == 1 else jnp.where(due, self.target_rate, 0)
        # This form is exact for rates of 0 and 1.
        blend = lambda t, w: (1 - rate) * t + rate * w  # noqa: E731
        target = jax.tree.map(blend, state.target, online)
        state = DQNState(online, target, optimizer, state.replay, state.episodes, state.steps)
        return state, {"loss": loss.mean(), "max_q": max_q.mean()}

    def _learning_rate(self, update: Int[Array, ""]) -> Float[Array, ""]:
        """A cosine from ``learning_rate`` to its final share (Loshchilov & Hutter 2017)."""
        done = jnp.minimum(update / self.learning_rate_steps, 1.0)
        weight = (1 + jnp.cos(jnp.pi * done)) / 2
        final = self.learning_rate_final
        return self.learning_rate * (final + weight * (1 - final))

    def _loss(
        self, online: MLP, target: MLP, batch: Experience
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Mean loss, and the batch's mean max_a Q(s, a) in units of reward."""
        q = online(batch.observation)
        taken = jnp.take_along_axis(q, batch.action[:, None], axis=1)[:, 0]
        q_next = target(batch.next_observation)
        selector = online(batch.next_observation) if self.double else q_next
        following = bootstrap(q_next, selector)
        goal = td_target(self.reward_scale * batch.reward, batch.terminal, following, self.discount)
        error = lax.stop_gradient(goal) - taken
        return huber_loss(error, self.huber).mean(), q.max(1).mean() / self.reward_scale


def bootstrap(
    q_next: Float[Array, "batch action"], selector: Float[Array, "batch action"]
) -> Float[Array, " batch"]:
    """The next state's value: ``q_next`` at the action that ``selector`` finds best.

    Double Q-learning (van Hasselt et al. 2016, eq. 4) lets the online network select and the target
    network evaluate; with ``selector = q_next`` this is max_a Q'(s', a) (Mnih et al. 2015).
    """
    return jnp.take_along_axis(q_next, selector.argmax(1)[:, None], axis=1)[:, 0]


def td_target(
    reward: Float[Array, " batch"],
    terminal: Bool[Array, " batch"],
    following: Float[Array, " batch"],
    discount: Float[Array, ""] | float,
) -> Float[Array, " batch"]:
    """Bellman target r + γ V(s'), where nothing follows a terminal transition."""
    return reward + jnp.where(terminal, 0.0, discount * following)


def huber_loss(
    error: Float[Array, "*batch"], delta: Float[Array, ""] | float
) -> Float[Array, "*batch"]:
    """½e² up to |e| = δ and δ(|e| − ½δ) beyond (Huber 1964); δ = ∞ squares everything."""
    clipped = jnp.clip(error, -delta, delta)
    return clipped * (error - clipped / 2)


def _require(agent: DQN, names: str, holds: Callable[[Any], bool], wanted: str) -> None:
    for name in names.split():
        value = getattr(agent, name)
        if not holds(value):
            raise QfolioError(f"{name} is {value}; it must be {wanted}.")
