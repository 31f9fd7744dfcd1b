"""Deep Q-network (Mnih et al. 2015), with double Q-learning (van Hasselt et al. 2016).

A Q-network estimates the discounted return of each action. Collecting: actions are ε-greedy on it,
and transitions go into a replay buffer. Training: it regresses, on batches from the buffer, towards
r + γ max_a Q'(s', a), where Q' is a target network that follows it slowly. In an exogenous task one
move of the market tells the outcome of all actions from any holding, and ``all_actions`` regresses
them together. docs/dqn.md holds every formula, the place where it stands here, and each deviation
from the paper.
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

from qfolio import networks, optimizer
from qfolio.errors import QfolioError
from qfolio.exploration import epsilon_greedy
from qfolio.fields import number, require, require_sizes, sizes, static
from qfolio.mdp import (
    Agent,
    Contrast,
    Discrete,
    ExogenousTask,
    Metrics,
    Position,
    Task,
    Transition,
)
from qfolio.networks import KINDS, Network, outputs_of
from qfolio.replay import Experience, Replay
from qfolio.targets import bootstrap, follow, huber_loss, td_target


class Move(NamedTuple):
    """What the buffer keeps for all actions: how the market moved."""

    market: PyTree
    next_market: PyTree


class DQNState(eqx.Module):
    """All that a DQN agent learns and remembers."""

    online: Network
    target: Network
    optimizer: optimizer.Optimizer
    replay: Replay
    episodes: Int[Array, ""]  # finished; ε follows it
    steps: Int[Array, ""]  # of each environment; the target network follows them


class DQN(Agent):
    """A deep Q-network; the defaults are those of the report that qfolio grew out of."""

    network: str = static("flat")  # over everything observed; or mlp, cnn, rnn, shared by assets
    hidden: tuple[int, ...] = sizes(256, 256)
    environments: int = static(1)  # stepped side by side
    episode_steps: int = static(0)  # training episodes are cut here; 0: the task's horizon
    batch_size: int = static(64)
    updates: int = static(1)  # gradient steps per step of all environments
    replay_capacity: int = static(50_000)  # transitions
    learning_starts: int = static(64)  # transitions stored before learning
    double: bool = static(False)
    all_actions: bool = static(False)  # learn every action at once, from re-drawn holdings
    market_baseline: bool = static(False)  # with all_actions: rewards above those of other holdings
    time_limit_terminal: bool = static(False)  # wrong, but often done
    target_period: int = static(200)  # steps between target updates
    target_rate: float = number(1.0)  # how far each goes towards the online network; 1 copies it
    discount: float = number(0.99)
    learning_rate: float = number(1e-3)
    learning_rate_final: float = number(1.0)  # share of it that is left at the end of the cosine
    learning_rate_steps: float = number(1e5)  # gradient steps of the cosine
    epsilon: float = number(1.0)
    epsilon_end: float = number(0.01)
    epsilon_decay: float = number(0.995)  # factor per finished episode
    huber: float = number(math.inf)  # |TD error| beyond which the loss is linear; inf: squared
    reward_scale: float = number(1.0)  # the network learns values of scaled rewards
    input_gain: float = number(0.0)  # of the first layer, observations taken to ±1; 0: as it is

    def __check_init__(self) -> None:
        counts = "environments batch_size updates target_period"
        require(self, counts, lambda x: 1 <= x < 2**31, "from 1 to 2³¹ − 1")
        require(self, "replay_capacity", lambda x: 1 <= x <= 2**23, "from 1 to 2²³")
        require(self, "episode_steps learning_starts", lambda x: 0 <= x < 2**31, "at least 0")
        require(self, "input_gain", lambda x: 0 <= x <= 1e9, "from 0 to 10⁹")
        optimizer.require_schedule(self)
        require(self, "reward_scale", lambda x: 1e-30 <= x <= 1e30, "from 1e-30 to 1e30")
        require(self, "huber", lambda x: x >= 1e-30, "greater than 0")
        fractions = "discount target_rate epsilon epsilon_end epsilon_decay"
        require(self, fractions, lambda x: 0 <= x <= 1, "between 0 and 1")
        require_sizes(self)
        require(self, "network", lambda x: x in KINDS, f"one of {', '.join(KINDS)}")
        if self.market_baseline and self.batch_size < 2:
            raise QfolioError(
                "market_baseline compares holders; it needs a batch_size of 2 or more."
            )
        if self.learning_starts > self.replay_capacity:
            raise QfolioError(
                f"learning_starts is {self.learning_starts}, more than replay_capacity "
                f"({self.replay_capacity}) can hold; lower the one or raise the other."
            )

    def contrast(self) -> Contrast:
        if self.all_actions:
            single = dataclasses.replace(self, all_actions=False)
            return Contrast("all actions at once", "one action at a time", single)
        names = ("without double DQN", "double DQN")
        other = dataclasses.replace(self, double=not self.double)
        return Contrast(names[self.double], names[not self.double], other)

    def init(self, task: Task, key: PRNGKeyArray) -> DQNState:
        state = task.reset(key)
        observation = task.observe(state)
        online = self._network(task, observation, key)
        row: Experience | Move = Experience(
            observation=observation,
            action=jnp.array(0, jnp.int32),
            reward=jnp.array(0.0),
            next_observation=observation,
            terminal=jnp.array(False),
        )
        if self.all_actions:
            if not isinstance(task, ExogenousTask):
                raise QfolioError(
                    "all_actions needs a market, whose prices do not answer to actions; "
                    f"{type(task).__name__} is none."
                )
            if getattr(task, "reward", "") == "differential-sharpe":
                raise QfolioError(
                    "all_actions draws holdings without a past, and differential-sharpe rewards "
                    "what comes after one; take reward=crra, or all_actions=false."
                )
            row = Move(state.market, state.market)
        zero = jnp.array(0, jnp.int32)
        return DQNState(
            online=online,
            target=online,
            optimizer=optimizer.begin(online),
            replay=Replay.empty(row, self.replay_capacity, self.environments),
            episodes=zero,
            steps=zero,
        )

    def _network(self, task: Task, observation: PyTree, key: PRNGKeyArray) -> Network:
        if not isinstance(task.actions, Discrete):
            raise QfolioError(
                f"dqn chooses among numbered actions, and those of {type(task).__name__} are "
                "continuous; in a market, give it a menu of allocations (menu=grid:10)."
            )
        outputs = outputs_of(task.actions)
        return networks.build(
            self.network, task, observation, self.hidden, outputs, key, self.input_gain
        )

    def warm_up(self) -> int:
        return max(0, math.ceil(self.learning_starts / self.environments) - 1)

    def epsilon_now(self, state: DQNState) -> Float[Array, ""]:
        return jnp.maximum(self.epsilon_end, self.epsilon * self.epsilon_decay**state.episodes)

    def monitor(self, state: DQNState) -> Metrics:
        return {"epsilon": self.epsilon_now(state)}

    def carry_over(self, state: DQNState, fresh: DQNState) -> DQNState:
        return eqx.tree_at(lambda s: s.replay, state, fresh.replay)

    def weights(self, state: DQNState) -> Network:
        return state.online

    def action_values(
        self, weights: Network, observation: PyTree
    ) -> Float[Array, "batch action"] | None:
        """Q(s, ·) in units of the task's reward; none where they are above a baseline."""
        return None if self.market_baseline else weights(observation) / self.reward_scale

    def policy(self, weights: Network, observation: PyTree) -> Int[Array, " batch"]:
        return weights(observation).argmax(-1)

    def act(self, state: DQNState, observation: PyTree, key: PRNGKeyArray) -> Int[Array, " batch"]:
        return epsilon_greedy(key, state.online(observation), self.epsilon_now(state))

    def observe(self, state: DQNState, rollout: Transition) -> DQNState:
        experience: Experience | Move = Experience.of(
            rollout, time_limit_terminal=self.time_limit_terminal
        )
        if self.all_actions:
            moves = Move(rollout.state.market, rollout.next_state.market)
            experience = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), moves)
        finished = (rollout.terminated | rollout.truncated).sum(dtype=jnp.int32)
        return eqx.tree_at(
            lambda s: (s.replay, s.episodes, s.steps),
            state,
            (state.replay.add(experience), state.episodes + finished, state.steps + 1),
        )

    def learn(
        self, task: Task, state: DQNState, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[DQNState, Metrics]:
        state = self.observe(state, rollout)

        def update(carry, key):  # type: ignore[no-untyped-def]
            online, adam = carry
            sample_key, holding_key = jax.random.split(key) if self.all_actions else (key, key)
            batch = state.replay.sample(sample_key, self.batch_size)
            every = partial(self._all_action_loss, task, holding_key)
            loss_of = jax.value_and_grad(every if self.all_actions else self._loss, has_aux=True)
            (loss, max_q), gradient = loss_of(online, state.target, batch)
            return optimizer.descend(self, online, gradient, adam), (loss, max_q)

        carry = (state.online, state.optimizer)
        if self.updates == 1:
            (online, adam), (loss, max_q) = update(carry, key)
        else:
            keys = jax.random.split(key, self.updates)
            (online, adam), (loss, max_q) = lax.scan(update, carry, keys)

        due = state.steps % self.target_period == 0
        rate = self.target_rate if self.target_period == 1 else jnp.where(due, self.target_rate, 0)
        target = follow(state.target, online, rate)
        state = DQNState(online, target, adam, state.replay, state.episodes, state.steps)
        return state, {"loss": loss.mean(), "max_q": max_q.mean()}

    def _loss(
        self, online: Network, target: Network, batch: Experience
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

    def _all_action_loss(
        self, task: ExogenousTask, key: PRNGKeyArray, online: Network, target: Network, moves: Move
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """The same, over every action from holdings drawn anew: what each would have led to."""
        holdings = jax.vmap(task.draw_holding)(jax.random.split(key, self.batch_size))
        q = online(jax.vmap(task.observe)(Position(moves.market, holdings)))

        def after(holdings: PyTree, action: Array) -> tuple[Array, PyTree]:
            settle = jax.vmap(task.settle, (0, 0, 0, None))
            return settle(moves.market, moves.next_market, holdings, action)

        actions = jnp.arange(q.shape[-1])
        reward, next_holdings = jax.vmap(partial(after, holdings))(actions)  # (action, batch)
        if self.market_baseline:
            # What the same move pays another holder, on average over his actions, depends on the
            # market alone: taking it off leaves the best policy as it is, and takes off what all
            # actions have in common of the market's noise (input-dependent baselines, Mao et al.
            # 2019).
            others = jax.tree.map(lambda x: jnp.roll(x, 1, 0), holdings)
            reward = reward - jax.vmap(partial(after, others))(actions)[0].mean(0)
        never = jnp.zeros(reward.shape[1:], bool)

        def goal(reward: Array, holding: PyTree) -> Array:
            view = jax.vmap(task.observe)(Position(moves.next_market, holding))
            q_next = target(view)
            following = bootstrap(q_next, online(view) if self.double else q_next)
            return td_target(self.reward_scale * reward, never, following, self.discount)

        goals = lax.stop_gradient(jax.vmap(goal)(reward, next_holdings)).T
        return huber_loss(goals - q, self.huber).mean(), q.max(1).mean() / self.reward_scale
