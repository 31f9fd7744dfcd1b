"""Deep deterministic policy gradient (Lillicrap et al. 2016).

The critic regresses Q(s, a) towards r + γ Q'(s', π'(s')), where Q' and π' are slowly updated
targets. The actor π ascends Q(s, π(s)) by the critic's gradient in the action (Silver et al. 2014,
eq. 9). Exploration adds noise to the actor's action. docs/algorithms/actor_critic.md lists formulas
and deviations.
"""

import math
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from qfolio.agents import actor_critic
from qfolio.agents.actor_critic import ActorCritic, ActorCriticState, Batch, Critics
from qfolio.core import simplex
from qfolio.core.errors import QfolioError
from qfolio.core.fields import constant, number, require, static
from qfolio.core.mdp import Box, Discrete, Metrics, Simplex, Task
from qfolio.learning import optimizer
from qfolio.learning.networks import outputs_of, saturation, with_last_layer
from qfolio.learning.replay import Experience
from qfolio.learning.targets import Scalar, follow, smallest

REACH = 4.0
"""Output beyond which tanh counts as flat: at this output it is within 0.0007 of its bound."""


class Actor(actor_critic.Actor):
    """A deterministic policy: a network whose outputs are mapped to actions.

    Tanh maps them to a box's bounds, softmax to the simplex of weights.
    """

    actions: Box | Simplex

    def __call__(self, observation: PyTree) -> Float[Array, "batch entry"]:
        return self.among(self.network(observation))

    def among(self, output: Float[Array, "batch entry"]) -> Float[Array, "batch entry"]:
        """The actions of the network's outputs."""
        if isinstance(self.actions, Simplex):
            return jax.nn.softmax(output)
        if math.isinf(self.actions.bound):
            return output
        return self.actions.bound * jnp.tanh(output)

    def perturb(
        self, action: Float[Array, "batch entry"], noise: Float[Array, "batch entry"]
    ) -> Float[Array, "batch entry"]:
        """The action nearest to ``action`` plus noise; the noise is in units of the bound."""
        if isinstance(self.actions, Simplex):
            return simplex.project(action + noise)
        bound = self.actions.bound
        return jnp.clip(action + self.actions.unit * noise, -bound, bound)


class Learned(actor_critic.Learned):
    """What gradient steps change, including a target of the actor."""

    actor: Actor
    target_actor: Actor


def actor_loss(
    actor: Actor, critics: Callable[..., Array], observation: PyTree, saturation_penalty: Scalar
) -> tuple[Float[Array, ""], Metrics]:
    """Minus the mean of Q(s, π(s)), by the smallest of the critics.

    saturation_penalty: cost of a unit of ``saturation``.
    """
    output = actor.network(observation)
    value = smallest(critics(observation, actor.among(output))).mean()
    return saturation_penalty * saturation(actor.actions, output, REACH).mean() - value, {}


class DDPG(ActorCritic[Learned]):
    """A deterministic actor and a critic, both with targets that follow them."""

    exploration_noise: float = number(0.1)  # standard deviation of the noise, in units of the bound
    saturation_penalty: float = number(0.1)  # penalty on outputs where tanh is flat; 0: none
    late_action: bool = static(False)  # the action enters the critic at its second layer
    critic_weight_decay: float = constant(0.0)  # coefficient of the critic's L2 penalty
    last_layer_bound: float = constant(0.0)  # last layers start uniform in ± this; 0: in ±1/√inputs

    critic_count: ClassVar[int] = 1

    def __check_init__(self) -> None:
        scales = "exploration_noise saturation_penalty critic_weight_decay last_layer_bound"
        require(self, scales, lambda x: 0 <= x <= 1e9, "from 0 to 10⁹")

    def begin(self, task: Task, observation: PyTree, key: PRNGKeyArray) -> Learned:
        if isinstance(task.actions, Discrete):
            raise QfolioError(
                f"{type(self).__name__.lower()} needs continuous actions, but those of "
                f"{task.name} are numbered; use dqn or sac, or make them continuous: "
                "set torques=0 on the pendulum, or leave menu empty in a market."
            )
        actor_key, critic_key = jax.random.split(key)
        network = self.build(task, observation, outputs_of(task.actions, observation), actor_key)
        actor = Actor(network, task.actions)
        count, late = self.critic_count, self.late_action
        critics = self.build_critics(task, observation, count, critic_key, late=late)
        if bound := self.last_layer_bound:
            both = lambda x: (x[0].network, x[1].networks)  # noqa: E731
            small = lambda network: with_last_layer(network, bound)  # noqa: E731
            actor, critics = eqx.tree_at(both, (actor, critics), replace_fn=small)
        begin = optimizer.begin
        return Learned(actor, critics, critics, begin(actor), begin(critics), actor)

    def policy(self, weights: Actor, observation: PyTree) -> Float[Array, "batch entry"]:
        return weights(weights.seen(observation))

    def explore(
        self, state: ActorCriticState[Learned], observation: PyTree, key: PRNGKeyArray
    ) -> Float[Array, "batch entry"]:
        actor = state.learned.actor
        action = actor(observation)
        process = state.noise
        noise = jax.random.normal(key, action.shape) if process is None else process.value
        return actor.perturb(action, self.exploration_noise * noise)

    def update(self, learned: Learned, batch: Batch, key: PRNGKeyArray) -> tuple[Learned, Metrics]:
        learned, metrics = self.evaluate(learned, batch, key)
        return self.improve(learned, batch.steps), metrics

    def evaluate(
        self, learned: Learned, batch: Batch, key: PRNGKeyArray
    ) -> tuple[Learned, Metrics]:
        """A step of the critics towards the Bellman target."""
        following = self.following(learned, batch.steps.next_observation, key)
        target = self.target(batch, following)
        return self.regress(learned, batch.steps, target, self.critic_weight_decay)

    def following(
        self, learned: Learned, observation: PyTree, key: PRNGKeyArray
    ) -> Float[Array, " batch"]:
        """The value of the next observation: Q'(s', π'(s'))."""
        return learned.target_critics(observation, learned.target_actor(observation))[0]

    def improve(self, learned: Learned, batch: Experience) -> Learned:
        """A step of the actor up the critics' values, then an update of the targets."""
        rate = self.actor_learning_rate_ratio * self._schedule(learned.critic_adam.count)
        actor, adam, _ = optimizer.minimize(
            actor_loss,
            learned.actor,
            learned.actor_adam,
            rate,
            self.climbed(learned.critics),
            batch.observation,
            self.saturation_penalty,
        )
        targets = (learned.target_critics, learned.target_actor)
        target_critics, target_actor = follow(targets, (learned.critics, actor), self.tau)
        return Learned(
            actor, learned.critics, target_critics, adam, learned.critic_adam, target_actor
        )

    def climbed(self, critics: Critics) -> Critics:
        """The critics whose smallest value the actor ascends."""
        return critics
