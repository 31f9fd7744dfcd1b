"""What policy-gradient agents share: a stochastic policy and an estimate of its return.

They act by drawing from the policy, and learn from rollouts of the current policy: each action's
return is compared with the estimate (the difference is its advantage), the policy moves towards
actions that did better, and the estimate moves towards the returns. ``reinforce.py``, ``a2c.py``
and ``ppo.py`` differ in how. docs/algorithms/policy_gradients.md has the formulas.
"""

import dataclasses
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree

from qfolio.core.fields import Group, constant, number, require, require_counts, sizes, static
from qfolio.core.mdp import Actions, Agent, Box, Metrics, Position, Simplex, Task, Transition
from qfolio.learning import networks, optimizer
from qfolio.learning.distributions import Distribution, policy_of
from qfolio.learning.networks import Network, NetworkConfig, Outputs, outputs_of, saturation
from qfolio.learning.normalization import Moments, NormalizationConfig, Normalizer, normalized
from qfolio.learning.optimizer import CosineSchedule, OptimizerConfig
from qfolio.learning.recall import recalled, stored
from qfolio.learning.targets import advantages

LARGEST = 1e18
"""Bound of metrics; a metric that is not finite would count as a failure of training."""

REACH = 2.0
"""Mean, in units of the bound, beyond which nearly all draws are clipped."""


class PolicyAndValue(eqx.Module):
    """A policy (the actor) and an estimate of its discounted return (the critic)."""

    actor: Network
    log_std: Float[Array, " coordinate"]  # the same in all states; one for all assets of a market
    critic: Network
    actions: Actions = eqx.field(static=True)
    observations: Moments | None = None  # for normalization; None during training

    def policy(self, observation: PyTree) -> Distribution:
        """The distribution of actions."""
        seen = normalized(self.observations, observation)
        return policy_of(self.actions, self.actor(seen), self.log_std)

    def value(self, observation: PyTree) -> Float[Array, " batch"]:
        """V(s) in units of scaled rewards."""
        return self.critic(normalized(self.observations, observation))[:, 0]


class OnPolicyState(eqx.Module):
    """The state of an agent that learns from its current policy's rollouts."""

    weights: PolicyAndValue  # for normalized observations
    optimizer: optimizer.Optimizer
    normalizer: Normalizer


class Batch(NamedTuple):
    """Steps of a rollout as rows, by time and then environment, with advantages and targets."""

    observation: PyTree  # as stored
    action: Array
    log_prob: Float[Array, " batch"]  # of the action, when it was drawn
    advantage: Float[Array, " batch"]
    target: Float[Array, " batch"]  # of the critic
    counted: Bool[Array, " batch"] | None = None  # steps to learn from; None: all


class OnPolicy(Agent):
    """Acting, the networks and the optimizer's step; subclasses differ in how they learn."""

    network: str = static("flat")  # flat, or a kind of docs/concepts/networks.md
    hidden: tuple[int, ...] = sizes(64, 64)  # units of each hidden layer of actor and critic
    activation: str = static("relu")  # relu, tanh or silu
    initialization: str = static("uniform")  # uniform (in ±1/√inputs) or orthogonal
    num_envs: int = static(8)  # environments stepped side by side
    rollout_length: int = static(128)  # steps of each environment that are learned from at once
    episode_steps: int = static(0)  # longest training episode; 0: the task's horizon
    discount: float = number(0.99)  # γ, the discount per step
    learning_rate: float = number(3e-4)  # step size at the start
    learning_rate_final: float = number(1.0)  # share of learning_rate at the end of its cosine
    learning_rate_steps: float = number(1e5)  # gradient steps of that cosine
    optimizer: str = static("adam")  # adam, rmsprop, rmsprop-centered or sgd
    rmsprop_decay: float = constant(0.99)  # decay of RMSProp's mean of squared gradients
    optimizer_epsilon: float = constant(1e-8)  # added to the divisor of a gradient
    max_grad_norm: float = number(0.5)  # longer gradients are rescaled to it
    value_coef: float = number(0.5)  # weight of the critic's squared error in the loss
    entropy_coef: float = number(0.0)  # weight of the policy's entropy in the loss
    initial_std: float = number(1.0)  # deviation of actions, in units of the bound, or of logits
    normalize_advantages: bool = static(True)  # gives advantages mean 0, deviation 1 in a batch
    time_limit_terminal: bool = static(False)  # treats time limits as terminations (biased)
    saturation_penalty: float = number(0.1)  # penalty on means far beyond the bounds; 0: none
    reward_scale: float = number(1.0)  # rewards are multiplied by it before learning
    input_gain: float = number(0.0)  # gain of the first layer on inputs scaled to ±1; 0: unscaled
    normalize_observations: bool = static(False)  # by their running mean and standard deviation
    normalize_rewards: bool = static(False)  # by the running deviation of discounted returns

    _networks = Group(NetworkConfig)
    _normalization = Group(NormalizationConfig)
    _schedule = Group(CosineSchedule)
    _optimizer = Group(OptimizerConfig)

    least_length = 1  # of a rollout
    gae_lambda = 1.0  # λ of the advantages, which A2C and PPO have as a setting

    def __check_init__(self) -> None:
        require_counts(self, "rollout_length", self.least_length)
        require(self, "discount", lambda x: 0 <= x <= 1, "between 0 and 1")
        require(self, "max_grad_norm", lambda x: x > 0, "greater than 0")
        coefficients = "value_coef entropy_coef saturation_penalty"
        require(self, coefficients, lambda x: 0 <= x <= 1e9, "from 0 to 10⁹")
        require(self, "initial_std", lambda x: 1e-9 <= x <= 1e9, "from 10⁻⁹ to 10⁹")
        require(self, "reward_scale", lambda x: 1e-30 <= x <= 1e30, "from 1e-30 to 1e30")
        self._schedule.check()
        self._optimizer.check()
        self._networks.check()
        self._normalization.check(self.input_gain)

    @property
    def rollout_steps(self) -> int:
        return self.rollout_length

    def init(self, task: Task, key: PRNGKeyArray) -> OnPolicyState:
        actor_key, critic_key, start_key = jax.random.split(key, 3)
        observation = task.observe(task.reset(start_key))

        def build(outputs: Outputs, key: PRNGKeyArray) -> Network:
            return networks.build(self._networks, task, observation, outputs, key)

        actor = build(outputs_of(task.actions, observation), actor_key)
        weights = PolicyAndValue(
            # A last layer of zeros: the first policy is the same everywhere.
            actor=networks.start_at_zero(actor),
            log_std=jnp.full(_coordinates(task.actions), jnp.log(self.initial_std)),
            critic=build(Outputs(1), critic_key),
            actions=task.actions,
        )
        normalizer = self._normalization.begin(task, observation, self.num_envs)
        return OnPolicyState(weights, optimizer.begin(weights, self._optimizer), normalizer)

    def weights(self, state: OnPolicyState) -> PolicyAndValue:
        return state.normalizer.attached(state.weights)

    def policy(self, weights: PolicyAndValue, observation: PyTree) -> Array:
        return weights.policy(observation).mode()

    def act(self, state: OnPolicyState, observation: PyTree, key: PRNGKeyArray) -> Array:
        return self.weights(state).policy(observation).sample(key)

    def learn(
        self, task: Task, state: OnPolicyState, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[OnPolicyState, Metrics]:
        # Observations are normalized as they were when the policy acted on them.
        before, after = state.normalizer, state.normalizer.update(rollout, self.discount)
        rollout = rollout._replace(
            observation=stored(rollout.state, before.observation(rollout.observation)),
            next_observation=stored(
                rollout.next_state, before.observation(rollout.next_observation)
            ),
            reward=after.reward(rollout.reward),
        )
        state, metrics = self.improve(task, state, rollout, key)
        return dataclasses.replace(state, normalizer=after), metrics

    def improve(
        self, task: Task, state: OnPolicyState, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[OnPolicyState, Metrics]:
        """Learns from a rollout of normalized observations, as stored, and rewards."""
        batch = self.judge(task, state.weights, rollout)
        state, metrics = self.practise(task, state, batch, key)
        return state, metrics | {"explained_variance": explained_variance(batch)}

    def practise(
        self, task: Task, state: OnPolicyState, batch: Batch, key: PRNGKeyArray
    ) -> tuple[OnPolicyState, Metrics]:
        """Learns from the steps of a rollout; by default with one gradient step."""
        return self.descend(task, state, batch)

    def judge(self, task: Task, weights: PolicyAndValue, rollout: Transition) -> Batch:
        """The steps of a rollout that these weights made, with advantages and targets."""

        def look(step: Transition) -> tuple[Array, Array, Array]:
            seen = recalled(task, step.observation)
            following = weights.value(recalled(task, step.next_observation))
            return weights.value(seen), following, weights.policy(seen).log_prob(step.action)

        step = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), rollout)
        # Views of a market are recalled one time at a time: all together, they exceed the caches.
        by_time = isinstance(rollout.observation, Position)
        found = lax.map(look, rollout) if by_time else look(step)
        value, following, log_prob = (x.reshape(rollout.reward.shape) for x in found)
        terminated, truncated = rollout.terminated, rollout.truncated
        if self.time_limit_terminal:
            terminated = terminated | truncated
        advantage = advantages(
            self.reward_scale * rollout.reward, value, following, terminated, truncated,
            self.discount, self.gae_lambda,
        )  # fmt: skip
        return Batch(
            observation=step.observation,
            action=step.action,
            log_prob=log_prob.reshape(-1),
            advantage=advantage.reshape(-1),
            target=(advantage + value).reshape(-1),
        )

    def objective(self, log_prob: Float[Array, " batch"], batch: Batch) -> Float[Array, " batch"]:
        """The policy's objective, given its log density of the batch's actions."""
        return log_prob * self.weighed(batch)

    def weighed(self, batch: Batch) -> Float[Array, " batch"]:
        """The advantages in the objective, normalized with ``normalize_advantages``.

        That of a single step stays as it is: normalized, it would always be 0.
        """
        if not self.normalize_advantages or len(batch.advantage) == 1:
            return batch.advantage
        return standardized(batch.advantage, batch.counted)

    def loss(self, weights: PolicyAndValue, batch: Batch) -> tuple[Float[Array, ""], Metrics]:
        """Minus the objective and the weighted entropy, plus the critic's weighted error.

        The saturation penalty is added.
        """
        output = weights.actor(batch.observation)
        policy = policy_of(weights.actions, output, weights.log_std)
        mean = partial(jnp.mean, where=batch.counted)
        log_prob = policy.log_prob(batch.action)
        loss = -mean(self.objective(log_prob, batch))
        value_loss = mean((batch.target - weights.value(batch.observation)) ** 2)
        entropy = mean(policy.entropy())
        total = loss + self.value_coef * value_loss - self.entropy_coef * entropy
        total += self.saturation_penalty * mean(saturation(weights.actions, output, REACH))
        metrics = {"loss": loss, "value_loss": value_loss, "entropy": entropy}
        return total, metrics | self.diagnose(log_prob - batch.log_prob)

    def diagnose(self, log_ratio: Float[Array, " batch"]) -> Metrics:
        """Further metrics, given the log ratio of new to old probabilities of the actions."""
        return {}

    def cut(self, state: OnPolicyState) -> OnPolicyState:
        return dataclasses.replace(state, normalizer=state.normalizer.cut())

    def carry_over(self, state: OnPolicyState, fresh: OnPolicyState) -> OnPolicyState:
        return self.cut(state)

    def descend(
        self, task: Task, state: OnPolicyState, batch: Batch
    ) -> tuple[OnPolicyState, Metrics]:
        """One gradient step."""
        batch = batch._replace(observation=recalled(task, batch.observation))
        gradient, metrics = jax.grad(self.loss, has_aux=True)(state.weights, batch)
        metrics["gradient_norm"] = jnp.minimum(optimizer.norm(gradient), LARGEST)
        gradient = optimizer.clip(gradient, self.max_grad_norm)
        rate = self._schedule(state.optimizer.count + 1)
        weights, adam = optimizer.descend(state.weights, gradient, state.optimizer, rate)
        return dataclasses.replace(state, weights=weights, optimizer=adam), metrics


def standardized(
    advantage: Float[Array, " batch"], counted: Bool[Array, " batch"] | None = None
) -> Float[Array, " batch"]:
    """Advantages with mean 0 and standard deviation 1 over those that count."""
    mean, std = advantage.mean(where=counted), advantage.std(where=counted)
    return (advantage - mean) / (std + 1e-8)


def explained_variance(batch: Batch) -> Float[Array, ""]:
    """The share of the targets' variance that the critic's values explain; 1 at best.

    It is negative if the critic is worse than a constant, and 0 if all targets are the same.
    """
    error = batch.advantage.var(where=batch.counted)
    total = batch.target.var(where=batch.counted)
    share = 1 - error / jnp.where(total > 0, total, 1.0)
    return jnp.where(total > 0, jnp.maximum(share, -LARGEST), 0.0)


def _coordinates(actions: Actions) -> int:
    """The number of a policy's standard deviations; discrete policies have none."""
    return actions.n if isinstance(actions, Box) else int(isinstance(actions, Simplex))
