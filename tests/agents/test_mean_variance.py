"""Learned mean and variance: lags that fit the market, and weights that may be held."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.agents.mean_variance import MeanVariance, MinimumVariance, best
from qfolio.core.errors import QfolioError
from qfolio.core.market import View
from qfolio.core.mdp import Simplex
from qfolio.core.population import Population
from qfolio.core.training import begin, play
from qfolio.portfolio.task import Portfolio
from qfolio.tasks.pendulum import Pendulum

from populations import train_to
from tables import price_table

SMALL: dict[str, Any] = {
    "num_envs": 8,
    "rollout_length": 42,
    "head": 7,
    "learning_rate_steps": 40.0,
}
TASK: dict[str, Any] = {"window": 126, "horizon": 42, "anchor": "equal-weight"}


def prices(moves):
    return price_table(np.exp(np.cumsum(moves, 0)))


def trained(*tables, task=None, rounds=40, agent=MinimumVariance, **settings):
    """The tasks of some tables, and the states of agents trained on them."""
    tasks = [Portfolio.of(prices(moves), **TASK, **(task or {})) for moves in tables]
    population = Population(tasks, agent(**{**SMALL, **settings}), range(len(tables)))
    train_to(population, rounds * SMALL["rollout_length"])
    states = jax.tree.map(jnp.asarray, population.fetch().agent)
    pick = lambda i: jax.tree.map(lambda x: x[i], states)  # noqa: E731
    return tasks, [pick(i) for i in range(len(tables))]


def changing(rows=2000, assets=6, block=40):
    """Volatilities that are drawn anew every ``block`` rows."""
    rng = np.random.default_rng(0)
    levels = np.repeat(rng.uniform(0.003, 0.03, (rows // block, assets)), block, 0)
    return rng.normal(0, 1, levels.shape) * levels


def test_learns_shorter_half_lives_where_volatility_changes():
    calm = np.random.default_rng(0).normal(0, 0.01, (2000, 6))
    (market, _), (state, steady) = trained(changing(), calm, task={"cost": 0.0}, learning_rate=0.1)
    found, other = (one.policy.learned.covariance.described for one in (state, steady))
    assert found["volatility_half_life"] < 30 < other["volatility_half_life"]
    assert state.policy.trading.described["rate"] > 2 * steady.policy.trading.described["rate"]

    def realized(policy):
        rows = jnp.arange(500, 1900)
        views = jax.vmap(lambda row: market.view(row, market.hold(jnp.append(1.0, jnp.zeros(6)))))(
            rows
        )
        weights = policy.target(views)[:, 1:]
        earned = (weights * jnp.expm1(jax.vmap(market.coming)(rows + 1))).sum(-1)
        return float(earned.std())

    started = eqx.tree_at(lambda policy: policy.learned, state.policy, state.start)
    assert realized(state.policy) < 0.95 * realized(started)


def test_expected_returns_are_learned_only_where_there_is_momentum():
    rng = np.random.default_rng(1)
    drift = np.repeat(rng.normal(0, 0.004, (20, 6)), 100, axis=0)
    noise = rng.normal(0, 0.01, (4, 2000, 6))
    _, (found, *nothing) = trained(noise[0] + drift, *noise[1:], agent=MeanVariance)
    assert found.policy.learned.members.means.coefficients.sum(1).mean() > 0.5
    assert found.policy.share > 0.5
    assert [float(state.policy.share) for state in nothing].count(0.0) >= 2


def test_a_step_is_evidence_from_the_one_member_that_does_not_learn_from_it():
    """If all members expect the same returns, it does not matter how many there are."""
    task = Portfolio.of(prices(np.random.default_rng(1).normal(0, 0.01, (300, 3))), **TASK)
    found = []
    for count in (2, 4):
        agent = MeanVariance(**SMALL, members=count)
        start = begin(task, agent, jnp.uint32(0))
        where = lambda s: s.agent.policy.learned.members.means.coefficients  # noqa: E731
        start = eqx.tree_at(where, start, jnp.full((count, 4), 0.1))

        @jax.jit
        def learned(start, agent=agent):
            state, rollout = play(task, agent, start)
            return agent.learn(task, state.agent, rollout, jax.random.key(0))[0]

        state = learned(start)
        found.append(state.evidence)
        means = state.policy.learned.members.means.coefficients
        assert len(np.unique(means, axis=0)) == count  # of other blocks each
    assert abs(found[0].total).max() > 1e-6
    for one, other in zip(*found, strict=True):  # up to the rounding of the largest
        np.testing.assert_allclose(other, one, rtol=1e-4, atol=2e-5 * float(abs(one).max()))


def test_without_evidence_it_is_the_least_variance():
    market, held = Portfolio.of(prices(changing()), **TASK), jnp.full(7, 1 / 7)
    policy = MeanVariance(**SMALL).init(market, jax.random.key(0)).policy
    least = MinimumVariance(**SMALL).init(market, jax.random.key(0)).policy
    members = jax.tree.map(lambda x: x + 0.3, policy.learned.members)
    policy = eqx.tree_at(lambda one: one.learned.members, policy, members)
    view = market.view(jnp.array(500), market.hold(held))
    np.testing.assert_array_equal(policy(view), least(view))
    full = eqx.tree_at(lambda one: one.share, policy, jnp.array(1.0))
    assert abs(full(view) - least(view)).max() > 0.01


def test_members_order_nothing_that_opened_since_the_covariance_was_estimated():
    """Then it has almost no variance; without expected returns all hold the least variance."""
    moves = np.random.default_rng(0).normal(0, 0.01, (170, 6)) * [1, 1, 1, 1, 1, 20]
    members = np.ones(moves.shape, bool)
    members[:150, -1] = False  # an episode begins at row 126; estimates are from rows 147 and 154
    table = price_table(np.exp(np.cumsum(moves, 0)), members=members)
    population = Population(Portfolio.of(table, **TASK), MeanVariance(**SMALL), [0])
    evidence = train_to(population, 42).fetch().agent.evidence
    assert evidence.steps.sum() > 0
    np.testing.assert_allclose(evidence.total, 0.0, atol=1e-5)


@pytest.mark.parametrize("agent", [MinimumVariance, MeanVariance])
def test_an_asset_that_has_just_been_listed_gets_no_more_than_its_share(agent):
    values = np.exp(np.cumsum(np.random.default_rng(0).normal(0, 0.01, (400, 6)), 0))
    values[:200, -1] = np.nan
    table = price_table(values, members=np.ones(values.shape, bool))
    market, held = Portfolio.of(table, **TASK), jnp.eye(7)[0]
    policy = agent(**SMALL).init(market, jax.random.key(0)).policy
    members = jax.tree.map(lambda x: x + 0.1, policy.learned.members)
    policy = eqx.tree_at(lambda one: (one.learned.members, one.share), policy,
                         (members, jnp.array(1.0)), is_leaf=lambda x: x is None)  # fmt: skip
    rows = 200 + jnp.array([0, 1, 5, 21, 63])
    views = jax.vmap(lambda row: market.view(row, market.hold(held)))(rows)
    assert policy.target(views)[:, -1].max() < 0.3


def test_cap_and_assets_that_cannot_be_traded():
    market = Portfolio.of(prices(changing()), **TASK, max_weight=0.3)
    market = market.part(0, 1000, np.array([True] * 5 + [False]))
    agent = MinimumVariance(**SMALL)
    policy = agent.init(market, jax.random.key(0)).policy
    weights = policy.target(market.observe(market.reset(jax.random.key(1))))
    np.testing.assert_allclose(weights.sum(), 1, atol=1e-5)
    assert weights[1:].max() <= 0.3 + 1e-6
    assert weights[-1] == 0


def test_the_cap_is_one_of_weights_whatever_the_anchor_invests():
    sigma = jnp.diag(jnp.array([0.001, 1.0, 1.0, 1.0, 1.0]))
    for invested, most in ((1.0, 0.3), (0.5, 0.3), (0.2, 0.2), (0.0, 0.0)):
        view = View(jnp.zeros((5, 1, 1)), jnp.zeros(5), jnp.full(5, invested / 5))
        weights = best(view, sigma, None, Simplex(5, 0.3))
        others = [(invested - most) / 4] * 4
        np.testing.assert_allclose(weights, [1 - invested, most, *others], atol=0.01 * invested)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"every": 5}, "divisor"),
        ({"head": 42}, "head"),
        ({"head": 0}, "head is 0; it must be at least 1"),
        ({"risk_aversion": 0.0}, "risk_aversion"),
        ({"ridge": -1.0}, "ridge"),
        ({"units": 0}, "units"),
        ({"num_envs": 2**31}, "must be from 1 to 2147483647"),
        ({"members": 33}, "from 2 to the number of blocks, 32"),
    ],
)
def test_settings_out_of_range_are_named(settings, says):
    with pytest.raises(QfolioError, match=says):
        MinimumVariance(**{**SMALL, **settings})


def test_needs_a_portfolio_with_an_anchor():
    with pytest.raises(QfolioError, match="anchor"):
        MinimumVariance(**SMALL).init(Pendulum(), jax.random.key(0))
    market = Portfolio.of(prices(changing()), window=126, horizon=42)
    with pytest.raises(QfolioError, match="anchor=equal-weight"):
        MinimumVariance(**SMALL).init(market, jax.random.key(0))
    menu = Portfolio.of(prices(changing()), **TASK, menu="grid:2")
    with pytest.raises(QfolioError, match="menu"):
        MinimumVariance(**SMALL).init(menu, jax.random.key(0))
