"""What drives the trades of a policy that is known."""

import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.portfolio.allocation import Allocation
from qfolio.portfolio.backtest.attribution.drivers import reasons, sentence
from qfolio.portfolio.policy import Policy

from planted import ASSETS, Known, four_folds, planted


@pytest.fixture(scope="module")
def plan():
    prices = planted()
    stretch = four_folds(prices)[-1]
    policy = Policy(stretch.task, Known("momentum"), jnp.array([0.4, 0.6]), prices.assets)
    allocation = Allocation.of(policy, prices, np.zeros(ASSETS), 1000.0)
    return allocation, reasons(policy, prices, allocation)


def test_the_largest_trades_are_explained_exactly(plan):
    """From cash to equal weights, tilted by half of the rank of momentum."""
    allocation, found = plan
    changes = dict(zip(allocation.assets, allocation.weights[1:], strict=True))
    assert [reason.change for reason in found] == sorted(changes.values(), reverse=True)[:3]
    for reason in found:
        assert reason.change == changes[reason.asset]
        first, *others = reason.drivers
        assert first.name == "momentum:20"
        assert reason.rest == pytest.approx(1 / ASSETS, abs=1e-6)
        assert first.weight == pytest.approx(reason.change - 1 / ASSETS, abs=1e-6)
        assert [each.weight for each in others] == [0, 0, 0]
    best = found[0]
    assert best.drivers[0].weight == pytest.approx(0.5 / ASSETS, abs=1e-6)
    assert sentence(best).startswith(f"{best.asset} +25.00%: momentum:20 +8.33%, ")
    assert sentence(best).endswith("on a typical day it would be +16.67%.")
