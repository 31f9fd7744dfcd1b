"""From a price table to orders: check it, backtest an agent, and trade what it wants now."""

import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

import qfolio
from qfolio.portfolio.desk.allocation import Allocation


def momentum_market(years=8, assets=8, seed=0):
    """Prices of assets whose drifts change slowly, so that past winners go on winning."""
    rng, rows = np.random.default_rng(seed), 252 * years
    drift = np.zeros((rows, assets))
    for row in range(1, rows):
        drift[row] = 0.99 * drift[row - 1] + rng.normal(0, 1.5e-4, assets)
    prices = 100 * np.exp(np.cumsum(drift + rng.normal(2e-4, 0.01, drift.shape), 0))
    days = pd.bdate_range(end="2024-12-31", periods=rows)
    return pd.DataFrame(prices, days, [f"Fund {letter}" for letter in "ABCDEFGH"[:assets]])


with tempfile.TemporaryDirectory() as folder:
    file = Path(folder, "prices.csv")
    momentum_market().to_csv(file, index_label="date")
    prices = qfolio.load_prices(file)

agents = {"tilts": qfolio.preset("fast", "portfolio", "tilts")}
backtest = qfolio.Backtest.create(prices, agents, train="4y", test="2y", seeds=2)
backtest.run()

strategies = backtest.assess(backtest.entries()[0]).strategies
for name in ("tilts-together", "equal-weight", "momentum"):
    measures = strategies[name].measures
    growth, sharpe = measures["growth"].mean, measures["sharpe"].mean
    print(f"{name:15} {growth:7.2%} a year, Sharpe ratio {sharpe:.2f}")

held = np.zeros(len(prices.assets))  # shares; all of the wealth is cash
order = Allocation.of(backtest.policy(), prices, held, cash=1e6, whole_shares=True)
print(f"Orders for {order.wealth:,.0f}, which cost {order.cost:,.0f}:")
for asset, shares in zip(prices.assets, order.trades, strict=True):
    print(f"  {asset} {shares:+7,.0f}")
