"""What a policy is told that it holds, against the replay in double precision."""

import sys

import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.agents.pathwise import Pathwise
from qfolio.core.errors import QfolioError
from qfolio.core.population import Population
from qfolio.portfolio.backtest.simulation import simulate
from qfolio.portfolio.costs import Proportional, with_cash
from qfolio.portfolio.following import begin, follow, on_table
from qfolio.portfolio.mandate.feasible import exactly
from qfolio.portfolio.policy import Policy
from qfolio.portfolio.task import Portfolio

from tables import price_table, random_walk

ROWS, LAG = 40, 3


@pytest.fixture(scope="module")
def prices():
    return price_table(random_walk(ROWS, volatility=0.02))


@pytest.fixture(scope="module")
def policy(prices):
    """Undertrained: what it decides depends on what it holds."""
    task = Portfolio.of(prices, window=5, horizon=10, lag=LAG)
    agent = Pathwise(rollout_length=10, num_envs=2, hidden=(4, 4), learning_rate=0.1)
    population = Population(task, agent, [0, 1])
    population.advance(10)
    return Policy(task, agent, population.weights(), prices.assets)


def test_holdings_are_those_of_the_replay_up_to_the_last_row(policy, prices):
    """Orders that are carried out a row later lie, by then, where prices have moved them."""
    first, held = ROWS - 12, np.array([0.4, 0.3, 0.2, 0.1])
    targets, after = policy.decide(prices, first, held, 12)
    replay = simulate(prices.values, targets[:10], first=first, cost=0.0, lag=1)
    np.testing.assert_allclose(after[:10], replay.weights, atol=1e-6)
    moved = np.append(1, prices.values[-1] / prices.values[-2])
    np.testing.assert_allclose(after[10], targets[10] * moved / (targets[10] @ moved), atol=1e-6)
    # Nothing is known to move behind the last row.
    np.testing.assert_allclose(after[11], targets[11], atol=1e-6)
    # What is held decides what is ordered: from where the replay is, the policy decides the same.
    again, _ = policy.decide(prices, ROWS - 3, replay.weights[-2], 3)
    np.testing.assert_allclose(again, targets[-3:], atol=1e-6)


class Diverged(Pathwise):
    def policy(self, weights, observation):
        return super().policy(weights, observation).at[:, 1].set(jnp.nan)


def test_targets_that_are_not_numbers_are_no_silent_holding(policy, prices):
    task = on_table(policy.task, prices)
    agent = Diverged(rollout_length=10, num_envs=2, hidden=(4, 4))
    with pytest.raises(
        QfolioError, match=r"Diverged gives target weights at row 30 .* off 1 by nan"
    ):
        follow(task, agent, policy.members, 30, begin(task, np.eye(4)[:2]), 2)


class Wants(Pathwise):
    """Wants the same weights at each row."""

    wish: tuple[float, ...] = (0.1, 0.6, 0.3, 0.0)

    def policy(self, weights, observation):
        return jnp.broadcast_to(jnp.array(self.wish), super().policy(weights, observation).shape)


def test_orders_are_the_nearest_under_limits_on_risk(policy, prices):
    """Training may stop at an order that is only near them."""
    agent = Wants(rollout_length=10, num_envs=2, hidden=(4, 4))
    mandate = {"risk": {"volatility": 0.2, "tracking_error": 0.1}, "assets": {"cap": 0.5}}
    task = Portfolio.of(prices, mandate=mandate, window=5, horizon=10)
    targets, _ = follow(task, agent, policy.members, 30, begin(task, np.eye(4)[:2]), 8)
    wanted = np.array(agent.wish)
    nearest = [exactly(task.feasible_at(jnp.array(row)), wanted, wanted) for row in range(30, 38)]
    # Near the nearest point, distances hardly change.
    np.testing.assert_allclose(targets[0], nearest, atol=1e-3)
    assert np.abs(targets[0] - wanted).max(-1).min() > 0.05


class Dividend(Proportional):
    share = 0.0

    def carry(self, relatives, context):
        return with_cash(relatives * (1 + self.share))


def test_a_cost_model_that_is_defined_again_is_the_one_that_is_followed(monkeypatch):
    """By a backtest and by its replays, which share the programs of equal settings, too."""
    prices = price_table(random_walk(20, volatility=0.0))
    task = Portfolio.of(prices, window=5, horizon=5, cost_model=f"{__name__}:Dividend")
    agent = Pathwise(hidden=(2, 2), num_envs=1, rollout_length=5)
    members = Population(task, agent, [0]).weights()

    def cash_later():
        targets, held = follow(task, agent, members, 10, begin(task, [[0.5, 0.5, 0.0, 0.0]]), 1)
        return float(held.weights[0, 0, 0] / targets[0, 0, 0])

    assert cash_later() == pytest.approx(1)
    again = type("Dividend", (Dividend,), {"share": 1.0})
    monkeypatch.setattr(sys.modules[__name__], "Dividend", again)
    assert cash_later() < 0.9
