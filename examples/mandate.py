"""A mandate and a benchmark: every order of a backtest obeys the one and is judged by the other."""

import numpy as np
import pandas as pd

import qfolio

MANDATE = {
    "assets": {"cap": 0.35, "floor": {"Bonds": 0.1}, "forbidden": ["Crypto"]},
    "cash": {"max": 0.05},
    "trading": {"calendar": "monthly"},
    "costs": {"cost": 0.0005},
}


def market(rows=1800, seed=0):
    """Five random walks around one market."""
    rng = np.random.default_rng(seed)
    volatility = np.array([0.010, 0.012, 0.014, 0.003, 0.040])
    moves = rng.normal(2e-4, 0.006, (rows, 1)) + rng.normal(0, volatility, (rows, 5))
    names = ["USA", "Europe", "Asia", "Bonds", "Crypto"]
    days = pd.bdate_range("2018-01-01", periods=rows)
    return pd.DataFrame(100 * np.exp(np.cumsum(moves, 0)), days, names)


preset = qfolio.preset("fast", "portfolio", "tilts")
agents = {"tilts": preset._replace(episodes=preset.episodes // 8)}  # to be quick
backtest = qfolio.Backtest.create(
    qfolio.load_prices(market()), agents, mandate=MANDATE, benchmark="USA", train="4y", test="3y",
    seeds=2, baselines=["equal-weight", "minimum-variance"],
)  # fmt: skip
backtest.run()

entry = backtest.entries()[0]
for name, strategy in backtest.assess(entry).strategies.items():
    measures = strategy.measures
    growth, drawdown = measures["growth"].mean, measures["drawdown"].mean
    print(f"{name:25} {growth:7.2%} a year, drawdown {drawdown:6.1%}")
print({name: round(w, 3) for name, w in backtest.policy().weights(market()).items()})
