"""Costs by kind, interest, fees and shorts, against a ledger in shares and money."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest import simulation
from qfolio.portfolio.backtest.simulation import simulate
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.costs import Context, Proportional
from qfolio.portfolio.itemized import Itemized
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio

from tables import days, price_table, random_walk, weekdays

ROWS, ASSETS = 9, 3
COLUMNS = ("volume", "spread", "fee", "dividend")


def table(seed: int, rows: int = ROWS, assets: int = ASSETS) -> Prices:
    """Random prices with columns, on days with weekends between them."""
    rng = np.random.default_rng(seed)
    values = random_walk(rows, assets, rng, volatility=0.03)
    features = np.stack(
        [
            1e5 * rng.uniform(0.2, 2, (rows, assets)),
            0.002 * rng.random((rows, assets)),
            0.05 * rng.random((rows, assets)),
            0.04 * rng.random((rows, assets)),
        ],
        -1,
    )
    dates = weekdays(rows, "2024-01-01")
    return price_table(values, dates=dates, features=features, feature_names=COLUMNS)


def random_model(rng: np.random.Generator) -> Itemized:
    """A model in which about every second kind of cost is there."""
    draw = lambda value, none: value if rng.random() < 0.5 else none  # noqa: E731
    return Itemized(
        cost=draw(0.01 * rng.random(), 0.0),
        buy=draw("0.005", "0"),
        sell=draw("0.002", "0"),
        spread=draw("column:spread", "0.001"),
        fixed=draw(20.0, 0.0),
        minimum=draw(50.0, 0.0),
        impact=draw(1.5 * rng.random(), 0.0),
        impact_power=draw(0.5, 1.0),
        capital=10 ** rng.uniform(4.5, 7),
        cash_rate=draw("0.05", "0"),
        borrow_spread=draw(0.02, 0.0),
        borrow_fee=draw("column:fee", "0"),
        carry_rate=draw("column:dividend", "-0.01"),
        per_share=draw(0.2, 0.0),
        maximum=draw(0.004, 1.0),
    )


def volatility(values: np.ndarray, row: int, asset: int) -> float:
    logs = np.diff(np.log(values[max(0, row - 21) : row + 1, asset]))
    return float(np.std(logs)) if len(logs) else 0.0


class Ledger:
    """Shares and money, one trade and one day at a time."""

    def __init__(self, model: Itemized, prices: Prices) -> None:
        self.model, self.prices = model, prices
        self.known = dict(zip(COLUMNS, np.moveaxis(prices.features, -1, 0), strict=True))

    def value(self, quantity: str, row: int, asset: int) -> float:
        name = quantity.removeprefix("column:")
        return float(quantity) if name == quantity else float(self.known[name][row, asset])

    def rate(self, quantity: str, row: int, asset: int, days: float) -> float:
        return math.exp(self.value(quantity, row, asset) * days / 365)

    def held(
        self, shares: np.ndarray, cash: float, start: int, end: int
    ) -> tuple[np.ndarray, float]:
        """Shares and cash after some rows; carry and fees are settled in shares of the asset."""
        model, shares = self.model, shares.copy()
        for row in range(start, end):
            days = float(
                (self.prices.dates[row + 1] - self.prices.dates[row]) / np.timedelta64(1, "D")
            )
            loan = model.borrow_spread if cash < 0 else 0.0
            cash *= math.exp((float(model.cash_rate) + loan) * days / 365)
            for i in range(len(shares)):
                shares[i] *= self.rate(model.carry_rate, row, i, days)
                if shares[i] < 0:
                    shares[i] *= self.rate(model.borrow_fee, row, i, days)
        return shares, cash

    def worth(self, shares: np.ndarray, cash: float, row: int) -> float:
        return float(shares @ self.prices.values[row] + cash)

    def paid(
        self, shares: np.ndarray, target: np.ndarray, wealth: float, left: float, row: int
    ) -> float:
        """Money paid for trading from shares to weights of the wealth that is left."""
        model, total = self.model, 0.0
        now = shares * self.prices.values[row]
        for i, have in enumerate(now):
            change = target[1 + i] * left - have
            tax = model.buy if change > 0 else model.sell
            rates = [model.cost, self.value(tax, row, i), self.value(model.spread, row, i) / 2]
            if change > 0:
                rates = [rate / (1 - sum(rates)) for rate in rates]
            each = [rate * abs(change) for rate in rates]
            each[0] += model.per_share * abs(change) / self.prices.values[row, i]
            if abs(target[1 + i] - have / wealth) > 1e-6:
                each[0] = max(each[0], model.minimum)
                total += model.fixed
            if model.maximum < 1:
                each[0] = min(each[0], model.maximum * abs(change))
            total += sum(each)
            if model.impact:
                volume = self.known["volume"][row, i] * self.prices.values[row, i]
                moved = volatility(self.prices.values, row, i)
                total += (
                    model.impact
                    * moved
                    * (wealth * abs(change) / wealth / volume) ** (model.impact_power)
                    * abs(change)
                )
        return total

    def run(self, orders: np.ndarray, lag: int, start: np.ndarray) -> np.ndarray:
        """Returns, with an account that begins with the capital at the first trade."""
        values, wealth = self.prices.values, self.model.capital
        shares, cash = start[1:] * wealth / values[0], start[0] * wealth
        shares, cash = self.held(shares, cash, 0, lag)
        scale = wealth / self.worth(shares, cash, lag)
        shares, cash = shares * scale, cash * scale
        returns = []
        for day, order in enumerate(orders):
            row = day + lag
            wealth = self.worth(shares, cash, row)
            if not np.isnan(order).any():
                wanted, money = self.held(order[1:] / values[day], order[0], day, row)
                worth = self.worth(wanted, money, row)
                target = np.append(money, wanted * values[row]) / worth
                low, high = 0.0, wealth
                for _ in range(60):
                    middle = (low + high) / 2
                    spent = self.paid(shares, target, wealth, middle, row)
                    low, high = (middle, high) if middle + spent < wealth else (low, middle)
                shares, cash = target[1:] * low / values[row], target[0] * low
            shares, cash = self.held(shares, cash, row, row + 1)
            after = self.worth(shares, cash, row + 1)
            returns.append(after / wealth - 1)
        return np.array(returns)


def random_weights(rng: np.random.Generator, *shape: int, short: bool) -> np.ndarray:
    weights = rng.dirichlet(np.ones(shape[-1]), shape[:-1])
    if short:
        weights[..., 1:] += 0.4 * rng.normal(size=(*shape[:-1], shape[-1] - 1))
        weights[..., 0] = 1 - weights[..., 1:].sum(-1)
    return weights


@pytest.mark.parametrize("group", range(10))
def test_equals_a_ledger(group: int) -> None:
    """Fifty random models, tables, lags and orders a group, long-only and with debts."""
    for case in range(50):
        rng = np.random.default_rng((group, case))
        prices, model = table(1000 * group + case), random_model(rng)
        lag, short = int(rng.integers(0, 3)), bool(rng.random() < 0.5)
        days = ROWS - lag - 1
        orders = random_weights(rng, days, ASSETS + 1, short=short)
        orders[rng.random(days) < 0.3] = np.nan
        start = random_weights(rng, ASSETS + 1, short=short)
        replayed = simulate(
            prices.values,
            orders,
            first=0,
            cost=model,
            lag=lag,
            start=start,
            conditions=Conditions.of(prices, model),
            long_only=False,
        )
        np.testing.assert_allclose(
            replayed.returns, Ledger(model, prices).run(orders, lag, start), rtol=0, atol=1e-11
        )
        np.testing.assert_allclose(sum(replayed.costs.values()), replayed.cost, rtol=0, atol=1e-15)


def weights(seed: int, *shape: int) -> np.ndarray:
    return random_weights(np.random.default_rng(seed), *shape, short=True)


def test_commission_alone_is_proportional() -> None:
    before, after = weights(1, 200, 5), weights(2, 200, 5)
    one, kinds = Itemized(cost=0.003).trade(before, after, Context())
    other, _ = Proportional(0.003, gross=4.0).trade(before, after, Context())
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-15)
    assert kinds["commission"] == pytest.approx(1 - one, abs=1e-15)
    assert (Itemized().trade(before, before, Context())[0] == 1).all()


@pytest.mark.parametrize(
    ("shares", "price", "commission"),
    [(1000, 50.0, 5.0), (100, 50.0, 1.0), (10, 1.0, 0.1), (-1000, 0.25, 2.5), (-400, 10.0, 2.0)],
)
def test_a_commission_of_each_share(shares: int, price: float, commission: float) -> None:
    """Half a cent a share, at least 1 and at most 1% of the value: numbers worked out by hand."""
    model = Itemized(cost=0, per_share=0.005, minimum=1, maximum=0.01, capital=1e6)
    value = abs(shares) * price / 1e6
    held, wanted = (value, 0.0) if shares < 0 else (0.0, value)
    context = Context(columns={"price": np.array([price])})
    _, paid = model.trade(np.array([1 - held, held]), np.array([1 - wanted, wanted]), context)
    assert paid["commission"] * 1e6 == pytest.approx(commission, rel=1e-4)


@pytest.mark.parametrize(
    "model",
    [
        Itemized(cost=0.004, minimum=30, fixed=5, impact=1, spread="0.001", capital=1e5),
        Itemized(cost=0, per_share=0.02, minimum=30, capital=1e5),
        Itemized(cost=0.001, per_share=0.02, minimum=300, maximum=0.01, capital=1e5),
    ],
)
def test_jax_equals_numpy_and_its_derivative_is_exact(model: Itemized) -> None:
    columns = {"volume": np.full(4, 1e4), "price": np.full(4, 5.0), "volatility": np.full(4, 0.02)}
    context = Context(columns=columns)
    before, after = weights(3, 5), weights(4, 5)

    def remainder(after: np.ndarray) -> float:
        return float(model.trade(before, after, context)[0])

    with jax.enable_x64(True):
        traced = lambda after: model.trade(jnp.asarray(before), after, context)[0]  # noqa: E731
        value, slope = jax.jit(jax.value_and_grad(traced))(jnp.asarray(after))
        assert float(value) == pytest.approx(remainder(after), abs=1e-14)
        for move in np.eye(5)[1:] * 1e-6:
            wanted = (remainder(after + move) - remainder(after - move)) / 2e-6
            assert float(slope @ move) / 1e-6 == pytest.approx(wanted, abs=1e-8)


def test_the_volatility_of_an_asset_that_joins_late() -> None:
    values = table(3, rows=80).values.copy()
    values[:40, 1] = np.nan
    model = Itemized(impact=1, volume="1000")
    found = Conditions.of(price_table(values), model).values["volatility"]
    for row in (0, 3, 30, 45, 60, 79):
        assert found[row, 0] == pytest.approx(volatility(values, row, 0), abs=1e-12)
    for row in range(40, 45):  # it has no five returns yet
        others = [volatility(values, row, asset) for asset in (0, 2)]
        assert found[row, 1] == pytest.approx(np.mean(others), abs=1e-12)
    for row in (45, 50, 61, 79):
        returns = np.diff(np.log(values[max(40, row - 21) : row + 1, 1]))
        assert found[row, 1] == pytest.approx(np.std(returns), abs=1e-12)


def test_delisted_assets_say_nothing_about_the_volatility_of_a_new_one() -> None:
    values = table(3, rows=80).values.copy()
    values[:60, 1], values[20:, 2] = np.nan, values[20, 2]  # B joins, C has paid out
    listed = np.ones(values.shape, bool)
    listed[21:, 2] = False
    prices = price_table(values, listed=listed)
    found = Conditions.of(prices, Itemized(impact=1, volume="1000")).values["volatility"]
    for row in (45, 62):
        alone = volatility(values, row, 0)
        np.testing.assert_allclose(found[row], alone, atol=1e-12)


def test_training_pays_what_the_replay_pays() -> None:
    prices = table(7, rows=40)
    text = (
        "itemized(sell=0.002, spread=column:spread, fixed=30, minimum=40, impact=0.5, "
        "cash_rate=0.04, borrow_fee=column:fee, carry_rate=column:dividend)"
    )
    task = Portfolio.of(prices, window=5, lag=2, horizon=10, cost=0.002, cost_model=text)
    assert isinstance(task.costs, Itemized)
    assert (task.costs.cost, task.costs.fixed) == (0.002, 30)
    row, held, target = 20, *np.random.default_rng(0).dirichlet(np.ones(4), 2)
    replayed = simulate(
        prices.values,
        target[None],
        first=row,
        cost=task.costs,
        lag=2,
        start=held,
        conditions=Conditions.of(prices, task.costs),
    )
    states = jnp.array(row), jnp.array(row + 1)
    holding = task.hold(jnp.asarray(held, jnp.float32))
    reward, _ = task.settle(*states, holding, jnp.asarray(target, jnp.float32))
    assert float(reward) == pytest.approx(replayed.growth[0], abs=1e-6)
    assert replayed.costs.keys() == {"commission", "tax", "spread", "fixed", "impact"}
    # Cash of a weight of target[0] earns interest on what is left of a row.
    assert replayed.financing is not None
    assert replayed.financing[0] > 0


def test_cash_earns_its_rate_over_weekends() -> None:
    prices = table(1)
    still = np.tile(np.eye(4)[0], (ROWS - 1, 1))
    model = Itemized(cash_rate="0.05")
    known = Conditions.of(prices, model)
    earned = simulate(prices.values, still, first=0, cost=model, lag=0, conditions=known)
    days = np.diff(prices.dates) / np.timedelta64(1, "D")
    np.testing.assert_allclose(earned.growth, 0.05 * days / 365, rtol=1e-12)


def test_a_loan_costs_its_spread_though_nothing_else_is_charged() -> None:
    prices, model = table(1), Itemized(cost=0, borrow_spread=0.05)
    orders = np.tile([-0.5, 1.5, 0.0, 0.0], (ROWS - 1, 1))
    known = Conditions.of(prices, model)
    earned = simulate(
        prices.values, orders, first=0, cost=model, lag=0, conditions=known, long_only=False
    )
    days = np.diff(prices.dates) / np.timedelta64(1, "D")
    interest = np.expm1(0.05 * days / 365)
    np.testing.assert_allclose(
        earned.returns, 1.5 * (prices.relatives[:, 0] - 1) - 0.5 * interest, atol=1e-12
    )


def test_fees_follow_the_wealth_through_a_history_of_many_blocks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    prices, model = table(2, rows=60), Itemized(fixed=50, capital=1e4)
    orders = np.random.default_rng(2).dirichlet(np.ones(4), 58)
    known = Conditions.of(prices, model)
    once, daily = np.empty((2, 58))
    for found, block in ((once, 60_000), (daily, 1)):
        monkeypatch.setattr(simulation, "BLOCK", block)
        found[:] = simulate(prices.values, orders, first=0, cost=model, conditions=known).returns
    np.testing.assert_allclose(daily, once, rtol=0, atol=1e-12)


def test_an_account_that_is_wiped_out_stays_at_nothing() -> None:
    values = np.array([[100.0], [100.0], [160.0], [160.0], [80.0]])
    short = np.tile([3.0, -2.0], (4, 1))
    replayed = simulate(values, short, first=0, cost=0.001, lag=0, long_only=False)
    assert replayed.returns[1:].tolist() == [-1, 0, 0]
    assert replayed.returns[0] > -0.01
    assert replayed.ruined
    assert replayed.wealth[-1] == 0
    assert replayed.weights[3].tolist() == [1, 0]
    assert replayed.turnover[2:].tolist() == [0, 0]
    # An order that is worthless by the time of its trade, too.
    none = np.full((1, 2), np.nan)
    late = np.concatenate([none, short[:2]])
    replayed = simulate(values, late, first=0, cost=0.001, lag=1, long_only=False)
    assert replayed.returns.tolist() == [0, -1, 0]


def test_debts_are_refused_where_weights_must_be_positive() -> None:
    with pytest.raises(QfolioError, match="not be negative"):
        simulate(np.ones((3, 1)), np.array([[1.5, -0.5]]), first=0, cost=0.0)


@pytest.mark.parametrize("model", [Itemized(per_share=0.01), Itemized(impact=1.0)])
def test_returns_have_no_share_prices(model: Itemized) -> None:
    with pytest.raises(QfolioError, match="Returns give no share prices"):
        Conditions.of(dataclasses.replace(table(1), levels=True), model)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("itemized(fixed)", "must be written like"),
        ("itemized(fixed=5", "must be written like"),
        ("itemized(", "must be written like"),
        ("itemized(=5)", "must be written like"),
        ("itemized(fixed=5,)", "must be written like"),
        ("itemized(fee=5)", "did you mean|choose from"),
        ("itemized(fixed=-5)", "at least 0"),
        ("itemized(cash_rate=5)", "from -1 to 1"),
        ("itemized(spread=column:nothing)", "does not have"),
        ("itemized(cash_rate=column:fee)", "one rate for each date"),
        ("itemized(maximum=0.5)", "from 0 to 0.2, or 1"),
    ],
)
def test_settings_that_do_not_fit(text: str, said: str) -> None:
    def settle() -> None:
        task = Portfolio.of(table(1, rows=30), window=5, horizon=5, cost_model=text)
        holding = task.hold(jnp.eye(4)[0])
        task.settle(jnp.array(10), jnp.array(11), holding, jnp.eye(4)[1])

    with pytest.raises(QfolioError, match=said):
        settle()


@pytest.mark.parametrize(
    ("text", "wrong", "said"),
    [
        ("itemized(spread=column:spread)", 5.0, r"'spread' is 5 on 2024-01-21 for B; .* 0 to 0.2"),
        ("itemized(spread=column:spread)", -0.01, "'spread' is -0.01 on 2024-01-21 for B"),
        ("itemized(buy=column:fee)", 0.3, "'fee' is 0.3 on 2024-01-21 for B"),
        ("itemized(impact=1)", 0.0, "'volume' is 0 on 2024-01-21 for B; .* above 0"),
        ("itemized(carry_rate=column:dividend)", 4.5, "'dividend' is 4.5 .* -1 to 1 per year"),
        ("itemized(cash_rate=column:bills)", 4.5, r"'bills' is 4.5 on 2024-01-21; .* -1 to 1 per"),
    ],
)
def test_columns_have_the_limits_of_numbers(text: str, wrong: float, said: str) -> None:
    """An interest rate in percent would earn more than all else."""
    values = table(1, rows=30).values.copy()
    values[:10, 1] = np.nan
    features, bills = np.full((30, 3, 4), 0.01), np.full((30, 1), 0.03)
    features[:10, 1] = np.nan

    def trade() -> None:
        prices = price_table(
            values, dates=days(30, "2024-01-01"), features=features, feature_names=COLUMNS,
            market=bills, market_names=("bills",),
        )  # fmt: skip
        Portfolio.of(prices, window=5, horizon=5, cost_model=text)

    trade()
    features[20, 1] = bills[20] = wrong
    with pytest.raises(QfolioError, match=said):
        trade()


def test_later_rows_change_no_earlier_return() -> None:
    for case in range(60):
        rng = np.random.default_rng(case)
        prices, model = table(case, rows=40), random_model(rng)
        lag = int(rng.integers(0, 3))
        orders = random_weights(rng, 40 - lag - 1, ASSETS + 1, short=True)
        last = int(rng.integers(lag + 2, 39))  # the last row that stays as it is
        values, features = prices.values.copy(), prices.features.copy()
        values[last + 1 :] *= rng.uniform(0.5, 2, values[last + 1 :].shape)
        features[last + 1 :] *= rng.uniform(0.5, 2, features[last + 1 :].shape)
        other = Prices(prices.dates, prices.assets, values, features, COLUMNS)
        one, two = (
            simulate(
                each.values,
                orders,
                first=0,
                cost=model,
                lag=lag,
                conditions=Conditions.of(each, model),
                long_only=False,
            )
            for each in (prices, other)
        )
        known = last - lag  # returns up to the row `last`
        # Newton's method stops for all trades at once, so that the last digit may differ.
        np.testing.assert_allclose(one.returns[:known], two.returns[:known], rtol=0, atol=1e-14)
        np.testing.assert_allclose(one.cost[: known + 1], two.cost[: known + 1], rtol=0, atol=1e-14)


def test_fees_that_exceed_the_wealth_wipe_an_account_out() -> None:
    prices, model = table(2), Itemized(fixed=400, capital=1000)
    orders = np.tile([0.1, 0.3, 0.3, 0.3], (ROWS - 1, 1))
    known = Conditions.of(prices, model)
    replayed = simulate(prices.values, orders, first=0, cost=model, lag=0, conditions=known)
    assert replayed.returns.tolist() == [-1, *[0] * (ROWS - 2)]
    assert replayed.cost[0] == pytest.approx(1, abs=1e-5)
    assert replayed.cost[1:].max() == 0


@pytest.mark.parametrize("power", [0.5, 1.5, 2.0])
def test_an_asset_without_a_price_has_no_impact(power: float) -> None:
    model = Itemized(impact=1, impact_power=power, cost=0.0)
    values = {"volume": [1e4, 0.0], "price": [5.0, 0.0], "volatility": [0.02, 0.02]}
    before, after = np.array([1.0, 0.0, 0.0]), np.array([0.5, 0.5, 0.0])
    exact = model.trade(
        before, after, Context(columns={name: np.array(x) for name, x in values.items()})
    )[0]
    context = Context(columns={name: jnp.asarray(x) for name, x in values.items()})

    def traded(after: jax.Array) -> jax.Array:
        return model.trade(jnp.asarray(before, jnp.float32), after, context)[0]

    value, slope = jax.value_and_grad(traded)(jnp.asarray(after, jnp.float32))
    assert float(value) == pytest.approx(float(exact), abs=1e-6)
    assert 0 < exact < 1
    assert jnp.isfinite(slope).all()
