"""Twin delayed deep deterministic policy gradient (Fujimoto et al. 2018, algorithm 1).

DDPG with three changes against overestimation: the Bellman target takes the smaller of two critics'
estimates; noise on its action smooths the value over similar actions; and the actor and all targets
are updated only once in several steps of the critics. docs/algorithms/actor_critic.md lists
formulas and deviations.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from qfolio.agents.actor_critic import Batch, Critics
from qfolio.agents.ddpg import DDPG, Learned
from qfolio.core.fields import number, require, require_counts, static
from qfolio.core.mdp import Metrics
from qfolio.learning.targets import smallest


class TD3(DDPG):
    """DDPG with two critics, a smoothed target and a delayed actor."""

    target_noise: float = number(0.2)  # noise on the target's action, in units of the bound
    target_noise_clip: float = number(0.5)  # largest absolute value of that noise
    policy_delay: int = static(2)  # critics' steps per step of the actor and the targets
    pessimistic_actor: bool = static(True)  # the actor ascends the smaller value

    critic_count: ClassVar[int] = 2

    def __check_init__(self) -> None:
        require(self, "target_noise target_noise_clip", lambda x: 0 <= x <= 1e9, "from 0 to 10⁹")
        require_counts(self, "policy_delay")

    def update(self, learned: Learned, batch: Batch, key: PRNGKeyArray) -> tuple[Learned, Metrics]:
        learned, metrics = self.evaluate(learned, batch, key)
        due = learned.critic_adam.count % self.policy_delay == 0
        improve = lambda learned: self.improve(learned, batch.steps)  # noqa: E731
        return lax.cond(due, improve, lambda learned: learned, learned), metrics

    def following(
        self, learned: Learned, observation: PyTree, key: PRNGKeyArray
    ) -> Float[Array, " batch"]:
        """min Q'(s', a') at a' = π'(s') with clipped noise (eq. 14 and 15)."""
        action = learned.target_actor(observation)
        noise = self.target_noise * jax.random.normal(key, action.shape)
        noise = jnp.clip(noise, -self.target_noise_clip, self.target_noise_clip)
        action = learned.target_actor.perturb(action, noise)
        return smallest(learned.target_critics(observation, action))

    def climbed(self, critics: Critics) -> Critics:
        if self.pessimistic_actor:
            return critics
        return jax.tree.map(lambda x: x[:1], critics)
