"""What drives the trades of a policy that is known."""

import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.portfolio.backtest.attribution.drivers import Driver, Reason, reasons, sentence
from qfolio.portfolio.desk.allocation import Allocation
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
    assert sentence(best) == (
        f"{best.asset} +25.00%: momentum:20 +8.33%; on a typical day it would be +16.67%."
    )
    many = Reason("A", 0.1, [Driver(name, 0.02) for name in "abcde"], 0.0)
    assert "a +2.00%, b +2.00%, c +2.00%, other signals +4.00%;" in sentence(many)
    none = Reason("A", 0.1, [Driver("a", 1e-6)], 0.1)
    assert (
        sentence(none) == "A +10.00%: no signal moves it, so that it is the same on a typical day."
    )
