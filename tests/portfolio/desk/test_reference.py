"""The benchmark over live rows, without any training."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.desk.desk import Desk
from qfolio.portfolio.desk.reference import reference
from qfolio.portfolio.prices.table import load

from tables import days, price_table, random_walk
from tiny import PATHWISE

AGENTS = {"pathwise": PATHWISE}
DAYS = days(190).astype(str)


def table(rows=160):
    return price_table(random_walk(rows, drift=3e-4))


def desk(out, benchmark, **options):
    """Of a backtest with one fold that is not trained."""
    rest = {"train": "100d", "test": "60d", "seeds": 1, "cost": 0.002, "baselines": []}
    Backtest.create(table(), AGENTS, out=out, benchmark=benchmark, **{**rest, **options})
    return Desk.open(out)


ORDERS = pd.DataFrame({"date": DAYS[[40, 110, 130]], "A": [0.6, 0.2, 0.5], "B": [0.4, 0.8, 0.1]})
INDEX = pd.DataFrame({"date": DAYS[:160], "level": np.exp(np.arange(160) * 1e-3)})


@pytest.mark.parametrize(
    ("benchmark", "options"),
    [
        ("equal-weight", {}),
        ("equal-weight", {"calendar": "drift:0.02"}),
        ("equal-weight", {"calendar": "monthly"}),  # it trades first when the account does
        ("minimum-variance", {}),
        ("minimum-variance", {"mandate": {"assets": {"cap": 0.4}}}),
        ("A", {}),
        (ORDERS, {}),
        (INDEX, {}),
    ],
)
def test_the_benchmark_earns_what_the_backtest_says(tmp_path, benchmark, options):
    made = desk(tmp_path / "run", benchmark, **options)
    run, name = made.run, made.run.config.benchmark
    entries, _ = run.replay.others(run.baselines, run._own, name)
    decisions = run.folds[0].decisions
    count = decisions.stop - decisions.start
    found, note = reference(made, run.prices, decisions.start, count, None)
    np.testing.assert_array_equal(found, entries[name].simulation.returns[0])
    assert note == ""


def test_what_a_delisted_asset_paid_out_is_no_price_to_learn_from(tmp_path):
    """It started late, so that with its prices the training would have to start late, too."""
    values = random_walk(160, 4, drift=3e-4)
    values[:20, 3] = values[50:, 3] = np.nan
    frame = pd.DataFrame(values, pd.DatetimeIndex(days(160), name="date"), list("ABCD"))
    prices = load(frame, late="join", ended="cash-out")
    Backtest.create(
        prices, AGENTS, out=tmp_path / "run", train="100d", test="30d", seeds=1, baselines=[],
        benchmark="minimum-variance",
    )  # fmt: skip
    made = Desk.open(tmp_path / "run")
    run, fold = made.run, made.run.folds[1]
    entry, _ = dataclasses.replace(run.replay, folds=[fold]).baseline(
        "baseline", "minimum-variance", run.baselines["minimum-variance"]
    )
    found, _ = reference(made, prices, fold.decisions.start, fold.days, None)
    np.testing.assert_array_equal(found, entry.simulation.returns[0])


def test_a_table_of_ones_own_goes_on_with_its_latest_rows(tmp_path):
    made, later = desk(tmp_path / "index", INDEX), table(190)
    with pytest.raises(QfolioError, match=r"no level on 2020-06-.* latest table with --benchmark"):
        reference(made, later, 159, 28, None)
    longer = pd.DataFrame({"date": DAYS, "level": np.exp(np.arange(190) * 1e-3)})
    longer.to_csv(tmp_path / "index.csv", index=False)
    found, _ = reference(made, later, 159, 28, tmp_path / "index.csv")
    np.testing.assert_allclose(found, np.expm1(1e-3))
    made = desk(tmp_path / "orders", ORDERS)
    _, note = reference(made, later, 159, 28, None)
    assert "The last order of benchmark is of 2020-05-10, and its holding has drifted since" in note
    made = desk(tmp_path / "equal", None)
    with pytest.raises(QfolioError, match="equal-weight is a baseline, which needs no table"):
        reference(made, later, 159, 28, tmp_path / "index.csv")
