"""Model-based policy optimization (Janner et al. 2019, algorithm 2): SAC on imagined steps.

An ensemble of networks learns from all real transitions how an action changes the observation, its
reward, and whether the episode ends. From real observations the model then imagines a few steps of
the policy, each predicted by a random member. Soft actor-critic learns from these steps and, if so
set, from a share of real ones. Members differ in their initial weights and their data: each counts
a real transition 0, 1, 2, … times (online bootstrap, Oza & Russell 2001).
docs/algorithms/model_based.md lists formulas and deviations.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt32

from qfolio.agents.actor_critic import ActorCriticState, State
from qfolio.agents.sac import SAC, Learned
from qfolio.core.errors import QfolioError
from qfolio.core.fields import (
    constant,
    number,
    require,
    require_counts,
    require_sizes,
    sizes,
    static,
)
from qfolio.core.mdp import Actions, Discrete, Metrics, Task, Transition
from qfolio.learning import optimizer
from qfolio.learning.encoders import MLP
from qfolio.learning.exploration import uniform
from qfolio.learning.replay import Discount, Experience, Replay
from qfolio.learning.targets import squash, unsquash

GAIN = 3.0
"""Gain of the model's first layer: inputs within ±1 should reach the bend of SiLU."""

LOG_VARIANCE = (-10.0, 0.5)
"""Soft bounds of a predicted log variance (the first bounds of Chua et al. 2018)."""


class Prediction(NamedTuple):
    """The predictions of all members."""

    mean: Float[Array, "member batch prediction"]
    log_variance: Float[Array, "member batch prediction"] | None  # None: no distribution


class Model(eqx.Module):
    """An ensemble of networks, whose weights have a leading member axis.

    The inputs are observations and actions scaled to ±1. The networks predict the change of the
    observation in units of its range, the reward's signed root (``squash``), and whether the
    episode ends (0 or 1). Small rewards matter once large ones are avoided, and a root resolves
    them better.
    gaussian: the outputs are the means of normal distributions and as many log variances.
    """

    members: Callable[[Array], Array]
    scale: Float[Array, " seen"]  # range of each component of an observation
    actions: Actions
    gaussian: bool = eqx.field(static=True, default=False)

    def __call__(
        self, observation: Float[Array, "batch seen"], action: Array
    ) -> Float[Array, "member batch outputs"]:
        """The outputs of all members' networks."""
        if isinstance(self.actions, Discrete):
            action = jax.nn.one_hot(action, self.actions.n)
        else:
            action = action / self.actions.unit
        inputs = jnp.concatenate([observation / self.scale, action], -1)
        return jax.vmap(lambda member: member(inputs))(self.members)

    def predict(self, observation: Float[Array, "batch seen"], action: Array) -> Prediction:
        """The predictions of all members, with log variances within soft bounds."""
        outputs = self(observation, action)
        if not self.gaussian:
            return Prediction(outputs, None)
        mean, log_variance = jnp.split(outputs, 2, -1)
        low, high = LOG_VARIANCE
        log_variance = high - jax.nn.softplus(high - log_variance)
        return Prediction(mean, low + jax.nn.softplus(log_variance - low))

    def truth(self, step: Experience) -> Float[Array, "batch prediction"]:
        """What a perfect model would predict."""
        change = (step.next_observation - step.observation) / self.scale
        return jnp.column_stack([change, squash(step.reward), step.terminal])

    def imagine(
        self,
        observation: Float[Array, "batch seen"],
        action: Array,
        among: Int[Array, " elite"],
        key: PRNGKeyArray,
    ) -> Experience:
        """One step from each row, predicted by a random member of ``among``.

        Members that predict distributions draw from them.
        """
        expected, log_variance = self.predict(observation, action)
        if log_variance is not None:
            key, noise_key = jax.random.split(key)
            noise = jax.random.normal(noise_key, expected.shape[1:])
            expected += jnp.exp(log_variance / 2) * noise
        member = among[jax.random.randint(key, expected.shape[1:2], 0, len(among))]
        drawn = expected[member, jnp.arange(len(member))]
        change, root, terminal = drawn[:, :-2], drawn[:, -2], drawn[:, -1] > 0.5
        follows = observation + self.scale * change
        return Experience(observation, action, unsquash(root), follows, terminal)


def model_loss(
    model: Model, step: Experience, counts: Float[Array, "batch member"]
) -> tuple[Float[Array, ""], Metrics]:
    """Mean error of all members, weighted by each member's counts.

    Squared errors are relative to the batch's variance; if members predict normal distributions,
    errors are twice the negative log likelihood, up to a constant.
    """
    prediction = model.predict(step.observation, step.action)
    if prediction.log_variance is None:
        errors = squared_errors(model, prediction, step)
    else:
        error = prediction.mean - model.truth(step)
        errors = error**2 * jnp.exp(-prediction.log_variance) + prediction.log_variance
    loss = (counts.T * errors.mean(-1)).mean(1).sum()
    return loss, {"model_loss": errors.mean()}


def squared_errors(
    model: Model, prediction: Prediction, step: Experience
) -> Float[Array, "member batch prediction"]:
    """Squared errors of the means, relative to the batch's variance."""
    truth = model.truth(step)
    unit = jnp.maximum(truth.std(0), 1e-2).at[-1].set(1.0)
    return ((prediction.mean - truth) / unit) ** 2


def best_members(
    model: Model, step: Experience, counts: Float[Array, "batch member"], elites: int
) -> Int[Array, " elite"]:
    """The members with the least squared errors on steps that they have not learned from."""
    prediction = model.predict(step.observation, step.action)
    errors = squared_errors(model, prediction, step).mean(-1)
    return jnp.argsort(errors.mean(1, where=counts.T == 0))[:elites]


class Remembered(NamedTuple):
    """A real step, and how often each member counts it."""

    step: Experience
    counts: Float[Array, "*batch member"]


class MBPOState(ActorCriticState[Learned]):
    """SAC's state, whose buffer holds real steps, with a model and its imagined steps."""

    model: Model
    model_adam: optimizer.Optimizer
    imagined: Replay
    bootstrap_key: UInt32[Array, "2"]  # for the counts; each step folds its number in


class MBPO(SAC):
    """Soft actor-critic that learns from the steps of a learned model."""

    ensemble_size: int = static(5)  # networks in the ensemble
    elites: int = static(0)  # number of members that imagine: those with the least error; 0: all
    gaussian_model: bool = static(False)  # members predict normal distributions instead of means
    model_hidden: tuple[int, ...] = sizes(128, 128)  # units of each hidden layer of the model
    model_updates: int = static(4)  # gradient steps of the model per step of all environments
    model_learning_rate_ratio: float = number(1.0)  # the model's step size over the critics'
    model_rollout_batch: int = static(64)  # rollouts of the model, each from a real observation
    model_rollout_length: int = static(5)  # steps of each such rollout
    model_replay_capacity: int = static(100_000)  # steps of the model that are kept
    real_ratio: float = constant(0.0)  # share of real steps in a batch of soft actor-critic

    def __check_init__(self) -> None:
        require_counts(self, "ensemble_size model_updates model_rollout_batch model_rollout_length")
        require(self, "model_replay_capacity", lambda x: 1 <= x <= 2**23, "from 1 to 2²³")
        require(self, "model_learning_rate_ratio", lambda x: 0 <= x <= 1e9, "from 0 to 10⁹")
        wanted = "from 0 to ensemble_size"
        require(self, "elites", lambda x: 0 <= x <= self.ensemble_size, wanted)
        require(self, "real_ratio", lambda x: 0 <= x <= 1, "between 0 and 1")
        require(self, "n_steps", lambda x: x == 1, "1: imagined steps are single")
        require(self, "noise_theta", lambda x: x == 1, "1: imagined steps have no order")
        normalized = "normalize_observations normalize_rewards"
        require(self, normalized, lambda x: not x, "false: a model imagines steps as they are")
        require_sizes(self, "model_hidden")

    def init(self, task: Task, key: PRNGKeyArray) -> MBPOState:
        model_key, key, bootstrap_key = jax.random.split(key, 3)
        observation = task.observe(task.reset(key))
        row = getattr(observation, "ndim", 0) == 1 and task.states is None
        if not row or not jnp.issubdtype(observation.dtype, jnp.floating):
            raise QfolioError(
                "mbpo predicts observations that are one row of real numbers (float32); those of "
                f"{task.name} are not; use sac or dqn."
            )
        actions = task.actions
        entries = actions.n if isinstance(actions, Discrete) else uniform(actions, key, 1).shape[1]
        outputs = (observation.size + 2) * (2 if self.gaussian_model else 1)
        layers = (observation.size + entries, *self.model_hidden, outputs)
        make = lambda key: MLP(layers, key, GAIN, "silu")  # noqa: E731
        model = Model(
            jax.vmap(make)(jax.random.split(model_key, self.ensemble_size)),
            jnp.broadcast_to(jnp.array(task.observation_scale), observation.shape),
            actions,
            self.gaussian_model,
        )
        start = super().init(task, key)
        step = jax.tree.map(lambda x: x[0], start.replay.unpack(start.replay.rows[:1]))
        rows = Remembered(step, jnp.ones(self.ensemble_size))
        width = self.model_rollout_batch * self.model_rollout_length
        return MBPOState(
            learned=start.learned,
            replay=Replay.empty(rows, self.replay_capacity, self.num_envs),
            steps=start.steps,
            rewards=start.rewards,
            normalizer=start.normalizer,
            noise=start.noise,
            model=model,
            model_adam=optimizer.begin(model.members),
            imagined=Replay.empty(step, self.model_replay_capacity, width),
            bootstrap_key=jax.random.key_data(bootstrap_key),
        )

    def row(self, state: ActorCriticState[Learned], step: Experience) -> Remembered:
        assert isinstance(state, MBPOState)
        key = jax.random.fold_in(jax.random.wrap_key_data(state.bootstrap_key), state.steps)
        counts = jax.random.poisson(key, 1.0, (len(step.reward), self.ensemble_size))
        return Remembered(step, counts.astype(jnp.float32))

    def learn(
        self, task: Task, state: ActorCriticState[Learned], rollout: Transition, key: PRNGKeyArray
    ) -> tuple[MBPOState, Metrics]:
        assert isinstance(state, MBPOState)
        now = self.observe(state, rollout)
        model_key, imagine_key, key = jax.random.split(key, 3)
        model, model_adam, metrics = self._study(now, model_key)
        imagined = self._imagine(model, now, imagine_key)
        draw = partial(self._draw, now.replay, imagined)
        learned, more = self.practise(now.learned, draw, now.rewards, key)
        now = dataclasses.replace(
            now, learned=learned, model=model, model_adam=model_adam, imagined=imagined
        )
        return now, metrics | more

    def _study(
        self, state: MBPOState, key: PRNGKeyArray
    ) -> tuple[Model, optimizer.Optimizer, Metrics]:
        """Gradient steps of the model on real transitions."""
        done = state.learned.critic_adam.count
        rate = self.model_learning_rate_ratio * self._schedule(done)

        def update(carry: tuple, key: PRNGKeyArray) -> tuple[tuple, Metrics]:
            members, adam = carry
            batch = state.replay.sample(key, self.batch_size)
            loss = lambda members: model_loss(  # noqa: E731
                eqx.tree_at(lambda m: m.members, state.model, members), batch.step, batch.counts
            )
            members, adam, metrics = optimizer.minimize(loss, members, adam, rate)
            return (members, adam), metrics

        carry = (state.model.members, state.model_adam)
        (members, adam), metrics = optimizer.repeat(update, carry, self.model_updates, key)
        model = eqx.tree_at(lambda m: m.members, state.model, members)
        return model, adam, metrics

    def _imagine(self, model: Model, state: MBPOState, key: PRNGKeyArray) -> Replay:
        """The buffer of imagined steps, with new ones of the current policy and model."""
        start_key, key = jax.random.split(key)
        among = jnp.arange(self.ensemble_size)
        if self.elites:
            start_key, elite_key = jax.random.split(start_key)
            judged = state.replay.sample(elite_key, self.batch_size)
            among = best_members(model, judged.step, judged.counts, self.elites)
        starts = state.replay.sample(start_key, self.model_rollout_batch).step.observation

        def step(
            observation: Float[Array, "batch seen"], key: PRNGKeyArray
        ) -> tuple[Float[Array, "batch seen"], Experience]:
            act_key, key = jax.random.split(key)
            action = self.explore(state, observation, act_key)
            step = model.imagine(observation, action, among, key)
            return jnp.where(step.terminal[:, None], starts, step.next_observation), step

        _, steps = lax.scan(step, starts, jax.random.split(key, self.model_rollout_length))
        return state.imagined.add(jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), steps))

    def _draw(
        self, replay: Replay, imagined: Replay, key: PRNGKeyArray
    ) -> tuple[Experience, Discount]:
        """A batch of steps: the real ones first, then the imagined ones."""
        real = round(self.real_ratio * self.batch_size)
        if not real:
            return imagined.sample(key, self.batch_size), self.discount
        real_key, key = jax.random.split(key)
        both = replay.sample(real_key, real).step, imagined.sample(key, self.batch_size - real)
        return jax.tree.map(lambda *x: jnp.concatenate(x), *both), self.discount

    def carry_over(self, state: State, fresh: State) -> State:
        assert isinstance(fresh, MBPOState)
        state = super().carry_over(state, fresh)
        return eqx.tree_at(lambda s: s.imagined, state, fresh.imagined)
