"""Classical allocators: what they decide, that they see no future, and what they earned."""

import sys
import warnings
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qfolio.core.errors import QfolioError
from qfolio.core.registry import BASELINES, find
from qfolio.portfolio.backtest.baselines import Baseline, Fitted, History, baseline
from qfolio.portfolio.backtest.folds import Fold
from qfolio.portfolio.backtest.orders import Orders, orders
from qfolio.portfolio.backtest.simulation import simulate

from tables import days

FITTED = [name for name in BASELINES if isinstance(baseline(name), Fitted)]


def fold(name: str, train: slice, decided: slice) -> Fold:
    return Fold(name, train, decided, recent=train)


def walk(rows: int, train: int, test: int, count: int | None = None) -> list[Fold]:
    """Whole folds whose training ends with the first decision; each decision earns a return."""
    starts = range(train, rows - test, test)[:count]
    return [fold(str(i), slice(s - train, s + 1), slice(s, s + test)) for i, s in enumerate(starts)]


def prices(rows: int = 90, assets: int = 4) -> np.ndarray:
    """Assets of volatility 1%, 2%, …, all of which rise."""
    generator = np.random.default_rng(0)
    scales = 0.01 * np.arange(1, assets + 1)
    return np.exp((generator.normal(size=(rows, assets)) * scales + scales / 5).cumsum(0))


MONTH = 5
"""Rows, so that short tables have months."""


def ask(
    one: str | Baseline, folds: Sequence[Fold], values: np.ndarray, **options: object
) -> Orders:
    name, made = (one, baseline(one)) if isinstance(one, str) else ("own", one)
    chosen = {"month": MONTH} | options
    return orders(name, made, folds, days(len(values)), values, **chosen)  # type: ignore[arg-type]


def decisions(
    name: str, folds: Sequence[Fold], values: np.ndarray, **options: object
) -> np.ndarray:
    return ask(name, folds, values, **options).decisions


def weights(name: str, returns: np.ndarray, cap: float = 1.0) -> np.ndarray:
    """Of the assets, fitted to returns."""
    return fitted(
        name, np.concatenate([np.ones((1, returns.shape[1])), 1 + returns]).cumprod(0), cap
    )


def fitted(name: str, prices: np.ndarray, cap: float = 1.0) -> np.ndarray:
    rows, assets = prices.shape
    history = History(days(rows), prices, slice(0, rows), np.ones(assets, bool), cap)
    found = baseline(name).decide(history, np.eye(assets + 1)[0])
    assert found is not None
    return found[1:]


FOLDS = walk(90, train=40, test=15)


@cache
def decided(name: str) -> np.ndarray:
    return decisions(name, FOLDS, prices())


@pytest.mark.parametrize("name", FITTED)
def test_fits_every_month_to_all_rows_since_its_training_began(name: str) -> None:
    rows = decided(name)
    assert rows.shape == (45, 5)
    asked = ~np.isnan(rows[:, 0])
    np.testing.assert_array_equal(asked, np.arange(45) % MONTH == 0)
    assert (rows[asked] >= 0).all()
    np.testing.assert_allclose(rows[asked].sum(1), 1, rtol=1e-12)
    np.testing.assert_allclose(rows[asked, 0], 0, atol=1e-12)
    assert (rows[0] != rows[5]).any()
    for place, start in ((0, 0), (10, 0), (15, 15), (40, 30)):  # folds train from 0, 15 and 30 on
        expected = fitted(name, prices()[start : 41 + place])
        np.testing.assert_array_equal(rows[place, 1:], expected)


def test_months_count_from_the_first_decision_of_the_test() -> None:
    """Not from each fold's, or a fold that is not whole months long would trade twice."""
    rows = decisions("equal-weight-monthly", FOLDS, prices(), month=10)
    np.testing.assert_array_equal(~np.isnan(rows[:, 0]), np.arange(45) % 10 == 0)
    rows = decisions("equal-weight-monthly", FOLDS, prices(), month=40)  # longer than a fold
    np.testing.assert_array_equal(np.flatnonzero(~np.isnan(rows[:, 0])), [0, 40])
    assert not np.isnan(decisions("equal-weight-monthly", FOLDS, prices(), month=1)).any()
    rows = decisions("equal-weight-monthly", FOLDS, prices(), month=7)  # not from row 0, either
    np.testing.assert_array_equal(~np.isnan(rows[:, 0]), np.arange(45) % 7 == 0)


def test_windows_end_with_the_decision() -> None:
    tradable = np.array([True, False, True, True])
    history = History(days(50), prices()[:50], slice(10, 41), tradable, 1.0, month=3)
    np.testing.assert_array_equal(history.window(), prices()[10:50, [0, 2, 3]])
    np.testing.assert_array_equal(history.window(4), prices()[37:50, [0, 2, 3]])
    np.testing.assert_array_equal(history.window(20), history.window())  # there is no more
    assert history.returns(4).shape == (12, 3)


def test_what_allocators_mean() -> None:
    generator = np.random.default_rng(1)
    noise = generator.normal(size=(200, 3))
    noise = np.linalg.qr(noise - noise.mean(0))[0] * np.sqrt(199)  # of variance 1, uncorrelated
    returns = np.array([0.001, 0.004, 0.004]) + noise * np.array([0.01, 0.02, 0.04])
    # Without correlation weights go as 1/σ, as 1/σ², and for the ratio as mean/σ²; those of timing
    # as the squares of the latter two.
    for name, expected in {
        "equal-weight": [1, 1, 1],
        "buy-and-hold": [1, 1, 1],
        "inverse-volatility": [4, 2, 1],
        "volatility-timing": [256, 16, 1],
        "reward-to-risk-timing": [16, 16, 1],
        "risk-budgeting": [4, 2, 1],
        "minimum-variance": [16, 4, 1],
        "maximum-ratio": [16, 16, 4],
    }.items():
        wanted = np.array(expected) / sum(expected)
        np.testing.assert_allclose(weights(name, returns), wanted, atol=2e-3)


def test_equal_weight_and_buy_and_hold() -> None:
    np.testing.assert_array_equal(decided("equal-weight"), np.tile([0, *[0.25] * 4], (45, 1)))
    bought = decided("buy-and-hold")
    np.testing.assert_array_equal(bought[0], [0, *[0.25] * 4])
    assert np.isnan(bought[1:]).all()
    result = simulate(prices(), bought, first=40, cost=0.01)
    assert (result.turnover[1:] == 0).all()


@settings(max_examples=12, deadline=None)
@given(st.integers(40, 88), st.integers(0, 2**32 - 1))
@pytest.mark.parametrize("name", BASELINES)
def test_no_later_price_changes_a_decision(name: str, row: int, seed: int) -> None:
    changed = prices()
    later = changed[row + 1 :]
    later *= np.random.default_rng(seed).lognormal(size=later.shape)
    known = slice(0, min(row, 84) - 40 + 1)  # decisions at or before the row
    np.testing.assert_array_equal(decisions(name, FOLDS, changed)[known], decided(name)[known])


@pytest.mark.parametrize("name", FITTED)
def test_fits_see_their_training(name: str) -> None:
    changed = prices()
    changed[20:40, 0] *= np.random.default_rng(0).lognormal(sigma=0.2, size=20)
    assert (decisions(name, FOLDS[:1], changed)[0] != decided(name)[0]).any()


@pytest.mark.parametrize("name", BASELINES)
def test_cap(name: str) -> None:
    found = decisions(name, FOLDS, prices(), cap=0.3)
    found = found[~np.isnan(found[:, 0])]
    assert (found[:, 1:] <= 0.3 + 1e-12).all()
    np.testing.assert_allclose(found.sum(1), 1, rtol=1e-12)
    assert name == "trend" or (found[:, 0] < 1e-12).all()
    if name in ("inverse-volatility", "minimum-variance"):
        assert found[0, 1] == pytest.approx(0.3)  # would like more: the calmest
    tight = decisions(name, FOLDS[:1], prices(), cap=0.2)[0]
    held = tight[1:] > 0
    assert name == "trend" or held.all()
    np.testing.assert_allclose(tight[1:][held], 0.2)
    assert tight[0] == pytest.approx(1 - 0.2 * held.sum())


def test_cap_keeps_proportions() -> None:
    generator = np.random.default_rng(2)
    returns = np.linalg.qr(generator.normal(size=(500, 4)))[0]
    returns /= returns.std(0, ddof=1) * np.array([60, 25, 10, 5])  # weights .6, .25, .1, .05
    np.testing.assert_allclose(
        weights("inverse-volatility", returns), [0.6, 0.25, 0.1, 0.05], rtol=1e-6
    )
    # The first is cut to .4; the other .6 go to .25, .1 and .05 as .375, .15 and .075. With a cap
    # of .35 the second would have .40625 and is cut, too; .3 are left for .1 and .05.
    np.testing.assert_allclose(
        weights("inverse-volatility", returns, cap=0.4), [0.4, 0.375, 0.15, 0.075], rtol=1e-6
    )
    np.testing.assert_allclose(
        weights("inverse-volatility", returns, cap=0.35), [0.35, 0.35, 0.2, 0.1], rtol=1e-6
    )


@pytest.mark.parametrize("name", BASELINES)
def test_assets_that_join_late(name: str) -> None:
    values = prices()
    values[:30, 1] = np.nan  # the third fold is the first whose training it covers
    found = decisions(name, FOLDS, values)
    assert np.nansum(found[:30, 2]) == 0
    if name.startswith("equal-weight") or name in ("inverse-volatility", "risk-budgeting"):
        first = np.flatnonzero(~np.isnan(found[30:, 0]))[0]
        assert found[30 + first, 2] > 0.1
    without = decisions(name, FOLDS[:2], np.delete(values, 1, axis=1))
    np.testing.assert_allclose(np.delete(found[:30], 2, axis=1), without, atol=1e-12)
    values[0] = np.nan
    with pytest.raises(QfolioError, match="Fold 0 has no asset with a price in all of its"):
        decisions(name, FOLDS, values)


def test_failures_leave_a_note_and_equal_weights() -> None:
    values = prices()
    values[:60, 2] = 7.0  # no variance
    found, notes = ask("minimum-variance", FOLDS, values)
    np.testing.assert_array_equal(found[0], [0, *[0.25] * 4])
    assert (found[40] != found[0]).any()
    assert notes[0].startswith("minimum-variance, fold 0: no solution, so weights are equal: ")
    assert "variance" in notes[0].split("equal:")[1]
    falling = -np.abs(np.random.default_rng(0).normal(0, 0.1, size=(50, 3)))
    with pytest.warns(UserWarning, match="no solution"):
        np.testing.assert_array_equal(weights("maximum-ratio", falling), [1 / 3] * 3)


class Doubtful(Baseline):
    """A user's own, whose library warns."""

    def decide(self, history: History, held: np.ndarray) -> np.ndarray:
        warnings.warn("the solver  stopped early", stacklevel=1)
        return held


def test_warnings_are_notes() -> None:
    (note,) = ask(Doubtful(), FOLDS[:1], prices()).notes
    assert note == "own, fold 0: the solver stopped early"


class LastWinner(Baseline):
    """A user's own: hold what rose most on the last day, and stay where it is held already."""

    calendar = "row"

    def __init__(self) -> None:
        self.seen: list[tuple[int, np.ndarray]] = []

    def decide(self, history: History, held: np.ndarray) -> np.ndarray | None:
        self.seen.append((len(history.prices), held))
        assert len(history.dates) == len(history.prices)
        winner = 1 + int((history.prices[-1] / history.prices[-2]).argmax())
        return None if held[winner] > 0.9 else np.eye(len(held))[winner]


def test_a_baseline_is_asked_row_by_row_and_sees_no_further() -> None:
    own = LastWinner()
    found = ask(own, FOLDS, prices()).decisions
    assert [rows for rows, _ in own.seen] == list(range(41, 86))  # up to the row it decides at
    relatives = prices()[1:] / prices()[:-1]
    winners = relatives[39:84].argmax(1)
    changes = np.flatnonzero(np.diff(winners, prepend=-1))
    ordered = np.flatnonzero(~np.isnan(found[:, 0]))
    np.testing.assert_array_equal(ordered, changes)
    np.testing.assert_array_equal(found[ordered, 1:].argmax(1), winners[changes])


def test_what_is_held_drifts_with_prices() -> None:
    class Once(Baseline):
        calendar = "row"

        def decide(self, history: History, held: np.ndarray) -> np.ndarray | None:
            seen.append(held)
            return np.array([0.4, 0.6, 0, 0, 0]) if held[0] == 1 else None

    seen: list[np.ndarray] = []
    ask(Once(), FOLDS, prices())
    worth = 0.6 * prices()[40:85, 0] / prices()[40, 0]
    np.testing.assert_allclose([held[1] for held in seen[1:]], (worth / (0.4 + worth))[1:])


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ([0.5, 0.5], r"own at 2020-02-10 gives weights of the shape \(2,\)"),
        ([0.5, 0, 0, 0, 0], "sum to 0.5"),
        ([0.5, 0.7, -0.2, 0, 0], "minimum of -0.2"),
        ([np.nan] * 5, "sum to nan"),
        ([0, 1, 0, 0, 0], "an asset 1, more than the cap of 0.8"),
        ([0.5, 0, 0, 0, 0.5], "an asset that this fold may not hold"),
        ("all", "decide of the baseline own returns 'all'; it must return an array of numbers"),
    ],
)
def test_weights_that_cannot_be(wanted: Any, message: str) -> None:
    class Wrong(Baseline):
        def decide(self, history: History, held: np.ndarray) -> Any:
            return wanted

    values = prices()
    values[0, 3] = np.nan
    with pytest.raises(QfolioError, match=message):
        ask(Wrong(), FOLDS, values, cap=0.8)


def test_a_calendar_that_there_is_not() -> None:
    class Weekly(LastWinner):
        calendar: ClassVar[Any] = "weekly"

    with pytest.raises(QfolioError, match="of Weekly is 'weekly'; it must be one of fold, month, "):
        ask(Weekly(), FOLDS, prices())


def test_a_baseline_of_a_users_own_is_found_by_its_module(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "own_baselines.py").write_text(
        "import numpy as np\n"
        "from qfolio.portfolio.backtest.baselines import Baseline\n"
        "class First(Baseline):\n"
        "    def decide(self, history, held):\n"
        "        return np.eye(len(held))[1]\n"
        "class Unfinished(Baseline): pass\n"
    )
    with pytest.raises(QfolioError, match="add --trust own_baselines"):
        baseline("own_baselines:First")  # a file may have named it
    find("baseline", "own_baselines:First")  # a person has
    found = decisions("own_baselines:First", FOLDS, prices())
    np.testing.assert_array_equal(found, np.tile(np.eye(5)[1], (45, 1)))
    with pytest.raises(QfolioError, match="Unfinished is not complete: it lacks decide"):
        baseline("own_baselines:Unfinished")


def test_errors_say_what_and_where() -> None:
    with pytest.raises(QfolioError, match="no baseline 'best'; choose from equal-weight"):
        baseline("best")
    with pytest.raises(QfolioError, match="no fold"):
        decisions("equal-weight", [], prices())
    with pytest.raises(QfolioError, match="Fold x trains on rows up to 41, but decides from row 4"):
        decisions("equal-weight", [fold("x", slice(0, 42), slice(40, 50))], prices())
    with pytest.raises(QfolioError, match="Fold 2 decides from row 70 on, but fold 0 before row 5"):
        decisions("equal-weight", FOLDS[::2], prices())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "sharpe"),
    [
        ("equal-weight", 0.926),
        ("inverse-volatility", 0.904),
        ("minimum-variance", 0.903),
        ("hierarchical-risk-parity", 0.916),
        ("risk-budgeting", 0.939),
        ("maximum-ratio", 1.0445),
    ],
)
def test_sharpe_ratios_of_skfolio_on_its_own_prices(name: str, sharpe: float) -> None:
    """Fitted once a fold, as there."""
    values = real_prices()
    folds = walk(len(values), train=1260, test=252)
    made = type("OnceAFold", (type(baseline(name)),), {"calendar": "fold"})()
    found, notes = ask(made, folds, values)
    assert notes == ()
    returns = simulate(values, found, first=1260, cost=0.0, lag=0).returns
    assert returns.mean() / returns.std(ddof=1) * np.sqrt(252) == pytest.approx(sharpe, abs=5e-4)


@cache
def real_prices() -> np.ndarray:
    from skfolio.datasets import load_sp500_dataset

    return load_sp500_dataset().to_numpy()
