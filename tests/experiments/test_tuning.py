"""Searches so small that they take seconds; what they find does not matter, how they go does."""

import dataclasses
import json
import math
import os
import signal
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.agents.dqn import DQN
from qfolio.agents.pathwise import Pathwise
from qfolio.agents.sac import SAC
from qfolio.commands.console.tuning import describe_search
from qfolio.core import settings
from qfolio.core.errors import QfolioError
from qfolio.core.evaluation import start_keys
from qfolio.core.fields import constant, require
from qfolio.core.population import Population
from qfolio.experiments.budget import Budget
from qfolio.experiments.events import EVENTS, read
from qfolio.experiments.executor import Here
from qfolio.experiments.presets import preset
from qfolio.experiments.run import Run
from qfolio.experiments.tuning import search
from qfolio.experiments.tuning.journal import Trial, best_of
from qfolio.experiments.tuning.run import Progress, Tuning, tuning_keys
from qfolio.experiments.tuning.search import dimension, positions
from qfolio.experiments.tuning.sensitivity import (
    ENOUGH,
    Effect,
    Outcome,
    Sensitivity,
    sensitivity,
    short,
    verdicts,
)
from qfolio.experiments.tuning.trials import trials_jobs
from qfolio.report.figures.tuning import draw_progress
from qfolio.report.sweep import Sweep
from qfolio.report.tuning import render_page, write_tuning_report
from qfolio.tasks.catch import Catch

from jobs import Elsewhere
from populations import assert_same, train_to
from shell import TINY, qfolio

EPISODES = 4
BOOM = 1e30  # a learning rate with which weights overflow at once


def start(folder, task, agent, *ranges, trials=4, batch=2, seeds=2):
    space = search.parse(ranges or ["learning_rate=1e-4..1e-2", "discount=0.9..0.99"], type(agent))
    return Tuning.create(
        task, agent, space, trials=trials, seeds=seeds, budget=Budget(EPISODES), batch=batch,
        fresh_seeds=2, preset="fast", out=folder,
    )  # fmt: skip


def ask(work):
    own = {dim.name: search.own_value(work.agent, dim) for dim in work.space}
    return work.journal.ask(work.config.batch, work.config.trials, own)


def trained(task, agents, seeds, steps=60):
    return train_to(Population(task, agents, seeds), steps, strict=False)


# The population


def test_members_with_numbers_of_their_own_equal_each_alone(task, agent):
    changes = [{"learning_rate": 1e-2, "input_gain": 2.0}, {"discount": 0.5, "huber_delta": 0.3}]
    first, second = (settings.build(DQN, settings.describe(agent) | change) for change in changes)
    together = trained(task, [first, second, first, second], [0, 0, 1, 1])
    greedy = together.evaluate(tuning_keys(), tail=0)
    for index, one in enumerate((first, second)):
        alone = trained(task, one, [0, 1])
        pick = lambda x, i=index: x[i::2]  # noqa: E731
        assert_same(alone.fetch(), jax.tree.map(pick, together.fetch()))
        # The overestimation depends on the member's own discount.
        assert_same(alone.evaluate(tuning_keys(), tail=0), jax.tree.map(pick, greedy))


def test_the_tail_is_that_of_the_longest_discount(task, agent):
    far = settings.build(DQN, settings.describe(agent) | {"discount": 0.9})
    near = settings.build(DQN, settings.describe(agent) | {"discount": 0.5})
    for agents in ([near, far], [far, near]):
        assert Population(task, agents, [0, 0])._tail == 44  # 0.9^44 < 1% < 0.9^43


def test_agents_of_other_programs_are_refused(task, agent):
    other = settings.build(DQN, settings.describe(agent) | {"hidden": (8,)})
    with pytest.raises(QfolioError, match="must share all settings that shape the program"):
        Population(task, [agent, other], [0, 0])


def test_a_diverging_member_leaves_the_others_alone(task, agent):
    wild = settings.build(DQN, settings.describe(agent) | {"learning_rate": BOOM})
    together = trained(task, [agent, wild, agent, wild], [0, 0, 1, 1])
    assert together.healthy == [True, False, True, False]
    alone = trained(task, agent, [0, 1])
    assert_same(alone.fetch(), jax.tree.map(lambda x: x[::2], together.fetch()))
    with pytest.raises(QfolioError, match="no longer finite"):
        together.advance(10)


# The space


@pytest.mark.parametrize(
    ("name", "text", "scale"),
    [
        ("learning_rate", "1e-4..1e-2", "log"),
        ("learning_rate", "1e-3..2e-3", "linear"),
        ("learning_rate", "linear:1e-4..1e-2", "linear"),
        ("learning_rate", "log:1e-3..2e-3", "log"),
        ("learning_rate", "1.23446e-4..1.23456e-2", "log"),  # of which four digits are outside
        ("discount", "0.9..0.99", "near-one"),
        ("discount", "0.9..0.95", "linear"),
        ("discount", "0.001..1", "log"),
        ("learning_rate_final", "0..1", "linear"),
        ("hidden", "8|8,8", "choice"),
        ("discount", "0.9|0.99", "choice"),
        ("double", "true|false", "choice"),
    ],
)
def test_scales_and_texts(name, text, scale):
    dim = dimension(name, text, DQN)
    assert dim.scale == scale
    assert dimension(name, str(dim), DQN) == dim
    ends = dim.choices or (dim.low, dim.high)
    for value in ends:
        assert dim.value(dim.stored(value)) == value
        assert dim.covers(value)
        assert 0 <= dim.position(value) <= 1
    if not dim.choices:
        assert (dim.position(dim.low), dim.position(dim.high)) == pytest.approx((0, 1), abs=1e-9)
        for place in (0.1, 0.5, 0.8):
            assert dim.position(dim.at(place)) == pytest.approx(place, abs=1e-6)


def test_positions_by_hand():
    assert dimension("learning_rate", "1e-4..1e-2", DQN).position(1e-3) == pytest.approx(0.5)
    assert dimension("discount", "0.9..0.999", DQN).position(0.99) == pytest.approx(0.5)
    assert dimension("discount", "0.9..0.999", DQN).at(0.5) == pytest.approx(0.99)
    assert dimension("hidden", "8|16", DQN).position("16") == 0.75
    space = [dimension("discount", "0.9..0.99", DQN)]
    for outside, place in ((0.8, 0), (0.999, 1)):
        np.testing.assert_array_equal(positions(space, {"discount": outside}), [place])


def test_what_is_usually_searched_surrounds_the_agents_own_values():
    agent = preset("fast").build()
    space = {dim.name: dim for dim in search.usual(agent)}
    assert set(space) >= {"learning_rate", "discount", "tau", "epsilon_decay", "huber_delta",
                          "reward_scale", "input_gain"}  # fmt: skip
    for name, dim in space.items():
        assert dim.position(getattr(agent, name)) == pytest.approx(0.5, abs=1e-6)
    assert (space["learning_rate"].low, space["learning_rate"].high) == (3e-4, 3e-2)
    assert (space["discount"].low, space["discount"].high) == (0.95, 0.9995)
    # Where the own value says nothing of the scale: infinite, 0, or already 1.
    report = {dim.name: dim for dim in search.usual(DQN())}
    for name in ("huber_delta", "input_gain"):
        assert report[name] == dimension(name, search.USUAL[name], DQN)
    assert str(report["tau"]) == "0.1..1.0"
    half = report["discount"].around(0.5)  # 10 times what is missing would be more than all
    assert (half.low, half.high) == (0.001, 0.95)
    assert {dim.name for dim in search.usual(Pathwise())} == {
        "learning_rate", "max_grad_norm", "reward_scale"
    }  # fmt: skip


@pytest.mark.parametrize(
    ("ranges", "says"),
    [
        (["learning_rate"], "takes name=low..high"),
        (["learning_rat=1..2"], "did you mean learning_rate"),
        (["learning_rate=1e-2..1e-4"], "the first number must be below the second"),
        (["learning_rate=a..b"], "must be a number"),
        (["learning_rate=0..inf"], "both finite"),
        (["learning_rate=log:0..1"], "must be above 0"),
        (["discount=near-one:0.9..1"], "must be below 1"),
        (["discount=cubic:0.9..1"], "no scale 'cubic'"),
        (["discount=0.9"], "leaves nothing to search"),
        (["discount=0.9-0.99"], r"give a range \(low..high\)"),
        (["discount=0.9|0.90"], "different choices"),
        (["hidden=8|x"], "whole numbers"),
        (["batch_size=32..64"], r"list the values: batch_size=32\|64"),
        (["discount=0.9..0.99", "discount=0.8..0.9"], "names discount twice"),
    ],
)
def test_wrong_ranges(ranges, says):
    with pytest.raises(QfolioError, match=says):
        search.parse(ranges, DQN)


@pytest.mark.parametrize(
    ("ranges", "says"),
    [
        (["discount=0.5..1.5"], "discount is 1.5"),
        (["learning_starts=20|500"], "learning_starts \\(500\\)"),
        (["hidden=1|2|3|4|5|6|7|8|9", "batch_size=1|2|3|4|5|6|7|8"], "72 programs"),
    ],
)
def test_spaces_that_hold_no_agent_leave_no_folder(ranges, says, tmp_path, task, agent):
    with pytest.raises(QfolioError, match=says):
        start(tmp_path / "s", task, agent, *ranges)
    assert not list(tmp_path.iterdir())


def test_as_many_programs_as_may_be_are_made(task, agent):
    eight = "1|2|3|4|5|6|7|8"
    space = search.parse([f"hidden={eight}", f"batch_size={eight}"], DQN)
    agents = search.require_buildable(agent, task, space)
    assert len({str(settings.describe(one)) for one in agents}) == search.PROGRAMS == 64


# The search


def test_tuning_never_sees_the_graded_starts():
    graded, tuned = (jax.random.key_data(keys) for keys in (start_keys(), tuning_keys()))
    assert not {tuple(k) for k in graded.tolist()} & {tuple(k) for k in tuned.tolist()}


def test_a_search_goes_on_where_it_was_left(tmp_path, task, agent):
    folder = tmp_path / "s"
    progress: list[Progress] = []
    start(folder, task, agent).run(progress.append)
    assert [(p.done, p.trials) for p in progress] == [(2, 2), (4, 2)]
    again = Tuning.open(folder, trials=7, batch=2)
    again.run()
    trials = again.journal.trials()
    assert [trial.number for trial in trials] == list(range(7))
    assert len({json.dumps(trial.values) for trial in trials}) == 7
    # Half of four trials, and of seven, are drawn at random; the first is the preset.
    assert [trial.number for trial in trials if trial.at_random] == [1]
    own = [trial for trial in trials if trial.is_preset]
    assert [trial.number for trial in own] == [0]
    assert own[0].values == {"learning_rate": agent.learning_rate, "discount": agent.discount}
    # What it says of a trial is what training that configuration by itself gives.
    last = trials[-1]
    alone = again.trained({"last": again.configured(last.values)}, range(2), tuning_keys())
    np.testing.assert_array_equal(alone[0], last.returns)
    # Everything on disk is text: nothing of it is ever unpickled.
    for line in (folder / "journal.log").read_text().splitlines():
        json.loads(line)
    assert not list((folder / "processes").iterdir())


def test_a_configuration_does_in_a_search_what_it_does_in_a_run(tmp_path, task, agent):
    work = start(tmp_path / "s", task, agent)
    found = work.trained({"mine": agent}, [7, 8], start_keys())
    run = Run.create(task, agent, episodes=EPISODES, seeds=2, seed=7)
    run.train()
    np.testing.assert_array_equal(found[0], run.grade()["return_per_seed"])


def test_the_same_search_again_is_the_same(tmp_path, task, agent):
    first, second = (start(tmp_path / name, task, agent) for name in "ab")
    for work in (first, second):
        work.run()
    strip = lambda work: [trial[:4] for trial in work.journal.trials()]  # noqa: E731
    assert strip(first) == strip(second)


@pytest.mark.slow
def test_configurations_of_several_programs(tmp_path, task, agent):
    ranges = ["hidden=16|8", "learning_rate=1e-4..5e-4"]
    work = start(tmp_path / "s", task, agent, *ranges, trials=6, batch=1)
    shared = [{"hidden": size, "learning_rate": 2e-4} for size in ("16", "8")]
    named = {str(v): work.configured(v) for v in shared}
    together = work.trained(named, range(2), tuning_keys())
    for values, row in zip(shared, together, strict=True):
        alone = work.trained({"one": work.configured(values)}, range(2), tuning_keys())
        np.testing.assert_array_equal(alone[0], row)
    assert not np.array_equal(*together)
    work.run()
    trials = work.journal.trials()
    assert {trial.values["hidden"] for trial in trials} == {"16", "8"}
    assert not any(trial.is_preset for trial in trials)  # its learning rate is outside


def test_diverged_trials_are_pruned_and_never_best(tmp_path, task, agent):
    work = start(tmp_path / "s", task, agent, f"learning_rate=0.001|{BOOM}", trials=6)
    progress: list[Progress] = []
    work.run(progress.append)
    lost = [trial for trial in work.journal.trials() if trial.values["learning_rate"] != "0.001"]
    assert 0 < len(lost) < 6
    assert all(trial.returns == (None, None) and math.isnan(trial.value) for trial in lost)
    assert progress[-1].diverged == len(lost)
    best = best_of(work.journal.trials())
    assert best is not None
    assert best.values == {"learning_rate": "0.001"}


def test_the_log_tells_fresh_seeds_from_those_of_the_search(tmp_path, task, agent):
    """The board named the best of many trials' returns as if it were a result."""
    work = start(tmp_path / "s", task, agent)
    work.run()
    trials = work.journal.trials()
    best, preset = best_of(trials), next(trial for trial in trials if trial.is_preset)
    assert best is not None
    tried = {"best": best.value, "preset": preset.value}

    def logged() -> list[Any]:
        events, _ = read(tmp_path / "s" / EVENTS)
        return [event["values"] for event in events if event["event"] == "result"]

    assert logged()[-1] == {name: {"return_in_search": value} for name, value in tried.items()}
    summary = work.conclude()
    fresh = {"best": summary["return_per_seed"], "preset": summary["preset_return_per_seed"]}
    assert logged()[-1] == {
        name: {"return": pytest.approx(np.mean(fresh[name])), "return_in_search": value}
        for name, value in tried.items()
    }
    count = len(logged())
    assert work.conclude() == summary
    assert len(logged()) == count


def test_a_preset_outside_the_ranges_is_no_trial_and_that_is_said(tmp_path, task, agent):
    assert len(describe_search(start(tmp_path / "in", task, agent))) == 3
    endless = dataclasses.replace(agent, huber_delta=math.inf)
    out = start(tmp_path / "out", task, endless, "huber_delta=0.1..10")
    assert describe_search(out)[-1] == (
        "The preset is no trial, because it has huber_delta=inf, which is outside 0.1..10.0; it is "
        "graded at the end."
    )
    out.run()
    assert not any(trial.is_preset for trial in out.journal.trials())


def test_a_search_where_all_diverge_says_so(tmp_path, task, agent):
    work = start(tmp_path / "s", task, agent, f"learning_rate=1e29|{BOOM}", trials=2)
    work.run()
    with pytest.raises(QfolioError, match="None of the 2 configurations kept a finite loss"):
        work.conclude()


class Ordered(DQN):
    """Explores less at the end than at the start."""

    def __check_init__(self):
        require(self, "epsilon_end", lambda x: x <= self.epsilon_start, "at most epsilon_start")


def test_settings_that_the_agent_refuses_together_do_not_end_a_search(tmp_path, task, agent):
    ranges = ["epsilon_start=0.2|0.8", "epsilon_end=0.1|0.5"]
    ordered = settings.build(Ordered, settings.describe(agent) | {"epsilon_end": 0.1})
    work = start(tmp_path / "s", task, ordered, *ranges, trials=6, batch=1)
    work.run()
    trials = work.journal.trials()
    refused = [
        trial for trial in trials if trial.values == {"epsilon_start": "0.2", "epsilon_end": "0.5"}
    ]
    assert len(trials) == 6
    assert refused == [trial for trial in trials if math.isnan(trial.value)] != []


def test_a_budget_in_which_nothing_is_learned_is_refused(tmp_path, task, agent):
    """Four episodes of 25 steps; of two values, one may be too large."""
    agent = dataclasses.replace(agent, learning_starts=102)
    says = "^The agent learns nothing: it begins after 100 environment steps, and a seed has 100. "
    with pytest.raises(QfolioError, match=says):
        start(tmp_path / "s", task, agent)
    start(tmp_path / "s", task, agent, "learning_starts=100|102")


class Weighted(DQN):
    """Holds what is no setting."""

    weights_of: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(2))


def test_what_settings_do_not_describe_is_refused_before_a_folder_is_made(tmp_path, task, agent):
    """It was made, and could not be opened."""
    odd = Weighted(**settings.describe(agent), weights_of=np.ones(2))
    with pytest.raises(QfolioError, match=r"^A search takes only what .*, but weights_of of "):
        start(tmp_path / "s", task, odd)
    assert not any(tmp_path.iterdir())


def test_numbers_that_do_not_fit_the_task(tmp_path):
    agent, says = (
        SAC(hidden=(4,), learning_starts=8, batch_size=8),
        r"spread is 2\.0; it must be below 1",
    )
    with pytest.raises(QfolioError, match=says):
        start(tmp_path / "s", Catch(), agent, "spread=0.1..2")
    work = start(tmp_path / "s", Catch(), agent, "spread=0.1..0.9")
    with pytest.raises(QfolioError, match=says):
        work.configured({"spread": 2.0})


class Unpaid(Catch):
    """Its rewards are no numbers."""

    def step(self, state, action, key):
        return super().step(state, action, key)._replace(reward=jnp.array(jnp.nan))


def test_a_search_where_the_task_is_at_fault_says_so(tmp_path, agent):
    work = start(tmp_path / "s", Unpaid(), agent, trials=1, batch=1, seeds=1)
    work.run()
    with pytest.raises(QfolioError, match="The reward of Unpaid is not finite at step 1"):
        work.conclude()


def test_trials_of_a_killed_process_are_tried_anew(tmp_path, task, agent):
    folder = tmp_path / "s"
    dead = start(folder, task, agent)
    assert len(ask(dead)) == 2  # and then it was killed: nothing holds its file locked
    again = Tuning.open(folder)
    again.run()
    assert [trial.number for trial in again.journal.trials()] == [2, 3, 4, 5]
    assert sum(trial.is_preset for trial in again.journal.trials()) == 1
    assert again.journal.in_hand() == 0


def proposals(work):
    """What was tried, in the order in which it was asked for."""
    return [(trial.values, trial.is_preset, trial.at_random) for trial in work.journal.trials()]


@pytest.fixture
def quick(monkeypatch):
    """Nothing is trained, and a learning rate of 10⁻³ is best: the seeds that were asked for."""
    asked = list[list[int]]()

    def train(work, agents, seeds, *rest, **options):
        asked.append(list(seeds))
        near = [-abs(math.log10(one.learning_rate) + 3) for one in agents.values()]
        return np.repeat(np.array(near)[:, None], len(seeds), 1)

    monkeypatch.setattr(Tuning, "trained", train)
    return asked


@pytest.mark.parametrize("killed", [[0], [1, 4], [5]])
def test_a_killed_search_proposes_what_an_unbroken_one_does(killed, tmp_path, task, agent, quick):
    """killed: batches that the process does not live to finish. Half of 18 trials are random."""
    unbroken = start(tmp_path / "unbroken", task, agent, trials=18, batch=3, seeds=1)
    unbroken.run()
    work = start(tmp_path / "broken", task, agent, trials=18, batch=3, seeds=1)
    for batch in range(6):
        asked = ask(work)
        if batch in killed:
            work = Tuning.open(tmp_path / "broken")
            asked = ask(work)
        work._train(asked)
    assert proposals(work) == proposals(unbroken)
    assert len({str(values) for values, *_ in proposals(work)}) == 18


def test_only_the_second_half_of_the_trials_follows_from_results(
    tmp_path, task, agent, monkeypatch
):
    found = []
    for sign in (1, -1):

        def train(work, agents, *rest, sign=sign):
            return np.array([[sign * one.learning_rate] for one in agents.values()])

        monkeypatch.setattr(Tuning, "trained", train)
        work = start(tmp_path / str(sign), task, agent, trials=18, batch=3, seeds=1)
        work.run()
        found.append([values for values, *_ in proposals(work)])
    assert found[0][:9] == found[1][:9]
    assert found[0][9:] != found[1][9:]


def test_what_is_tried_and_what_is_graded_have_seeds_and_starts_of_their_own(
    tmp_path, task, agent, quick, monkeypatch
):
    count = "qfolio.experiments.tuning.run.optimal_returns"
    monkeypatch.setattr(count, lambda task, keys: np.array([len(keys)]))
    work = start(tmp_path / "s", task, agent, trials=2)
    work.run()
    summary = work.conclude()
    assert quick == [[0, 1], [1000, 1001]]
    assert summary["seeds"] == [1000, 1001]
    assert (summary["optimum"], summary["optimum_tuned_on"]) == (1024, 256)


def test_the_time_of_a_batch_is_shared_by_its_trials(tmp_path, task, agent, quick, monkeypatch):
    monkeypatch.setattr("qfolio.experiments.tuning.run.perf_counter", iter([1.0, 7.0]).__next__)
    work = start(tmp_path / "s", task, agent)
    work._train(ask(work))
    assert [trial.seconds for trial in work.journal.trials()] == [3, 3]


def test_a_new_number_of_trials_is_for_all_and_a_batch_for_this_process(tmp_path, task, agent):
    folder = tmp_path / "s"
    start(folder, task, agent)
    here = Tuning.open(folder, trials=7, batch=3).config
    others = Tuning.open(folder).config
    assert (here.trials, here.batch) == (7, 3)
    assert (others.trials, others.batch) == (7, 2)


def test_the_first_two_trials_are_not_chosen_by_the_sampler(tmp_path, task, agent, quick):
    work = start(tmp_path / "s", task, agent, trials=2, batch=1)
    work.run()
    assert [at_random for _, _, at_random in proposals(work)] == [False, True]


def test_processes_share_a_search(tmp_path, task, agent):
    folder = tmp_path / "s"
    other = start(folder, task, agent)
    with other.journal.at_work():
        asked = ask(other)
        mine = Tuning.open(folder)
        mine.run()
        assert (len(mine.journal.trials()), mine.journal.in_hand()) == (2, 2)
        other._train(asked)
        assert (len(mine.journal.trials()), mine.journal.in_hand()) == (4, 0)
        assert not ask(mine)


def test_on_workers_a_search_is_the_same(tmp_path, task, agent):
    """A configuration is a job there; what is proposed next follows from all of a batch."""
    here, there = (start(tmp_path / name, task, agent) for name in ("here", "there"))
    here.run()
    elsewhere, shares = Elsewhere(), list[float]()
    there.run(chunk_listener=shares.append, executor=elsewhere)
    assert elsewhere.ran == [f"trial {number}" for number in range(1, 5)]  # as in the report
    assert shares.count(1.0) == 2
    timeless = [[trial._replace(seconds=0.0) for trial in work.journal.trials()]
                for work in (here, there)]  # fmt: skip
    assert timeless[0] == timeless[1]
    assert here.conclude() == there.conclude(executor=elsewhere)
    assert elsewhere.ran[4:] == ["best", "preset"]


def test_a_search_that_is_stopped_on_workers(tmp_path, task, agent):
    work = start(tmp_path / "s", task, agent)

    def press(share):
        os.kill(os.getpid(), signal.SIGINT)

    work.run(chunk_listener=press, executor=Elsewhere())
    assert work.interrupted
    assert (work.journal.trials(), work.journal.in_hand()) == ([], 0)


def test_jobs_fill_a_worker(tmp_path, task, agent):
    agents = {f"{i}": agent for i in range(5)}
    agents["other"] = settings.build(DQN, settings.describe(agent) | {"hidden": (8,)})
    executor, starts = Elsewhere(), np.zeros((4, 2), np.uint32)
    executor.devices = 4
    made = trials_jobs(task, agents, [0, 1], Budget(4), starts, executor)
    assert [job.name for job in made] == ["0 and 1", "2 and 3", "4", "other"]
    assert [job.most for job in made] == [2, 2, 2, 1]
    whole = trials_jobs(task, agents, [0, 1], Budget(4), starts, Here())
    assert [job.name for job in whole] == ["0 to 4", "other"]


def test_an_error_gives_the_batch_back(tmp_path, task, agent, monkeypatch):
    work = start(tmp_path / "s", task, agent)

    def fail(*args, **kwargs):
        raise MemoryError

    monkeypatch.setattr(Tuning, "trained", fail)
    with pytest.raises(MemoryError):
        work.run()
    assert (work.journal.trials(), work.journal.in_hand()) == ([], 0)
    assert not list((work.folder / "processes").iterdir())


@pytest.mark.parametrize(("share", "known"), [(1.0, 2), (0.0, 0)])
def test_ctrl_c_stops_after_the_chunk(share, known, tmp_path, task, agent):
    """A batch that is finished by then counts; one that is not is tried again."""
    work = start(tmp_path / "s", task, agent)

    def press(now):
        if now >= share:
            os.kill(os.getpid(), signal.SIGINT)

    work.run(chunk_listener=press)
    assert work.interrupted
    assert (len(work.journal.trials()), work.journal.in_hand()) == (known, 0)


def test_a_line_that_a_crash_cut_short(tmp_path, task, agent):
    folder = tmp_path / "s"
    start(folder, task, agent).run()
    journal = folder / "journal.log"
    whole = journal.read_bytes()
    journal.write_bytes(whole + b'{"op_code":4,"wor')
    assert len(Tuning.open(folder).journal.trials()) == 4
    for line in journal.read_text().splitlines():
        json.loads(line)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("journal.log", '{"op_code": 99}\n{}\n', "journal.log is damaged"),
        ("journal.log", "nonsense\nmore\n", "journal.log is damaged"),
        ("study.json", '{"format": 7}', "in another format"),
        ("study.json", '{"kind": "search", "format": 2}', "study.json is damaged .task is missing"),
    ],
)
def test_damaged_folders(name, content, says, tmp_path, task, agent):
    folder = tmp_path / "s"
    start(folder, task, agent)
    (folder / name).write_text(content)
    with pytest.raises(QfolioError, match=says):
        Tuning.open(folder)


# What a search says


def made_up(count=80, seed=0):
    """Trials in which the learning rate is everything, best at 10⁻³, and the discount nothing."""
    draw = np.random.default_rng(seed)
    space = [
        dimension("discount", "0.9..0.999", DQN),
        dimension("learning_rate", "1e-4..1e-2", DQN),
        dimension("hidden", "8|16", DQN),
    ]
    trials = []
    for number in range(count):
        place = draw.uniform(size=2)
        values = {
            "discount": space[0].at(place[0]),
            "learning_rate": space[1].at(place[1]),
            "hidden": ("8", "16")[number % 2],
        }
        regret = 0.02 * 10 ** (4 * abs(place[1] - 0.5)) * (1 + 0.05 * draw.normal())
        returns = (-100 * (1 + regret),) * 2
        trials.append(Trial(number, values, returns, number == 3, number < 40, 1.0))
    return space, trials


def test_sensitivity_finds_what_matters():
    space, trials = made_up()
    found = sensitivity(space, trials, optimum=-100.0)
    assert found is not None
    effects = {effect.dimension.name: effect for effect in found.effects}
    assert found.effects[0].dimension.name == "learning_rate"
    assert effects["learning_rate"].share > 0.8
    assert max(effects["discount"].share, effects["hidden"].share) < 0.05
    assert found.explained > 0.8
    # 0.02 · 10^(4 |p − 1/2|) ≤ 0.02 + 0.05 where |p − 1/2| ≤ log10(3.5)/4 = 0.136.
    low, high = effects["learning_rate"].range
    assert (low, high) == pytest.approx((0.364, 0.636), abs=0.05)
    assert effects["discount"].width == 1
    assert effects["hidden"].robust.all()
    text = " ".join(verdicts(found, trials))
    best = best_of(trials)
    assert best is not None
    good = sum(-trial.value <= 107 + (-best.value - 102) for trial in trials[:40])
    assert f"Of 40 configurations drawn at random, {good} lost no more than 5 points" in text
    assert "What matters most: learning_rate" in text
    assert "hidden hardly matter" in text or "hidden and discount hardly matter" in text
    assert "The narrowest is learning_rate" in text
    factor = float(text.partition("is robust, a factor of ")[2].rstrip("."))
    assert factor == pytest.approx(100 ** (high - low), rel=0.05)


def test_sensitivity_admits_what_it_does_not_know():
    space, trials = made_up(ENOUGH - 1)
    assert sensitivity(space, trials, -100.0) is None
    assert "trials with a finite loss are needed" in verdicts(None, trials)[0]
    alike = [trial._replace(returns=(1.0, 1.0)) for trial in made_up(20)[1]]
    assert sensitivity(space, alike, None) is None
    assert verdicts(None, alike) == [
        "All trials ended alike: within the searched ranges no setting matters."
    ]
    space, trials = made_up(30)
    draw = np.random.default_rng(1)
    noise = [trial._replace(returns=(float(draw.normal()),)) for trial in trials]
    assert "do not tell what matters" in verdicts(sensitivity(space, noise, None), noise)[0]
    flat = [trial._replace(returns=(-1.0,)) for trial in trials]
    assert sensitivity(space, flat, None) is None


def test_outcomes():
    known = Outcome.of([-200.0, -110.0, math.nan], optimum=-100.0)
    heights = known.height([-200.0, -110.0, math.nan, -101.0])
    failed = 1.1  # worse than the worst by more than what is tolerated
    np.testing.assert_allclose(heights, [0.0, 1.0, -np.log10(failed), 2.0], atol=1e-12)
    np.testing.assert_allclose(known.loss(heights), [1.0, 0.1, failed, 0.01])
    np.testing.assert_allclose(known.height([-100.0, -99.0]), 4)  # as near as 0.01%
    assert Outcome.of([-1.0, 0.0], optimum=0.0).optimum is None  # it has no shares
    unknown = Outcome.of([1.0, 2.0, 3.0, -1e9], optimum=None)
    assert unknown.floor == 3 - 3 * 1.5
    np.testing.assert_allclose(unknown.height([2.0, math.nan, -1e9]), [2.0, -1.8, -1.5])


def test_the_effect_of_a_setting_is_that_where_the_others_are_right():
    """A small network loses all, whatever the discount."""
    space, trials = made_up(60)
    places = np.array([positions(space, trial.values) for trial in trials])
    regrets = np.where(places[:, 2] < 0.5, 1.0, 0.01 * 10 ** (1.5 * places[:, 0]))
    trials = [
        trial._replace(returns=(-100.0 * (1 + regret),))
        for trial, regret in zip(trials, regrets.tolist(), strict=True)
    ]
    found = sensitivity(space, trials, -100.0)
    assert found is not None
    (effect,) = (each for each in found.effects if each.dimension is space[0])
    assert effect.range[0] == 0
    assert effect.range[1] < 0.7


@pytest.mark.parametrize(
    ("share", "says"),
    [
        (0.3, "The variation comes from discount (30%), by the share that each explains alone, but "
              "hardly any value costs more than 5 points of regret."),
        (0.09, "No setting by itself explains a tenth of the variation."),
    ],
)  # fmt: skip
def test_what_varies_but_costs_little_does_not_matter(share, says):
    space, trials = made_up()
    places = np.linspace(0, 1, 5)
    effect = Effect(space[0], share, places, np.zeros(5), np.ones(5, bool))
    found = Sensitivity(Outcome.of([-101.0, -110.0], -100.0), [effect], 0.9)
    assert verdicts(found, trials)[1:] == [says]


@pytest.mark.parametrize("optimum", [-100.0, None])
def test_trials_that_diverged_are_not_near_the_best(optimum):
    """The others all lie within the tolerance of the best."""
    space, trials = made_up(40)
    learning_rate = np.array([positions(space, trial.values)[0] for trial in trials])
    trials = [
        trial._replace(returns=(math.nan if place > 0.8 else -102.0 - place,) * 2, at_random=True)
        for trial, place in zip(trials, learning_rate, strict=True)
    ]
    finite = int((learning_rate <= 0.8).sum())
    found = sensitivity(space, trials, optimum)
    assert f"Of 40 configurations drawn at random, {finite} lost" in verdicts(found, trials)[0]
    assert found is not None
    (effect,) = (each for each in found.effects if each.dimension is space[0])
    assert effect.range[1] < 0.95
    best = found.outcome.height(found.outcome.best)
    assert all(each.heights.max() <= best + 1e-9 for each in found.effects)


@pytest.mark.parametrize(
    ("value", "text"), [(0.995, "0.995"), (0.99934, "0.99934"), (0.95, "0.95"), (3e-4, "0.0003"),
                        (0.0123, "0.012"), (0.6, "0.6"), (60.0, "60"), (1.0, "1")]
)  # fmt: skip
def test_short_numbers(value, text):
    assert short(value) == text


# The report and the command


def page(optimum=-100.0, **changes) -> Sweep:
    space, trials = made_up(30)
    trials[5] = trials[5]._replace(returns=(None, -120.0))
    summary = {
        "best": trials[0].values, "return_tuned_on": -102.0, "seeds": list(range(1000, 1005)),
        "return_per_seed": [-102.0, -103.0, -102.5, -102.4, -102.6],
        "preset_return_per_seed": [-110.0, -111.5, -110.7, -110.8, -110.9],
        "optimum": optimum, "optimum_tuned_on": optimum,
    } | changes  # fmt: skip
    config = {"task": "pendulum", "agent": "<dqn>", "preset": "fast", "seeds": 2,
              "episodes": 2144, "steps": None, "batch": 16}  # fmt: skip
    own: dict[str, Any] = {"discount": 0.95, "learning_rate": 1e-3, "hidden": "32"}
    found = sensitivity(space, trials, optimum)
    return Sweep(config, space, trials, own, summary, found, "qfolio train\nqfolio tune")


@pytest.mark.parametrize("optimum", [-100.0, None])
def test_the_page(optimum, tmp_path):
    data = page(optimum)
    write_tuning_report(tmp_path, data)
    assert {path.name for path in tmp_path.iterdir()} == {
        "report.html", "progress.png", "sensitivity.png", "pair.png"
    }  # fmt: skip
    text = (tmp_path / "report.html").read_text()
    assert "&lt;dqn&gt;" in text
    assert "<dqn>" not in text
    assert "://" not in text.replace("http://www.w3.org", "")
    assert text.count("<svg") == 6
    assert "color-mix(in srgb, var(--accent)" in text
    assert ("regret (smallest at the top)" in text) == (optimum is not None)
    assert "1 diverged" in text
    assert "better (+8.3" in text


def test_the_page_of_few_trials(tmp_path):
    data = page()
    few = Sweep(**{**vars(data), "trials": data.trials[:4], "found": None})
    assert "are needed to say what matters" in render_page(few)


@pytest.mark.parametrize("optimum", [-100.0, None])
def test_the_best_so_far(optimum):
    """By hand; a trial that diverged never is the best, nor one that comes before any result."""
    returns = [(None,), (-150.0,), (-180.0,), (None,), (-110.0,), (-120.0,)]
    data = page(optimum)
    trials = [trial._replace(returns=x) for trial, x in zip(data.trials, returns, strict=False)]
    few = Sweep(**{**vars(data), "trials": trials, "found": None})
    (axes,) = draw_progress(few, 7.2).axes
    (line,) = (x for x in axes.lines if x.get_drawstyle() == "steps-post")
    best = np.array([math.nan, -150.0, -150.0, -150.0, -110.0, -110.0])
    expected = best if optimum is None else -np.log10((-100 - best) / 100)
    np.testing.assert_allclose(np.asarray(line.get_ydata(), float), expected)
    np.testing.assert_array_equal(np.asarray(line.get_xdata(), float), np.arange(1, 7))


@pytest.mark.parametrize("optimum", [-100.0, None])
def test_the_progress_of_a_single_trial(optimum, tmp_path):
    data = page(optimum)
    one = Sweep(**{**vars(data), "trials": data.trials[:1], "found": None})
    (axes,) = draw_progress(one, 7.2).axes
    low, high = axes.get_xlim()
    assert [tick for tick in axes.get_xticks() if low <= tick <= high] == [1]
    low, high = axes.get_ylim()
    assert sum(low <= tick <= high for tick in axes.get_yticks()) >= 2
    (tmp_path / "pair.png").touch()
    write_tuning_report(tmp_path, one)
    assert {path.name for path in tmp_path.iterdir()} == {"report.html", "progress.png"}


@pytest.mark.parametrize(
    ("best", "preset", "says"),
    [
        ([-103.0, -101.0, -102.0, -103.0, -101.5], [-102.0] * 5, "no clear difference"),
        ([-110.0, -111.0, -110.0, -111.0, -110.5], [-102.0] * 5, "worse"),
        ([-110.0, -111.0], [-102.0, -102.0], "2 seeds, −9.0 to −8.0): too few seeds for a verdict"),
        ([-110.0, None], [-102.0, -102.8], "diverged for the best"),
        ([-110.0], [-102.0], "a single seed allows no further conclusion"),
    ],
)
def test_the_comparison_is_honest(best, preset, says):
    data = page(return_per_seed=best, preset_return_per_seed=preset)
    assert says in data.comparison
    assert "Best" in render_page(data)


def test_the_preset_may_be_the_best():
    data = page()
    trials = list(data.trials)
    trials[3] = trials[3]._replace(returns=(-101.0, -101.0))
    assert (
        "None of 30 configurations did better"
        in Sweep(**{**vars(data), "trials": trials}).comparison
    )


def test_tune_from_the_command_line(tmp_path, monkeypatch, capsys):
    folder = tmp_path / "s"
    code = qfolio(monkeypatch, "tune", "pendulum", "--trials", 4, "--batch", 4, "--seeds", 4,
                  "--episodes", 4, "--search", "learning_rate=1e-4..1e-2", "--out", folder,
                  *TINY)  # fmt: skip
    printed = capsys.readouterr().out
    assert code == 0
    assert "4/4" in printed
    command = next(line for line in printed.splitlines() if line.startswith("qfolio train"))
    best = best_of(Tuning.open(folder).journal.trials())
    assert best is not None
    assert "--episodes 4" in command
    assert (folder / "report.html").exists()
    summary = json.loads((folder / "summary.json").read_text())
    assert len(summary["return_per_seed"]) == len(summary["preset_return_per_seed"]) == 8
    before = (folder / "summary.json").stat().st_mtime_ns
    # The command names what was searched, to the last digit.
    work = Tuning.open(folder)
    words = command.split()
    chosen = settings.parse(words[words.index("--set") + 1 :])
    assert chosen.pop("horizon") == "20"
    assert preset("fast").build(**chosen) == work.configured(best.values)
    taken = ["tune", "--out", folder, "--search", "learning_rate=1e-4..1e-2"]
    assert qfolio(monkeypatch, *taken) == 2
    assert f"continue with --join {folder}." in capsys.readouterr().err
    # Joining what is done only writes the report again.
    assert qfolio(monkeypatch, "tune", "--join", folder) == 0
    assert (folder / "summary.json").stat().st_mtime_ns == before
    # Of other trials, it is no report's: only the search makes it again, as if it were damaged.
    other = json.dumps(summary | {"best": {"learning_rate": 1.0}})
    (folder / "summary.json").write_text(other)
    assert qfolio(monkeypatch, "report", folder) == 2
    assert f"not finished; continue with qfolio tune --join {folder}." in capsys.readouterr().err
    assert (folder / "summary.json").read_text() == other
    (folder / "summary.json").write_text('{"best": {')
    assert qfolio(monkeypatch, "tune", "--join", folder) == 0
    assert json.loads((folder / "summary.json").read_text()) == summary


def test_the_learning_rate_ends_with_the_training(tmp_path, monkeypatch, capsys):
    def fail(self, *args):
        raise QfolioError(f"{self.agent.learning_rate_steps}")

    monkeypatch.setattr(Tuning, "run", fail)
    cases = [
        (["--episodes", 86], [], 75.0),
        (["--steps", 86 * 20], [], 75.0),  # of as many episodes
        (["--episodes", 86], ["learning_rate_steps=9"], 9.0),
    ]
    for number, (budget, more, steps) in enumerate(cases):
        out = tmp_path / str(number)
        assert qfolio(monkeypatch, "tune", *budget, "--out", out, *TINY, *more) == 2
        said = capsys.readouterr().err
        assert float(said.split()[-1]) == pytest.approx(steps, rel=0.01)

    few = ["market/kelly", "--agent", "pathwise", "--episodes", 50]
    assert qfolio(monkeypatch, "tune", *few, "--out", tmp_path / "few") == 2
    assert 0 < float(capsys.readouterr().err.split()[-1]) < 0.05  # which is not rounded to 0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere"], "there is no task 'nowhere'"),
        (["pendulum", "--agent", "dqm"], "did you mean dqn"),
        (["--trials", "0"], "trials is 0"),
        (["--batch", "0"], "batch is 0"),
        (["--episodes", "0"], "episodes is 0"),
        (["--search", "discount=0.9..0.99", "--set", "discount=0.9"], "both name discount"),
        (["--join", "nowhere"], "is no search"),
        (["--join", "nowhere", "--seeds", "3"], "keeps the settings of the search"),
        (["--set", "torques=0"], "continuous"),
    ],
)
def test_wrong_commands(arguments, says, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert qfolio(monkeypatch, "tune", *arguments) == 2
    assert says in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


class Discounted(Catch):
    """It has a setting that agents have, too."""

    discount: float = constant(0.9)


def test_a_setting_of_agent_and_task_is_not_searched(monkeypatch, capsys, tmp_path):
    """The command that trains the best configuration could not set it."""
    monkeypatch.chdir(tmp_path)
    words = ["tune", f"{__name__}:Discounted", "--agent", "dqn", "--trials", 1, "--steps", 9]
    assert qfolio(monkeypatch, *words) == 2
    assert "both have a setting discount" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_without_optuna(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "optuna", None)
    for name in ("qfolio.experiments.tuning.run", "qfolio.experiments.tuning.journal"):
        monkeypatch.delitem(sys.modules, name)
    assert qfolio(monkeypatch, "tune") == 2
    assert "qfolio[tune]" in capsys.readouterr().err
