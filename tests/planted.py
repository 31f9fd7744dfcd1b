"""A market with planted momentum, and agents whose drivers are known."""

import jax.numpy as jnp
import numpy as np

from qfolio.core.fields import static
from qfolio.core.mdp import Agent
from qfolio.portfolio.backtest.folds import walk_forward
from qfolio.portfolio.backtest.replay import Stretch
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio

from tables import days, price_table

ASSETS = 6
SIGNALS = "momentum:20,reversal:3,market-volatility:20"
NAMES = ["log return", *SIGNALS.split(",")]


class Known(Agent):
    """Its weights are the coefficient of a rule, not learned."""

    rule: str = static("momentum")
    num_envs: int = static(1)
    episode_steps: int = static(0)

    discount = None

    def init(self, task, key):
        return jnp.array(0.5)

    def act(self, state, observation, key):
        return self.policy(state, observation)

    def learn(self, task, state, rollout, key):
        return state, {}

    def weights(self, state):
        return state

    def policy(self, weights, observation):
        latest, held = observation.features[:, :, -1], observation.holding
        equal = jnp.full_like(held, 1 / held.shape[-1])
        if self.rule == "momentum":
            assets = equal * (1 + weights * latest[..., 1])
        elif self.rule == "market":  # half of the wealth when volatility is high
            assets = equal * jnp.where(latest[..., 3] > -5.5, 0.5, 1.0)
        elif self.rule == "band":
            assets = jnp.clip(held, 0.1 * (1 + weights * latest[..., 1]), 0.16)
        else:
            assets = equal * (0.5 if self.rule == "constant" else 0.0)
        return jnp.concatenate([1 - assets.sum(-1, keepdims=True), assets], -1)


def planted(rows=800, seed=2):
    """Prices whose assets go on as they went over the last 20 rows."""
    rng = np.random.default_rng(seed)
    logs = np.zeros((rows, ASSETS))
    logs[0] = np.log(50)
    for t in range(1, rows):
        went = logs[t - 1] - logs[max(0, t - 21)]
        ranks = 2 * went.argsort().argsort() / (ASSETS - 1) - 1
        calm = 0.007 if t // 60 % 2 else 0.015
        logs[t] = logs[t - 1] + 0.003 * ranks + calm * rng.normal(size=ASSETS)
    return price_table(np.exp(logs), dates=days(rows, "2001-01-01"))


def with_a_delisted_asset(prices, rows=100):
    """The prices and a seventh asset, which is delisted after some rows."""
    rng = np.random.default_rng(0)
    own = 50 * np.exp(rng.normal(0, 0.02, len(prices)).cumsum())
    own[rows:] = own[rows - 1]
    values = np.concatenate([prices.values, own[:, None]], 1)
    listed = np.ones(values.shape, bool)
    listed[rows:, -1] = False
    return Prices(prices.dates, (*prices.assets, "G"), values, listed=listed)


def persistent(rows=700, assets=6, seed=0, market=0.0):
    """Prices whose relative returns persist for a while; the market adds noise to all of them."""
    rng = np.random.default_rng(seed)
    drift = np.zeros((rows, assets))
    for row in range(1, rows):
        drift[row] = 0.95 * drift[row - 1] + rng.normal(0, 0.001, assets)
    moves = drift + rng.normal(0, 0.005, drift.shape) + market * rng.normal(size=(rows, 1))
    return price_table(50 * np.exp(moves.cumsum(0)), "abcdef")


def four_folds(prices, **changed):
    """Four folds with two seeds, whose rules have coefficients 0.4 and 0.6."""
    settings = {"signals": SIGNALS, "window": 2, "horizon": 20, "cost": 0.0005, **changed}
    task = Portfolio.of(prices, **settings)
    folds = walk_forward(prices.dates, "200d", "150d", 1)
    plain = {"center": jnp.zeros_like(task.center), "scale": jnp.ones_like(task.scale)}
    parts = (task.part(fold.train.start, fold.train.stop - 1) for fold in folds)
    return [
        Stretch(part.having(**plain), jnp.array([0.4, 0.6]), fold)
        for part, fold in zip(parts, folds, strict=True)
    ]
