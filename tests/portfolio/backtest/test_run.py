import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.core.registry import BASELINES, find
from qfolio.experiments.events import read
from qfolio.experiments.executor import Here
from qfolio.experiments.presets import Preset, preset
from qfolio.portfolio.backtest import notes
from qfolio.portfolio.backtest.folder import MOST_WEIGHTS, BacktestFolder, rows_written
from qfolio.portfolio.backtest.kept import LATEST
from qfolio.portfolio.backtest.replay import Entry, Stretch, decide
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.backtest.simulation import Simulation, simulate
from qfolio.portfolio.backtest.training import FoldsJob
from qfolio.portfolio.backtest.writing import write_tables
from qfolio.portfolio.following import begin, follow
from qfolio.portfolio.prices.table import DEFAULT_SOURCE, DEFAULT_TRIALS, Prices, load

from listeners import Interrupt, Tell
from tables import price_table, random_walk, write_table
from tiny import DQN, with_task

AGENTS = {
    "dqn": DQN,
    "pathwise": Preset(
        "pathwise", {"rollout_length": 10, "num_envs": 4, "hidden": (8, 8)},
        episodes=24, seeds=2, task={"window": 10, "horizon": 20},
    ),
}  # fmt: skip


def table(rows=260, seed=0):
    values = random_walk(rows, seed=seed, drift=3e-4)
    return price_table(values, ("A", "B", "=<b>C"), note="made up")


def create(folder=None, prices=None, agents=AGENTS, **settings):
    options = {
        "expanding": False,
        "train": "100d",
        "test": "50d",
        "seeds": 2,
        "cost": 0.002,
        **settings,
    }
    prices = table() if prices is None else prices
    return Backtest.create(prices, agents, out=folder, **options)


def changed(name, **task):
    """An agent alone, with other settings of the task."""
    return {name: with_task(AGENTS[name], **task)}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("backtests") / "run"
    backtest = create(folder)
    backtest.run()
    return backtest


def test_the_log_names_every_job_and_member(finished):
    events, _ = read(finished.folder / "events.jsonl")
    jobs = {job for event in events if event["event"] == "queued" for job in event["jobs"]}
    assert {job.partition("/")[0] for job in jobs} == {"dqn", "pathwise"}
    for state in ("running", "done"):
        assert {event["job"] for event in events if event["event"] == state} == jobs
    members = [name for e in events if e["event"] == "running" for name in e["members"]]
    folds = [*(fold.name for fold in finished.folds), "latest"]
    assert sorted(members) == sorted(
        f"{fold}, seed {seed}" for fold in folds for seed in range(2) for _ in finished.agents
    )
    assert events[-1]["event"] == "end"


def test_all_strategies_are_replayed_on_the_same_days(finished):
    entries, _ = finished.entries()
    agents = ["dqn", "dqn-together", "pathwise", "pathwise-together"]
    slower = [f"equal-weight at {speed}" for speed in ("0.3", "0.1", "0.03", "0.01", "0")]
    assert list(entries) == [*agents, *BASELINES, *slower]
    assert len(finished.folds) == 4
    assert len(finished.dates) == 260 - 100
    assert str(finished.dates[0])[:10] == finished.folds[0].name == "2020-04-10"
    assert finished.dates[-1] == table().dates[-1]
    for name, entry in entries.items():
        seeds = 2 if name in AGENTS else 1
        assert entry.simulation.returns.shape == (seeds, 160), name
    assessment = finished.assess(entries)
    assert assessment.trials == 6
    assert [s.kind for s in assessment.strategies.values()][:4] == ["agent", "ensemble"] * 2
    assert assessment.strategies["dqn"].to_reference.reference == "equal-weight"


@pytest.mark.parametrize(
    ("settings", "cost"),
    [
        ({}, 0.002), ({"cost_model": "itemized(cost=0.003)"}, 0.003),
        ({"mandate": {"costs": {"cost": 0.0005}}}, 0.0005),
        ({"mandate": {"costs": {"cost": 0.0005}}, "cost_model": "itemized(cost=0.003)"}, 0.003),
    ],
)  # fmt: skip
def test_the_cost_that_is_stated_is_charged(settings, cost):
    backtest = create(cost=0.002, **settings)
    assert backtest.config.cost == cost
    assert f"{cost * 1e4:g} bp" in backtest._repr_html_()
    charged = backtest.replay.task.costs
    assert charged.cost == cost


def test_the_test_may_be_judged_from_a_date_on(finished):
    entries, _ = finished.entries()
    whole, half = finished.assess(entries), finished.assess(entries, str(finished.dates[60])[:10])
    assert half.strategies["dqn"].measures != whole.strategies["dqn"].measures
    with pytest.raises(QfolioError, match="'soon' is no date"):
        finished.assess(entries, "soon")
    with pytest.raises(QfolioError, match=r"The test ends on .*, before 2999-01-01"):
        finished.assess(entries, "2999-01-01")


def test_a_backtest_says_what_it_is(finished):
    first, last = (str(date)[:10] for date in finished.dates[[0, -1]])
    assert repr(finished) == (
        f"<Backtest: {', '.join(finished.agents)} on {len(finished.prices.assets)} assets, "
        f"{len(finished.folds)} folds from {first} to {last}, 2 seeds, in {finished.folder}>"
    )


def test_a_table_may_be_given_by_its_path(tmp_path):
    path = write_table(tmp_path / "prices.csv")
    assert np.array_equal(create(prices=path).prices.values, load(path).values)


def test_costs_are_charged(finished):
    """Each entry is what an independent replay of its decisions earns, at the cost asked for."""
    entries, _ = finished.entries()
    first = finished.folds[0].decisions.start
    for name, entry in entries.items():
        replay = {
            cost: simulate(finished.prices.values, entry.decisions, first=first, cost=cost, lag=1)
            for cost in (0.0, 0.002)
        }
        np.testing.assert_array_equal(entry.simulation.returns, replay[0.002].returns)
        paid = np.log1p(replay[0.0].returns).sum() - np.log1p(replay[0.002].returns).sum()
        assert paid == pytest.approx(-np.log1p(-entry.simulation.cost).sum(), rel=1e-6), name
    assert entries["equal-weight"].simulation.cost.sum() > 0.002


@pytest.mark.parametrize("name", AGENTS)
@pytest.mark.parametrize("together", [False, True])
def test_holdings_carry_over_from_fold_to_fold(finished, name, together):
    """Folds that all have one policy decide as that policy does in a single stretch."""
    same = Backtest.open(finished.folder)
    task, members, fold = same.stretches(name)[0]
    held = np.zeros((1 if together else 2, 4))
    held[:, 0] = 1
    agent, first = same.agents[name], fold.decisions.start
    start = begin(task, held)
    targets, _ = follow(task, agent, members, first, start, 160, together=together)
    stretches = [Stretch(task, members, each) for each in same.folds]
    decided = decide(agent, stretches, len(held), together=together)
    np.testing.assert_allclose(decided, targets, atol=1e-6)


def members(backtest: Backtest) -> list:
    return [stretch.members for stretch in backtest.stretches("pathwise")]


@pytest.mark.optimized  # programs that are hardly optimized round differently
def test_what_is_learned_does_not_depend_on_the_group(finished, tmp_path):
    """A backtest that is resumed has other groups of folds."""

    class FoldByFold(Here):
        def map(self, jobs, listen):
            yield from super().map(
                [
                    dataclasses.replace(job, folds=(fold,), tasks=(task,))
                    for job in jobs
                    for fold, task in zip(job.folds, job.tasks, strict=True)
                ],
                listen,
            )

    alone = create(tmp_path / "run", agents={"pathwise": AGENTS["pathwise"]})
    alone.run(executor=FoldByFold())
    one, other = (members(backtest) for backtest in (alone, finished))
    for x, y in zip(*(jax.tree.leaves(tree) for tree in (one, other)), strict=True):
        np.testing.assert_array_equal(x, y)


def test_rebalancing_at_speeds(finished):
    """At 0 it is buy and hold; the slower, the less it trades; each pays the backtest's costs."""
    entries, _ = finished.entries()
    never = entries["equal-weight at 0"].simulation.returns
    np.testing.assert_array_equal(never, entries["buy-and-hold"].simulation.returns)
    names = ["equal-weight", *(f"equal-weight at {speed}" for speed in ("0.3", "0.1", "0.03", "0"))]
    turnover = [entries[name].simulation.turnover.sum() for name in names]
    assert turnover == sorted(turnover, reverse=True)
    assert len(set(turnover)) == 5


def test_seeds_differ_and_opening_gives_the_same(finished):
    entries, _ = finished.entries()
    again, _ = Backtest.open(finished.folder).entries()
    for name in AGENTS:
        returns = entries[name].simulation.returns
        np.testing.assert_array_equal(again[name].simulation.returns, returns)
        assert not np.array_equal(returns[0], returns[1])


def test_a_backtest_is_opened_with_the_agents_that_it_trained(finished):
    """Another agent would train the folds that are missing, under the first one's name."""
    agent = finished.agents["dqn"]
    assert Backtest.open(finished.folder, {"dqn": agent}).agents["dqn"] is agent
    other = AGENTS["dqn"].build(learning_rate=0.5)
    with pytest.raises(QfolioError, match=r"agent_settings is .* give that agent"):
        Backtest.open(finished.folder, {"dqn": other})


def test_what_was_trained_stays(finished, tmp_path):
    """A backtest that is stopped goes on behind its finished folds, and ends up the same."""
    stopped = create(tmp_path / "run", agents={"pathwise": AGENTS["pathwise"]})
    jobs = []

    def stop_at_the_second(job, done, share):
        jobs.append(job)
        return [Interrupt()] if len(jobs) == 2 else []

    stopped.run(stop_at_the_second)
    assert stopped.interrupted
    resumed = Backtest.open(tmp_path / "run")
    with pytest.raises(QfolioError, match="not finished"):
        resumed.policy()

    def note(job, done, share):
        jobs.append(job)
        return []

    resumed.run(note)
    assert not resumed.interrupted
    # Each fold once: what was finished is not trained again.
    folds = [fold for job in jobs for fold in job.folds]
    assert folds == [fold.name for fold in resumed.folds] + [LATEST]
    rows = resumed.records("pathwise", resumed.folds[0].name)
    assert rows == finished.records("pathwise", finished.folds[0].name)
    assert {row["seed"] for row in rows} == {0, 1}
    one, other = ((members(b), b.policy("pathwise").learner) for b in (resumed, finished))
    for x, y in zip(*(jax.tree.leaves(tree) for tree in (one, other)), strict=True):
        np.testing.assert_array_equal(x, y)


def test_a_folder_that_is_moved_while_it_trains_is_resumed_there(tmp_path):
    place, elsewhere = tmp_path / "run", tmp_path / "elsewhere"
    backtest = create(place, agents={"pathwise": AGENTS["pathwise"]})
    move = lambda *_: place.exists() and place.rename(elsewhere)  # noqa: E731
    with pytest.raises(QfolioError, match="run is gone; if it was moved, resume it there"):
        backtest.run(lambda job, done, share: [Tell(move)])
    assert not place.exists()
    resumed = Backtest.open(elsewhere)
    resumed.run()
    assert resumed.policy()


def test_further_agents_are_prepared_while_the_first_trains(monkeypatch):
    """One that fails then says so when its turn comes, as the first one does."""
    prepared = []

    def prepare(job):
        prepared.append(job.name)
        raise MemoryError

    monkeypatch.setattr(FoldsJob, "prepare", prepare)
    backtest = create(prices=table(rows=160))
    backtest.run(lambda job, done, share: [Interrupt()] if done else [])
    assert prepared == [f"pathwise/{backtest.folds[0].name}"]
    assert backtest.interrupted


@pytest.mark.parametrize(
    ("t", "lag"),
    [
        (220, 1),  # within the last fold but one
        pytest.param(98, 1, marks=pytest.mark.slow),  # the first decision
        pytest.param(220, 0, marks=pytest.mark.slow),
        pytest.param(197, 2, marks=pytest.mark.slow),  # the first decision of a later fold
    ],
)
def test_no_strategy_looks_ahead(t, lag):
    """Prices after t change no weight decided up to t, through training, folds and baselines."""
    changed = table().values.copy()
    changed[t + 1 :] *= np.exp(np.random.default_rng(5).normal(0, 0.3, changed[t + 1 :].shape))
    decisions = []
    for values in (table().values, changed):
        prices = Prices(table().dates, table().assets, values)
        backtest = create(prices=prices, lag=lag)
        backtest.run()
        entries, _ = backtest.entries()
        decisions.append({name: entry.decisions for name, entry in entries.items()})
    known = t - backtest.folds[0].decisions.start + 1
    for name, before in decisions[0].items():
        after = decisions[1][name]
        np.testing.assert_array_equal(after[:, :known], before[:, :known], err_msg=name)
        if name not in (
            "equal-weight",
            "equal-weight-monthly",
            "buy-and-hold",
            "equal-weight at 0",
        ):
            assert not np.array_equal(after[:, known:], before[:, known:]), name


def test_tables_say_what_was_replayed(finished):
    entries, _ = finished.entries()
    write_tables(finished, entries, finished.assess(entries))
    lines = (finished.folder / "returns.csv").read_text().splitlines()
    assert lines[0].split(",")[:4] == ["date", "dqn/0", "dqn/1", "dqn-together"]
    assert len(lines) == 161
    assert [lines[i].partition(",")[0] for i in (1, -1)] == ["2020-04-10", "2020-09-16"]
    assert float(lines[1].split(",")[1]) == entries["dqn"].simulation.returns[0, 0]
    assert (finished.folder / "weights.csv").read_text().startswith("date,strategy,cash,A,B,'=<b>C")
    weights = (finished.folder / "weights.csv").read_text().splitlines()
    assert len(weights) - 1 == 160 * sum(e.kind != "rebalancing" for e in entries.values())
    for row, line in ((0, weights[1]), (-1, weights[160])):
        date, name, *numbers = line.split(",")
        assert (date, name) == (str(finished.dates[row])[:10], "dqn")
        held = entries["dqn"].simulation.weights.mean(0)[row]
        np.testing.assert_allclose(np.array(numbers, float), held, atol=1e-6)
    summary = json.loads((finished.folder / "summary.json").read_text())
    assert summary["strategies"]["pathwise"]["kind"] == "agent"
    assert list(summary["verdicts"]) == ["dqn", "dqn-together", "pathwise", "pathwise-together"]
    growth = summary["strategies"]["dqn"]["to_reference"]["growth"]
    assert growth["finding"] in ("better", "worse", "none")
    assert summary["rebalanced"].startswith("equal-weight")
    best = max(x["measures"]["growth"]["mean"] for n, x in summary["strategies"].items()
               if n == "equal-weight" or x["kind"] == "rebalancing")  # fmt: skip
    assert summary["strategies"][summary["rebalanced"]]["measures"]["growth"]["mean"] == best
    assert summary["bound"] > summary["strategies"]["buy-and-hold"]["measures"]["growth"]["mean"]


def test_large_tables_of_weights_have_the_last_row_of_each_day_or_month():
    hours = np.arange("2020-01-01", "2020-03-02", dtype="datetime64[h]").astype("datetime64[s]")
    most = MOST_WEIGHTS // len(hours)
    np.testing.assert_array_equal(rows_written(hours, most), np.arange(len(hours)))
    last = hours[rows_written(hours, most + 1)]
    np.testing.assert_array_equal(last, hours.reshape(-1, 24)[:, -1])
    last = hours[rows_written(hours, 24 * (most + 1))]
    assert last.astype("datetime64[h]").astype(str).tolist() == [
        "2020-01-31T23", "2020-02-29T23", "2020-03-01T23",
    ]  # fmt: skip


def test_looks_at_the_default_table_count_as_trials(finished):
    """They count on top of --trials, and docs/results/real_prices.md admits as many."""
    entries, _ = finished.entries()
    prices = dataclasses.replace(table(), source=DEFAULT_SOURCE)
    known = create(prices=prices, trials=3)
    assert known.assess(entries).earlier_trials == 3 + DEFAULT_TRIALS
    assert finished.assess(entries).earlier_trials == 0
    results = Path(__file__).parents[3] / "docs" / "results" / "real_prices.md"
    (said,) = re.findall(r"\*\*(\d+) earlier trials\*\*", results.read_text(encoding="utf-8"))
    assert int(said) == DEFAULT_TRIALS


def test_an_asset_joins_at_the_first_fold_that_it_covers():
    values = table().values.copy()
    values[:120, 1] = np.nan
    prices = Prices(table().dates, table().assets, values)
    backtest = create(prices=prices, expanding=True)
    backtest.run()
    entries, _ = backtest.entries()
    starts = [fold.recent.start for fold in backtest.folds]
    first = next(i for i, start in enumerate(starts) if start >= 120)
    day = backtest.folds[first].decisions.start - backtest.folds[0].decisions.start
    for name, entry in entries.items():
        held = entry.decisions[..., 2]
        assert np.nansum(held[:, :day]) == 0, name
    assert entries["equal-weight"].decisions[0, day, 2] == pytest.approx(1 / 3)


@pytest.mark.slow
def test_the_cap_holds():
    backtest = create(cap=0.4, agents={"pathwise": AGENTS["pathwise"]})
    backtest.run()
    for name, entry in backtest.entries()[0].items():
        assert np.nanmax(entry.decisions[..., 1:]) <= 0.4 + 1e-6, name


def test_the_policy_for_tomorrow(finished):
    policy = finished.policy("pathwise")
    latest = finished.prices.between(-30, None)
    weights = policy.weights(latest, {"A": 0.5})
    assert list(weights) == ["cash", "A", "B", "=<b>C"]
    assert sum(weights.values()) == pytest.approx(1, abs=1e-5)
    shuffled = latest.select(["=<b>C", "A", "B"])
    assert policy.weights(shuffled, {"A": 0.5}) == pytest.approx(weights, abs=1e-6)
    for holdings, message in (({"A": 1.5}, "from 0 to 1"), ({"D": 0.5}, "does not know"),
                              ({"A": 0.7, "B": 0.7}, "sum to")):  # fmt: skip
        with pytest.raises(QfolioError, match=message):
            policy.weights(latest, holdings)
    with pytest.raises(QfolioError, match="lacks 'B'"):
        policy.weights(latest.select(["A", "=<b>C"]))
    with pytest.raises(QfolioError, match="5 rows"):
        policy.weights(latest.between(0, 5))


@pytest.mark.slow
@pytest.mark.parametrize("agent", AGENTS)
def test_an_update_goes_on_learning_and_is_kept(finished, agent, tmp_path):
    """The continual learning: from the rows that came since, and as if never written to disk."""
    folder = shutil.copytree(finished.folder, tmp_path / "copy")
    newer = table(280)
    before = Backtest.open(folder).policy(agent)
    after = before.update(newer)
    Backtest.open(folder).keep(agent, after)
    kept = Backtest.open(folder).policy(agent)
    assert (before.learned, kept.learned) == (table().dates[-1], newer.dates[-1])
    with pytest.raises(QfolioError, match="give newer prices"):
        kept.update(newer)
    assert (before.updates, after.updates, kept.updates) == (0, 1, 1)
    for x, y, z in zip(*(jax.tree.leaves(p.members) for p in (before, after, kept)), strict=True):
        assert not np.array_equal(x, y)
        np.testing.assert_array_equal(y, z)
    again = before.update(newer)
    for x, y in zip(*(jax.tree.leaves(p.members) for p in (again, after)), strict=True):
        np.testing.assert_array_equal(x, y)


def test_episodes_are_shorter_where_a_fold_is_short(tmp_path):
    quick = {"blocks": 4, "num_envs": 2, "network": "linear"}
    given = preset("fast", "portfolio", "tilts")
    agents = {
        "tilts": given._replace(
            settings=quick, episodes=8, task={**given.task, "signals": "momentum:5"}
        ),
        "pathwise": AGENTS["pathwise"],
    }
    run = create(tmp_path / "run", train="60d", test="100d", agents=agents, seeds=1)
    for backtest in (run, Backtest.open(tmp_path / "run")):
        assert {name: task.horizon for name, task in backtest.tasks.items()} == {
            "tilts": 42,
            "pathwise": 20,
        }
        assert backtest.config.agents["tilts"].settings["rollout_length"] == 42
    run.run()
    said = [note for note in Backtest.open(tmp_path / "run").entries()[1] if "episodes" in note]
    assert said == [
        "tilts learns from episodes of 42 rows instead of 84, because a fold trains on 59 rows "
        "only."
    ]
    longer = create(train="100d", test="100d", agents=agents)
    assert not any(entry.shortened for entry in longer.config.agents.values())


def test_a_signal_that_no_training_row_has_is_named():
    agents = changed("pathwise", signals="momentum:5,momentum:150")
    run = create(train="100d", test="100d", agents=agents, seeds=1)
    assert notes.unknown(run.config.agents, run.replay) == [
        "momentum:150 looks back on more rows than 1 of 2 folds has for training; there it is "
        "unknown and counts as 0."
    ]


def test_an_agent_that_names_its_preset_can_be_opened(tmp_path):
    create(tmp_path / "run", agents={"pathwise:fast": AGENTS["pathwise"]})
    assert list(Backtest.open(tmp_path / "run").agents) == ["pathwise:fast"]


def test_the_note_on_ruin_counts_seeds():
    def entry(*returns):
        table = np.array(returns)[:, None] * np.ones((1, 3))
        return Entry("agent", table, Simulation(table, table, table, table[..., None]))

    found = notes.wiped_out({"a": entry(-1, 0.1, -1), "b": entry(-1), "c": entry(0.1, -0.9)})
    assert found == [
        "a was wiped out with 2 of 3 seeds: it lost everything.",
        "b was wiped out: it lost everything.",
    ]


def test_a_wrong_baseline_of_ones_own_is_found_before_the_training(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "half.py").write_text(
        "import numpy as np\n"
        "from qfolio.portfolio.backtest.baselines import Baseline\n"
        "class Half(Baseline):\n"
        "    def decide(self, history, held):\n"
        "        return np.eye(len(held))[1] / 2\n"
    )
    find("baseline", "half:Half")
    with pytest.raises(QfolioError, match=r"Half at .* gives weights that sum to 0\.5"):
        create(tmp_path / "run", baselines=("half:Half",))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"train": "300d"}, "nothing to test"), ({"test": "1 year"}, "like 5y"),
        ({"train": "259d"}, "260 rows, .*, leave 1 row to test after train=259d, fewer than 5;"),
        ({"train": "256d"}, "leave 4 rows to test after train=256d, fewer than 5; shorten it"),
        ({"train": "25d"}, "dqn, fold .*: 24 rows are too few: .* of 20 need at least 32"),
        ({"train": "10d"}, r"rows are too few: .* or lower window \(--set window=…\)"),
        ({"cost": 0.5}, "cost is 0.5"),
        ({"trials": -1}, "trials is -1; it must be from 0"),
        ({"lag": -1}, "lag is -1"), ({"agents": {}}, "at least one agent"),
        ({"cap": 1.5}, "The cap is 1.5; it must be above 0"), ({"cap": np.nan}, "The cap is nan"),
        ({"baselines": "momentum"}, "baselines is 'momentum'; it must be a list"),
        ({"baselines": ("momentum", "m:momentum")}, "Two baselines are called momentum; rename"),
        ({"agents": changed("dqn", menu="nonsense")}, "menu is 'nonsense'; it must be like"),
        ({"agents": changed("pathwise", horizon=13)}, "^pathwise: rollout_length .* divide the 13"),
        ({"episodes": 3}, "are for agents without a preset; change those of a preset with"),
        ({"agents": {"../dqn": AGENTS["dqn"]}}, "called '../dqn'; use letters, digits, - and _"),
        ({"agents": {"-dqn": AGENTS["dqn"]}}, "called '-dqn'; .* no - at the start"),
        ({"agents": {"dqn:a": AGENTS["dqn"], "dqn-a": AGENTS["dqn"]}}, "would share a folder"),
        ({"agents": {"x": AGENTS["dqn"], "x-together": AGENTS["dqn"]}}, "all seeds of x hold tog"),
    ],
)  # fmt: skip
def test_backtests_that_cannot_be(settings, message, tmp_path):
    with pytest.raises(QfolioError, match=message):
        create(tmp_path / "run", **settings)
    assert not (tmp_path / "run").exists()


def test_names_beyond_ascii_are_read_whatever_the_locale(tmp_path):
    folder = BacktestFolder(tmp_path)
    folder.write_returns(["2024-01-02"], {"Börse": np.array([0.01])})
    code = (
        "import sys; from pathlib import Path\n"
        "from qfolio.portfolio.backtest.folder import BacktestFolder\n"
        "print(ascii(list(BacktestFolder(Path(sys.argv[1])).read_returns()[1])))"
    )
    plain = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], env=plain, capture_output=True, text=True
    )
    assert done.stdout.strip() == r"['B\xf6rse']", done.stderr


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("config.json", "{}", "in another format"),
        ("config.json", '{"kind": "backtest", "format": 1}', "in another format"),
        ("config.json", '{"kind": "comparison", "format": 2}', "is a comparison, not a backtest"),
        ("prices.safetensors", "", "prices.safetensors is damaged or not a safetensors file"),
        ("config.json", None, "config.json is damaged"),
    ],
)
def test_damaged_folders(finished, tmp_path, name, content, message):
    folder = shutil.copytree(finished.folder, tmp_path / "copy")
    if content is None:  # a name that would lead out of the folder
        config = json.loads((folder / name).read_text())
        config["agents"] = {"../../elsewhere": config["agents"]["dqn"]}
        content = json.dumps(config)
    (folder / name).write_text(content)
    with pytest.raises(QfolioError, match=message):
        Backtest.open(folder)


def test_the_table_of_another_backtest_is_refused(finished, tmp_path):
    folder = shutil.copytree(finished.folder, tmp_path / "copy")
    BacktestFolder(folder).write_prices(table(seed=1))
    with pytest.raises(QfolioError, match=r"does not belong to config\.json"):
        Backtest.open(folder)


def test_returns_have_what_cash_earned(tmp_path):
    agents = {"pathwise": AGENTS["pathwise"]}
    backtest = create(tmp_path / "run", agents=agents, cost_model="itemized(cash_rate=0.05)")
    backtest.run()
    entries, _ = backtest.entries()
    assessed = backtest.assess(entries)
    write_tables(backtest, entries, assessed)
    _, columns = BacktestFolder(tmp_path / "run").read_returns()
    np.testing.assert_allclose(columns["risk_free"], np.expm1(0.05 / 365), rtol=1e-9)
    returns = entries["equal-weight"].simulation.returns[0] - columns["risk_free"]
    sharpe = assessed.strategies["equal-weight"].measures["sharpe"].mean
    year = backtest.prices.periods_per_year
    assert sharpe == pytest.approx(year**0.5 * returns.mean() / returns.std(ddof=1))
