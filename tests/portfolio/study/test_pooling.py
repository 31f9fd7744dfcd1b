import math

import numpy as np
import pytest

from qfolio.portfolio.backtest.statistics.bootstrap import percentile_interval
from qfolio.portfolio.backtest.statistics.estimates import estimate
from qfolio.portfolio.study.evidence import TableReturns, evidence, z_of
from qfolio.portfolio.study.pooling import (
    RESAMPLES,
    correlations,
    hierarchical_bootstrap,
    p_value,
    pool,
    stouffer,
)

from studies import made_up
from tables import weekdays


def days(first, count):
    dates = np.datetime64("2001-01-01") + np.arange(first, first + count, dtype="m8[D]")
    return tuple(map(str, dates))


def constant(active, count=40):
    """An agent that earns these log returns more than equal weights, which earn nothing."""
    flat = np.zeros(count)
    ours = np.expm1(np.resize(active, count))
    return TableReturns(days(0, count), 252.0, {"a": ours}, {"ew": flat}, {"ew": flat})


def test_stouffer_by_hand():
    assert stouffer([1, 2], [1, 1], np.eye(2)) == pytest.approx(3 / math.sqrt(2))
    assert stouffer([1, 2], [1, 2], np.eye(2)) == pytest.approx(5 / math.sqrt(5))
    assert stouffer([1, 2], [1, 1], np.ones((2, 2))) == pytest.approx(1.5)  # one table, twice
    assert stouffer([1.7], [3], [[1]]) == pytest.approx(1.7)


def test_p_values_by_hand():
    assert p_value(1.959964, both=True) == pytest.approx(0.05, abs=1e-6)
    assert p_value(-1.959964, both=True) == pytest.approx(0.05, abs=1e-6)
    assert p_value(-1.959964, both=False) == 1.0


def test_a_z_is_as_likely_as_its_t():
    rng = np.random.default_rng(0)
    ours, theirs = rng.normal(5e-4, 0.01, (2, 1, 400))
    difference = estimate(ours, theirs, 252)["growth"]
    tails = difference.tails()
    z = z_of(difference)
    assert p_value(z, both=True) == pytest.approx(2 * min(tails))
    assert (z > 0) == (difference.value > 0)
    assert z_of(difference.negated()) == pytest.approx(-z)
    assert z_of(estimate(ours, ours, 252)["growth"]) == 0


def test_a_loss_beyond_doubt_has_a_z():
    """An agent that pays costs at every minute; its t of −80 has no tail in double precision."""
    market, noise = 2e-4 * np.random.default_rng(0).standard_normal((2, 1, 100_000))
    difference = estimate(market + noise - 5e-5, market, 98_280)["growth"]
    assert difference.value / difference.error < -75
    assert -38 < z_of(difference) < -30
    assert z_of(difference.negated()) == -z_of(difference)


def test_the_information_ratio_by_hand():
    found = evidence(constant([0.002, -0.001]), "a").to_reference
    spread = math.sqrt(252) * 0.0015 * math.sqrt(40 / 39)
    assert found.growth == pytest.approx(252 * 0.0005)
    assert found.tracking_error == pytest.approx(spread)
    assert found.information_ratio == pytest.approx(252 * 0.0005 / spread)
    copied = evidence(constant([1e-9, -1e-10]), "a").to_reference
    assert pool({"t": constant([1e-9, -1e-10])}, ["a"])["a"].to_reference.positive == 0
    assert (copied.information_ratio, copied.t, copied.z) == (0, 0, 0)
    assert evidence(constant([0.002]), "a").years == pytest.approx(40 / 252)


def test_to_beat_the_best_rebalancing_is_to_beat_them_all():
    rng = np.random.default_rng(1)
    tested = made_up(rng, 600, 3e-4, "2001-01-02")
    jumpy = tested.rebalancings["equal-weight"] - 1e-4 + 0.02 * rng.standard_normal(600)
    tested = tested._replace(rebalancings={**tested.rebalancings, "jumpy": jumpy})
    ours = tested.agents["tilts"][None]
    each = {
        name: z_of(estimate(ours, theirs[None], 252)["growth"])
        for name, theirs in tested.rebalancings.items()
    }
    found = evidence(tested, "tilts")
    assert found.to_reference.z == pytest.approx(each["equal-weight"])
    assert found.to_rebalanced.z == pytest.approx(min(each.values()))
    growth = {name: np.log1p(x).mean() for name, x in tested.rebalancings.items()}
    assert found.to_rebalanced.reference == max(growth, key=lambda name: growth[name])


def number(found: float | None) -> float:
    assert found is not None
    return found


def risky(count=2000, free=0.0):
    """An agent without cash, and a calm baseline that is mostly cash, of the same market."""
    noise, own = np.random.default_rng(0).standard_normal((2000, 2))[:count].T
    market = 0.0006 + 0.01 * noise
    ours, calm = market, 0.1 * market + 0.9 * 0.0002 + 0.0002 * own
    rates = np.full(count, free) if free else None
    columns = {"ew": market, "calm": calm}
    return TableReturns(days(0, count), 252.0, {"a": ours}, {"ew": market}, columns, rates)


def test_sharpe_ratios_are_in_excess_of_cash():
    without, with_rates = evidence(risky(), "a"), evidence(risky(free=0.0002), "a")
    assert without.baseline == "calm"  # as cash counts as a return for its little risk
    assert number(without.sharpe) < -2
    assert with_rates.baseline == "ew"
    assert with_rates.sharpe == pytest.approx(0, abs=0.1)
    assert with_rates.to_reference == without.to_reference
    rates = risky(free=0.0002)
    beside = evidence(rates._replace(baselines={"calm": rates.baselines["calm"]}), "a")
    assert beside.sharpe == pytest.approx(0, abs=0.1)  # whichever baseline is the best


def test_sharpe_ratios_are_pooled():
    tables = {"one": risky(), "two": risky(count=800)}
    found = pool(tables, ["a"])["a"]
    each = [found.evidence[name] for name in tables]
    assert found.sharpe.difference == pytest.approx(np.mean([one.sharpe for one in each]))
    # The days of the second table are among those of the first, so they count once.
    weights = np.sqrt([one.years for one in each])
    apart = weights @ [number(one.sharpe_z) for one in each] / math.sqrt(weights @ weights)
    assert apart < number(found.sharpe.z) < -2
    assert found.sharpe.positive == 0


def test_a_table_of_four_years_counts_twice_as_much_as_one_of_a_year():
    """Without common days, z is (1 · z₁ + 2 · z₂) / √5."""
    rng = np.random.default_rng(3)
    tables = {
        "short": made_up(rng, 252, -2e-4, "2001-01-01"),
        "long": made_up(rng, 4 * 252, 3e-4, "2011-01-03"),
    }
    found = pool(tables, ["tilts"])["tilts"]
    short, long = (number(found.evidence[name].to_reference.z) for name in tables)
    assert number(found.to_reference.z) == pytest.approx((short + 2 * long) / math.sqrt(5))


def test_correlations_come_from_common_days():
    rng = np.random.default_rng(2)
    x = rng.standard_normal(100)
    same, half = days(0, 100), days(50, 100)
    assert correlations([same, same], [x, 2 * x])[0, 1] == pytest.approx(1)
    assert correlations([same, same], [x, -x])[0, 1] == 0
    assert correlations([same, half], [x, np.append(x[50:], x[:50])])[0, 1] == pytest.approx(0.5)
    assert correlations([same, days(100, 100)], [x, x])[0, 1] == 0


def by_period(dates, x, unit):
    """The last day of each week or month, and the sum of the numbers in it."""
    shift = np.timedelta64(3 if unit == "W" else 0, "D")
    _, places = np.unique((dates + shift).astype(f"M8[{unit}]"), return_inverse=True)
    return dates[np.flatnonzero(np.append(np.diff(places) > 0, True))], np.bincount(places, x)


def text(dates):
    return tuple(map(str, dates))


def test_rows_of_any_length_share_shocks():
    x = np.random.default_rng(5).standard_normal(1200)
    dates = weekdays(1200, "2001-01-01").astype("M8[D]")
    weeks, weekly = by_period(dates, x, "W")
    months, monthly = by_period(dates, x, "M")
    day, first = np.timedelta64(1, "D"), months.astype("M8[M]")
    following = (first + np.timedelta64(1, "M")).astype("M8[D]")
    tables = [
        (text(dates), x),
        (text(weeks), weekly),
        (text(weeks - 2 * day), weekly),
        (text(months), monthly),
        (text(first.astype("M8[D]")), monthly),
        (text(following - day), monthly),
        (tuple(f"{date}-{time}" for date in text(dates) for time in ("103000", "160000")),
         np.repeat(x / 2, 2)),
    ]  # fmt: skip
    found = correlations(*zip(*tables, strict=True))
    # A week may belong to two months.
    assert found == pytest.approx(np.ones((7, 7)), abs=0.15)
    assert np.delete(np.delete(found, [1, 2], 0), [1, 2], 1) == pytest.approx(1)
    assert found[:3, :3] == pytest.approx(1)
    other = np.random.default_rng(6).standard_normal(len(monthly))
    assert correlations([text(dates), text(months)], [x, other])[0, 1] < 0.3


def test_shocks_that_arrive_a_day_later_are_shared():
    """As in Asia those of America; from two years on, months show it."""
    x = np.random.default_rng(5).standard_normal(1201)
    days = text(weekdays(1200, "2001-01-01").astype("M8[D]"))
    assert correlations([days, days], [x[1:], x[:-1]])[0, 1] > 0.85
    assert correlations([days[:200]] * 2, [x[1:201], x[:200]])[0, 1] < 0.3
    rng = np.random.default_rng(6)
    others = [correlations([days] * 2, [*rng.standard_normal((2, 1200))])[0, 1] for _ in range(50)]
    assert np.mean(others) < 0.1


def test_a_few_common_months_say_nothing():
    """Of two tables of years, only what both have in common counts."""
    x = np.random.default_rng(5).standard_normal(1901)
    dates = text(weekdays(1900, "2001-01-01").astype("M8[D]"))
    early, late, shared = x[1:1001], x[900:1900], 100
    daily = np.corrcoef(early[-shared:], late[:shared])[0, 1] * shared / 1000
    assert correlations([dates[:1000], dates[900:]], [early, late])[0, 1] == max(0, daily)


def test_one_market_with_two_frequencies_counts_once():
    """Were its rows independent, its z would be √2 times as large."""
    rng = np.random.default_rng(7)
    dates = weekdays(1500, "2001-01-01").astype("M8[D]")

    def table(days, active, year):
        flat = np.zeros(len(days))
        ours = {"a": np.expm1(active)}
        return TableReturns(text(days), year, ours, {"ew": flat}, {"ew": flat})

    active = 3e-4 + 0.002 * rng.standard_normal(1500)
    weeks, sums = by_period(dates, active, "W")
    daily, weekly = table(dates, active, 252), table(weeks, sums, 52)
    z = [number(pool({"t": each}, ["a"])["a"].to_reference.z) for each in (daily, weekly)]
    both = pool({"daily": daily, "weekly": weekly}, ["a"])["a"].to_reference.z
    assert min(z) > 1
    assert number(both) == pytest.approx(np.mean(z), rel=0.01)


def test_the_bootstrap_draws_tables():
    tables = [np.zeros((1, 30)), np.ones((1, 50))]
    drawn = hierarchical_bootstrap(tables, 4000, np.random.default_rng(0))[:, 0]
    values, counts = np.unique(drawn.round(9), return_counts=True)
    assert values.tolist() == [0, 0.5, 1]
    assert counts / 4000 == pytest.approx([0.25, 0.5, 0.25], abs=0.03)


def test_the_bootstrap_of_one_table_draws_days():
    days = np.random.default_rng(3).standard_normal((1, 400))
    drawn = hierarchical_bootstrap([days], 2000, np.random.default_rng(0))[:, 0]
    assert drawn.mean() == pytest.approx(days.mean(), abs=0.01)
    assert drawn.std() == pytest.approx(1 / 20, rel=0.15)


@pytest.mark.parametrize("between", [0.0, 0.1])
def test_intervals_cover_the_mean_of_all_tables(between):
    rng = np.random.default_rng(4)
    covered = 0
    for _ in range(100):
        tables = [
            0.1 + between * rng.standard_normal() + rng.standard_normal((1, 100)) for _ in range(8)
        ]
        drawn = hierarchical_bootstrap(tables, 400, rng)[:, 0]
        low, high = np.quantile(drawn, [0.025, 0.975])
        covered += low <= 0.1 <= high
    assert covered >= 92  # the noise of days counts twice, so that intervals are rather wide


@pytest.mark.parametrize("shared", [0.0, 0.6])
def test_intervals_of_tables_with_common_shocks_cover_the_mean(shared, monkeypatch):
    monkeypatch.setattr("qfolio.portfolio.study.pooling.RESAMPLES", 200)
    rng, missed = np.random.default_rng(7), 0
    for _ in range(60):
        common, tables = rng.standard_normal(250), {}
        for i in range(8):
            active = shared**0.5 * common + (1 - shared) ** 0.5 * rng.standard_normal(250)
            flat = 0.01 * rng.standard_normal(250)
            each = {"a": flat + 0.003 * active}, {"ew": flat}, {"ew": flat}
            tables[f"t{i}"] = TableReturns(days(0, 250), 252.0, *each)
        pooled = pool(tables, ["a"])["a"].to_reference
        assert pooled.low is not None
        assert pooled.high is not None
        missed += not pooled.low <= 0 <= pooled.high
    assert missed <= 6  # 25 with shared shocks, if tables counted as independent


def test_an_interval_is_as_much_wider_as_the_errors_that_tables_share():
    """Errors are those of the means: four calm years count less than a wild one."""
    rng = np.random.default_rng(9)
    common, tables = rng.standard_normal(1008), {}
    for name, size, count in (("calm", 0.001, 1008), ("wild", 0.003, 252)):
        moves = size * (common[:count] + 0.5 * rng.standard_normal(count))
        flat = np.zeros(count)
        each = {"a": np.expm1(moves)}, {"ew": flat}, {"ew": flat}
        tables[name] = TableReturns(days(0, count), 252.0, *each)
    pooled = pool(tables, ["a"])["a"].to_reference
    active = [np.log1p(each.agents["a"]) for each in tables.values()]
    drawn = hierarchical_bootstrap(
        [252 * each[None] for each in active], RESAMPLES, np.random.default_rng(0)
    )
    mean = 252 * np.mean([each.mean() for each in active])
    one, other = (each.std(ddof=1) / math.sqrt(len(each)) for each in active)
    shared = correlations([each.days for each in tables.values()], active)[0, 1]
    wider = math.sqrt(1 + 2 * shared * one * other / (one**2 + other**2))
    assert (pooled.low, pooled.high) == pytest.approx(
        tuple(mean + wider * (percentile_interval(drawn[:, 0]) - mean))
    )


def test_tables_are_pooled():
    tables = {f"t{i}": constant([0.002 * (i + 1), 0.0], 40 + 10 * i) for i in range(3)}
    pooled = pool(tables, ["a"])["a"].to_reference
    each = [evidence(tested, "a").to_reference for tested in tables.values()]
    growths = [active.growth or math.nan for active in each]
    assert pooled.growth == pytest.approx(np.mean(growths))
    assert pooled.low is not None
    assert pooled.high is not None
    assert pooled.low <= np.mean(growths) <= pooled.high
    assert pooled.worst == "t0"
    assert pooled.positive == 3
    assert pool(tables, ["a"]) == pool(tables, ["a"])


def test_a_total_loss_is_the_worst_and_has_no_numbers():
    lost = constant([0.001])
    lost.agents["a"][7] = -1.0
    found = evidence(lost, "a").to_reference
    assert (found.growth, found.information_ratio, found.t, found.z) == (None, None, None, None)
    pooled = pool({"good": constant([0.002, 0.0]), "lost": lost}, ["a"])["a"].to_reference
    assert pooled.worst == "lost"
    assert (pooled.growth, pooled.low, pooled.z, pooled.p) == (None, None, None, None)
    assert pooled.positive == 1
