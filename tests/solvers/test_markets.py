"""Exact optima of the synthetic markets: known figures, independent ways to the same numbers."""

import itertools
import math

import numpy as np
import pytest

from optima import lognormal_scenarios, merton, no_trade_growth, regime
from qfolio.core.errors import QfolioError
from qfolio.solvers.ar1 import Ar1Optimum, ar1
from qfolio.solvers.kelly import kelly
from qfolio.solvers.merton import growth_optimal
from qfolio.solvers.no_trade import no_trade_region, no_trade_region_discrete
from qfolio.solvers.regime import regime_bands
from qfolio.solvers.shared import gauss, log_remainder

# ------------------------------------------------------------------------ Kelly, growth, Merton


@pytest.mark.parametrize(
    ("bet", "fraction", "growth"),
    [
        ((1.1, 0.9, 0.53), 0.6, 0.00180108),
        ((2.0, 0.5, 0.5), 0.5, 0.0588915),
        ((2.0, 0.0, 0.75), 0.5, math.log(1.5) * 0.75 + math.log(0.5) * 0.25),
        ((2.0, 0.0, 1.0), 1.0, math.log(2.0)),  # certain: all of it, and 0·log 0 is 0
        ((1.1, 0.9, 0.5), 0.0, 0.0),
        ((2.0, 0.9, 0.5), 1.0, math.log(2 * 0.9) / 2),  # would borrow
    ],
)
def test_kelly(bet: tuple[float, float, float], fraction: float, growth: float) -> None:
    found = kelly(*bet)
    assert found == pytest.approx((fraction, growth), abs=5e-8)
    up, down, p = bet
    grid = np.linspace(0, 0.999, 1000)
    tried = p * np.log(1 + grid * (up - 1)) + (1 - p) * np.log(1 + grid * (down - 1))
    assert tried.max() <= found[1] + 1e-12


def test_growth_optimum_of_a_two_point_bet_is_kellys() -> None:
    fraction, growth = kelly(1.1, 0.9, 0.53)
    optimum = growth_optimal(np.array([[1, 1.1], [1, 0.9]]), [0.53, 0.47])
    assert optimum.weights == pytest.approx([1 - fraction, fraction], abs=1e-12)
    assert optimum.growth == pytest.approx(growth, abs=1e-15)


def test_growth_optimum_of_covers_example() -> None:
    # Cash and a stock that doubles and halves: half in each grows by √(9/8) a step.
    optimum = growth_optimal(np.array([[1, 2], [1, 0.5]] * 2))
    assert optimum.weights == pytest.approx([0.5, 0.5], abs=1e-12)
    assert math.exp(optimum.growth) == pytest.approx(math.sqrt(9 / 8))


@pytest.mark.parametrize("shape", [(1, 1), (2, 5), (200, 3), (500, 30), (20, 60)])
@pytest.mark.parametrize("scale", [0.02, 0.5, 3.0, 60.0])
def test_growth_optimum_is_certified(shape: tuple[int, int], scale: float) -> None:
    rng = np.random.default_rng(1)
    x = np.exp(rng.normal(0, scale, shape) + rng.normal(0, scale, (shape[0], 1)))
    p = rng.dirichlet(np.ones(shape[0]))
    weights, growth, violation = growth_optimal(x, p)
    assert weights.min() >= 0
    assert weights.sum() == pytest.approx(1, abs=1e-12)
    slope = (p / (x @ weights)) @ x
    assert slope.max() <= 1 + 1e-9
    assert slope[weights > 0] == pytest.approx(1, abs=1e-9)
    assert violation <= 1e-9
    others = rng.dirichlet(np.full(shape[1], 0.3), 2000)
    assert (np.log(x @ others.T).T @ p).max() <= growth + 1e-9


def test_growth_optimum_matches_a_fine_grid() -> None:
    x = np.exp(np.random.default_rng(7).normal(0.0005, 0.02, (250, 2)))
    x = np.column_stack([np.ones(250), x])
    grid = np.array([(i, j) for i in range(201) for j in range(201 - i)]) / 200
    tried = np.log(x @ np.column_stack([1 - grid.sum(1), grid]).T).mean(0)
    weights, growth, _ = growth_optimal(x)
    assert tried.max() <= growth < tried.max() + 1e-6
    assert weights[1:] == pytest.approx(grid[tried.argmax()], abs=0.005)


def test_growth_optimum_with_repeated_and_useless_assets() -> None:
    x = np.array([[1, 2, 2, 0.9], [1, 0.5, 0.5, 0.9]])
    weights, growth, _ = growth_optimal(x)
    assert growth == pytest.approx(math.log(9 / 8) / 2)
    assert weights[0] == pytest.approx(0.5)
    assert weights[1] + weights[2] == pytest.approx(0.5)
    assert weights[3] == 0
    # Ruin is avoided without being told: an asset that can become worthless is never all there is.
    assert growth_optimal([[1, 3], [1, 0]]).weights == pytest.approx([0.75, 0.25])
    # Arrow securities: bet the probabilities.
    assert growth_optimal(np.eye(3), [0.2, 0.3, 0.5]).weights == pytest.approx([0.2, 0.3, 0.5])


def test_growth_optimum_of_hostile_scenarios() -> None:
    rng = np.random.default_rng(5)
    for _ in range(150):
        x = np.exp(rng.normal(0, rng.choice([1e-4, 1, 60]), rng.integers(1, (60, 25))))
        x *= rng.random(x.shape) < 0.8
        x = np.column_stack([x, x[:, 0], np.ones(len(x))])
        assert growth_optimal(x).violation <= 1e-9


def test_merton() -> None:
    assert merton([0.02], [[0.04]]) == pytest.approx([0.5])
    # Two assets with correlation ½: Σ⁻¹ = [[100/3, −50/3], [−50/3, 100/3]].
    weights = merton([0.05, 0.04], [[0.04, 0.02], [0.02, 0.04]], risk_aversion=2, rate=0.01)
    assert weights == pytest.approx([5 / 12, 1 / 6])


def test_growth_optimum_of_small_steps_is_mertons() -> None:
    drift, covariance = np.array([0.02, 0.015]), np.array([[0.04, 0.01], [0.01, 0.05]])
    goal = merton(drift, covariance)
    distances = []
    for dt in (1 / 2, 1 / 8, 1 / 32):
        relatives, chances = lognormal_scenarios(drift, covariance, dt)
        assert chances @ relatives[:, 1:] == pytest.approx(np.exp(drift * dt), abs=1e-12)
        distances.append(np.abs(growth_optimal(relatives, chances).weights[1:] - goal).max())
    assert distances[2] < 1e-4
    assert distances[0] / distances[1] == pytest.approx(4, rel=0.1)  # of first order in dt


# ------------------------------------------------------------------------------------- regimes


def enumerated_gain(stay: np.ndarray, means: np.ndarray, cost: float) -> float:
    """The best of all 16 policies, by the long-run frequencies of its four states."""
    change = np.array([[stay[0], 1 - stay[0]], [1 - stay[1], stay[1]]])
    best = -math.inf
    for policy in itertools.product((0, 1), repeat=4):
        chain, earned = np.zeros((4, 4)), np.zeros(4)
        for s, position in itertools.product((0, 1), repeat=2):
            i, chosen = 2 * s + position, policy[2 * s + position]
            earned[i] = chosen * means[s] - cost * (chosen != position)
            chain[i, chosen::2] = change[s]
        power = np.linalg.matrix_power((chain + np.eye(4)) / 2, 2**20)
        best = max(best, (power @ earned).max())
    return float(best)


def test_regime_figures() -> None:
    cheap = regime((0.95, 0.95), (0.002, -0.002), -math.log(1 - 0.005))
    assert cheap.gain == pytest.approx(7.4937e-4, abs=5e-9)
    assert cheap.policy.tolist() == [[1, 1], [0, 0]]  # follow
    dear = regime((0.95, 0.95), (0.002, -0.002), -math.log(1 - 0.03))
    assert dear.gain == 0
    assert dear.policy[:, 0].tolist() == [0, 0]  # never enter


def test_regime_agrees_with_all_policies() -> None:
    rng = np.random.default_rng(3)
    seen = set()
    for _ in range(60):
        stay, means = rng.uniform(0, 1, 2), rng.normal(0, 0.01, 2)
        cost = rng.exponential(0.01)
        optimum = regime(stay, means, cost)
        assert optimum.gain == pytest.approx(enumerated_gain(stay, means, cost), abs=1e-12)
        seen.add(tuple(optimum.policy.ravel().tolist()))
    assert len(seen) >= 5  # enter, leave or keep, in either regime


def test_regime_limits() -> None:
    stay, means = (0.9, 0.8), (-0.003, 0.004)
    free = regime(stay, means, 0.0)
    assert free.policy.tolist() == [[0, 0], [1, 1]]
    assert free.gain == pytest.approx(0.004 / 3)  # a third of the time in the second regime
    never = regime(stay, means, 100.0)
    assert never.gain == 0
    assert never.policy[:, 0].tolist() == [0, 0]
    # With a mean above 0 overall, one purchase pays off in the long run at any cost.
    assert regime(stay, (0.0, 0.004), 100.0).gain == pytest.approx(0.004 / 3)


def test_bands_of_regimes_are_all_in_and_out_where_switching_pays() -> None:
    """Where it does not, weights between are better than any of the two positions."""
    rng = np.random.default_rng(4)
    for _ in range(10):
        stay, mean = rng.uniform(0.5, 0.98, 2), rng.uniform(0.005, 0.02)
        bands = regime_bands(stay, (-mean, mean), 1e-4)
        np.testing.assert_array_equal(bands, [[0, 0], [1, 1]])
    apart = regime_bands((0.5, 0.5), (-0.2, 0.2), 0.2)
    np.testing.assert_allclose(apart, 1 - apart[::-1, ::-1], atol=0.02)  # good and bad mirror
    assert 0 < apart[1, 0] < apart[0, 1] < 1
    np.testing.assert_array_equal(regime_bands((0.9, 0.8), (-0.1, 0.1), 0.0), [[0, 0], [1, 1]])
    swinging = regime_bands((0.0, 0.0), (-0.1, 0.1), 0.005)  # good and bad times take turns
    np.testing.assert_array_equal(swinging, [[0, 0], [1, 1]])


# --------------------------------------------------------------------------------------- AR(1)


@pytest.fixture(scope="module")
def signal_market() -> Ar1Optimum:
    return ar1()


def myopic(optimum: Ar1Optimum) -> np.ndarray:
    """The level with the most expected growth in the coming step, costs ignored."""
    level = np.clip((0.0002 + 0.004 * optimum.signals) / 0.01**2, 0, 1).round(1)
    return np.repeat((level[:, None] * 10).round().astype(int), len(optimum.holdings), axis=1)


def yearly_growth(optimum: Ar1Optimum, actions: np.ndarray | None = None) -> float:
    """Stationary growth a year of the best or of other actions, starting in cash.

    The distribution of signals and holdings is followed from step to step, on the optimum's grid.
    """
    x, held, levels = optimum.signals, optimum.holdings, optimum.levels
    actions = optimum.actions if actions is None else actions
    following = np.exp(-0.5 * ((x - 0.95 * x[:, None]) / 0.3122) ** 2)
    following /= following.sum(1, keepdims=True)
    nodes, chances = gauss(9)
    returns = (0.0002 + 0.004 * x)[:, None, None] + 0.01 * nodes
    grown = 1 + levels[:, None] * returns  # (signal, level, node)
    drifted = levels[:, None] * (1 + returns) / grown
    cell = np.clip(np.searchsorted(held, drifted, side="right") - 1, 0, len(held) - 2)
    share = np.clip((drifted - held[cell]) / (held[cell + 1] - held[cell]), 0, 1)
    rows = np.arange(len(x))[:, None, None] * len(held)
    places = (rows + np.stack([cell, cell + 1])).ravel()
    shares = np.stack([1 - share, share]) * chances

    states = np.zeros(actions.shape)
    states[:, 0] = np.exp(-(x**2) * (1 - 0.95**2) / (2 * 0.3122**2))
    states /= states.sum()
    s, h = np.indices(states.shape)
    paid = log_remainder(held[h], levels[actions], optimum.cost)
    earned = paid + (np.log(grown) @ chances)[s, actions]
    before = np.zeros_like(states)
    while np.abs(states - before).max() >= 1e-12:
        chosen = np.zeros((len(x), len(levels)))
        np.add.at(chosen, (s, actions), states)
        moved = np.bincount(places, (chosen[..., None] * shares).ravel(), states.size)
        before, states = states, following.T @ moved.reshape(states.shape)
    return 252 * float((states * earned).sum())


def test_ar1_growth(signal_market: Ar1Optimum) -> None:
    # FACTS' figures 0.3875, 0.3743, 0.0360 come from a coarser grid; these are converged.
    assert yearly_growth(signal_market) == pytest.approx(0.38888, abs=2e-5)
    assert yearly_growth(signal_market, myopic(signal_market)) == pytest.approx(0.3692, abs=5e-4)
    hold = yearly_growth(signal_market, np.full(signal_market.actions.shape, 10))
    mean, variance = 0.0002, 0.01**2 + 0.004**2 * 0.3122**2 / (1 - 0.95**2)
    exact = mean - (variance + mean**2) / 2 + mean * variance - 0.75 * variance**2
    assert hold == pytest.approx(252 * exact, abs=2e-6)


def test_ar1_converges_on_finer_grids(signal_market: Ar1Optimum) -> None:
    finer = ar1(signal_points=301, holding_parts=6)
    assert yearly_growth(finer) == pytest.approx(yearly_growth(signal_market), abs=2e-5)
    at_zero = [np.interp(0, o.signals, o.value[:, 0]) for o in (finer, signal_market)]
    assert at_zero[0] == pytest.approx(at_zero[1], abs=3e-6)


def test_ar1_policy_in_simulation(signal_market: Ar1Optimum) -> None:
    rng = np.random.default_rng(0)
    paths, steps = 4000, 400
    x, weight = rng.normal(0, 1, paths), np.zeros(paths)
    levels, total = signal_market.levels, 0.0
    for step in range(steps + 50):
        after = levels[signal_market.policy(x, weight)]
        sell = np.log((1 - 0.002 * weight) / (1 - 0.002 * after))
        buy = np.log((0.998 + 0.002 * weight) / (0.998 + 0.002 * after))
        paid = np.minimum(sell, buy)  # the other one would be a gain
        mean = 0.0002 + 0.004 * x
        realized = mean + 0.01 * rng.normal(size=paths)
        # The expected log instead of the drawn one: the same mean, a fraction of the noise.
        growth = after * mean - after**2 * (0.01**2 + mean**2) / 2
        total += float((paid + growth).mean()) * (step >= 50)
        weight = after * (1 + realized) / (1 + after * realized)
        x = 0.95 * x + 0.3122 * rng.normal(size=paths)
    assert 252 * total / steps == pytest.approx(yearly_growth(signal_market), abs=0.003)


def test_ar1_policy_table_and_function_agree(signal_market: Ar1Optimum) -> None:
    x, held = np.meshgrid(signal_market.signals, signal_market.holdings, indexing="ij")
    assert (signal_market.policy(x, held) == signal_market.actions).all()
    best = signal_market.actions
    assert (np.diff(best, axis=0) >= 0).all()  # a better signal never asks for less
    assert (np.diff(best, axis=1) >= 0).all()  # nor does more in hand


def test_ar1_limits(signal_market: Ar1Optimum) -> None:
    free = ar1(cost=0.0, signal_points=101)
    assert (free.actions == myopic(free)).all()
    dear = ar1(cost=0.5, signal_points=101)
    assert (dear.actions[:, 0] == 0).all()
    assert yearly_growth(dear) == 0
    blind = ar1(discount=0.0, signal_points=101)  # costs count, tomorrow does not
    assert yearly_growth(blind) < yearly_growth(signal_market) - 0.005 < yearly_growth(free)


# ------------------------------------------------------------------------------- no-trade region


@pytest.mark.parametrize(
    ("cost", "low", "high", "growth"),
    [(0.01, 0.40120, 0.59882, 0.00481413), (0.001, 0.45447, 0.54553, 0.00495900)],
)
def test_no_trade_figures(cost: float, low: float, high: float, growth: float) -> None:
    region = no_trade_region(0.02, 0.2, cost)
    assert region[:2] == pytest.approx((low, high), abs=5.1e-6)
    assert region.growth == pytest.approx(growth, abs=5.1e-9)


def by_integration(a: float, b: float, drift: float, volatility: float, cost: float) -> float:
    """Growth of a region from the stationary density between two reflecting barriers."""
    from scipy.integrate import quad

    k = 2 * drift / volatility**2
    density = lambda w: 2 / volatility**2 * w ** (k - 2) * (1 - w) ** -k  # noqa: E731
    earned = lambda w: (drift * w - volatility**2 * w**2 / 2) * density(w)  # noqa: E731
    flow = lambda w: w**k * (1 - w) ** (2 - k)  # noqa: E731
    costs = cost / (1 + cost * a) * flow(a) + cost / (1 - cost * b) * flow(b)
    return float((quad(earned, a, b)[0] - costs) / quad(density, a, b)[0])


@pytest.mark.parametrize("market", [(0.02, 0.2), (0.035, 0.2), (0.004, 0.2), (0.06, 0.3)])
@pytest.mark.parametrize("cost", [1e-4, 0.01, 0.2])
def test_no_trade_region_is_the_best(market: tuple[float, float], cost: float) -> None:
    low, high, growth = no_trade_region(*market, cost)
    assert by_integration(low, high, *market, cost) == pytest.approx(growth, rel=1e-9)
    widths = np.linspace(-0.3, 0.3, 13) * (high - low)
    lows = np.clip(low + widths, 1e-6, None)[:, None]
    highs = np.clip(high + widths, None, 1 - 1e-6)[None]
    lows, highs = np.broadcast_arrays(lows, highs)
    tried = no_trade_growth(lows, highs, *market, cost)
    assert tried.max() == pytest.approx(growth, abs=1e-14)
    assert np.argmax(tried) == 6 * 13 + 6
    assert tried[3, 9] == pytest.approx(by_integration(lows[3, 9], highs[3, 9], *market, cost))


def test_no_trade_limits() -> None:
    low, high, growth = no_trade_region(0.02, 0.2, 0.0, rate=0.01)
    assert (low, high) == pytest.approx((0.5, 0.5))
    assert growth == pytest.approx(0.01 + 0.02**2 / 0.04 / 2)
    wide = no_trade_region(0.02, 0.2, 0.99)
    assert wide.low < 0.05
    assert wide.high > 0.999
    # Small costs: half the width is (3/2 c w²(1 − w)²)^(1/3) (Rogers 2004; both ways cost c).
    tiny = no_trade_region(0.02, 0.2, 1e-6)
    assert (tiny.high - tiny.low) / 2 == pytest.approx((1.5e-6 / 16) ** (1 / 3), rel=1e-3)


def band_gain(low: float, high: float, cost: float, dt: float, rate: float = 0.0) -> float:
    """Growth a year of a band for θ = .02, σ = .2, by a chain on a fine grid of weights.

    Cash earns ``rate``, and the asset's drift is that much higher.
    """
    points = 1501
    w = np.linspace(low, high, points)
    z, chances = np.polynomial.hermite_e.hermegauss(40)
    chances = chances / chances.sum()
    x = np.exp((0.02 + rate - 0.02) * dt + 0.2 * math.sqrt(dt) * z)
    grown = (1 - w[:, None]) * math.exp(rate * dt) + w[:, None] * x
    moved = w[:, None] * x / grown
    kept = np.clip(moved, low, high)
    sold = np.where(moved > high, np.log((1 - cost * moved) / (1 - cost * high)), 0)
    bought = np.where(moved < low, np.log((1 - cost + cost * moved) / (1 - cost + cost * low)), 0)
    reward = (np.log(grown) + sold + bought) @ chances
    place = (kept - low) / (high - low) * (points - 1)
    cell = np.clip(place.astype(int), 0, points - 2)
    states = np.full(points, 1 / points)
    for _ in range(2000):
        mass = states[:, None] * chances
        part = place - cell
        states, before = (
            np.bincount(cell.ravel(), (mass * (1 - part)).ravel(), points)
            + np.bincount(cell.ravel() + 1, (mass * part).ravel(), points),
            states,
        )
        if np.abs(states - before).sum() < 1e-10:
            break
    return float(states @ reward) / dt


@pytest.mark.parametrize("rate", [0.0, 0.05])
def test_discrete_no_trade_region_is_the_best_band(rate: float) -> None:
    region = no_trade_region_discrete(0.02, 0.2, 0.01, 1 / 4, rate=rate)
    gain = lambda low, high: band_gain(low, high, 0.01, 1 / 4, rate)  # noqa: E731
    assert gain(region.low, region.high) == pytest.approx(region.growth, abs=1e-9)
    for shift in (-0.02, 0.02):
        assert gain(region.low + shift, region.high) < region.growth - 1e-7
        assert gain(region.low, region.high + shift) < region.growth - 1e-7


@pytest.mark.parametrize("drift", [0.02, 0.03])
def test_discrete_no_trade_region_tends_to_the_continuous(drift: float) -> None:
    limit = no_trade_region(drift, 0.2, 0.01, buying=0.01 / 0.99)
    regions = [no_trade_region_discrete(drift, 0.2, 0.01, dt) for dt in (1 / 12, 1 / 52, 1 / 5200)]
    apart = [max(abs(r.low - limit.low), abs(r.high - limit.high)) for r in regions]
    assert apart == sorted(apart, reverse=True)
    assert apart[0] < 0.009
    assert apart[1] < 0.0045
    assert apart[2] < 0.0005
    lost = [(limit.growth - r.growth) * n for r, n in zip(regions, (12, 52, 5200), strict=True)]
    assert lost == pytest.approx([lost[2]] * 3, rel=0.05)  # of first order in dt
    assert 0 < lost[0] < 1.3e-5


def test_discrete_no_trade_region_without_costs_is_growth_optimal() -> None:
    relatives, chances = lognormal_scenarios([0.03], [[0.04]], 0.25, points=40)
    optimum = growth_optimal(relatives, chances)
    region = no_trade_region_discrete(0.03, 0.2, 0.0, 0.25, rate=0.01)
    assert region.low == region.high == pytest.approx(optimum.weights[1], abs=1e-6)
    assert region.growth == pytest.approx(0.01 + optimum.growth / 0.25, abs=1e-10)


# ---------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    "call",
    [
        lambda: kelly(1.0, 0.9, 0.5),
        lambda: kelly(1.1, 0.9, 1.5),
        lambda: kelly(math.nan, 0.9, 0.5),
        lambda: growth_optimal([1.0, 2.0]),
        lambda: growth_optimal([[1.0, -2.0]]),
        lambda: growth_optimal([[1.0, math.nan]]),
        lambda: growth_optimal([[1.0, 2.0]], [0.5]),
        lambda: growth_optimal([[1.0, 2.0]], [0.5, 0.5]),
        lambda: growth_optimal([[1.0, 2.0], [0.0, 0.0]]),
        lambda: ar1(rho=1.0),
        lambda: ar1(noise=math.inf),
        lambda: ar1(slope=1.0),
        lambda: ar1(cost=1.0),
        lambda: ar1(levels=(0.5, 0.2)),
        lambda: ar1(discount=1.0),
        lambda: no_trade_region(0.04, 0.2, 0.01),
        lambda: no_trade_region(-0.01, 0.2, 0.01),
        lambda: no_trade_region(0.02, 0.0, 0.01),
        lambda: no_trade_region(0.02, 0.2, 1.0),
        lambda: no_trade_region_discrete(0.02, 0.2, 0.01, 0.0),
        lambda: no_trade_region_discrete(0.02, 0.2, 1.0, 0.25),
    ],
)
def test_parameters_without_an_optimum(call: object) -> None:
    with pytest.raises(QfolioError, match=r"^[^\n]+\.$"):
        call()  # type: ignore[operator]
