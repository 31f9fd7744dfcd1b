"""A strategy of the desk whose weights are known."""

import numpy as np


class Fixed:
    """Wants the same weights whatever it sees; cash comes first."""

    def __init__(self, wanted, costs, mandate=""):
        self.wanted, self.costs, self.mandate = wanted, costs, mandate

    def weights(self, prices, holdings=None, *, spent=0.0):
        names = ("cash", *prices.assets)
        return dict(zip(names, np.asarray(self.wanted, float).tolist(), strict=True))
