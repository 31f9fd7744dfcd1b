"""A backtest whose agent observes a signal of your own and pays costs of your own, see parts.py."""

import numpy as np
import pandas as pd

import qfolio

import parts  # noqa: F401 - names of a module that has not been imported are refused


def trending_market(rows=1800, assets=6, seed=0):
    """Prices of assets whose drifts wander, so that trends last."""
    rng = np.random.default_rng(seed)
    drift = np.cumsum(rng.normal(0, 3e-5, (rows, assets)), 0)
    noise = rng.normal(2e-4, 0.01, drift.shape)
    prices = 100 * np.exp(np.cumsum(drift - drift.mean(1, keepdims=True) + noise, 0))
    return pd.DataFrame(prices, pd.bdate_range("2018-01-01", periods=rows), list("ABCDEF"))


preset = qfolio.preset("fast", "portfolio", "tilts")
own = preset._replace(task=preset.task | {"signals": "parts:Trend:60"})
backtest = qfolio.Backtest.create(
    qfolio.load_prices(trending_market()), {"tilts": own},
    cost_model="parts:PerOrder", train="4y", test="1y", seeds=2,
)  # fmt: skip
backtest.run()
strategies = backtest.assess(backtest.entries()[0]).strategies
for name in ("tilts-together", "equal-weight"):
    growth, drag = (strategies[name].measures[key].mean for key in ("growth", "cost_drag"))
    print(f"{name:15} {growth:7.2%} a year, after {drag:.2%} of costs")
