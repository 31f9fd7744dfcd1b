"""The replay against a ledger that knows nothing of weights, only of shares and cash."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest import simulation
from qfolio.portfolio.backtest.simulation import simulate

CASES = {
    "seed": st.integers(0, 2**32 - 1),
    "assets": st.integers(1, 5),
    "days": st.integers(1, 12),
    "first": st.integers(0, 2),
    "lag": st.integers(0, 3),
    "cost": st.sampled_from([0.0, 0.0001, 0.001, 0.01, 0.1]) | st.floats(0, 0.3),
    "volatility": st.sampled_from([0.01, 0.1, 1.0]),
    "silent": st.sampled_from([0.0, 0.0, 0.3, 0.9]),
}


def market(
    seed: int,
    assets: int,
    days: int,
    first: int,
    lag: int,
    volatility: float,
    silent: float,
    strategies: int = 2,
    **_: Any,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Prices, decisions (with that share of days without an order) and start holdings."""
    generator = np.random.default_rng(seed)
    steps = generator.normal(scale=volatility, size=(first + lag + days + 1, assets))
    values = np.exp(steps.cumsum(0) + generator.normal(scale=5, size=assets))

    def weights(*shape: int) -> np.ndarray:
        raw = generator.gamma(0.5, size=(*shape, assets + 1)) + 1e-9
        raw *= generator.random(raw.shape) > 0.3
        raw[..., generator.integers(assets + 1)] += 0.01
        return raw / raw.sum(-1, keepdims=True)

    decisions = weights(strategies, days)
    decisions[generator.random((strategies, days)) < silent] = np.nan
    return values, decisions, weights(strategies)


def ledger(
    prices: list[list[float]],
    decisions: list[list[float]],
    first: int,
    cost: float,
    lag: int,
    start: list[float],
) -> tuple[list[float], list[float]]:
    """Wealth before the first trade and after each day, and turnovers, share by share."""
    cash, shares = start[0], [w / p for w, p in zip(start[1:], prices[first], strict=True)]
    wealths, turnovers = [worth(cash, shares, prices[first + lag])], []
    for row, decision in enumerate(decisions, start=first):
        traded = 0.0
        if decision[0] == decision[0]:  # is a number
            price = prices[row + lag]
            recipe = [w / p for w, p in zip(decision[1:], prices[row], strict=True)]
            low, high = 0.0, 1.0  # how much of the recipe the wealth affords
            while purse(high, cash, shares, recipe, price, cost) > high * decision[0]:
                high *= 2
            for _ in range(80):
                middle = (low + high) / 2
                affordable = purse(middle, cash, shares, recipe, price, cost) > middle * decision[0]
                low, high = (middle, high) if affordable else (low, middle)
            before = worth(cash, shares, price)
            trades = [low * wanted - n for n, wanted in zip(shares, recipe, strict=True)]
            traded = sum(abs(n) * p for n, p in zip(trades, price, strict=True)) / before
            cash, shares = low * decision[0], [low * n for n in recipe]
        turnovers.append(traded)
        wealths.append(worth(cash, shares, prices[row + lag + 1]))
    return wealths, turnovers


def worth(cash: float, shares: list[float], price: list[float]) -> float:
    return cash + sum(n * p for n, p in zip(shares, price, strict=True))


def purse(
    scale: float,
    cash: float,
    shares: list[float],
    recipe: list[float],
    price: list[float],
    cost: float,
) -> float:
    """The cash that is there after shares are traded for so many times the recipe."""
    for n, wanted, p in zip(shares, recipe, price, strict=True):
        change = scale * wanted - n
        cash -= change * p / (1 - cost) if change > 0 else change * p * (1 - cost)
    return cash


@settings(max_examples=300, deadline=None)
@given(block=st.sampled_from([1, 13, 10_000]), **CASES)
def test_wealth_equals_a_ledger_of_shares(block: int, **case: Any) -> None:
    values, decisions, start = market(**case)
    first, cost, lag = (case[name] for name in ("first", "cost", "lag"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulation, "BLOCK", block)
        result = simulate(values, decisions, first=first, cost=cost, lag=lag, start=start)
    for i in range(len(decisions)):
        wealths, turnovers = ledger(
            values.tolist(), decisions[i].tolist(), first, cost, lag, start[i].tolist()
        )
        relative = np.array(wealths) / wealths[0]
        np.testing.assert_allclose(result.wealth[i], relative, rtol=1e-10)
        np.testing.assert_allclose(result.turnover[i], turnovers, atol=1e-10)
    relatives = result.wealth[:, 1:] / result.wealth[:, :-1]
    np.testing.assert_allclose(result.returns, relatives - 1, atol=1e-14)
    np.testing.assert_allclose(result.growth.sum(-1), np.log(result.wealth[:, -1]), atol=1e-12)
    # Weights are on the simplex, and a day without an order is free to the last bit.
    assert (result.weights >= 0).all()
    np.testing.assert_allclose(result.weights.sum(-1), 1, rtol=1e-14)
    silent = np.isnan(decisions[..., 0])
    assert (result.cost[silent] == 0).all()
    assert (result.turnover[silent] == 0).all()
    assert (result.cost >= -1e-16).all()


@settings(max_examples=50, deadline=None)
@given(**CASES)
def test_without_cost_wealth_is_the_product_of_returns(**case: Any) -> None:
    values, decisions, start = market(**(case | {"silent": 0.0}))
    first, lag, days = (case[name] for name in ("first", "lag", "days"))
    result = simulate(values, decisions, first=first, cost=0.0, lag=0, start=start)
    rows = slice(first, first + days + 1)
    relatives = values[rows][1:] / values[rows][:-1]
    plain = decisions[..., 0] + (decisions[..., 1:] * relatives).sum(-1)
    np.testing.assert_allclose(result.wealth[:, 1:], plain.cumprod(-1), rtol=1e-12)
    assert (result.cost == 0).all()
    np.testing.assert_allclose(result.weights, decisions, atol=1e-15)

    delayed = simulate(values, decisions, first=first, cost=0.0, lag=lag, start=start)
    np.testing.assert_allclose(
        1 + delayed.returns,
        delayed.weights[..., 0]
        + (delayed.weights[..., 1:] * (values[1:] / values[:-1])[first + lag :]).sum(-1),
        rtol=1e-12,
    )


@settings(max_examples=50, deadline=None)
@given(**CASES)
def test_order_of_assets_does_not_matter(**case: Any) -> None:
    values, decisions, start = market(**case)
    rule = {name: case[name] for name in ("first", "cost", "lag")}
    order = np.random.default_rng(case["seed"]).permutation(case["assets"])
    entries = np.append(0, order + 1)
    one = simulate(values, decisions, start=start, **rule)
    other = simulate(values[:, order], decisions[..., entries], start=start[:, entries], **rule)
    np.testing.assert_allclose(other.returns, one.returns, rtol=0, atol=1e-12)
    np.testing.assert_allclose(other.turnover, one.turnover, rtol=0, atol=1e-12)
    np.testing.assert_allclose(other.weights, one.weights[..., entries], rtol=0, atol=1e-12)


def test_two_days_by_hand() -> None:
    # Prices of A: 10, 10, 20, 20; of B: 10, 20, 20, 10. All cash, 10% cost, lag 1.
    values = np.array([[10.0, 10.0], [10.0, 20.0], [20.0, 20.0], [20.0, 10.0]])
    # Row 0 decides for half A, half B: as many shares of both. At row 1 B costs twice as much,
    # so a third of the wealth goes to A: bought for 90% of the cash, .3 A and .6 B per unit.
    # By row 2, A doubles: .6 + .6 = 1.2 for each unit of wealth.
    # Row 1 decides for all A; at row 2 that sells .6 of B for .54, which buys .486 of A:
    # 1.086 of 1.2 remains, and stays so, as A does not move into row 3.
    result = simulate(values, [[0, 0.5, 0.5], [0.0, 1, 0]], first=0, cost=0.1, lag=1)
    np.testing.assert_allclose(result.wealth, [1, 1.2, 1.086], rtol=1e-14)
    np.testing.assert_allclose(result.returns, [0.2, -0.095], atol=1e-14)
    np.testing.assert_allclose(result.growth, np.log([1.2, 0.905]), atol=1e-14)
    np.testing.assert_allclose(result.cost, [0.1, 0.095], atol=1e-14)
    np.testing.assert_allclose(result.turnover, [0.9, 0.5 + 0.486 / 1.2], atol=1e-14)
    np.testing.assert_allclose(result.weights, [[0, 1 / 3, 2 / 3], [0.0, 1, 0]], atol=1e-14)


def test_first_decision_may_hold_on() -> None:
    values, decisions, start = market(1, 3, 6, 1, 2, 0.1, 0.0)
    decisions[:, 0] = start
    result = simulate(values, decisions, first=1, cost=0.05, lag=2, start=start)
    assert (result.cost[:, 0] == 0).all()
    assert (result.cost[:, 1:] > 0).all()


def test_leading_axes_share_the_market() -> None:
    values, decisions, start = market(2, 3, 9, 1, 1, 0.1, 0.3, strategies=6)
    many = simulate(values, decisions.reshape(2, 3, 9, 4), first=1, cost=0.01, start=start[0])
    assert many.wealth.shape == (2, 3, 10)
    assert many.weights.shape == (2, 3, 9, 4)
    for i in range(6):
        one = simulate(values, decisions[i], first=1, cost=0.01, start=start[0])
        np.testing.assert_allclose(many.wealth[i // 3, i % 3], one.wealth, rtol=1e-13)


def test_decades_without_an_order_do_not_overflow() -> None:
    values = np.array([[1e-150, 1.0]] * 3 + [[1e150, 1.0]] * 5000)
    decisions = np.full((5001, 3), np.nan)
    decisions[0] = [0, 0.5, 0.5]
    result = simulate(values, decisions, first=0, cost=0.001)
    assert result.wealth[-1] == pytest.approx(0.999 * 0.5e300, rel=1e-12)
    assert (result.turnover[1:] == 0).all()


def test_small_errors_of_weights_are_put_right() -> None:
    values, decisions, _ = market(3, 2, 5, 0, 1, 0.1, 0.0)
    clean = decisions[0]
    clean[0] = [0.5, 0.5, 0.0]
    noisy = clean * (1 + 5e-7)
    noisy[0, 2] = -3e-7
    one, other = (simulate(values, d, first=0, cost=0.01) for d in (clean, noisy))
    np.testing.assert_allclose(other.wealth, one.wealth, rtol=1e-6)
    assert (other.weights >= 0).all()
    np.testing.assert_allclose(other.weights.sum(-1), 1, rtol=1e-15)


def test_assets_that_start_late() -> None:
    values, decisions, _ = market(4, 3, 6, 0, 1, 0.1, 0.0)
    decisions[:, :, 3] = 0
    decisions[:, 4:, 3] = 0.5  # from row 4 on there is a price
    decisions[:, :, 0] += 1 - decisions.sum(-1)
    decisions = np.abs(decisions)
    decisions /= decisions.sum(-1, keepdims=True)
    known = simulate(values, decisions, first=0, cost=0.01)
    values[:4, 2] = np.nan
    late = simulate(values, decisions, first=0, cost=0.01)
    np.testing.assert_array_equal(late.wealth, known.wealth)
    with pytest.raises(QfolioError, match="row 3 hold asset 2"):
        simulate(values, np.tile([0.5, 0, 0, 0.5], (2, 1)), first=3, cost=0.01)
    with pytest.raises(QfolioError, match="row 3 hold asset 2"):
        simulate(values, decisions[0, 4:5], first=3, cost=0.01, start=[0.5, 0, 0, 0.5])
    values[5, 2] = np.nan
    with pytest.raises(QfolioError, match=r"asset 2 .* at row 5 is nan"):
        simulate(values, decisions, first=0, cost=0.01)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"decisions": [[0.5, 0.5, 0.1]]}, "row 1 sum to 1.1"),
        ({"decisions": [[0.5, 0.6, -0.1]]}, "minimum of -0.1"),
        ({"decisions": [[0.5, 0.5, np.nan]]}, "row 1"),
        ({"decisions": [[1.0, np.inf, 0.0]]}, "row 1"),
        ({"decisions": [[0.5, 0.5]]}, "cash first"),
        ({"decisions": [0.5, 0.5, 0.0]}, "cash first"),
        ({"start": [0.5, 0.4, 0.0]}, "row 1 sum to 0.9"),
        ({"start": [0.5, 0.5]}, r"start weights have the shape \(2,\)"),
        ({"start": [np.nan] * 3}, "start weights"),
        ({"cost": 1.0}, "cost is 1.0"),
        ({"cost": -0.001}, "cost is -0.001"),
        ({"cost": np.nan}, "cost is nan"),
        ({"lag": -1}, "Lag and first row are -1 and 1"),
        ({"first": -1}, "Lag and first row are 1 and -1"),
        ({"lag": 3}, "up to row 5, but row 4 is the last"),
        ({"values": [1.0] * 5}, "must be .rows, assets."),
        ({"values": [[1.0, 0.0]] * 5}, "asset 1 .* at row 0 is 0"),
        ({"values": [[1.0, 1.0]] * 4 + [[np.inf, 1.0]]}, "asset 0 .* at row 4 is inf"),
    ],
)
def test_errors_say_what_and_where(change: dict[str, Any], message: str) -> None:
    good: dict[str, Any] = {
        "values": [[1.0, 2.0]] * 5,
        "decisions": [[0.2, 0.5, 0.3]],
        "first": 1,
        "cost": 0.001,
    }
    assert simulate(**good).wealth[-1] == pytest.approx(1 - 0.8 * 0.001 / (1 - 0.2 * 0.001))
    with pytest.raises(QfolioError, match=message):
        simulate(**(good | change))
