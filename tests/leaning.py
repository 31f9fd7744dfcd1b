"""An agent with a field that no folder can hold."""

import equinox as eqx
import numpy as np

from qfolio.agents.pathwise import Pathwise


class Leaning(Pathwise):
    """Leans towards some weights of cash and three assets, which are no setting."""

    towards: np.ndarray = eqx.field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))

    def policy(self, weights, observation):
        return 0.5 * super().policy(weights, observation) + 0.5 * self.towards
