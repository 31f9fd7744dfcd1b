"""Comparisons of strategies: paired, two-sided, and corrected for how many there are."""

import math
from typing import Any

import numpy as np
import pytest

from qfolio.core.statistics import holm
from qfolio.portfolio.backtest.assessment import Strategy, assess
from qfolio.portfolio.backtest.differences import (
    MARGIN,
    Sampled,
    tails_to,
    tails_to_best,
)

from records import days, strategy


def sampled(observed: float, drawn: list[float]) -> Sampled:
    """Of one seed, given log growth as drawn."""
    growth = np.expm1(np.array(drawn))[:, None]
    return Sampled(
        {"growth": np.expm1([observed])}, {"growth": growth}, np.zeros((len(drawn), 1), int)
    )


NOTHING = sampled(0.0, [0.0] * 39)


def test_p_values_by_hand() -> None:
    ours = sampled(0.1, [-0.1] * 3 + [MARGIN / 2] * 2 + [0.2] * 34)
    better, worse = tails_to(ours, NOTHING)
    assert better == (1 + 5) / 40  # what is within the margin of rounding speaks for neither
    assert worse == (1 + 36) / 40
    assert tails_to(NOTHING, NOTHING) == (1, 1)
    unknown = sampled(math.nan, [math.nan] * 39)
    assert tails_to(unknown, NOTHING) == (1, 1)


def test_the_best_is_chosen_in_hindsight() -> None:
    """Two rivals alike but for luck: the luckier one is ahead by less than luck explains."""
    rng = np.random.default_rng(0)
    ours = sampled(0.0, [0.0] * 1999)
    noise = rng.normal(0, 0.01, (2, 1999))
    rivals = [sampled(0.021, list(0.021 + noise[0])), sampled(0.0, list(noise[1]))]
    alone = tails_to(ours, rivals[0]).worse
    either = tails_to_best(ours, rivals)
    assert alone == pytest.approx(0.018, abs=0.006)  # Φ(−2.1)
    assert either.worse == pytest.approx(2 * 0.018, abs=0.01)  # one of two was to be that lucky
    assert either.better > 0.95


def test_beating_the_best_is_beating_every_baseline() -> None:
    """The rival that grew less, but may as well have grown more than ours, counts."""
    rng = np.random.default_rng(1)
    ours = sampled(0.02, [0.02] * 1999)
    calm = sampled(0.01, list(0.01 + rng.normal(0, 0.001, 1999)))
    wild = sampled(0.005, list(0.005 + rng.normal(0, 0.01, 1999)))
    assert tails_to_best(ours, [calm]).better < 0.001
    assert tails_to_best(ours, [calm, wild]).better == tails_to(ours, wild).better > 0.05


def both(result: Any, name: str) -> list[Any]:
    entry = result.strategies[name]
    return [each for each in (entry.to_reference, entry.to_best_baseline) if each is not None]


def test_holm_takes_away_what_many_comparisons_found_by_luck() -> None:
    """The same edge is evidence when it is compared once, and none among six comparisons."""
    rng = np.random.default_rng(12)
    base = strategy(rng, "baseline", 1)
    # A mean excess of 2.2 standard errors over 300 days: p is about 0.03.
    excess = rng.standard_normal(300)
    excess = 0.002 * ((excess - excess.mean()) / excess.std() + 2.2 / math.sqrt(300))
    edge = Strategy("agent", np.asarray(base.returns) + excess, base.turnover, base.cost)
    noise = {
        f"noise {i}": base._replace(
            kind="agent", returns=np.asarray(base.returns) + 0.002 * rng.standard_normal(300)
        )
        for i in range(5)
    }
    alone, among = (
        assess({"equal weight": base, "edge": edge, **more}, days(300), periods_per_year=252)
        for more in ({}, noise)
    )
    (single,), (one,) = both(alone, "edge"), both(among, "edge")
    assert single.p == single.p_holm < 0.05
    assert single.finding == "better"
    assert single.growth_interval[0] > 0
    assert among.comparisons == 6
    assert one.growth_interval[0] > 0  # of this difference alone
    assert one.p < 0.05 < one.p_holm
    assert one.finding == "none"
    tested = [each for name in ("edge", *noise) for each in both(among, name)]
    np.testing.assert_allclose([each.p_holm for each in tested], holm([x.p for x in tested]))


def test_the_best_baseline_is_the_one_that_grew_most() -> None:
    """Not the one with the best Sharpe ratio: what is compared with it is growth."""
    rng = np.random.default_rng(3)
    wave = rng.standard_normal((1, 300))
    wave -= wave.mean()
    zeros = np.zeros((1, 300))
    calm = Strategy("baseline", 0.0004 + 0.001 * wave, zeros, zeros)
    bold = Strategy("baseline", 0.0010 + 0.010 * wave, zeros, zeros)
    cash = Strategy("baseline", zeros, zeros, zeros)
    entries = {"equal weight": cash, "calm": calm, "bold": bold, "dqn": strategy(rng)}
    result = assess(entries, days(300), periods_per_year=252, resamples=100)
    sharpes = {name: entry.measures["sharpe"].mean for name, entry in result.strategies.items()}
    assert sharpes["calm"] > sharpes["bold"]
    assert result.best_baseline == "bold"
    assert result.comparisons == 2
    best = result.strategies["dqn"].to_best_baseline
    assert best is not None
    assert best.reference == "bold"
    assert result.strategies["calm"].to_reference.finding is None  # type: ignore[union-attr]


def test_the_reference_as_the_best_is_one_comparison() -> None:
    rng = np.random.default_rng(4)
    base = strategy(rng, "baseline", 1)
    weak = base._replace(returns=np.asarray(base.returns) - 0.01)
    entries = {"equal weight": base, "weak": weak, "dqn": strategy(rng)}
    result = assess(entries, days(300), periods_per_year=252, resamples=100)
    assert result.best_baseline == "equal weight"
    assert result.comparisons == 1
    assert result.strategies["dqn"].to_best_baseline is None


def test_a_strategy_does_not_differ_from_itself() -> None:
    rng = np.random.default_rng(11)
    base = strategy(rng, "baseline", 1)
    copies = {"equal weight": base, "dqn": base._replace(kind="agent"), "noise": strategy(rng)}
    difference = both(assess(copies, days(300), periods_per_year=252), "dqn")[0]
    assert difference.growth == difference.sharpe == 0
    assert difference.growth_interval == difference.sharpe_interval == (0, 0)
    assert difference.p == 1
    assert difference.finding == "none"


def test_differences_are_paired() -> None:
    # The agent is equal weight and 0.01 % more every day: the days cannot blur that.
    rng = np.random.default_rng(12)
    base = strategy(rng, "baseline", 1)
    returns = np.asarray(base.returns)
    agent = Strategy("agent", (1 + returns) * math.exp(1e-4) - 1, base.turnover, base.cost)
    result = assess({"equal weight": base, "dqn": agent}, days(300), periods_per_year=252)
    (difference,) = both(result, "dqn")
    np.testing.assert_allclose(difference.growth_interval, 0.0252, rtol=1e-9)
    assert difference.p == pytest.approx(2 / 2001)
    assert difference.finding == "better"
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
    (difference,) = both(result, "dqn")
    assert difference.growth == pytest.approx(0, abs=1e-12)
    width = 2 * 1.96 * extra.std(ddof=1) / math.sqrt(6)
    assert np.diff(difference.growth_interval).item() == pytest.approx(width, rel=0.08)
