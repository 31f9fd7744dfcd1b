"""Advantage actor-critic (Mnih et al. 2016, in its synchronous form, A2C).

After a few steps of all environments, the policy takes one step along the gradient of its actions'
log probabilities times their advantages, and the critic takes one towards the returns.
docs/algorithms/policy_gradients.md has the formulas and the deviations from the paper.
"""

from qfolio.agents.on_policy import OnPolicy
from qfolio.core.fields import number, require, static


class A2C(OnPolicy):
    """Advantage actor-critic."""

    rollout_length: int = static(5)
    gae_lambda: float = number(1.0)  # λ of the advantages: 0 trusts the critic, 1 the rewards
    learning_rate: float = number(7e-4)  # step size at the start
    normalize_advantages: bool = static(False)

    def __check_init__(self) -> None:
        require(self, "gae_lambda", lambda x: 0 <= x <= 1, "between 0 and 1")
