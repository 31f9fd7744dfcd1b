"""Tasks so small that every action value is known by hand."""

import equinox as eqx
import jax
import jax.numpy as jnp

from qfolio.core.market import View
from qfolio.core.mdp import Box, Discrete, Simplex, Step, Task
from qfolio.portfolio.rewards import Reward
from qfolio.portfolio.synthetic.kelly import Kelly

TERMINATED, GOES_ON = jnp.array(True), jnp.array(False)


class Probe(Task):
    """Two actions."""

    @property
    def actions(self):
        return Discrete(2)


class OneState(Probe):
    """One step; action 1 pays 1 and action 0 nothing."""

    horizon: int = eqx.field(static=True, default=1)

    def reset(self, key):
        return jnp.zeros(())

    def observe(self, state):
        return jnp.ones(1)

    def step(self, state, action, key):
        return Step(state, action.astype(jnp.float32), TERMINATED)


class TwoStates(Probe):
    """One step from a state ±1; the action must match it: Q(s, a) = s · (2a − 1)."""

    horizon: int = eqx.field(static=True, default=1)

    def reset(self, key):
        return jax.random.rademacher(key, (), jnp.float32)

    def observe(self, state):
        return state[None]

    def step(self, state, action, key):
        return Step(state, state * (2.0 * action - 1.0), TERMINATED)


class RewardDelay(Probe):
    """Two steps whatever the action; only the second pays 1: values γ, then 1."""

    horizon: int = eqx.field(static=True, default=2)

    def reset(self, key):
        return jnp.zeros(())

    def observe(self, state):
        return jnp.stack([1.0 - state, state])

    def step(self, state, action, key):
        return Step(state + 1.0, state, state > 0.5)


class Endless(OneState):
    """Pays 1 for ever, cut after one step: worth 1/(1 − γ), but 1 if the cut counts as the end."""

    def step(self, state, action, key):
        return Step(state, jnp.array(1.0), GOES_ON)


class Explosive(Endless):
    """Rewards that overflow after some steps, so that the loss becomes infinite."""

    horizon: int = eqx.field(static=True, default=1000)

    def step(self, state, action, key):
        return Step(state + 1.0, jnp.where(state > 40, jnp.inf, 1.0), GOES_ON)


class Aim(Task):
    """Pays 1 − (a/2 − s)² in a state s = ±½, which ends after one step where s < 0.

    Where s > 0 it goes on for ever, cut after every step: Q(s, a) is the reward, and where s > 0
    γ / (1 − γ) more.
    """

    bound: float = eqx.field(static=True, default=2.0)
    horizon: int = eqx.field(static=True, default=1)

    @property
    def actions(self):
        return Box(1, self.bound)

    def reset(self, key):
        return 0.5 * jax.random.rademacher(key, (), jnp.float32)

    def observe(self, state):
        return state[None]

    def step(self, state, action, key):
        action = jnp.clip(action[0], -self.bound, self.bound)
        return Step(state, 1.0 - (action / 2 - state) ** 2, state < 0)


class AimNumbered(Aim):
    """The same in numbered states, 250 where s < 0 and 3 where s > 0."""

    states = 256

    def observe(self, state):
        return jnp.where(state < 0, 250, 3)


class AimWeights(Aim):
    """One step that pays 1 − 10 |w − (0.2, 0.5, 0.3)|² for weights of cash and two assets."""

    @property
    def actions(self):
        return Simplex(2)

    def observe(self, state):
        return View(jnp.full((2, 1, 1), state), jnp.zeros(2))

    def step(self, state, action, key):
        error = action - jnp.array([0.2, 0.5, 0.3])
        return Step(state, 1.0 - 10 * (error**2).sum(), TERMINATED)


class AimPlainWeights(AimWeights):
    """The same, with an observation that is no view of a market."""

    def observe(self, state):
        return state[None]


class Bonus(Reward):
    """The same at each step; tests define it again, with another value."""

    value = 1.0

    def __call__(self, state, outcome):
        return jnp.asarray(self.value), None


class Rewarded(Kelly):
    """A market with that reward."""

    reward = f"{__name__}:Bonus"
