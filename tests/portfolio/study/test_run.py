import json
import shutil

import msgspec
import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.core.statistics import holm
from qfolio.experiments.events import EVENTS, read
from qfolio.experiments.executor import Here
from qfolio.portfolio.backtest.folder import BacktestFolder
from qfolio.portfolio.backtest.folds import require_fold
from qfolio.portfolio.study.folder import StudyFolder, Variant
from qfolio.portfolio.study.run import Study
from qfolio.portfolio.study.summary import corrected, summarize

from listeners import Interrupt
from studies import made_up, study
from tables import days, price_table, random_walk
from tiny import PATHWISE, with_task

AGENTS = {"pathwise": PATHWISE}


def table(seed, rows=160):
    return price_table(random_walk(rows, seed=seed, drift=3e-4), source=f"made up {seed}")


TABLES = {"one": table(0), "two": table(1)}


def create(folder, tables=TABLES, **options):
    chosen = {"train": "80d", "test": "40d", "seeds": 2, "baselines": [], **options}
    return Study.create(tables, AGENTS, out=folder, **chosen)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    done = create(tmp_path_factory.mktemp("studies") / "study", costs=(0.001, 0.005))
    done.run()
    done.result()
    return done


class Killed(Here):
    """Stops as a killed process does, after some jobs."""

    def __init__(self, jobs):
        self.jobs = jobs

    def map(self, jobs, listen):
        for done in super().map(jobs, listen):
            if not self.jobs:
                raise RuntimeError("killed")
            self.jobs -= 1
            yield done


def test_a_study_killed_and_resumed_equals_an_undisturbed_one(finished, tmp_path):
    broken = create(tmp_path / "study", costs=(0.001, 0.005))
    with pytest.raises(RuntimeError, match="killed"):
        broken.run(executor=Killed(5))
    again = Study.open(tmp_path / "study")
    with pytest.raises(QfolioError, match="not finished; continue with qfolio study --resume"):
        again.result()
    assert 0 < len(again.config.looks) < 4
    trained, shares = [], []

    def note(job, done, share):
        shares.append((done, share))
        return ()

    def listen(name, variant, backtest):
        trained.append((name, variant))
        return note

    again.run(listen)
    assert 0 < shares[0][0] < 1  # of the whole backtest, with what was trained before
    assert sum(shares[-1]) == pytest.approx(1)
    left = [place for place in finished.places if place not in finished.places[: 4 - len(trained)]]
    assert trained == left  # finished tables are not run again
    assert again.result() == finished.config.result
    assert (tmp_path / "study/study.csv").read_text() == (finished.folder / "study.csv").read_text()


def test_ctrl_c_stops_after_the_current_chunk(tmp_path):
    made = create(tmp_path / "study")
    made.run(lambda *place: lambda job, done, share: [Interrupt()])
    assert made.interrupted
    assert not made.config.looks
    made.run()
    assert not made.interrupted
    assert len(made.config.looks) == 2


def test_a_study_writes_typed_finite_numbers(finished):
    content = json.loads((finished.folder / "study.json").read_text())
    assert content["kind"] == "study"
    assert Study.open(finished.folder).config == finished.config
    lines = (finished.folder / "study.csv").read_text().splitlines()
    assert len(lines) == 1 + 2 * 2
    assert lines[0].startswith("table,lag,cost_bps,agent,")
    main = content["result"]["variants"][0]["agents"]["pathwise"]
    assert main["to_reference"]["p_holm"] is not None
    assert content["result"]["variants"][1]["agents"]["pathwise"]["to_reference"]["p_holm"] is None
    assert "4 of 4 backtests finished" in repr(finished)


def test_the_log_of_a_study_has_its_result(finished):
    events, _ = read(finished.folder / EVENTS)
    pooled = finished.config.result.variants[0].agents["pathwise"].to_reference
    (values,) = [event["values"] for event in events if event["event"] == "result"]
    assert values == {
        "pathwise": {
            "active_growth": pooled.growth, "low": pooled.low, "high": pooled.high, "z": pooled.z,
        }
    }  # fmt: skip


def test_a_study_shows_itself_in_a_notebook(finished, tmp_path):
    pooled = finished.config.result.variants[0].agents["pathwise"].to_reference
    shown = finished._repr_html_()
    assert "Study of pathwise" in shown
    assert "4 of 4 backtests finished" in shown
    assert f"<td>{pooled.z:+.2f}</td>".replace("-", "−") in shown
    assert "0 of 2 backtests finished" in create(tmp_path / "new")._repr_html_()
    config, result = study(1)
    alone = Study(msgspec.structs.replace(config, result=result), tmp_path)._repr_html_()
    assert ("pooled, a year, net" in shown, "pooled" in alone) == (True, False)
    assert "a year, net" in alone


def test_names_of_tables_may_have_any_letters(tmp_path):
    named = {"börse": TABLES["one"], "株価": TABLES["two"]}
    create(tmp_path / "study", named)
    again = Study.open(tmp_path / "study")
    assert list(again.config.tables) == list(named)
    assert again.backtest("株価").prices.digest == TABLES["two"].digest


def test_each_table_is_an_ordinary_backtest(finished):
    backtest = finished.backtest("two", Variant(1, 0.005))
    assert backtest.config.cost == 0.005
    assert not (backtest.folder / "why.json").exists()
    assert (finished.backtest("two").folder / "why.json").exists()  # the main variant
    summary = json.loads((backtest.folder / "summary.json").read_text())
    contrast = summary["strategies"]["pathwise-together"]["to_reference"]["growth"]
    assert finished.config.result is not None
    pools = finished.config.result.variants[1].agents["pathwise"]
    active = pools.evidence["two"].to_reference
    assert active.growth == pytest.approx(contrast["value"])
    assert (active.low, active.high) == pytest.approx(tuple(contrast["interval"]))
    with pytest.raises(QfolioError, match="no table 'three'; choose from one, two"):
        finished.backtest("three")


def test_a_table_whose_summary_is_lost_can_be_written_again(finished):
    place = finished.backtest("one").folder
    (place / "summary.json").rename(place / "lost.json")
    try:
        with pytest.raises(QfolioError, match="damaged; write its tables again with qfolio backt"):
            finished.result()
    finally:
        (place / "lost.json").rename(place / "summary.json")


def test_a_backtest_that_has_gone_on_beyond_its_table_is_not_pooled(finished, tmp_path):
    folder = tmp_path / "study"
    shutil.copytree(finished.folder, folder)
    place = folder / "tables/one/lag1-10bp"
    returns, summary = place / "returns.csv", place / "summary.json"
    content = json.loads(summary.read_text())
    day = str(TABLES["one"].dates[-1].astype("datetime64[D]") + np.timedelta64(1, "D"))
    with returns.open("a") as file:
        file.write(",".join([day, *returns.read_text().splitlines()[-1].split(",")[1:]]) + "\n")
    summary.write_text(json.dumps({**content, "periods": content["periods"] + 1}))
    with pytest.raises(QfolioError, match=f"has gone on to {day}, but the study's table one ends"):
        Study.open(folder).result()
    assert Study.open(folder).config.result == finished.config.result


def test_what_cash_earned_is_read_with_the_returns(finished, tmp_path):
    files, main = StudyFolder(tmp_path / "study"), finished.config.variants[0]
    shutil.copytree(finished.folder, files.path)
    backtest = BacktestFolder(files.place("one", main))
    dates, columns = backtest.read_returns()
    rate = np.linspace(1e-4, 2e-4, len(dates))
    backtest.write_returns(dates, {**columns, "risk_free": rate})
    found = files.read_returns("one", main, finished.config).risk_free
    np.testing.assert_array_equal(found, rate)


def test_looks_are_counted_and_inherited(finished, tmp_path):
    result = finished.config.result
    assert (result.looks, result.earlier, result.trials) == (4, 0, 2)
    tables = {"again": TABLES["one"], "new": table(7)}
    later = create(tmp_path / "later", tables, trials=3, after=[finished.folder, finished.folder])
    assert later.config.tables["again"].trials == 3 + 2  # both costs
    assert later.config.tables["new"].trials == 3
    assert later.backtest("again").config.trials == 5
    assert len(later.config.earlier) == 4  # each once
    after = [finished.folder, later.folder, later.folder]
    last = create(tmp_path / "last", tables, trials=1, after=after)
    assert last.config.tables["again"].trials == 1 + 3 + 2  # those that the second was told of, too
    assert last.config.tables["new"].trials == 1 + 3


def _untested(pools):
    """As ``pool`` returns them."""
    return msgspec.structs.replace(
        pools,
        **{
            key: msgspec.structs.replace(getattr(pools, key), p_holm=None, finding=None)
            for key in ("to_reference", "to_rebalanced")
        },
    )


def test_the_correction_counts_all_agents_and_references():
    _, result = study(3)
    agents = result.variants[0].agents
    pooled = [
        each for name in agents for each in (agents[name].to_reference, agents[name].to_rebalanced)
    ]
    found = corrected({name: _untested(pools) for name, pools in agents.items()}, True)
    after = [
        each for name in found for each in (found[name].to_reference, found[name].to_rebalanced)
    ]
    assert after == pooled
    assert [each.p_holm for each in after] == pytest.approx(
        holm(np.array([each.p for each in after]))
    )
    better = [pools.to_reference.finding for pools in found.values()]
    assert set(better) <= {"better", "worse", "none"}
    worse = msgspec.structs.replace(
        agents["tilts"],
        to_reference=msgspec.structs.replace(agents["tilts"].to_reference, z=-9.0, p=1e-9),
    )
    assert corrected({"tilts": worse}, True)["tilts"].to_reference.finding == "worse"
    # A reference without rebalancings is one comparison, not two.
    once = corrected({"tilts": worse}, False)["tilts"]
    assert once.to_reference.p_holm == pytest.approx(1e-9)
    assert once.to_rebalanced == once.to_reference


def test_luck_of_many_looks_is_not_better():
    _, result = study(3)
    pools = result.variants[0].agents["tilts"]
    z = msgspec.structs.replace(pools.to_reference, z=2.5, p=0.0124)
    pools = msgspec.structs.replace(pools, to_reference=z, to_rebalanced=z)

    def finding(threshold, z):
        one = msgspec.structs.replace(pools.to_reference, z=z)
        decided = corrected(
            {"tilts": msgspec.structs.replace(pools, to_reference=one)}, False, threshold
        )
        return decided["tilts"].to_reference.finding

    assert finding(2.4, 2.5) == "better"
    assert finding(2.8, 2.5) == "none"
    assert finding(2.8, -2.5) == "worse"


def test_a_verdict_counts_earlier_looks():
    """The same returns, which 213 earlier looks at a table make those of luck."""
    config, _ = study(2)
    rng = np.random.default_rng(0)
    tested = {
        name: made_up(rng, 2520, 1e-4, f"{1960 + 20 * i}-01-04")
        for i, name in enumerate(config.tables)
    }

    def said(*trials):
        tables = {
            name: msgspec.structs.replace(table, trials=earlier)
            for (name, table), earlier in zip(config.tables.items(), trials, strict=True)
        }
        changed = msgspec.structs.replace(config, tables=tables, agents=["tilts"])
        return summarize(changed, [tested]).verdicts["tilts"][0]

    assert said(0, 0).startswith("tilts beats equal-weight, however it is rebalanced,")
    luck = said(213, 213)
    assert luck.startswith("No evidence that tilts beats the best rebalancing of equal-weight")
    assert luck.endswith(
        "corrected p = 0.012, but luck is expected to reach a z of +2.79 after all looks."
    )
    assert said(213, 0) == said(0, 213) == luck  # the table that was looked at most


def test_short_tables_are_left_out_with_a_reason(tmp_path):
    short = table(3, rows=100)
    part = create(tmp_path / "part", {**TABLES, "short": short})
    assert list(part.config.tables) == ["one", "two"]
    assert "are fewer than train=80d and one fold of test=40d" in part.config.left_out["short"]
    part = create(tmp_path / "few", {**TABLES, "short": table(3, rows=84)}, test="4d")
    assert "leave 4 rows to test after train=80d, fewer than 5" in part.config.left_out["short"]
    with pytest.raises(QfolioError, match="short is too short: 100 rows"):
        create(tmp_path / "none", {"short": short})
    assert not (tmp_path / "none").exists()


def test_tables_too_short_for_an_agent_are_left_out(tmp_path):
    """At two of the lags it is long enough, and the backtests there do not stay."""
    agent = with_task(PATHWISE, window=60, horizon=10)
    weeks = price_table(table(3).values, dates=days(7 * 160)[::7])
    made = Study.create(
        {"days": table(0, rows=700), "weeks": weeks}, {"p": agent}, out=tmp_path / "part",
        lags=(1, 2, 9), train="18m", test="3m", seeds=1, baselines=[],
    )  # fmt: skip
    assert list(made.config.tables) == ["days"]
    assert "rows are too few: a window of 60, a lag of 9" in made.config.left_out["weeks"]
    assert [place.name for place in (tmp_path / "part" / "tables").iterdir()] == ["days"]


def test_a_fold_may_end_on_a_holiday():
    weekdays = np.busday_offset("2001-01-01", np.arange(520), roll="forward")
    last = np.searchsorted(weekdays, np.datetime64("2002-12-30"))
    require_fold(weekdays[: last + 1].astype("datetime64[s]"), "1y", "1y", 1)
    with pytest.raises(QfolioError, match="one fold of test=1y"):
        require_fold(weekdays[: last - 9].astype("datetime64[s]"), "1y", "1y", 1)
    months = np.arange("2001-01", "2003-01", dtype="datetime64[M]").astype("datetime64[s]")
    require_fold(months, "1y", "1y", 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tables": {}}, "needs at least one table"),
        ({"trials": -1}, "trials is -1; it must be from 0"),
        ({"costs": ()}, "needs at least one lag and one cost"),
        ({"tables": {"../a": TABLES["one"]}}, "A table is called '../a'"),
        ({"tables": {"a": TABLES["one"], "b": TABLES["one"]}}, "a and b are the same table"),
        ({"lags": (1, 1)}, "lag of 1 with a cost of 10 bp is given twice"),
        ({"baselines": ["equl-weight"]}, "one: .*equl-weight"),
        ({"costs": (0.001, 0.002), "mandate": {"costs": {"cost": 0.0005}}}, "sets a cost of 5 bp"),
        ({"costs": (0.001, 0.002), "cost_model": "itemized(cost=0.003)"}, "sets a cost of 30 bp"),
        ({"train": "five"}, "A length is 'five'"),
        ({"after": ["nowhere"]}, "nowhere is no study"),
    ],
)
def test_studies_that_are_refused(tmp_path, options, message):
    with pytest.raises(QfolioError, match=message):
        create(tmp_path / "study", **options)
    assert not (tmp_path / "study").exists()


def test_tables_with_the_same_prices_are_named_in_the_result(tmp_path):
    tables = {"one": TABLES["one"], "cents": price_table(TABLES["one"].values.round(2))}
    made = create(tmp_path / "study", tables)
    (said,) = made.config.twins
    assert said.startswith("one and cents hold nearly the same prices")
    made.run()
    assert made.result().twins == [said]
    assert create(tmp_path / "other").config.twins == []
