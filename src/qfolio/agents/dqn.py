"""Deep Q-network (Mnih et al. 2015), with its extensions as options.

A Q-network estimates the discounted return of each action. Collecting: actions are ε-greedy in its
values, and transitions go into a replay buffer. Training: on batches from the buffer, the network
regresses towards r + γ max_a Q'(s', a), where Q' is a slowly updated target network.

Options, which together are Rainbow (Hessel et al. 2018): double Q-learning (van Hasselt et al.
2016), dueling networks (Wang et al. 2016), returns over n steps, prioritized replay (Schaul et al.
2016), noisy networks (Fortunato et al. 2018), and distributions of returns in place of their means
(Bellemare et al. 2017; Dabney et al. 2018). In addition, a network may learn roots of values (after
Pohlen et al. 2018), and in an exogenous task ``all_actions`` learns every action's outcome from one
move of the market. docs/algorithms/dqn.md lists every formula, its place in this file, and each
deviation from the papers.
"""

import dataclasses
import math
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from qfolio.agents import hindsight
from qfolio.agents.hindsight import Move
from qfolio.core.errors import QfolioError
from qfolio.core.fields import Group, constant, number, require, require_counts, sizes, static
from qfolio.core.mdp import Agent, Discrete, ExogenousTask, Metrics, Task, Transition
from qfolio.learning import heads, optimizer
from qfolio.learning.bootstrapped import Heads, cautious, samples
from qfolio.learning.distributional import ValueConfig, Values
from qfolio.learning.exploration import EpsilonSchedule, LinearSchedule, epsilon_greedy
from qfolio.learning.heads import HeadConfig
from qfolio.learning.networks import Network, NetworkConfig
from qfolio.learning.optimizer import CosineSchedule, OptimizerConfig
from qfolio.learning.priorities import ImportanceSchedule, Priorities
from qfolio.learning.replay import Discount, Experience, Replay, ReplayConfig, cut, join
from qfolio.learning.targets import bootstrap, chosen, follow, follow_when, huber_loss, td_target

Weights = Network | Heads
"""One network of action values, or bootstrapped heads."""


class DQNState(eqx.Module):
    """The state of a DQN agent."""

    online: Weights
    target: Weights
    optimizer: optimizer.Optimizer
    replay: Replay
    episodes: Int[Array, ""]  # finished; ε follows it
    steps: Int[Array, ""]  # of each environment; target updates and a linear ε follow them


Learned = tuple[Weights, optimizer.Optimizer, Priorities | None]


class Losses(NamedTuple):
    """Losses of a batch."""

    each: Float[Array, "batch *action"]
    off: Float[Array, " batch"] | None  # absolute errors of the values, for priorities
    max_q: Float[Array, ""]  # mean of max_a Q(s, a), in units of reward


class DQN(Agent):
    """A deep Q-network.

    The defaults are those of the report that qfolio grew out of (docs/algorithms/dqn.md).
    """

    network: str = static("flat")  # flat, or a kind of docs/concepts/networks.md
    hidden: tuple[int, ...] = sizes(256, 256)  # units of each hidden layer
    num_envs: int = static(1)  # environments stepped side by side
    episode_steps: int = static(0)  # longest training episode; 0: the task's horizon
    batch_size: int = static(64)  # transitions per gradient step
    train_freq: int = static(1)  # steps of each environment between updates
    gradient_steps: int = static(1)  # gradient steps per update
    replay_capacity: int = static(50_000)  # transitions that the replay buffer holds
    learning_starts: int = static(64)  # transitions stored before learning
    double: bool = static(False)  # the online network chooses the action of a target
    dueling: bool = static(False)  # a stream for the state's value and one for advantages
    n_steps: int = static(1)  # steps of the return in a target
    prioritized: bool = static(False)  # transitions are drawn in proportion to their errors
    priority_exponent: float = number(0.6)  # α: how strongly errors decide what is drawn
    importance_exponent: float = number(0.4)  # β, the importance weights' exponent, at the start
    importance_steps: float = number(1e5)  # gradient steps until β is 1
    values: str = static("expected")  # expected, categorical or quantile returns
    atoms: int = static(51)  # numbers for each action, if values are a distribution
    v_min: float = number(-10.0)  # lower end of categorical's support, in units of scaled reward
    v_max: float = number(10.0)  # upper end of it, in the same units
    noisy: bool = static(False)  # explore by learned noise on weights, in addition to ε
    noise_scale: float = number(0.5)  # σ₀: the noise's size at the start
    all_actions: bool = static(False)  # learn all actions at once, from random holdings
    outcomes: int = static(0)  # with all_actions: actions learned per move; 0: all
    market_baseline: bool = static(False)  # with all_actions: rewards less the anchor's or a mean
    bootstrap_heads: int = static(1)  # with all_actions: networks, each learned from some blocks
    caution: float = number(0.0)  # standard errors by which an action must beat the first one
    time_limit_terminal: bool = static(False)  # treats time limits as terminations (biased)
    target_update_interval: int = static(200)  # steps between target updates
    tau: float = number(1.0)  # target's step towards the online network; 1 copies it
    discount: float = number(0.99)  # γ, the discount per step
    learning_rate: float = number(1e-3)  # step size at the start
    learning_rate_final: float = number(1.0)  # share of learning_rate at the end of its cosine
    learning_rate_steps: float = number(1e5)  # gradient steps of that cosine
    optimizer: str = static("adam")  # adam, rmsprop, rmsprop-centered or sgd
    rmsprop_decay: float = constant(0.95)  # decay of RMSProp's mean of squared gradients
    optimizer_epsilon: float = constant(1e-8)  # added to the divisor of a gradient
    epsilon_start: float = number(1.0)  # share of random actions at the start
    epsilon_end: float = number(0.01)  # least share of random actions
    epsilon_decay: float = number(0.995)  # factor on ε per finished episode
    epsilon_steps: float = constant(0.0)  # length of a linear decay in steps; 0: use epsilon_decay
    persistence: float = constant(0.0)  # of the last action, with probability ε times this
    huber_delta: float = number(math.inf)  # |TD error| beyond which the loss is linear
    reward_scale: float = number(1.0)  # rewards are multiplied by it before learning
    input_gain: float = number(0.0)  # gain of the first layer on inputs scaled to ±1; 0: unscaled
    value_rescaling: bool = static(False)  # learn roots of values, so that small ones weigh more

    _replay = Group(ReplayConfig)
    _networks = Group(NetworkConfig)
    _value_config = Group(ValueConfig)
    _schedule = Group(CosineSchedule)
    _optimizer = Group(OptimizerConfig)
    _importance = Group(ImportanceSchedule)
    _linear, _decaying = Group(LinearSchedule), Group(EpsilonSchedule)  # of ε
    _rule = Group(hindsight.Rule)

    def __check_init__(self) -> None:
        self._replay.check()
        self._networks.check()
        self._schedule.check()
        self._optimizer.check()
        self._value_config.check()
        require_counts(self, "train_freq gradient_steps target_update_interval")
        require(self, "importance_steps", lambda x: 1e-30 <= x <= 1e30, "from 1e-30 to 1e30")
        require(self, "reward_scale", lambda x: 1e-30 <= x <= 1e30, "from 1e-30 to 1e30")
        require(self, "noise_scale", lambda x: 0 <= x <= 1e9, "from 0 to 10⁹")
        require(self, "epsilon_steps", lambda x: 0 <= x <= 1e30, "from 0 to 1e30")
        fractions = "discount tau epsilon_start epsilon_end epsilon_decay persistence"
        exponents = " priority_exponent importance_exponent"
        require(self, fractions + exponents, lambda x: 0 <= x <= 1, "between 0 and 1")
        if self.persistence and self.train_freq > 1:
            raise QfolioError(
                f"train_freq is {self.train_freq}, and persistence needs the last action at each "
                "step; set train_freq=1 or persistence=0."
            )
        if self.all_actions:
            hindsight.require_plain(self)
        require_counts(self, "outcomes", 0)
        require(self, "bootstrap_heads", lambda x: 1 <= x <= 1000, "from 1 to 1,000")
        require(self, "caution", lambda x: 0 <= x <= 1e3, "from 0 to 1,000")
        for name, none in (("bootstrap_heads", 1), ("outcomes", 0), ("market_baseline", False)):
            if getattr(self, name) != none and not self.all_actions:
                raise QfolioError(f"{name} is for moves of a market; set all_actions=true.")
        if isinstance(self.caution, float) and self.caution and self.bootstrap_heads == 1:
            raise QfolioError("caution compares heads; set bootstrap_heads to 2 or more.")
        if self.market_baseline and self.batch_size < 2:
            raise QfolioError(
                "market_baseline compares holdings; it needs a batch_size of 2 or more."
            )

    @property
    def _head(self) -> HeadConfig:
        noise = self.noise_scale if self.noisy else None
        return HeadConfig(self._values.atoms, self.dueling, noise)

    def _epsilon(self, state: DQNState) -> Float[Array, ""]:
        if self.epsilon_steps:
            return self._linear(1.0 * self.num_envs * state.steps)
        return self._decaying(state.episodes)

    @property
    def _values(self) -> Values:
        """The kind of values that the network's outputs represent."""
        return self._value_config.build()

    def init(self, task: Task, key: PRNGKeyArray) -> DQNState:
        if not isinstance(task.actions, Discrete):
            has_menu = any(field.name == "menu" for field in dataclasses.fields(task))
            menu = "give it a menu of allocations (menu=tilts:0.1), or " if has_menu else ""
            raise QfolioError(
                f"dqn chooses among numbered actions, but those of {task.name} are continuous; "
                f"{menu}use sac or ppo."
            )
        state = task.reset(key)
        observation = task.observe(state)
        build = partial(heads.build, self._networks, self._head, task, observation)
        online: Weights = build(key)
        if self.bootstrap_heads > 1:
            online = Heads.build(build, self.bootstrap_heads, key)
        zero = jnp.array(0, jnp.int32)
        if self.all_actions:
            hindsight.require_exogenous(task)
            row: Experience | Move = Move(state.market, state.market)
        else:
            row = Experience.like(state, observation, zero, with_last=self.n_steps > 1)
        return DQNState(
            online=online,
            target=online,
            optimizer=optimizer.begin(online, self._optimizer),
            replay=self._replay.empty(row),
            episodes=zero,
            steps=zero,
        )

    @property
    def rollout_steps(self) -> int:
        return self.train_freq

    def warm_up(self) -> int:
        return self._replay.warm_up

    def monitor(self, state: DQNState) -> Metrics:
        return {"epsilon": self._epsilon(state)}

    def cut(self, state: DQNState) -> DQNState:
        return eqx.tree_at(lambda s: s.replay, state, cut(state.replay))

    def carry_over(self, state: DQNState, fresh: DQNState) -> DQNState:
        return eqx.tree_at(lambda s: s.replay, state, fresh.replay)

    def weights(self, state: DQNState) -> Weights:
        return state.online

    def action_values(
        self, weights: Weights, observation: PyTree
    ) -> Float[Array, "batch action"] | None:
        """Q(s, ·) in units of the task's reward; None if they are relative to a baseline."""
        if self.market_baseline:
            return None
        if isinstance(weights, Heads):
            return self._head_values(weights, observation).mean(0) / self.reward_scale
        return self._q(weights, observation) / self.reward_scale

    def policy(self, weights: Weights, observation: PyTree) -> Int[Array, " batch"]:
        return self._merits(weights, observation).argmax(-1)

    def act(self, state: DQNState, observation: PyTree, key: PRNGKeyArray) -> Int[Array, " batch"]:
        online = state.online
        if self.noisy:
            key, noise_key = jax.random.split(key)
            online = heads.draw_noise(online, noise_key)
        epsilon = self._epsilon(state)
        last = state.replay.latest().action if self.persistence else None
        merits = self._merits(online, observation)
        return epsilon_greedy(key, merits, epsilon, last, self.persistence)

    def _merits(self, weights: Weights, observation: PyTree) -> Float[Array, "batch action"]:
        """What a greedy action maximizes: its value, or its cautious advantage."""
        if isinstance(weights, Heads):
            values = self._head_values(weights, observation)
            return cautious(values, self.caution)
        return self._q(weights, observation)

    def _head_values(
        self, weights: Heads, observation: PyTree
    ) -> Float[Array, "head batch action"]:
        return jax.vmap(self._q, (0, None))(weights.networks, observation)

    def _q(self, network: Network, observation: PyTree) -> Float[Array, "batch action"]:
        return self._values.mean(self._read(network, observation))

    def _read(self, network: Network, observation: PyTree) -> Float[Array, "batch action atom"]:
        """The network's outputs for each action; ``_values`` interprets them."""
        return heads.read(self._head, network, observation)

    def observe(self, state: DQNState, rollout: Transition) -> DQNState:
        wrong, with_last = self.time_limit_terminal, self.n_steps > 1
        row = Experience.of(rollout, time_limit_terminal=wrong, with_last=with_last)
        stored = Move.of(rollout) if self.all_actions else row
        finished = (rollout.terminated | rollout.truncated).sum(dtype=jnp.int32)
        return eqx.tree_at(
            lambda s: (s.replay, s.episodes, s.steps),
            state,
            (
                state.replay.extend(stored),
                state.episodes + finished,
                state.steps + self.train_freq,
            ),
        )

    def learn(
        self, task: Task, state: DQNState, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[DQNState, Metrics]:
        state = self.observe(state, rollout)
        update = partial(self._update, task, state.replay, state.target)
        learned = (state.online, state.optimizer, state.replay.priorities)
        learned, metrics = optimizer.repeat(update, learned, self.gradient_steps, key)
        online, adam, priorities = learned
        if self.target_update_interval == 1:
            target = follow(state.target, online, self.tau)
        else:
            due = state.steps % self.target_update_interval < self.train_freq
            target = follow_when(due, state.target, online, self.tau)
        replay = dataclasses.replace(state.replay, priorities=priorities)
        return DQNState(online, target, adam, replay, state.episodes, state.steps), metrics

    def _update(
        self, task: Task, replay: Replay, target: Weights, learned: Learned, key: PRNGKeyArray
    ) -> tuple[Learned, Metrics]:
        """One gradient step, with its loss and the batch's mean max_a Q(s, a)."""
        online, adam, priorities = learned
        draw_key = key
        if self.all_actions or self.noisy:
            draw_key, key = jax.random.split(key)
        index = dataclasses.replace(replay, priorities=priorities).draw(draw_key, self.batch_size)
        weight: Array | float = 1.0
        if priorities is not None:
            weight = priorities.importance(index, self._importance(adam.count))

        def objective(online: Weights) -> tuple[Float[Array, ""], Losses]:
            if self.all_actions:
                losses = self._all_action_losses(task, online, target, replay.at(index), key)
            else:
                assert not isinstance(online, Heads)
                assert not isinstance(target, Heads)
                batch, discount = join(replay, index, self.discount)
                losses = self._losses(online, target, batch.recalled(task), discount, key)
            return (weight * losses.each).mean(), losses

        (loss, losses), gradient = jax.value_and_grad(objective, has_aux=True)(online)
        if priorities is not None and losses.off is not None:
            priorities = priorities.update(index, losses.off, self.priority_exponent)
        rate = self._schedule(adam.count + 1)
        online, adam = optimizer.descend(online, gradient, adam, rate)
        return (online, adam, priorities), {"loss": loss, "max_q": losses.max_q}

    def _losses(
        self,
        online: Network,
        target: Network,
        batch: Experience,
        discount: Discount,
        key: PRNGKeyArray,
    ) -> Losses:
        """discount: of the values that follow the batch's rewards. key: for the noise."""
        noisy = heads.draw_noise(online, key) if self.noisy else online
        values = self._values
        z = self._read(noisy, batch.observation)
        z_next = self._read(target, batch.next_observation)
        selector = self._read(online, batch.next_observation) if self.double else z_next
        following = bootstrap(z_next, values.mean(selector))

        reward = self.reward_scale * batch.reward
        each_target = jax.vmap(td_target, (None, None, 1, None), 1)  # one for each outcome
        targets = each_target(reward, batch.terminal, values.outcomes(following), discount)
        each, off = values.loss(
            chosen(z, batch.action), lax.stop_gradient(targets), lax.stop_gradient(following)
        )
        return Losses(each, off, values.mean(z).max(1).mean() / self.reward_scale)

    def _all_action_losses(
        self, task: Task, online: Weights, target: Weights, moves: Move, key: PRNGKeyArray
    ) -> Losses:
        assert isinstance(task, ExogenousTask)

        def errors(online: Network, target: Network) -> tuple[Array, Array]:
            q = partial(self._q, online), partial(self._q, target)
            return hindsight.errors(self._rule, task, moves, key, *q)

        if isinstance(online, Heads) and isinstance(target, Heads):
            error, values = jax.vmap(errors)(online.networks, target.networks)
            count = samples(task, moves.market, self.bootstrap_heads)
            each = (count[..., None] * huber_loss(error, self.huber_delta)).sum(0)
        else:
            assert not isinstance(online, Heads)
            assert not isinstance(target, Heads)
            error, values = errors(online, target)
            each = huber_loss(error, self.huber_delta)
        return Losses(each, None, values.max(-1).mean() / self.reward_scale)
