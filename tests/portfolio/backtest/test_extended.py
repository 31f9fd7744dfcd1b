"""A backtest goes on with a table that has more rows at its end."""

import dataclasses
import shutil

import jax
import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.experiments.executor import Here
from qfolio.experiments.presets import Preset
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.prices.extended import require_grown

from populations import assert_same
from tables import price_table, random_walk

ROWS, FIRST = 160, 130  # folds of 30 rows begin at 60, 90, 120 and 150; the third has 10 at first
SETTINGS = {"rollout_length": 5, "num_envs": 2, "hidden": (4,)}
AGENT = Preset("pathwise", SETTINGS, episodes=4, seeds=1, task={"window": 5, "horizon": 10})


def table(rows=ROWS):
    rng = np.random.default_rng(3)
    values = random_walk(ROWS, seed=rng, drift=3e-4)
    volumes = rng.uniform(1, 2, (ROWS, 3, 1))
    prices = price_table(values, features=volumes, feature_names=("volume",), source="made up")
    return prices.between(0, rows)


def finished(folder, prices):
    run = Backtest.create(
        prices, {"pathwise": AGENT}, out=folder, train="60d", test="30d", seeds=1,
        baselines=("momentum",),
    )  # fmt: skip
    run.run()
    return run


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    return finished(tmp_path_factory.mktemp("growth") / "run", table(FIRST))


def policies(run):
    return {
        stretch.fold.name: jax.tree.leaves(stretch.members) for stretch in run.stretches("pathwise")
    }


def returns(run):
    entries, _ = run.entries()
    return {name: entry.simulation.returns for name, entry in entries.items()}


def test_going_on_equals_one_run_and_keeps_what_was_there(first, tmp_path):
    shutil.copytree(first.folder, tmp_path / "run")
    tomorrow, before = first.policy(), returns(first)
    named = dataclasses.replace(table(), source="another file")
    jobs = []

    def note(job, done, share):
        jobs.append(job)
        return ()

    Backtest.open(tmp_path / "run").extended(named).run(note)
    on, whole = Backtest.open(tmp_path / "run"), finished(None, table())
    assert [fold for job in jobs for fold in job.folds] == [on.folds[-1].name, "latest-1"]
    assert len(on.folds) == 4
    assert_same(policies(on), policies(whole))
    after = returns(on)
    assert_same(after, returns(whole))
    for name, series in before.items():
        np.testing.assert_array_equal(after[name][:, : series.shape[1]], series, err_msg=name)
    # Policies for tomorrow: one of all rows, and the one before it, which orders may have followed.
    now = on.policy()
    assert_same(now.learner, whole.policy().learner)
    assert (now.updates, now.learned) == (1, table().dates[-1])
    stored = on.policy(stored="latest")
    assert stored.weights(table(FIRST)) == tomorrow.weights(table(FIRST))
    assert now.weights(table()) == whole.policy().weights(table())
    assert on.config.prices["rows"] == ROWS
    assert on.config.prices["source"] == "made up"


def first_delisting(late=0):
    """B is delisted in the new rows; it may have started late."""
    values, listed = table().values.copy(), np.ones((ROWS, 3), bool)
    values[FIRST + 4 :, 1] = 0.7 * values[FIRST + 3, 1]
    listed[FIRST + 4 :, 1] = False
    values[:late, 1], listed[:late, 1] = np.nan, False
    return changed(values=values, listed=listed)


def test_the_first_delisting_may_be_new(first, tmp_path):
    shutil.copytree(first.folder, tmp_path / "run")
    before, longer = returns(first), first_delisting()
    assert longer.between(0, FIRST).digest == table(FIRST).digest
    Backtest.open(tmp_path / "run").extended(longer).run()
    on = Backtest.open(tmp_path / "run")
    np.testing.assert_array_equal(on.prices.listed, longer.listed)
    after = returns(on)
    for name, series in before.items():
        np.testing.assert_allclose(after[name][:, : series.shape[1]], series, rtol=0, atol=1e-14)
    orders = on.entries()[0]["pathwise"].decisions[0]
    row = np.arange(on.folds[0].decisions.start, on.folds[-1].decisions.stop)
    assert (orders[row >= FIRST + 4, 2] == 0).all()


def test_a_first_delisting_is_refused_where_assets_started_late():
    with pytest.raises(QfolioError, match="Assets come and go in one of the tables"):
        require_grown(
            changed(values=first_delisting(9).values).between(0, FIRST), first_delisting(9)
        )


def test_nothing_is_kept_before_a_longer_table_is_trained_on(first, tmp_path):
    """A policy updated by hand would take the name of the one that is still to be trained."""
    shutil.copytree(first.folder, tmp_path / "run")
    why = tmp_path / "run" / "why.json"
    why.write_text("{}")
    longer = Backtest.open(tmp_path / "run").extended(table())
    assert not why.exists()  # nor are old attributions mixed with a new test
    updated = longer.policy(stored="latest")
    updated.updates = 1
    with pytest.raises(QfolioError, match="not finished; continue with qfolio backtest --resume"):
        longer.keep(None, updated)
    assert longer._kept.names("pathwise") == first._kept.names("pathwise")


def test_the_same_table_trains_nothing(first):
    assert first.extended(table(FIRST)).jobs(Here()) == []


def changed(**columns):
    return dataclasses.replace(table(), **columns)


def test_rows_that_move_the_folds_are_refused():
    """A second row in the last month, so that lengths do not count months any more."""
    following = np.datetime64("2000-02") + np.arange(ROWS).astype("m8[M]")
    dates = np.busday_offset(following.astype("M8[D]"), -1, roll="forward")
    months = changed(dates=dates).between(0, FIRST)
    dates[FIRST] = dates[FIRST - 1] + np.timedelta64(2, "D")
    run = Backtest.create(months, {"pathwise": AGENT}, train="5y", test="1y", seeds=1, baselines=())
    message = r"folds begin on other dates \(first: \d+-\d+-\d+, now .*\); start a new backtest"
    with pytest.raises(QfolioError, match=message):
        run.extended(changed(dates=dates).between(0, FIRST + 1))


SECOND = np.timedelta64(1, "s")


def moved(array, *place, by=1):
    array = array.copy()
    array[place] += by
    return array


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (lambda: changed(values=moved(table().values, 7, 1)), "for 'B' on 2020-01-08 where"),
        (lambda: changed(features=moved(table().features, 9, 2, 0)), "'volume of C' on 2020-01-10"),
        (
            lambda: changed(dates=moved(table().dates, 4, by=SECOND)),
            "of 2020-01-05 00:00:01 where .*-05;",
        ),
        (lambda: table().between(1, None), "of 2020-01-02 where .* 2020-01-01"),
        (lambda: table().select(["A", "C"]), "no asset 'B'"),
        (lambda: changed(assets=("A", "C", "B")), "assets in another order"),
        (lambda: changed(feature_names=("size",)), "no feature 'volume'"),
        (lambda: table(FIRST - 1), "129 rows up to 2020-05-08, fewer than"),
        (lambda: changed(members=np.ones((ROWS, 3), bool)), "Assets come and go"),
    ],
)
def test_other_rows_are_refused_by_name(first, other, message):
    kept = (first.folder / "prices.safetensors").read_bytes()
    with pytest.raises(QfolioError, match=message):
        first.extended(other())
    assert (first.folder / "prices.safetensors").read_bytes() == kept


def test_another_rate_of_the_market_is_refused_by_name():
    rate = np.full((ROWS, 1), 0.02)
    before, after = (
        changed(market=each, market_names=("rate",)) for each in (rate, moved(rate, 9, 0))
    )
    require_grown(before.between(0, FIRST), before)
    with pytest.raises(QfolioError, match="'rate' on 2020-01-10 where"):
        require_grown(before.between(0, FIRST), after)
