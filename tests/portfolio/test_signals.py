"""Signals: formulas by hand, no look at later rows, and what a portfolio makes of them."""

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from qfolio.core.errors import QfolioError
from qfolio.core.registry import SIGNALS
from qfolio.portfolio import signals
from qfolio.portfolio.following import on_table
from qfolio.portfolio.task import Portfolio

from tables import days, price_table, random_walk

EACH = [f"{name}:8-2" for name in SIGNALS]


def prices(rows=60, assets=5, seed=0):
    values = random_walk(rows, assets, seed, volatility=0.02)
    values[:25, -1] = np.nan  # it joins later
    return values


def signal(text, values):
    (found,) = signals.parse(text)
    return found(values)


@pytest.mark.parametrize("text", EACH)
def test_none_looks_ahead(text):
    values = prices()
    now = signal(text, values)
    for row in (20, 30, 45):
        later = values.copy()
        later[row + 1 :] *= np.exp(
            np.random.default_rng(row).normal(0, 0.3, later[row + 1 :].shape)
        )
        np.testing.assert_array_equal(signal(text, later)[: row + 1], now[: row + 1])
        np.testing.assert_array_equal(signal(text, values[: row + 1]), now[: row + 1])


@pytest.mark.parametrize("text", EACH)
def test_each_is_known_from_its_last_row_on(text):
    values = prices()
    known = ~np.isnan(signal(text, values))
    assert not known[:6].any()
    assert known[8:, :4].all()
    if not signals.parse(text)[0].shared:
        assert not known[:25, 4].any()
    assert known[34:].all()


def test_formulas_by_hand():
    values = prices(seed=3)[:, :4]
    r = np.diff(np.log(values), axis=0)  # r[t − 1] is the return of row t
    t = 40
    market = r.mean(1)
    last, skipped = slice(t - 8, t), slice(t - 8, t - 2)
    level = np.log(values[t - 7 : t + 1])
    expected = {
        "momentum:8": np.log(values[t] / values[t - 8]),
        "momentum:8-2": np.log(values[t - 2] / values[t - 8]),
        "reversal:8": -np.log(values[t] / values[t - 8]),
        "volatility:8": np.log(r[last].std(0)),
        "volatility:8-2": np.log(r[skipped].std(0)),
        "volatility:1": np.log(r[t - 2 : t].std(0)),  # of at least 2
        "drift:8-3": np.log(values[t] / values[t - 3]) / (r[last].std(0) * 3**0.5),
        "volatility-ratio:8-3": np.log(r[t - 3 : t].std(0) / r[last].std(0)),
        "high:8": level[-1] - level.max(0),
        "moving-average:8": np.log(values[t] / values[t - 7 : t + 1].mean(0)),
        "maximum:8": r[last].max(0),
        "market-momentum:8": np.full(4, market[last].sum()),
        "market-volatility:8": np.full(4, np.log(market[last].std())),
        "beta:8": [np.polyfit(market[last], r[last, i], 1)[0] for i in range(4)],
        "correlation:8": [
            np.corrcoef(r[last, i], np.delete(r[last], i, 1).mean(1))[0, 1] for i in range(4)
        ],
    }
    for text, wanted in expected.items():
        np.testing.assert_allclose(signal(text, values)[t], wanted, rtol=1e-8, err_msg=text)
    slope = np.array(expected["beta:8"])
    rest = r[last] - market[last, None] * slope
    found = signal("residual-volatility:8", values)[t]
    np.testing.assert_allclose(found, np.log(rest.std(0)), rtol=1e-8)


class Level(signals.Signal):
    def measure(self, prices, rows):
        return prices


def test_a_signal_of_ones_own_skips_rows_as_the_others_do():
    values = prices()[:, :4]
    np.testing.assert_array_equal(Level(rows=8, skip=2)(values)[2:], values[:-2])


class Running(signals.Signal):
    """A mean of all rows so far, whose rounding depends on how it is computed."""

    def measure(self, prices, rows):
        weights = np.tri(len(prices)) / np.arange(1, len(prices) + 1)[:, None]
        return weights @ np.nan_to_num(prices)


class Tomorrow(signals.Signal):
    def measure(self, prices, rows):
        return np.vstack([prices[1:], prices[-1:]])


class Crash(signals.Signal):
    """Sells before the worst rows alone."""

    def measure(self, prices, rows):
        returns = np.vstack([np.diff(np.log(prices), axis=0), 0 * prices[-1:]])
        return np.where(returns < -0.05, -1.0, 0.0)


class Sometimes(signals.Signal):
    """A sum of squares that grows, except on a tenth of the rows."""

    def measure(self, prices, rows):
        ahead = np.arange(len(prices))[:, None] % 10 == 3
        found = np.cumsum(np.nan_to_num(prices) ** 2, axis=0)
        return np.where(ahead, np.vstack([found[1:], found[-1:]]), found)


class Filled(signals.Signal):
    """Knows an asset's first price too early."""

    def measure(self, prices, rows):
        return pd.DataFrame(prices).bfill(limit=1).to_numpy()


class Standardized(signals.Signal):
    def measure(self, prices, rows):
        return prices / np.nanstd(prices, axis=0)


class Whole(signals.Signal):
    def measure(self, prices, rows):
        return prices - prices[-1:] if len(prices) > 50 else prices


class Drawn(signals.Signal):
    def measure(self, prices, rows):
        return np.random.default_rng().normal(size=prices.shape)


class Silent(signals.Signal):
    def measure(self, prices, rows):
        with np.errstate(divide="ignore"):
            return prices / np.zeros(1)


class Words(signals.Signal):
    def measure(self, prices, rows):
        return "up"


class Short(signals.Signal):
    def measure(self, prices, rows):
        return prices[:-1]


def test_scales_by_hand():
    values = np.array(
        [[1.0, 3.0, 2.0, np.nan], [5.0, 5.0, 9.0, 7.0], [4.0, np.nan, np.nan, np.nan]]
    )
    of = lambda scale: signals.compute([Level()], values, scale)[..., 0]  # noqa: E731
    nan = np.nan
    ranks = np.array([[-1, 1, 0, nan], [-2 / 3, -2 / 3, 1, 1 / 3], [0, nan, nan, nan]])
    np.testing.assert_allclose(of("rank"), ranks)
    unit = 1.5**0.5
    np.testing.assert_allclose(of("z-score")[0], [-unit, unit, 0.0, nan])
    np.testing.assert_allclose(of("z-score")[2], [0, nan, nan, nan])
    np.testing.assert_allclose(of("centered")[0], [-1, 1, 0, nan])
    np.testing.assert_allclose(of("centered")[1], [-1.5, -1.5, 2.5, 0.5])
    np.testing.assert_allclose(of("raw")[0], [1, 3, 2, nan])
    values[0, 3] = np.inf  # counts as unknown
    for scale in signals.SCALES:
        assert np.isnan(of(scale)[0, 3])
    np.testing.assert_allclose(of("z-score")[0], [-unit, unit, 0.0, nan])


def test_drift_keeps_its_scale():
    found = signals.compute(signals.parse("drift:8-2"), prices(), "rank")
    wanted = signals.compute(signals.parse("drift:8-2"), prices(), "centered")
    np.testing.assert_array_equal(found, wanted)
    assert np.nanmax(abs(found[20:])) > 1


def test_what_all_assets_share_has_no_rank():
    values = prices()[:, :4]
    (shared,) = signals.parse("market-momentum:5")
    found = signals.compute([shared], values, "rank")[..., 0]
    np.testing.assert_array_equal(found[10:], shared(values)[10:])


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("momentun:5", "there is no signal 'momentun'; did you mean momentum"),
        ("momentum:0", "looks back on 0 rows"),
        ("momentum:0m", "looks back on 0 rows"),
        ("momentum:1m-1m", "21 rows and skips 21"),
        ("momentum:5-5", "5 rows and skips 5"),
        ("momentum:1q", "has no length that can be read; .* such as momentum:21 or momentum:1m"),
        ("test_nowhere:Mine", "is code of the module test_nowhere"),
    ],
)
def test_what_is_no_signal(text, says):
    with pytest.raises(QfolioError, match=says):
        signals.parse(text)


def test_the_names_alone_need_lengths_that_can_be_read():
    """The commands look them up before there is a table."""
    assert signals.names("momentum:1y-1m, feature:pe, test_nowhere:Mine:5") == [
        "momentum", "test_nowhere:Mine"
    ]  # fmt: skip
    with pytest.raises(QfolioError, match="momentum:1q has no length that can be read"):
        signals.names("momentum:1q")


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (Tomorrow(), "Tomorrow looks ahead: its value at row"),
        (Crash(), "Crash looks ahead"),
        (Sometimes(), "Sometimes looks ahead"),
        (Filled(), "Filled looks ahead"),
        (Standardized(), "Standardized looks ahead"),
        (Whole(), "Whole looks ahead"),
        (Drawn(), "Drawn has other values each time it is computed on the same table; draw its"),
        (Silent(), "Silent is unknown at each row and for each asset"),
        (Short(), "shape"),
        (Words(), "The signal Words returns 'up'; it must return an array of numbers."),
    ],
)
def test_a_signal_of_ones_own_is_checked(wrong, says):
    with pytest.raises(QfolioError, match=says):
        signals.compute([wrong], prices(rows=2000))
    for right in (Level(), Running()):
        signals.compute([right], prices(rows=2000))


@pytest.mark.parametrize(
    ("a_year", "rows"),
    [
        (98_280, [(252, 21), (63, 0), (5, 0), (1, 0), (21, 5)]),  # minutes
        (365, [(252, 21), (63, 0), (5, 0), (1, 0), (21, 5)]),
        (252, [(252, 21), (63, 0), (5, 0), (1, 0), (21, 5)]),
        (52, [(52, 4), (13, 0), (1, 0), (1, 0), (4, 1)]),
        (12, [(12, 1), (3, 0), (1, 0), (1, 0), (2, 1)]),
        (1, [(2, 1), (1, 0), (1, 0), (1, 0), (2, 1)]),
    ],
)
def test_a_length_of_time_has_fewer_rows_on_a_slower_table(a_year, rows):
    text = "momentum:1y-1m,high:3m,high:1w,high:1d,momentum:1m-1w,volatility:21"
    *found, fixed = signals.parse(text, a_year)
    assert [(each.rows, each.skip) for each in found] == rows
    assert fixed.rows == 21


def test_signals_that_are_one_on_a_monthly_table_count_once():
    values = prices()[:, :4]
    found = signals.compute(signals.parse("drift:1y-1d,drift:1y-1m,high:1y", 12), values)
    assert found[20:, :, 0].any(1).all()
    assert not found[..., 1].any()
    assert found[20:, :, 2].any(1).all()


def table(rows=60, every=1):
    """every: days from a row to the next."""
    return price_table(prices()[:rows, :3], dates=days(rows * every)[::every])


def test_a_portfolio_counts_the_rows_of_its_own_table():
    weekly = Portfolio.of(table(every=7), window=2, horizon=10, signals="momentum:3m,high:2m")
    rows = Portfolio.of(table(every=7), window=2, horizon=10, signals="momentum:13,high:9")
    np.testing.assert_array_equal(weekly.extra, rows.extra)
    assert rows.extra[20:].any()


def test_a_portfolio_observes_them():
    text = "momentum:8-2,market-volatility:5"
    task = Portfolio.of(table(), window=2, horizon=10, signals=text)
    assert task.features(jnp.array(30)).shape == (3, 2, 3)
    ranks = signals.compute(signals.parse(text), table().values)
    np.testing.assert_allclose(task.extra, ranks, rtol=1e-6)
    np.testing.assert_array_equal(
        Portfolio.of(table(15), horizon=5, signals=text, window=2).extra, task.extra[:15]
    )
    assert np.isnan(task.extra[:5]).all()
    assert not task.features(jnp.array(4))[..., 1:].any()  # unknown, and so the mean
    again = on_table(task, table(50))
    np.testing.assert_array_equal(again.extra, task.extra[:50])
    np.testing.assert_array_equal(again.scale, task.scale)
    with pytest.raises(QfolioError, match="signal_scale is 'log'"):
        Portfolio.of(table(), window=2, horizon=10, signals=text, signal_scale="log")


def test_what_is_observed_has_a_mean_of_0_and_a_deviation_of_1():
    """Unknown rows that counted as 0 made the scale of a log volatility 4 times as large."""
    text = "market-volatility:20,momentum:20"
    task = Portfolio.of(table(), window=2, horizon=10, signals=text)
    known = np.asarray(task.extra[21:])
    np.testing.assert_array_equal(np.isnan(task.extra).any((1, 2)), np.arange(60) < 20)
    np.testing.assert_allclose(task.center[1:], np.nanmean(task.extra, (0, 1)), rtol=1e-5)
    assert abs(task.center[1]) > 5 * task.scale[1]
    everywhere = jnp.concatenate([task.features(jnp.array(row))[:, -1:] for row in range(1, 60)], 1)
    np.testing.assert_allclose(everywhere[..., 1:].mean((0, 1)), 0, atol=1e-4)
    np.testing.assert_allclose(everywhere[..., 1:].std((0, 1)), 1, atol=1e-4)
    later = task.part(30, 59)
    np.testing.assert_allclose(later.scale[1:], known[10:].std((0, 1)), rtol=1e-5)
    nowhere = Portfolio.of(table(15), window=2, horizon=5, signals=text)
    np.testing.assert_array_equal(nowhere.center[1:], 0)
    np.testing.assert_array_equal(nowhere.scale[1:], 1)


@pytest.mark.parametrize("text", ["market-volatility:252", "market-momentum:252", "momentum:252"])
@pytest.mark.parametrize("rows", [253, 256, 300])
def test_a_signal_that_is_known_at_few_rows_is_not_enlarged(text, rows):
    """The deviation of a few neighbors, or of one, would make later values thousands."""
    prices = price_table(random_walk(600, 4, volatility=0.02), dates=days(600))
    task = Portfolio.of(prices, window=1, horizon=1, signals=text).part(0, rows - 1)
    later = [task.features(jnp.array(row))[..., 1] for row in range(rows, 600)]
    assert abs(np.array(later)).max() < 10


def test_a_constant_has_no_scale():
    values = random_walk(60, 3)
    constant = np.full((60, 3, 1), 0.1)
    prices = price_table(values, dates=days(60), feature_names=("same",), features=constant)
    task = Portfolio.of(prices, window=1, horizon=1)
    assert task.scale[1] == 1
    assert abs(task.features(jnp.array(30))[..., 1]).max() < 1e-4


def test_a_column_of_the_table_is_ranked_like_a_signal():
    values = prices()[:, :3]
    column = np.random.default_rng(0).normal(size=values.shape)
    found = signals.compute(signals.parse("feature:value"), values, columns={"value": column})
    np.testing.assert_array_equal(found[..., 0], column.argsort(1).argsort(1) - 1.0)
    with pytest.raises(QfolioError, match="feature:value names no column"):
        signals.compute(signals.parse("feature:value"), values)


@pytest.mark.parametrize("text", ["residual-volatility:20", "correlation:20"])
@pytest.mark.parametrize("scale", ["rank", "z-score"])
def test_two_assets_tie_where_rounding_alone_tells_them_apart(text, scale):
    """Their residuals on the market, their mean, are opposite, and their correlation is one."""
    known = slice(25 + 20, None)
    raw = signal(text, prices(assets=2))[known]
    assert 0 < abs(raw[:, 0] - raw[:, 1]).max() < 1e-10
    assert not signals.compute(signals.parse(text), prices(assets=2), scale)[known].any()
    three = signals.compute(signals.parse(text), prices(assets=3), scale)[known, :, 0]
    assert (abs(three).max(1) > 0.5).all()


@pytest.mark.parametrize("text", ["drift:20-2", "volatility:20", "volatility-ratio:20-5"])
def test_a_deposit_among_stocks_leaves_their_signals_as_they_are(text):
    """Its returns are all the same, up to rounding, so that it has no volatility."""
    stocks = random_walk(60, 4, volatility=0.02)
    rate = np.where(np.arange(60) < 30, 1e-4, 1.2e-4)  # it changes once
    deposit = 100 * np.cumprod(1 + rate)[:, None]
    found = signals.compute(signals.parse(text), np.hstack([stocks, deposit]), "raw")
    settled = np.r_[0:30, 50:60]
    assert np.isnan(found[settled, -1]).all()
    if not text.startswith("drift"):  # which is centered
        alone = signals.compute(signals.parse(text), stocks, "raw")
        np.testing.assert_array_equal(found[:, :4], alone)
    assert np.nanmax(abs(found[settled])) < 20


def test_what_all_share_is_known_of_assets_that_are_not_there():
    """Or it would be 0 for these, far from all that it ever is, in the mean over the assets."""
    values, there = random_walk(60, 4, volatility=0.02), np.ones((60, 4), bool)
    there[:, 2:] = False
    chosen = signals.parse("market-volatility:20,volatility:20")
    found = signals.compute(chosen, values, "raw", tradable=there)
    np.testing.assert_array_equal(found[..., 0], found[:, :1, 0].repeat(4, 1))
    assert found[-1, 2:, 0].max() < -3
    assert np.isnan(found[:, 2:, 1]).all()


def test_an_asset_that_is_the_market_has_no_residual():
    assert np.isnan(signal("residual-volatility:20", prices(assets=1))).all()


class Framed(Tomorrow):
    """A data frame, as pandas makes of one."""

    def measure(self, prices, rows):
        return pd.DataFrame(prices).pct_change(rows)


def test_a_signal_may_be_a_data_frame():
    assert np.isfinite(signals.compute([Framed(rows=5)], random_walk(60, 4))[5:]).all()


def test_a_column_about_the_whole_market_stays_so_when_assets_come_and_go():
    values, there = random_walk(60), np.ones((60, 3), bool)
    there[:20, 1] = there[40:, 2] = False
    level = np.linspace(10, 30, 60)[:, None]
    column = np.broadcast_to(level, values.shape).copy()
    column[:20, 1] = np.nan  # not listed yet
    column[40:, 2] = column[40, 2]  # delisted: its last number remains
    compute = lambda rows: signals.compute(  # noqa: E731
        signals.parse("feature:vix"), values[:rows], columns={"vix": column[:rows]},
        tradable=there[:rows],
    )[..., 0]  # fmt: skip
    for rows in (20, 40, 60):
        np.testing.assert_array_equal(compute(rows), np.broadcast_to(level[:rows], (rows, 3)))
    alone = np.where([True, False, False], column, np.nan)
    found = signals.compute(signals.parse("feature:vix"), values, columns={"vix": alone})
    np.testing.assert_array_equal(found[:, 0, 0], 0)  # one asset's own number is not the market's
    assert np.isnan(found[:, 1:]).all()
    column[50, 0] += 1
    np.testing.assert_array_equal(compute(60)[50], [1, -1, np.nan])  # ranked if two differ
