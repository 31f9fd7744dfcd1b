import dataclasses
import itertools
import json
import math

import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest import bootstrap
from qfolio.portfolio.backtest.assessment import Strategy, assess, luck, verdict
from qfolio.portfolio.backtest.bootstrap import (
    block_length,
    bootstrap_measures,
    percentile_interval,
    stationary_bootstrap_indices,
)
from qfolio.portfolio.backtest.measures import MEASURES, drawdown, measures, monthly
from qfolio.portfolio.backtest.sharpe import (
    deflated_sharpe,
    expected_maximum_sharpe,
    minimum_track_record,
    probabilistic_sharpe,
)


def days(count: int) -> np.ndarray:
    return np.datetime64("2001-01-01") + np.arange(count)


def autoregressive(
    rng: np.random.Generator, rows: int, count: int, coefficient: float
) -> np.ndarray:
    noise = rng.standard_normal((count + 50, rows))
    for before, now in itertools.pairwise(noise):
        now += coefficient * before
    return noise[50:].T


def strategy(
    rng: np.random.Generator, kind: str = "agent", seeds: int = 3, count: int = 300
) -> Strategy:
    return Strategy(
        kind,
        0.0005 + 0.01 * rng.standard_normal((seeds, count)),
        rng.random((seeds, count)) / 10,
        rng.random((seeds, count)) / 1000,
    )


def text(sentence: str) -> str:
    return sentence.replace("\N{NARROW NO-BREAK SPACE}", " ").replace("\N{MINUS SIGN}", "-")


# Measures ------------------------------------------------------------------------------------


def test_measures_by_hand() -> None:
    # Wealth 1.1, 0.88, 1.144, 1.0296 in half-year periods, so two years in all.
    table = measures([0.1, -0.2, 0.3, -0.1], [1.0, 0.0, 0.5, 0.1], [0.01, 0, 0.005, 0], 2)
    mean = 0.1 / 4
    spread = math.sqrt((0.075**2 + 0.225**2 + 0.275**2 + 0.125**2) / 3)
    growth = math.sqrt(1.0296) - 1
    expected = {
        "growth": growth,
        "volatility": spread * math.sqrt(2),
        "sharpe": mean / spread * math.sqrt(2),
        "sortino": mean / math.sqrt((0.04 + 0.01) / 4) * math.sqrt(2),
        "drawdown": 0.2,
        "calmar": growth / 0.2,
        "turnover": 0.8,
        "cost_drag": math.sqrt(1.0296 / (0.99 * 0.995)) - math.sqrt(1.0296),
    }
    assert set(table) == set(MEASURES)
    for name, value in expected.items():
        np.testing.assert_allclose(table[name], value, rtol=1e-12, err_msg=name)


def test_measures_keep_the_leading_shape() -> None:
    rng = np.random.default_rng(0)
    returns, turnover, cost = rng.random((3, 2, 4, 9)) / 10
    table = measures(returns, turnover, cost, 252)
    one = measures(returns[1, 2], turnover[1, 2], cost[1, 2], 252)
    for name in MEASURES:
        assert table[name].shape == (2, 4)
        np.testing.assert_allclose(table[name][1, 2], one[name], rtol=1e-12)


def test_drawdown_counts_from_the_start() -> None:
    # Wealth 0.5, 0.75, 1.5, 0.3, 0.
    series = drawdown([-0.5, 0.5, 1.0, -0.8, -1.0])
    np.testing.assert_allclose(series, [0.5, 0.25, 0, 0.8, 1], atol=1e-15)


def test_cash_is_all_zeros() -> None:
    table = measures(np.zeros(5), np.zeros(5), np.zeros(5), 252)
    assert {name: float(value) for name, value in table.items()} == dict.fromkeys(MEASURES, 0)


@pytest.mark.parametrize("rate", [0.01, 0.1, 1 / 3])
def test_equal_gains_have_no_volatility(rate: float) -> None:
    table = measures(np.full(7, rate), np.zeros(7), np.zeros(7), 1)
    assert table["volatility"] == table["drawdown"] == 0
    assert table["sharpe"] == table["sortino"] == table["calmar"] == math.inf
    assert table["growth"] == pytest.approx(rate)
    loss = measures(np.full(7, -rate), np.zeros(7), np.zeros(7), 1)
    assert loss["sharpe"] == -math.inf
    assert loss["sortino"] == pytest.approx(-1)


def test_total_loss() -> None:
    table = measures([0.1, -1.0, 0.1], np.zeros(3), np.full(3, 0.01), 252)
    assert table["growth"] == -1
    assert table["drawdown"] == 1
    assert table["calmar"] == -1
    assert table["cost_drag"] == 0  # nothing was left to lose


def test_a_single_period() -> None:
    table = measures([[0.02]], [[0.5]], [[0.01]], 12)
    assert math.isnan(table["volatility"].item())
    assert math.isnan(table["sharpe"].item())
    np.testing.assert_allclose(table["growth"], 1.02**12 - 1)
    np.testing.assert_allclose(table["cost_drag"], (1.02 / 0.99) ** 12 - 1.02**12)
    assert measures([1e6], [0], [0], 252)["growth"] == math.inf


def test_doubled_cost_doubles_the_logarithm_of_the_drag() -> None:
    # The same gross path +10 % a year, a trade of 1 % or 1.99 % = 1 − 0.99² of wealth each year.
    once = measures(np.full(3, 1.1 * 0.99 - 1), np.ones(3), np.full(3, 0.01), 1)
    twice = measures(np.full(3, 1.1 * 0.99**2 - 1), np.ones(3), np.full(3, 0.0199), 1)
    assert once["cost_drag"] == pytest.approx(1.1 * 0.01)
    assert twice["cost_drag"] == pytest.approx(1.1 * 0.0199)


@pytest.mark.parametrize(
    ("returns", "turnover", "cost", "message"),
    [
        ([0.1, math.nan], [0, 0], [0, 0], "returns of the track record hold missing"),
        ([0.1, math.inf], [0, 0], [0, 0], "missing or infinite"),
        ([0.1, -1.01], [0, 0], [0, 0], "at least −1"),
        ([0.1, 0], [0, -0.1], [0, 0], "turnover of"),
        ([0.1, 0], [0, 0], [0, 1], "below 1"),
        ([0.1, 0], [0, 0], [0, -0.1], "cost of"),
        ([0.1, 0], [0], [0, 0], "same shape"),
        ([], [], [], "at least one period"),
        (0.1, 0, 0, "at least one period"),
        (["a"], [0], [0], "table of numbers"),
    ],
)
def test_measures_refuse(returns: object, turnover: object, cost: object, message: str) -> None:
    with pytest.raises(QfolioError, match=message):
        measures(returns, turnover, cost, 252)  # type: ignore[arg-type]


def test_monthly_by_hand() -> None:
    dates = ["1969-11-30", "1969-12-01", "1969-12-31", "1971-01-04", "1971-02-01", "1971-02-02"]
    years, table = monthly([[0.1, 0.2, -0.5, 0.3, 0.1, -1.0]], dates)
    assert years == [1969, 1970, 1971]
    expected = np.full((1, 3, 12), np.nan)
    expected[0, 0, 10:] = [0.1, 1.2 * 0.5 - 1]
    expected[0, 2, :2] = [0.3, -1]
    np.testing.assert_allclose(table, expected)


@pytest.mark.parametrize(
    "dates", [["2001-01-02", "2001-01-01"], ["2001-01-01"] * 2, ["2001-01-01"], ["x", "y"]]
)
def test_monthly_refuses_dates(dates: list[str]) -> None:
    with pytest.raises(QfolioError, match="date"):
        monthly([0.1, 0.2], dates)


# Resampling time -----------------------------------------------------------------------------


@pytest.mark.parametrize("coefficient", [-0.4, 0.3, 0.6])
def test_block_length_of_an_autoregression(coefficient: float) -> None:
    # R(k) ∝ φ^k gives G / g(0) = 2 φ / (1 − φ²), so b = (2 |φ| / (1 − φ²))^⅔ n^⅓.
    count = 8000
    series = autoregressive(np.random.default_rng(1), 9, count, coefficient)
    theory = (2 * abs(coefficient) / (1 - coefficient**2)) ** (2 / 3) * count ** (1 / 3)
    assert np.median([block_length(row) for row in series]) == pytest.approx(theory, rel=0.15)


def test_block_length_by_hand() -> None:
    # Neighbours alone are related, so the window is 2 wide, with the weights 1 at lag 1 and 0 at
    # lag 2: G = 2 R(1) and g(0) = R(0) + 2 R(1).
    noise = np.random.default_rng(1).standard_normal(501)
    series = noise[1:] + 0.8 * noise[:-1]
    centred = series - series.mean()
    none, one = centred @ centred, centred[1:] @ centred[:-1]
    expected = ((2 * one / (none + 2 * one)) ** 2 * 500) ** (1 / 3)
    assert block_length(series) == pytest.approx(expected)
    assert block_length(1000 - 3 * series) == pytest.approx(expected)


def test_block_length_is_bounded() -> None:
    # ±1 in turns, 8 in all: R(k) = ± (1 − k/8), the window is 7 wide, and the length would be 5.8.
    assert block_length([1.0, -1.0] * 4) == 3  # 8 / 3, rounded up


@pytest.mark.parametrize("series", [[0.1], [0.1, 0.2], [0.1] * 100, [0.0] * 100])
def test_block_length_of_hardly_anything(series: list[float]) -> None:
    assert block_length(series) == 1


def test_indices_are_blocks_of_geometric_length_in_a_circle() -> None:
    picks = stationary_bootstrap_indices(50, 5.0, 4000, np.random.default_rng(2))
    assert picks.shape == (4000, 50)
    follows = picks[:, 1:] == (picks[:, :-1] + 1) % 50
    # Each day follows its predecessor with chance 4/5, or by accident: 4/5 + 1/5 · 1/50.
    np.testing.assert_allclose(follows.mean(axis=0), 0.804, atol=0.03)
    pairs = follows[:, 1:] & follows[:, :-1]
    assert pairs.mean() == pytest.approx(0.804**2, abs=0.01)
    # Every day is equally likely at every place: expected 80, standard deviation 9.
    for place in (0, 1, 25, 49):
        counts = np.bincount(picks[:, place], minlength=50)
        assert (abs(counts - 80) < 45).all()


def test_indices_of_block_one_are_independent() -> None:
    picks = stationary_bootstrap_indices(10, 1.0, 5000, np.random.default_rng(3))
    assert (picks[:, 1:] == (picks[:, :-1] + 1) % 10).mean() == pytest.approx(0.1, abs=0.01)


def test_bootstrap_measures_are_the_measures_of_the_resampled_days(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(4)
    returns, turnover, cost = rng.random((3, 2, 30)) / 10
    returns -= 0.05
    returns[1, 7] = -1  # some histories are ruined, others are not
    monkeypatch.setattr(bootstrap, "_CHUNK", 90)  # three histories at a time
    drawn = bootstrap_measures(returns, turnover, cost, 252, 4, 7, np.random.default_rng(5))
    again = np.random.default_rng(5)
    picks = np.concatenate([stationary_bootstrap_indices(30, 4, n, again) for n in (3, 3, 1)])
    ruined = (picks == 7).any(axis=1)
    assert 0 < ruined.sum() < 7
    for row, days_drawn in enumerate(picks):
        direct = measures(returns[:, days_drawn], turnover[:, days_drawn], cost[:, days_drawn], 252)
        for name in MEASURES:
            np.testing.assert_allclose(drawn[name][row], direct[name], rtol=1e-9, err_msg=name)
    np.testing.assert_array_equal(drawn["growth"][:, 1] == -1, ruined)


def test_percentile_interval_by_hand() -> None:
    samples = np.random.default_rng(6).permutation(np.arange(1.0, 40.0))
    assert percentile_interval(samples) == (1, 39)  # the (39 + 1) · 2.5 % = first from either end
    assert percentile_interval(samples, 0.5) == (10, 30)
    samples[samples < 5] = -math.inf
    assert percentile_interval(samples) == (-math.inf, 39)


def test_blocks_cover_where_independent_days_do_not() -> None:
    # Log returns with φ = 0.5: the mean of n days varies (1 + φ) / (1 − φ) = 3 times as much as
    # independent days would tell, so their 95 % intervals cover 2 Φ(1.96 / √3) − 1 = 74 %.
    rng = np.random.default_rng(7)
    series = np.expm1(0.01 * autoregressive(rng, 150, 300, 0.5))
    zeros = np.zeros((1, 300))

    def coverage(block: float | None) -> float:
        hits = 0
        for row in series:
            length = block_length(row) if block is None else block
            drawn = bootstrap_measures(row[None], zeros, zeros, 252, length, 200, rng)
            low, high = percentile_interval(drawn["growth"][:, 0])
            hits += low <= 0 <= high
        return hits / len(series)

    assert coverage(1.0) == pytest.approx(0.74, abs=0.08)
    assert coverage(None) > 0.88


# Sharpe ratios and luck ----------------------------------------------------------------------


def test_probabilistic_sharpe_of_the_paper() -> None:
    # Bailey & López de Prado (2012): 24 months, Sharpe ratio 0.458 a month.
    assert probabilistic_sharpe(0.458, 24, 0, 3) == pytest.approx(0.982, abs=5e-4)
    assert probabilistic_sharpe(0.458, 24, -2.448, 10.164) == pytest.approx(0.913, abs=5e-4)


def test_probabilistic_sharpe_by_hand() -> None:
    # √(1 + 0.5 · 0.2 + 5/4 · 0.04) = √1.15, (0.2 − 0.1) · 10 / √1.15 = 0.9325; Φ = 0.82447.
    assert probabilistic_sharpe(0.2, 101, -0.5, 6, 0.1) == pytest.approx(0.82447, abs=1e-5)
    assert probabilistic_sharpe(0.1, 101, -0.5, 6, 0.1) == 0.5
    assert probabilistic_sharpe(math.inf, 10, 0, 3) == 1
    assert probabilistic_sharpe(-math.inf, 10, 0, 3) == 0


@pytest.mark.parametrize(("per_year", "years"), [(252, 2.73), (52, 2.83), (12, 3.24)])
def test_minimum_track_record_of_the_paper(per_year: int, years: float) -> None:
    # An annual Sharpe ratio of 2 is to be shown above 1 with normal returns.
    periods = minimum_track_record(2 / math.sqrt(per_year), 0, 3, 1 / math.sqrt(per_year))
    assert periods / per_year == pytest.approx(years, abs=5e-3)


def test_minimum_track_record_of_the_paper_for_hedge_funds() -> None:
    periods = minimum_track_record(2 / math.sqrt(12), -0.72, 5.78, 1 / math.sqrt(12))
    assert periods / 12 == pytest.approx(4.99, abs=5e-3)


def test_minimum_track_record_inverts_the_probability() -> None:
    periods = minimum_track_record(0.1, -1, 8, 0.02, 0.9)
    assert periods == pytest.approx(round(periods), abs=1)
    assert probabilistic_sharpe(0.1, math.ceil(periods), -1, 8, 0.02) >= 0.9
    assert probabilistic_sharpe(0.1, math.floor(periods), -1, 8, 0.02) < 0.9
    assert minimum_track_record(0.1, 0, 3, 0.1) == math.inf
    assert minimum_track_record(math.inf, 0, 3) == 1


def test_expected_maximum_sharpe() -> None:
    # The best of N standard normal draws, by simulation, and one trial picks nothing.
    best = np.random.default_rng(8).standard_normal((20_000, 40)).max(axis=1).mean()
    assert expected_maximum_sharpe(40, 1.0) == pytest.approx(best, rel=0.02)
    assert expected_maximum_sharpe(40, 0.25) == pytest.approx(expected_maximum_sharpe(40, 1) / 2)
    assert expected_maximum_sharpe(1, 1.0) == 0


def test_deflated_sharpe_of_the_paper() -> None:
    # Bailey & López de Prado (2014): annual Sharpe ratio 2.5 over five years of 250 days, chosen
    # from 100 trials whose annual Sharpe ratios have the variance 1/2.
    sharpe, variance = 2.5 / math.sqrt(250), 0.5 / 250
    assert expected_maximum_sharpe(100, variance) == pytest.approx(0.1132, abs=5e-5)
    assert deflated_sharpe(sharpe, 1250, -3, 10, 100, variance) == pytest.approx(0.9004, abs=5e-5)
    assert deflated_sharpe(sharpe, 1250, -3, 10, 46, variance) == pytest.approx(0.9505, abs=5e-5)
    assert deflated_sharpe(sharpe, 1250, 0, 3, 88, variance) == pytest.approx(0.9505, abs=5e-5)


# Sentences -----------------------------------------------------------------------------------


def test_verdict_at_the_boundary() -> None:
    nothing = "No evidence that dqn beats equal weight after costs: "
    assert text(verdict("dqn", "equal weight", 0.008, -0.019, 0.034)) == (
        f"{nothing}the difference in annual growth is +0.8 % (95 % interval -1.9 % to +3.4 %)."
    )
    assert verdict("dqn", "equal weight", 0.01, 0.0, 0.02).startswith(nothing)
    assert verdict("dqn", "equal weight", -0.01, -0.02, 0.0).startswith(nothing)
    assert verdict("dqn", "equal weight", 0.0, 0.0, 0.0).startswith(nothing)
    assert verdict("dqn", "equal weight", 1e-8, 0.9e-6, 1e-8).startswith(nothing)  # rounding
    least = 1.1e-6
    assert verdict("dqn", "it", 0.01, least, 0.02).startswith("dqn beats it after costs: ")
    assert verdict("dqn", "it", -0.01, -0.02, -least).startswith("dqn falls short of it after ")
    assert verdict("dqn", "it", math.nan, math.nan, math.nan).startswith("No evidence")


def test_verdict_shows_enough_digits_to_tell_an_end_from_zero() -> None:
    sentence = text(verdict("dqn", "it", 0.008, 0.00004, 0.02))
    assert sentence.endswith("+0.800 % (95 % interval +0.004 % to +2.000 %).")
    sentence = text(verdict("dqn", "it", -math.inf, -math.inf, 0.02))
    assert sentence.endswith("-∞ % (95 % interval -∞ % to +2.0 %).")


def test_luck_in_words() -> None:
    assert text(luck("dqn", 0.9, 0.31, 0.8349, 10)) == (
        "The Sharpe ratio of dqn, 0.90 a year, may be luck: the probability that the true one "
        "exceeds 0.31, what the best of 10 trials without skill shows on average, is 83.4 %, "
        "less than the usual 95 %."
    )
    assert text(luck("dqn", -0.9, 0.0, 0.9499999, 1)).endswith(
        "-0.90 a year, may be luck: the probability that the true one exceeds zero is 94.9 %, "
        "less than the usual 95 %."
    )
    assert "is more than luck is likely to explain" in luck("dqn", 0.9, 0.31, 0.95, 10)
    assert luck("dqn", math.nan, 0.31, math.nan, 10).count("undefined") == 2


# The whole -----------------------------------------------------------------------------------


def test_assess_by_hand_on_one_block() -> None:
    rng = np.random.default_rng(9)
    weak, strong, agent = (
        strategy(rng, "baseline", 1), strategy(rng, "baseline", 1), strategy(rng),
    )  # fmt: skip
    strong = strong._replace(returns=np.asarray(strong.returns) + 0.01)
    everything = {"equal weight": weak, "strong": strong, "dqn": agent}
    result = assess(everything, days(300), periods_per_year=252, other_trials=2)
    table = measures(agent.returns, agent.turnover, agent.cost, 252)
    dqn = result.strategies["dqn"]
    assert result.best_baseline == "strong"
    assert (result.first_date, result.last_date) == ("2001-01-01", "2001-10-27")
    assert result.trials == 3 + 2
    for name in MEASURES:
        measure = dqn.measures[name]
        assert measure.per_seed == tuple(table[name])
        assert measure.mean == pytest.approx(table[name].mean())
        assert measure.over_seeds is not None
        margin = 4.302653 * table[name].std(ddof=1) / math.sqrt(3)  # t of 2 degrees of freedom
        assert measure.over_seeds[1] - measure.mean == pytest.approx(margin, rel=1e-5)
        assert result.strategies["strong"].measures[name].over_seeds is None
        assert measure.over_time[0] < measure.over_time[1]

    baseline = measures(weak.returns, weak.turnover, weak.cost, 252)
    difference = dqn.to_reference
    assert difference is not None
    assert difference.growth == pytest.approx(
        np.log1p(table["growth"]).mean() - np.log1p(baseline["growth"][0])
    )
    assert difference.sharpe == pytest.approx(table["sharpe"].mean() - baseline["sharpe"][0])
    assert difference.growth_interval[0] < difference.growth < difference.growth_interval[1]
    assert difference.verdict.startswith("No evidence that dqn beats equal weight after costs")
    best = dqn.to_best_baseline
    assert best is not None
    assert best.verdict.startswith("dqn falls short of strong after costs")
    assert result.strategies["strong"].to_best_baseline is None
    assert result.strategies["equal weight"].to_reference is None

    variance = max(np.var(table["sharpe"], ddof=1) / 252, 1 / 299)
    test = dqn.sharpe_test
    threshold = expected_maximum_sharpe(5, variance)
    assert test.threshold == pytest.approx(threshold * math.sqrt(252))
    sharpe = table["sharpe"].mean() / math.sqrt(252)
    assert test.deflated == pytest.approx(
        probabilistic_sharpe(sharpe, 300, test.skewness, test.kurtosis, threshold)
    )
    assert test.deflated < test.probabilistic
    alone = result.strategies["equal weight"].sharpe_test
    assert alone.deflated == alone.probabilistic  # nobody picked it from anything


def test_skewness_and_kurtosis_by_hand() -> None:
    # One day of +3 among three of −1: variance 3, third moment 6, fourth 21.
    returns = np.tile([[0.03, -0.01, -0.01, -0.01]], 5)
    zeros = np.zeros((1, 20))
    result = assess(
        {"equal weight": ("baseline", returns, zeros, zeros)}, days(20), periods_per_year=252,
        resamples=10,
    )  # fmt: skip
    test = result.strategies["equal weight"].sharpe_test
    assert test.skewness == pytest.approx(6 / 3**1.5)
    assert test.kurtosis == pytest.approx(21 / 9)


def test_order_of_seeds_changes_nothing() -> None:
    rng = np.random.default_rng(10)
    base, agent = strategy(rng, "baseline", 1), strategy(rng, seeds=5)
    order = [3, 0, 4, 2, 1]
    shuffled = Strategy("agent", *(np.asarray(values)[order] for values in agent[1:]))
    first, second = (
        assess({"equal weight": base, "dqn": entry}, days(300), periods_per_year=252)
        for entry in (agent, shuffled)
    )
    for name, measure in first.strategies["dqn"].measures.items():
        other = second.strategies["dqn"].measures[name]
        assert [measure.per_seed[seed] for seed in order] == list(other.per_seed)
        assert measure == dataclasses.replace(other, per_seed=measure.per_seed)
    for field in ("to_reference", "to_best_baseline", "sharpe_test"):
        assert getattr(first.strategies["dqn"], field) == getattr(second.strategies["dqn"], field)


def test_a_strategy_does_not_differ_from_itself() -> None:
    rng = np.random.default_rng(11)
    base = strategy(rng, "baseline", 1)
    copies = {"equal weight": base, "dqn": base._replace(kind="agent"), "noise": strategy(rng)}
    result = assess(copies, days(300), periods_per_year=252)
    difference = result.strategies["dqn"].to_reference
    assert difference is not None
    assert difference.growth == difference.sharpe == 0
    assert difference.growth_interval == difference.sharpe_interval == (0, 0)
    assert "0.0 % (95 % interval 0.0 % to 0.0 %)" in text(difference.verdict)


def test_differences_are_paired() -> None:
    # The agent is equal weight and 0.01 % more every day: the days cannot blur that.
    rng = np.random.default_rng(12)
    base = strategy(rng, "baseline", 1)
    returns = np.asarray(base.returns)
    agent = Strategy("agent", (1 + returns) * math.exp(1e-4) - 1, base.turnover, base.cost)
    result = assess({"equal weight": base, "dqn": agent}, days(300), periods_per_year=252)
    difference = result.strategies["dqn"].to_reference
    assert difference is not None
    np.testing.assert_allclose(difference.growth_interval, 0.0252, rtol=1e-9)
    assert difference.verdict.startswith("dqn beats equal weight after costs")
    assert np.ptp(result.strategies["dqn"].measures["growth"].over_time) > 0.1


def test_differences_carry_the_doubt_about_seeds() -> None:
    # Every seed is equal weight times its own constant, so that all doubt is about seeds: the
    # interval is normal with the variance of the mean, s² / 6.
    rng = np.random.default_rng(13)
    base = strategy(rng, "baseline", 1)
    extra = np.array([-0.08, -0.03, 0.0, 0.02, 0.04, 0.05])
    returns = (1 + np.asarray(base.returns)) * np.exp(extra / 252)[:, None] - 1
    agent = Strategy("agent", returns, np.zeros((6, 300)), np.zeros((6, 300)))
    result = assess({"equal weight": base, "dqn": agent}, days(300), periods_per_year=252)
    difference = result.strategies["dqn"].to_reference
    assert difference is not None
    assert difference.growth == pytest.approx(0, abs=1e-12)
    width = 2 * 1.96 * extra.std(ddof=1) / math.sqrt(6)
    assert np.diff(difference.growth_interval).item() == pytest.approx(width, rel=0.08)


def test_block_length_listens_to_the_size_of_moves() -> None:
    # Calm and wild months in turn: no return tells the next, but its size does.
    rng = np.random.default_rng(14)
    size = np.repeat(np.exp(rng.normal(0, 1, 60)), 20)
    returns = 0.01 * (size * rng.choice([-1, 1], 1200))[None]
    zeros = np.zeros_like(returns)
    entry = ("baseline", returns, zeros, zeros)
    result = assess({"equal weight": entry}, days(1200), periods_per_year=252, resamples=10)
    assert result.block_length > 15 > 2 * block_length(returns[0])


def test_many_trials_raise_the_threshold_however_alike_the_seeds_are() -> None:
    """Seeds of one agent hardly differ; a thousand other trials could still be lucky."""
    rng = np.random.default_rng(3)
    one = strategy(rng, seeds=1)
    alike = one._replace(
        returns=np.asarray(one.returns) + rng.normal(0, 1e-6, (5, 300)),
        turnover=np.repeat(one.turnover, 5, 0),
        cost=np.repeat(one.cost, 5, 0),
    )
    strategies = {"equal weight": strategy(rng, "baseline", 1), "dqn": alike}
    result = assess(strategies, days(300), periods_per_year=252, other_trials=1000)
    threshold = result.strategies["dqn"].sharpe_test.threshold
    assert threshold == pytest.approx(math.sqrt(252) * expected_maximum_sharpe(1005, 1 / 299))
    assert threshold > 2


def test_trials_without_a_known_spread() -> None:
    rng = np.random.default_rng(15)
    strategies = {"equal weight": strategy(rng, "baseline", 1), "dqn": strategy(rng, seeds=1)}
    result = assess(strategies, days(300), periods_per_year=252, other_trials=9)
    threshold = result.strategies["dqn"].sharpe_test.threshold
    assert threshold == pytest.approx(math.sqrt(252) * expected_maximum_sharpe(10, 1 / 299))
    result = assess(strategies, days(300), periods_per_year=252)
    assert result.trials == 1
    assert result.strategies["dqn"].sharpe_test.threshold == 0


def test_json_of_the_worst() -> None:
    # A total loss, cash, and gains without any risk: nothing infinite reaches the file.
    zeros, gains = np.zeros((2, 30)), np.full((2, 30), 0.01)
    ruin = np.full((2, 30), 0.01)
    ruin[:, 3] = -1
    mixed = np.stack([gains[0], -gains[0]])
    strategies = {
        "equal weight": ("baseline", ruin[:1], zeros[:1], zeros[:1]),
        "cash": ("baseline", zeros[:1], zeros[:1], zeros[:1]),
        "ruin": ("agent", ruin, zeros, zeros),
        "gains": ("agent", gains, zeros, zeros),
        "mixed": ("agent", mixed, zeros, zeros),
    }
    result = assess(strategies, days(30), periods_per_year=252)
    content = json.loads(json.dumps(result.to_json(), allow_nan=False))
    ruined = content["strategies"]["ruin"]
    assert ruined["measures"]["growth"]["mean"] == -1
    assert content["strategies"]["gains"]["measures"]["sharpe"]["mean"] is None
    assert content["strategies"]["mixed"]["measures"]["sharpe"]["mean"] is None
    assert content["strategies"]["cash"]["measures"]["sharpe"]["over_time"] == [0, 0]
    assert content["best_baseline"] == "cash"
    assert ruined["to_best_baseline"]["growth"] is None  # −∞
    assert result.strategies["ruin"].to_best_baseline is not None
    assert result.strategies["ruin"].to_reference is not None
    assert ruined["to_reference"]["growth"] == 0  # both lost everything
    assert ruined["to_reference"]["growth_interval"] == [0, 0]  # on whichever days, together
    assert ruined["to_best_baseline"]["growth_interval"][0] is None


def test_assess_is_repeatable_and_its_seed_counts() -> None:
    rng = np.random.default_rng(16)
    strategies = {"equal weight": strategy(rng, "baseline", 1), "dqn": strategy(rng)}
    first, second, third = (
        assess(strategies, days(300), periods_per_year=252, resamples=200, seed=seed)
        for seed in (0, 0, 1)
    )
    assert first == second != third
    assert first.to_json()["strategies"]["dqn"]["seeds"] == 3


def refusals() -> list[tuple[dict[str, object], dict[str, object], str]]:
    good = ("baseline", np.zeros((1, 4)), np.zeros((1, 4)), np.zeros((1, 4)))
    flat = ("agent", np.zeros(4), np.zeros(4), np.zeros(4))
    long = ("agent", np.zeros((1, 5)), np.zeros((1, 5)), np.zeros((1, 5)))
    short = ("baseline", np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 1)))
    holes = ("agent", np.full((1, 4), np.nan), np.zeros((1, 4)), np.zeros((1, 4)))
    return [
        ({}, {}, "there are: none"),
        ({"hold": good}, {}, "'equal weight' is not among the baselines.*there are: hold"),
        ({"equal weight": ("agent", *good[1:])}, {}, "not among the baselines"),
        ({"equal weight": good, "dqn": ("robot", *good[1:])}, {}, "dqn is of kind 'robot'"),
        ({"equal weight": good, "dqn": flat}, {}, r"dqn have the shape \(4,\)"),
        ({"equal weight": good, "dqn": long}, {}, "same periods.*equal weight 4, dqn 5"),
        ({"equal weight": good, "dqn": holes}, {}, "returns of dqn hold missing"),
        ({"equal weight": good}, {"dates": days(3)}, "4 returns and dates of shape"),
        ({"equal weight": good}, {"dates": days(4)[::-1]}, "increase"),
        ({"equal weight": good}, {"resamples": 0}, "one resample"),
        ({"equal weight": good}, {"periods_per_year": 0.0}, "positive number of periods"),
        ({"equal weight": short}, {"dates": days(1)}, "two periods"),
    ]


@pytest.mark.parametrize(("strategies", "options", "message"), refusals())
def test_assess_refuses(
    strategies: dict[str, object], options: dict[str, object], message: str
) -> None:
    with pytest.raises(QfolioError, match=message):
        assess(strategies, **{"dates": days(4), "periods_per_year": 252.0} | options)  # type: ignore[arg-type]
