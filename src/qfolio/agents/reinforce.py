"""REINFORCE with a learned baseline (Williams 1992).

Whole episodes are played; then the policy takes one step along the gradient of its actions' log
probabilities, each times the return that followed it less the baseline. No reward is replaced by an
estimate, except that of what a time limit cuts off. docs/policy_gradients.md has the formulas and
the deviations from the paper.
"""

from jaxtyping import Array, Float, PRNGKeyArray

from qfolio.agents.on_policy import Batch, OnPolicy, OnPolicyState, normalised
from qfolio.core.errors import QfolioError
from qfolio.core.fields import static
from qfolio.core.mdp import Metrics, Task, Transition


class REINFORCE(OnPolicy):
    """REINFORCE with a learned baseline."""

    rollout_length: int = static(200)  # whole episodes

    def init(self, task: Task, key: PRNGKeyArray) -> OnPolicyState:
        episode = min(self.episode_steps or task.horizon, task.horizon)
        if self.rollout_length % episode:
            raise QfolioError(
                f"rollout_length is {self.rollout_length}; it must be a multiple of the {episode} "
                "steps of an episode (episode_steps, or the task's horizon)."
            )
        return super().init(task, key)

    def objective(self, log_prob: Float[Array, " batch"], batch: Batch) -> Float[Array, " batch"]:
        return log_prob * normalised(batch.advantage)

    def learn(
        self, task: Task, state: OnPolicyState, rollout: Transition, key: PRNGKeyArray
    ) -> tuple[OnPolicyState, Metrics]:
        return self.descend(state, self.judge(state.weights, rollout, gae_lambda=1.0))
