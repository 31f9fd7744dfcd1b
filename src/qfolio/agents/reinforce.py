"""REINFORCE with a learned baseline (Williams 1992).

Whole episodes are played; then the policy takes one step along the gradient of its actions' log
probabilities, each times the return that followed minus the baseline. No reward is replaced by an
estimate: steps of an episode that is unfinished at the end of a rollout are left out. There is one
exception: the baseline replaces the rewards that a time limit cuts off, unless
``time_limit_terminal``. docs/algorithms/policy_gradients.md has the formulas and the deviations
from the paper.
"""

import dataclasses

from jax import lax
from jaxtyping import Array, Bool, PRNGKeyArray

from qfolio.agents.on_policy import Batch, OnPolicy, OnPolicyState, PolicyAndValue
from qfolio.core.errors import QfolioError
from qfolio.core.fields import static
from qfolio.core.mdp import Task, Transition
from qfolio.core.training import episode_steps


class REINFORCE(OnPolicy):
    """REINFORCE with a learned baseline."""

    rollout_length: int = static(0)  # steps learned from at once: whole episodes; 0: one of them

    least_length = 0

    @property
    def rollout_steps(self) -> int:
        return self.rollout_length or 1  # not fitted to a task yet

    def fitted(self, task: Task) -> "REINFORCE":
        if self.rollout_length:
            return self
        return dataclasses.replace(self, rollout_length=episode_steps(task, self))

    def init(self, task: Task, key: PRNGKeyArray) -> OnPolicyState:
        episode = episode_steps(task, self)
        if self.rollout_length % episode:
            raise QfolioError(
                f"rollout_length is {self.rollout_length}; it must be a multiple of the {episode} "
                "steps of an episode (episode_steps, or the task's horizon)."
            )
        return super().init(task, key)

    def judge(self, task: Task, weights: PolicyAndValue, rollout: Transition) -> Batch:
        batch = super().judge(task, weights, rollout)
        return batch._replace(counted=finished(rollout).reshape(-1))


def finished(rollout: Transition) -> Bool[Array, "time environment"]:
    """Whether the episode of each step ends within the rollout."""
    ends = (rollout.terminated | rollout.truncated).astype(int)
    return lax.cummax(ends, axis=0, reverse=True).astype(bool)
