"""Orders over several rows, a year's turnover, and margin calls, against ledgers of shares."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.portfolio.backtest.baselines import Baseline
from qfolio.portfolio.backtest.baselines.equal_weight import BuyAndHold, EqualWeight
from qfolio.portfolio.backtest.folds import Fold
from qfolio.portfolio.backtest.notes import called
from qfolio.portfolio.backtest.orders import AT_EVERY_ROW, orders
from qfolio.portfolio.backtest.replay import Replay
from qfolio.portfolio.calendars import calendar_years, decision_rows, elapsed
from qfolio.portfolio.execution import Terms
from qfolio.portfolio.following import begin
from qfolio.portfolio.market import Holding
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio

from tables import price_table, random_walk

ASSETS = ("a", "b", "c")
FIRST, LAST = 40, 790


def table(seed: int = 0, sigma: float = 0.02) -> Prices:
    dates = np.arange("2018-09-03", "2022-01-01", dtype="datetime64[D]")
    dates = dates[dates.astype(int) % 7 != 4][:800]
    return price_table(random_walk(800, seed=seed, volatility=sigma), ASSETS, dates)


class Given(Baseline):
    """Orders that were drawn before, one for each row."""

    calendar = "row"
    wanted: np.ndarray

    def decide(self, history, held):
        return self.wanted[len(history.prices) - 1]


def drawn(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).dirichlet(np.ones(4), 800)


def by_baseline(prices: Prices, task: Portfolio, wanted: np.ndarray) -> np.ndarray:
    """Weights held after the trade of each row, from decisions that are NaN where nothing is."""
    terms = task.terms
    terms = terms._replace(decides=np.asarray(terms.decides), elapsed=np.asarray(terms.elapsed))
    rule = type("Rule", (Given,), {"wanted": wanted})()
    fold = Fold("only", slice(0, FIRST), slice(FIRST, LAST), slice(0, FIRST))
    allowed = (lambda fold, row: task.feasible) if task.mandate else None
    found = orders("rule", rule, [fold], prices.dates, prices.values, feasible=allowed, terms=terms)
    held, after = np.eye(4)[0], []
    for row, order in zip(range(FIRST, LAST), found.decisions, strict=True):
        held = held if np.isnan(order[0]) else order
        after.append(held)
        worth = held * np.append(1, prices.values[row + 1] / prices.values[row])
        held = worth / worth.sum()
    return np.array(after)


def by_task(task: Portfolio, wanted: np.ndarray) -> np.ndarray:
    """The same by the task's functions, as training and following use them."""

    def step(held, given):
        row, action = given
        target, plan = task.trade(row, held, task.wanted(row, held, action))
        after = Holding(task.drifted(row, target), held.reward, task.planned(row, plan))
        return after, target

    start = jax.tree.map(lambda x: x[0], begin(task, np.eye(4)[:1]))
    rows = jnp.arange(FIRST, LAST)
    given = rows, jnp.asarray(wanted[FIRST:LAST], jnp.float32)
    return np.asarray(jax.jit(lambda: jax.lax.scan(step, start, given)[1])())


def made(prices: Prices, calendar: str = "", **mandate) -> Portfolio:
    settings = {"window": 10, "horizon": 20, "calendar": calendar, "mandate": mandate}
    task = Portfolio.of(prices, **settings)
    return task.deciding_at(FIRST)


@pytest.mark.parametrize("calendar", ["10", "weekly", "3", ""])
def test_an_order_is_filled_in_equal_parts_of_shares(calendar):
    prices, wanted, parts = table(1), drawn(1), 4
    task = made(prices, calendar, trading={"fill": parts})
    decides = decision_rows(calendar, prices.dates)
    decides[FIRST] = True
    shares, cash, expected = np.zeros(3), 1.0, []
    goal, left = np.zeros(4), 0
    for row in range(FIRST, LAST):
        price = prices.values[row]
        wealth = cash + shares @ price
        if decides[row]:
            goal, left = wanted[row] * wealth / np.append(1, price), parts  # cash, then shares
        if left:
            scale = wealth / (goal @ np.append(1, price))  # the order grows otherwise than wealth
            bought = (scale * goal[1:] - shares) / left
            cash, shares, left = cash - bought @ price, shares + bought, left - 1
        expected.append(np.append(cash, shares * price) / wealth)
    for found in (by_baseline(prices, task, wanted), by_task(task, wanted)):
        np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.slow
def test_any_terms_are_those_of_a_ledger_of_shares():
    for seed in range(500):
        rng = np.random.default_rng(seed)
        days = slice(30, 30 + int(rng.integers(2, 60)))
        prices = table(seed, sigma=rng.uniform(0.001, 0.08))
        decides = rng.random(800) < rng.uniform(0.05, 1)
        band, fill = rng.choice([0.0, 0.02, 0.2]), int(rng.integers(1, 8))
        terms = AT_EVERY_ROW._replace(decides=decides, band=float(band), fill=fill)
        wanted = rng.dirichlet(np.full(4, rng.uniform(0.2, 3)), 800)
        rule = type("Rule", (Given,), {"wanted": wanted})()
        fold = Fold("only", slice(0, 30), days, slice(0, 30))
        found = orders("rule", rule, [fold], prices.dates, prices.values, terms=terms).decisions
        shares, cash, goal, left = np.zeros(3), 1.0, np.zeros(4), 0
        for row, order in zip(range(days.start, days.stop), found, strict=True):
            price = prices.values[row]
            wealth = cash + shares @ price
            held = np.append(cash, shares * price) / wealth
            if decides[row] and (not band or abs(wanted[row] - held).max() > band):
                goal, left = wanted[row] * wealth / np.append(1, price), fill
            if left:
                scale = wealth / (goal @ np.append(1, price))
                bought = (scale * goal[1:] - shares) / left
                cash, shares, left = cash - bought @ price, shares + bought, left - 1
                after = np.append(cash, shares * price) / wealth
                np.testing.assert_allclose(order, after, atol=1e-10)
            else:
                assert np.isnan(order).all()


def test_an_order_at_once_is_as_without_the_rule():
    prices, wanted = table(2), drawn(2)
    task, plain = (made(prices, "weekly", trading=t) for t in ({"fill": 1}, {}))
    assert not task.terms.remembers
    np.testing.assert_array_equal(by_task(task, wanted), by_task(plain, wanted))


@pytest.mark.parametrize("fill", [1, 3])
def test_a_year_trades_no_more_than_its_budget(fill):
    prices, wanted = table(3), drawn(3)
    budget = 3.0
    task = made(prices, "weekly", trading={"turnover_a_year": budget, "fill": fill})
    free = made(prices, "weekly", trading={"fill": fill})
    years = prices.dates[FIRST:LAST].astype("datetime64[Y]").astype(int)

    def turnover(weights):
        moved = np.append(np.ones((LAST - FIRST, 1)), _relatives(prices), 1)
        worth = weights * moved
        held = np.concatenate([np.eye(4)[:1], (worth / worth.sum(1, keepdims=True))[:-1]])
        traded = abs(weights - held)[:, 1:].sum(1)
        return np.array([traded[years == year].sum() for year in np.unique(years)])

    for follow in (lambda t: by_baseline(prices, t, wanted), lambda t: by_task(t, wanted)):
        assert (turnover(follow(free)) > 1.5 * budget).all()
        spent = turnover(follow(task))
        # What prices do between the parts of an order adds a little.
        assert (spent <= budget * (1 + (1e-4 if fill == 1 else 0.02))).all()
        assert (spent > 0.99 * budget).all()
    np.testing.assert_allclose(by_task(task, wanted), by_baseline(prices, task, wanted), atol=2e-4)


@pytest.mark.parametrize("days", [["01-01"], ["12-31"], ["06-30", "12-31"], ["03-31"]])
def test_each_calendar_year_has_a_budget_of_its_own(days):
    """Also on rows of the same day of each year, leap years included."""
    dates = np.array([f"{y}-{day}" for y in range(1990, 2030) for day in days], "datetime64[s]")
    dates[-1] = np.datetime64("2029-12-31T23:59:59")  # rounds to 2030 in single precision
    passed = calendar_years(dates).astype(np.float32)
    terms = Terms(np.zeros(0, bool), passed, turnover=1.0)
    plan = terms.begin(np.eye(4)[0], 0.7)
    assert plan is not None
    years = dates.astype("datetime64[Y]")
    for row in range(len(dates) - 1):
        spent = terms.next_row(row, plan, plan.order).spent
        assert (spent == 0) == (years[row + 1] > years[row])


def test_training_begins_with_some_of_the_budget_spent():
    task = made(table(), "weekly", trading={"turnover_a_year": 2.0})
    rows = jnp.arange(FIRST, LAST)
    keys = jax.random.split(jax.random.key(0), len(rows))
    plan = jax.vmap(task.draw_reachable)(rows, keys).plan
    assert plan is not None
    spent = np.asarray(plan.spent)
    passed = elapsed(table().dates)[FIRST:LAST]
    assert (spent <= 2.0 * passed + 1e-6).all()
    np.testing.assert_allclose(spent.mean(), passed.mean(), rtol=0.1)


def test_a_margin_call_is_a_decision_whatever_the_calendar_says():
    prices = table(4, sigma=0.03)
    debts = {"assets": {"cap": 2.0}, "cash": {"min": -1.0}}
    exposure = {"gross": 1.8, "margin": 0.5}
    task = made(prices, "quarterly", exposure=exposure, **debts)
    plain = made(prices, "quarterly", exposure={"gross": 1.8}, **debts)
    wanted = np.tile([-0.8, 0.6, 0.6, 0.6], (800, 1))
    called, free = by_task(task, wanted), by_task(plain, wanted)
    gross = abs(called[:, 1:]).sum(1)
    assert gross.max() <= 2.0
    assert abs(free[:, 1:]).sum(1).max() > 2.0
    decides = decision_rows("quarterly", prices.dates)[FIRST:LAST]
    ordered = abs(called - wanted[0]).max(1) < 1e-5
    assert (ordered & ~decides).sum() > 2  # calls
    before = np.flatnonzero(ordered & ~decides)[0]
    np.testing.assert_array_equal(called[:before], free[:before])


def leveraged(calendar: str) -> tuple[Prices, Portfolio]:
    """Assets of 1.65 times the wealth, which a fall of prices brings beyond a margin."""
    prices = table(7, sigma=0.03)
    debts = {"assets": {"cap": 2.0, "floor": 0.55}, "cash": {"min": -1.0}}
    return prices, made(prices, calendar, exposure={"gross": 1.7, "margin": 0.58}, **debts)


def test_a_margin_call_does_not_wait_for_a_band():
    _, task = leveraged("drift:0.9")
    held = by_task(task, np.tile([-0.65, 0.55, 0.55, 0.55], (800, 1)))
    assert abs(held[:, 1:]).sum(1).max() <= 1 / 0.58


def test_a_margin_call_does_not_wait_for_a_baseline():
    fold = Fold("only", slice(0, FIRST), slice(FIRST, LAST), slice(0, FIRST))
    for calendar in ("yearly", "drift:0.9"):
        prices, task = leveraged(calendar)
        replay = Replay(prices, [fold], task.deciding_at(FIRST), 1.0)
        entry, _ = replay.baseline("baseline", "hold", BuyAndHold())
        ordered = entry.decisions[0][~np.isnan(entry.decisions[0, :, 0])]
        calls = len(ordered) - 1  # it buys once, and never trades of its own accord
        assert calls > 2
        assert abs(ordered[:, 1:]).sum(1).max() <= 1.7 + 1e-6
        said = [f"Trades that margin calls forced: hold ({calls})."]
        # With a band, every row decides.
        assert called(replay, {"hold": entry}, ()) == (said if calendar == "yearly" else [])
        assert called(replay, {"hold": entry}, ("hold",)) == []


class Once(EqualWeight):
    """Decides once a fold, and counts how often it is asked."""

    calendar = "fold"
    asked = 0

    def decide(self, history, held):
        self.asked += 1
        return super().decide(history, held)


def test_at_a_margin_call_the_target_of_a_fold_stands():
    fold = Fold("only", slice(0, FIRST), slice(FIRST, LAST), slice(0, FIRST))
    prices, task = leveraged("yearly")
    once = Once()
    entry, _ = Replay(prices, [fold], task.deciding_at(FIRST), 1.0).baseline("baseline", "x", once)
    assert (~np.isnan(entry.decisions[0, :, 0])).sum() > 2  # calls
    assert once.asked == 1


def test_terms_do_nothing_where_there_are_none():
    held, wanted = np.full(4, 0.25), np.eye(4)[1]
    given = AT_EVERY_ROW.due(5, held) & AT_EVERY_ROW.beyond(held, wanted)
    target, plan = AT_EVERY_ROW.trade(held, wanted, given, None)
    assert target is wanted
    assert plan is AT_EVERY_ROW.begin(held) is AT_EVERY_ROW.unspent(None) is None


def _relatives(prices: Prices) -> np.ndarray:
    return prices.values[FIRST + 1 : LAST + 1] / prices.values[FIRST:LAST]


@pytest.mark.parametrize("calendar", ["yearly", "drift:0.05"])
def test_interest_brings_a_baseline_to_its_orders_at_the_rows_of_an_agent(calendar):
    """A loan at 15% a year, and assets whose fees of 5% do more than their prices."""
    prices = table(6, sigma=0.0005)
    task = Portfolio.of(
        prices,
        window=10,
        horizon=20,
        calendar=calendar,
        cost_model="itemized(cash_rate=0.1, borrow_spread=0.05, carry_rate=-0.05)",
        mandate={
            "assets": {"cap": 2.0, "floor": 0.55},
            "cash": {"min": -1.0},
            "exposure": {"gross": 1.7, "margin": 0.58},
        },
    ).deciding_at(FIRST)
    wanted = np.tile([0.1, 0.3, 0.3, 0.3], (800, 1))  # the mandate makes it 0.55 of each
    rule = type("Rule", (Given,), {"wanted": wanted})()
    fold = Fold("only", slice(0, FIRST), slice(FIRST, LAST), slice(0, FIRST))
    entry, _ = Replay(prices, [fold], task, 2.0).baseline("baseline", "rule", rule)
    ordered = ~np.isnan(entry.decisions[0, :, 0])
    levered = np.array([-0.65, 0.55, 0.55, 0.55])
    agent = abs(by_task(task, np.tile(levered, (800, 1))) - levered).max(1) < 1e-5
    np.testing.assert_array_equal(ordered, agent)
    np.testing.assert_allclose(entry.decisions[0, ordered] - levered, 0, atol=1e-5)
    forced = ordered & ~decision_rows("yearly", prices.dates)[FIRST:LAST]
    assert 3 < forced.sum() < 40
