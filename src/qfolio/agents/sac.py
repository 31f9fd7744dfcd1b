"""Soft actor-critic (Haarnoja et al. 2018, "Soft actor-critic algorithms and applications").

The agent maximizes reward plus α times the policy's entropy. Two critics regress Q(s, a) towards
r + γ V'(s') with the soft value V(s) = E[min Q(s, a) − α log π(a|s)]; the actor ascends V; the
temperature α is tuned so that the entropy meets a target. Actions are squashed normal numbers,
weights on a simplex, or numbered (then expectations are sums, Christodoulou 2019).
docs/algorithms/actor_critic.md lists formulas and deviations.
"""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from qfolio.agents import actor_critic
from qfolio.agents.actor_critic import ActorCritic, ActorCriticState, Batch, Critics
from qfolio.core.errors import QfolioError
from qfolio.core.fields import number, require
from qfolio.core.mdp import Actions, Box, Discrete, Metrics, Simplex, Task
from qfolio.learning import optimizer
from qfolio.learning.distributions import Categorical, Gaussian, LogisticNormal, Squashed
from qfolio.learning.networks import Outputs, outputs_of
from qfolio.learning.targets import Scalar, Scale, follow, smallest

LOG_STD = (-10.0, 2.0)
"""Bounds of a normal number's log standard deviation."""

MOST_SPREAD = 15
"""The largest ``spread``: half of exp of a normal number's entropy at the larger bound, or less.

No policy is as random as more would ask for, so that the temperature would rise forever."""


class Actor(actor_critic.Actor):
    """A stochastic policy over any kind of actions."""

    def __call__(self, observation: PyTree) -> Categorical | Gaussian | Squashed | LogisticNormal:
        output = self.network(observation)
        if isinstance(self.actions, Discrete):
            return Categorical(output)
        if isinstance(self.actions, Simplex):
            cash, assets, log_std = jnp.split(output, [1, 1 + self.actions.assets], axis=-1)
            return LogisticNormal(Gaussian(assets - cash, jnp.clip(log_std, *LOG_STD)))
        mean, log_std = jnp.split(output, 2, axis=-1)
        normal = Gaussian(mean, jnp.clip(log_std, *LOG_STD))
        bound = self.actions.bound
        return normal if math.isinf(bound) else Squashed(normal, bound)


class Learned(actor_critic.Learned):
    """What gradient steps change, including the temperature."""

    actor: Actor
    log_temperature: Float[Array, ""]
    temperature_adam: optimizer.Optimizer


def target_entropy(actions: Actions, spread: Scalar) -> Float[Array, ""]:
    """The entropy of a uniform distribution over a share of each coordinate's range.

    A coordinate without bounds counts as one from −1 to 1, weights have the simplex's volume, and
    of n numbered actions 1 + ``spread`` (n − 1) remain.
    """
    if isinstance(actions, Discrete):
        return jnp.log1p(spread * (actions.n - 1))
    if isinstance(actions, Simplex):
        return actions.assets * jnp.log(spread) - math.lgamma(actions.assets + 1)
    return actions.n * jnp.log(2 * actions.unit * spread)


def expectations(
    actor: Actor, critics: Critics, observation: PyTree, key: PRNGKeyArray
) -> tuple[Float[Array, " batch"], Float[Array, " batch"]]:
    """E[min Q(s, a)] and the entropy of the policy, for each observation.

    They are exact for numbered actions, and estimated from one draw otherwise, through which
    gradients flow.
    """
    policy = actor(observation)
    if isinstance(policy, Categorical):
        q = smallest(critics.every(observation))
        return (jax.nn.softmax(policy.logits) * q).sum(-1), policy.entropy()
    if isinstance(policy, Gaussian):
        action = policy.sample(key)
        log_prob = policy.log_prob(action)
    else:
        action, log_prob = policy.sample_and_log_prob(key)
    return smallest(critics(observation, action)), -log_prob


def actor_loss(
    actor: Actor,
    critics: Critics,
    temperature: Float[Array, ""],
    observation: PyTree,
    key: PRNGKeyArray,
) -> tuple[Float[Array, ""], Metrics]:
    """Minus the mean soft value (Haarnoja et al. 2018, eq. 9)."""
    q, entropy = expectations(actor, critics, observation, key)
    return -(q + temperature * entropy).mean(), {"entropy": entropy.mean()}


def temperature_loss(
    log_temperature: Float[Array, ""], excess: Float[Array, ""]
) -> tuple[Float[Array, ""], Metrics]:
    """The loss that lowers the temperature if the entropy exceeds its target, or else raises it."""
    return log_temperature * excess, {"temperature": jnp.exp(log_temperature)}


class Policy(NamedTuple):
    """The actor, and the critics of numbered actions."""

    actor: Actor
    critics: Critics | None


class SAC(ActorCritic[Learned]):
    """A stochastic actor, two critics with targets, and a temperature."""

    spread: float = number(0.184)  # target entropy: of uniform actions in this share of their range
    initial_temperature: float = number(1.0)  # weight of the entropy at the start

    def __check_init__(self) -> None:
        require(self, "initial_temperature", lambda x: 1e-30 <= x <= 1e30, "from 1e-30 to 1e30")
        require(self, "spread", lambda x: 1e-30 <= x <= MOST_SPREAD, f"from 1e-30 to {MOST_SPREAD}")
        require(self, "noise_theta", lambda x: 0 < x <= 1, "above 0 and at most 1")

    def init(self, task: Task, key: PRNGKeyArray) -> ActorCriticState[Learned]:
        if isinstance(task.actions, Discrete) and self.noise_theta < 1:
            raise QfolioError(
                f"noise_theta is {self.noise_theta}, for continuous actions, but those of "
                f"{task.name} are numbered; set noise_theta=1."
            )
        self.fitted(task)
        return super().init(task, key)

    def fitted(self, task: Task) -> "SAC":
        if not isinstance(task.actions, Box) or math.isfinite(task.actions.bound):
            wanted = f"below 1: no actions of {task.name} are more random than uniform ones"
            require(self, "spread", lambda x: x < 1, wanted)
        return self

    def begin(self, task: Task, observation: PyTree, key: PRNGKeyArray) -> Learned:
        actor_key, critic_key = jax.random.split(key)
        outputs = outputs_of(task.actions, observation)
        if isinstance(task.actions, Discrete):
            make = partial(self.build, task, observation, outputs)
            critics = Critics(make, 2, Scale(self.value_rescaling), critic_key)
        else:
            critics = self.build_critics(task, observation, 2, critic_key)
            weights = isinstance(task.actions, Simplex)  # cash needs no standard deviation
            both = Outputs(2 * outputs.pooled, 2 * outputs.each)
            outputs = Outputs(1, 2) if weights else both
        actor = Actor(self.build(task, observation, outputs, actor_key), task.actions)
        log_temperature = jnp.log(jnp.asarray(self.initial_temperature, float))
        begin = optimizer.begin
        return Learned(
            actor, critics, critics, begin(actor), begin(critics),
            log_temperature, begin(log_temperature),
        )  # fmt: skip

    def weights(self, state: ActorCriticState[Learned]) -> Policy:
        actor, critics = super().weights(state), state.learned.critics
        return Policy(actor, critics if isinstance(actor.actions, Discrete) else None)

    def policy(self, weights: Policy, observation: PyTree) -> Array:
        return weights.actor(weights.actor.seen(observation)).mode()

    def action_values(
        self, weights: Policy, observation: PyTree
    ) -> Float[Array, "batch action"] | None:
        """Q(s, ·) in units of reward, with the value of later entropy, if actions are numbered.

        None for other actions, and if values are in units of normalized rewards.
        """
        if weights.critics is None or self.normalize_rewards:
            return None
        seen = weights.actor.seen(observation)
        return smallest(weights.critics.every(seen)) / self.reward_scale

    def explore(
        self, state: ActorCriticState[Learned], observation: PyTree, key: PRNGKeyArray
    ) -> Array:
        policy, process = state.learned.actor(observation), state.noise
        if process is None or isinstance(policy, Categorical):
            return policy.sample(key)
        # Scaled to a variance that grows to 1, so that later draws alone are the policy's.
        theta = self.noise_theta
        noise = math.sqrt(theta * (2 - theta)) * process.value
        return policy.at(noise[:, : policy.coordinates])

    def update(self, learned: Learned, batch: Batch, key: PRNGKeyArray) -> tuple[Learned, Metrics]:
        next_key, key = jax.random.split(key)
        temperature = jnp.exp(learned.log_temperature)
        rate = self._schedule(learned.critic_adam.count)

        following, entropy = expectations(
            learned.actor, learned.target_critics, batch.steps.next_observation, next_key
        )
        value = following + temperature * entropy
        wanted = target_entropy(learned.actor.actions, self.spread)
        target = self.target(batch, value, self.bonus(wanted, entropy, temperature))
        learned, metrics = self.regress(learned, batch.steps, target)
        actor, actor_adam, more = optimizer.minimize(
            actor_loss, learned.actor, learned.actor_adam, self.actor_learning_rate_ratio * rate,
            learned.critics, temperature, batch.steps.observation, key,
        )  # fmt: skip
        excess = more["entropy"] - wanted
        log_temperature, temperature_adam, last = optimizer.minimize(
            temperature_loss, learned.log_temperature, learned.temperature_adam, rate, excess
        )
        target_critics = follow(learned.target_critics, learned.critics, self.tau)
        learned = Learned(
            actor, learned.critics, target_critics, actor_adam, learned.critic_adam,
            log_temperature, temperature_adam,
        )  # fmt: skip
        return learned, metrics | more | last

    def bonus(
        self,
        wanted: Float[Array, ""],
        entropy: Float[Array, " batch"],
        temperature: Float[Array, ""],
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """The least and the most value of a later step's entropy.

        The policy may keep its current entropy, or reach the one that is ``wanted``.
        """
        most = jnp.maximum(wanted, entropy.mean())
        return temperature * jnp.minimum(wanted, 0.0), temperature * jnp.maximum(most, 0.0)
