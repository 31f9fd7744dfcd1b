"""Comparisons of strategies: paired, two-sided, and corrected for how many there are."""

import math

import numpy as np
import pytest

from qfolio.core.statistics import holm
from qfolio.portfolio.backtest.statistics.assessment import Assessment, Strategy
from qfolio.portfolio.backtest.statistics.differences import Contrast, Difference, tails_to
from qfolio.portfolio.backtest.statistics.estimates import Estimate, Tails

from records import assessed, strategy
from tables import days

NU = 400


def estimate(value: float, error: float, seed: int = 0) -> Estimate:
    """Of one seed; those of different seeds are uncorrelated."""
    loads = np.random.default_rng(seed).standard_normal(NU)
    return Estimate(value, error * loads / math.sqrt((loads**2).mean()), 0.0, 1)


def to_best(*among: Estimate, more: bool = True) -> Tails:
    """Against the one that does best, as a backtest chooses it."""
    shown = min(among, key=lambda each: each.value if more else -each.value)
    return tails_to(shown, among, more, np.random.default_rng(0))


def test_the_best_is_chosen_in_hindsight() -> None:
    """Two rivals alike but for luck: the luckier one is ahead by less than luck explains."""
    lucky, other = estimate(-0.021, 0.01, 1), estimate(0.0, 0.01, 2)
    alone, either = to_best(lucky), to_best(lucky, other)
    assert alone.worse == pytest.approx(0.018, abs=0.001)  # Φ(−2.1)
    assert either.worse == pytest.approx(2 * 0.018, abs=0.006)  # one of two was to be that lucky
    assert either.better > 0.95
    # Copies of one rival are no choice.
    assert to_best(lucky, lucky, lucky).worse == pytest.approx(alone.worse, abs=0.004)


def test_beating_the_best_is_beating_every_one() -> None:
    """The rival that grew less, but may as well have grown more than ours, counts."""
    calm, wild = estimate(0.01, 0.001, 1), estimate(0.015, 0.01, 2)
    assert to_best(calm).better < 0.001
    assert to_best(calm, wild).better == wild.tails().better > 0.05


def test_a_wild_rival_does_not_hide_who_falls_short() -> None:
    """Its errors are large, but so is the lead that would be evidence for it."""
    behind, wild = estimate(-0.05, 0.01, 1), estimate(0.3, 0.08, 2)
    assert to_best(behind).worse < 1e-5
    assert to_best(behind, wild).worse < 0.001


def test_less_volatility_is_better() -> None:
    calmer = estimate(-0.03, 0.01)
    assert to_best(calmer, more=False) == to_best(calmer.negated())
    assert to_best(calmer, more=False).better < 0.01 < 0.9 < to_best(calmer, more=True).better


def test_unknown_differences_are_no_evidence() -> None:
    unknown = Estimate(math.inf, np.full(1, np.nan), 0.0, 1)
    assert to_best(unknown) == (1, 1)
    assert to_best(estimate(0.1, 0.01), unknown).better == 1
    assert to_best(estimate(-0.1, 0.01), unknown).worse < 0.01


def both(result: Assessment, name: str) -> list[Difference]:
    entry = result.strategies[name]
    return [each for each in (entry.to_reference, entry.to_best_baseline) if each is not None]


def in_tests(result: Assessment, *names: str) -> list[Contrast]:
    fields = ("to_reference", "to_rebalanced", "to_best_baseline", "to_best_sharpe")
    found = [getattr(result.strategies[name], field) for name in names for field in fields]
    contrasts = [c for each in found if each is not None for c in each.contrasts().values()]
    return [each for each in contrasts if each.p is not None]


def test_holm_takes_away_what_many_comparisons_found_by_luck() -> None:
    """The same edge is evidence when it is compared once, and none among six agents."""
    rng = np.random.default_rng(12)
    base = strategy(rng, "baseline", 1)
    # A mean excess of 3 standard errors over 300 days: p is about 0.008.
    excess = rng.standard_normal(300)
    excess = 0.002 * ((excess - excess.mean()) / excess.std() + 3.0 / math.sqrt(300))
    edge = Strategy("agent", np.asarray(base.returns) + excess, base.turnover, base.cost)
    noise = {
        f"noise {i}": base._replace(
            kind="agent", returns=np.asarray(base.returns) + 0.002 * rng.standard_normal(300)
        )
        for i in range(5)
    }
    alone, among = (
        assessed({"equal weight": base, "edge": edge, **more}, days(300)) for more in ({}, noise)
    )
    (single,), (one,) = both(alone, "edge"), both(among, "edge")
    assert alone.comparisons == 3  # measures
    assert single.growth.finding == "better"
    assert among.comparisons == 18
    assert one.growth.interval[0] > 0  # of this difference alone
    assert one.growth.p is not None
    assert one.growth.p_holm is not None
    assert one.growth.p == single.growth.p
    assert one.growth.p < 0.05 < one.growth.p_holm
    assert one.growth.finding == "none"
    every = in_tests(among, "edge", *noise)
    p_values = [(each.p or 0.0, each.p_holm or 0.0) for each in every]
    alone_p, corrected = np.array(p_values).T
    np.testing.assert_allclose(corrected, holm(alone_p))


def test_earlier_trials_weaken_claims_to_be_better() -> None:
    """Whoever tried 20 settings before has 21 chances to look better, and none to look worse."""
    rng = np.random.default_rng(6)
    base = strategy(rng, "baseline", 1)
    excess = rng.standard_normal(300)
    excess = 0.002 * ((excess - excess.mean()) / excess.std() + 3.5 / math.sqrt(300))
    up, down = (np.asarray(base.returns) + sign * excess for sign in (1, -1))
    entries = {
        "equal weight": base,
        "up": Strategy("agent", up, base.turnover, base.cost),
        "down": Strategy("agent", down, base.turnover, base.cost),
    }

    def growth(trials: int) -> list[Contrast]:
        result = assessed(entries, days(300), resamples=100, earlier_trials=trials)
        return [both(result, name)[0].growth for name in ("up", "down")]

    (up_alone, down_alone), (up_among, down_among) = growth(0), growth(20)
    assert up_alone.p is not None
    assert up_among.p == pytest.approx(21 * up_alone.p)
    assert down_among.p == down_alone.p
    assert [each.finding for each in (up_alone, up_among)] == ["better", "none"]
    assert [each.finding for each in (down_alone, down_among)] == ["worse", "worse"]


def test_the_best_are_those_with_the_most_growth_and_the_highest_sharpe_ratio() -> None:
    rng = np.random.default_rng(3)
    wave = rng.standard_normal((1, 300))
    wave -= wave.mean()
    zeros = np.zeros((1, 300))
    calm = Strategy("baseline", 0.0004 + 0.001 * wave, zeros, zeros)
    bold = Strategy("baseline", 0.0010 + 0.010 * wave, zeros, zeros)
    cash = Strategy("baseline", zeros, zeros, zeros)
    entries = {"equal weight": cash, "calm": calm, "bold": bold, "dqn": strategy(rng)}
    result = assessed(entries, days(300), resamples=100)
    sharpes = {name: entry.measures["sharpe"].mean for name, entry in result.strategies.items()}
    assert sharpes["calm"] > sharpes["bold"]
    assert (result.best_baseline, result.best_sharpe) == ("bold", "calm")
    assert result.comparisons == 3 + 1 + 1  # with the best, each in one measure
    best, calmest = (
        getattr(result.strategies["dqn"], field) for field in ("to_best_baseline", "to_best_sharpe")
    )
    assert (best.reference, calmest.reference) == ("bold", "calm")
    assert best.sharpe.finding is None is calmest.growth.finding
    assert best.growth.finding is not None is not calmest.sharpe.finding
    assert calmest.sharpe.value == pytest.approx(sharpes["dqn"] - sharpes["calm"])
    assert in_tests(result, "calm", "bold") == []
    # One baseline that is the best in both is compared in both.
    del entries["bold"]
    result = assessed(entries, days(300), resamples=100)
    assert result.best_baseline == result.best_sharpe == "calm"
    assert result.comparisons == 3 + 2
    assert result.strategies["dqn"].to_best_sharpe is None


def test_the_reference_as_the_best_is_one_comparison() -> None:
    rng = np.random.default_rng(4)
    base = strategy(rng, "baseline", 1)
    weak = base._replace(returns=np.asarray(base.returns) - 0.01)
    entries = {"equal weight": base, "weak": weak, "dqn": strategy(rng)}
    result = assessed(entries, days(300), resamples=100)
    assert result.best_baseline == "equal weight"
    assert result.comparisons == 3
    assert result.strategies["dqn"].to_best_baseline is None


def test_a_strategy_does_not_differ_from_itself() -> None:
    rng = np.random.default_rng(11)
    base = strategy(rng, "baseline", 1)
    copies = {"equal weight": base, "dqn": base._replace(kind="agent"), "noise": strategy(rng)}
    (difference,) = both(assessed(copies, days(300)), "dqn")
    for contrast in difference.contrasts().values():
        assert contrast.value == 0
        assert contrast.interval == (0, 0)
        assert contrast.p == 1
        assert contrast.finding == "none"


def test_differences_are_paired() -> None:
    # The agent is equal weight and 0.01% more every day: the days cannot blur that.
    rng = np.random.default_rng(12)
    base = strategy(rng, "baseline", 1)
    returns = np.asarray(base.returns)
    agent = Strategy("agent", (1 + returns) * math.exp(1e-4) - 1, base.turnover, base.cost)
    result = assessed({"equal weight": base, "dqn": agent}, days(300))
    (difference,) = both(result, "dqn")
    np.testing.assert_allclose(difference.growth.interval, 0.0252, rtol=1e-9)
    assert difference.growth.p is not None
    assert difference.growth.p < 1e-9
    assert difference.growth.finding == "better"
    assert np.ptp(result.strategies["dqn"].measures["growth"].over_time) > 0.1


def test_differences_carry_the_doubt_about_seeds() -> None:
    # Every seed is equal weight times its own constant, so that all doubt is about seeds: the
    # interval is Student's with the variance of the mean, s² / 6, and 5 degrees of freedom.
    rng = np.random.default_rng(13)
    base = strategy(rng, "baseline", 1)
    extra = np.array([-0.08, -0.03, 0.0, 0.02, 0.04, 0.05])
    returns = (1 + np.asarray(base.returns)) * np.exp(extra / 252)[:, None] - 1
    agent = Strategy("agent", returns, np.zeros((6, 300)), np.zeros((6, 300)))
    result = assessed({"equal weight": base, "dqn": agent}, days(300))
    (difference,) = both(result, "dqn")
    assert difference.growth.value == pytest.approx(0, abs=1e-12)
    width = 2 * 2.570582 * extra.std(ddof=1) / math.sqrt(6)
    assert np.diff(difference.growth.interval).item() == pytest.approx(width, rel=1e-6)


def test_the_best_rebalancing_is_the_one_that_grew_most() -> None:
    """And to beat it is to beat every speed, in each measure."""
    rng = np.random.default_rng(5)
    base = strategy(rng, "baseline", 1)
    market = np.asarray(base.returns)
    slow = base._replace(kind="rebalancing", returns=market + 2e-4)
    wave = rng.normal(size=(1, 300))
    wave -= wave.mean()
    never = base._replace(kind="rebalancing", returns=market + 1e-4 + 0.004 * wave)
    ours = base._replace(kind="agent", returns=market + 4e-4)
    entries = {"equal weight": base, "slow": slow, "never": never, "dqn": ours}
    result = assessed(entries, days(300), resamples=100)
    assert result.rebalanced == "slow"
    assert result.best_baseline == "equal weight"  # a rebalancing is no baseline
    assert result.comparisons == 6
    assert result.trials == 1
    entry = result.strategies["dqn"]
    assert entry.to_rebalanced is not None
    assert entry.to_reference is not None
    assert entry.to_rebalanced.reference == "slow"
    assert entry.to_reference.growth.finding == "better"
    assert entry.to_rebalanced.growth.interval[0] > 0  # ahead of the best for sure
    assert entry.to_rebalanced.growth.finding == "none"  # but not of each
    del entries["never"]
    alone = assessed(entries, days(300), resamples=100).strategies["dqn"]
    assert alone.to_rebalanced is not None
    assert alone.to_rebalanced.growth.finding == "better"


def test_costs_that_slower_rebalancing_saves_are_no_edge() -> None:
    """Noise that trades less than the reference beats it, but not its best rebalancing."""
    rng = np.random.default_rng(6)
    market = 0.01 * rng.standard_normal((1, 2000))
    zeros = np.zeros_like(market)
    entries = {
        "equal weight": Strategy("baseline", market - 1e-4, zeros, zeros),
        "slow": Strategy("rebalancing", market - 1e-5, zeros, zeros),
        "noise": Strategy("agent", market + 1e-4 * rng.standard_normal(market.shape), zeros, zeros),
    }
    noise = assessed(entries, days(2000), resamples=50).strategies["noise"]
    assert noise.to_reference is not None
    assert noise.to_rebalanced is not None
    assert noise.to_reference.growth.finding == "better"
    assert noise.to_rebalanced.growth.finding == "better"  # by the last basis point
    entries["noise"] = entries["noise"]._replace(
        returns=np.asarray(entries["noise"].returns) - 1e-5
    )
    noise = assessed(entries, days(2000), resamples=50).strategies["noise"]
    assert noise.to_reference is not None
    assert noise.to_rebalanced is not None
    assert noise.to_reference.growth.finding == "better"
    assert noise.to_rebalanced.growth.finding == "none"
