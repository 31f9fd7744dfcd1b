import contextlib
import dataclasses
import html
import json
import math
import re
import sys
import types
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from qfolio.agents.dqn import DQN
from qfolio.agents.ppo import PPO
from qfolio.commands.progress import JobsProgress
from qfolio.core.devices import places
from qfolio.core.errors import QfolioError
from qfolio.core.fields import number
from qfolio.core.statistics import interquartile_mean, regret
from qfolio.core.text import four_digits
from qfolio.experiments.budget import Budget
from qfolio.experiments.comparison import run as comparing
from qfolio.experiments.comparison.conclusion import conclusion, share
from qfolio.experiments.comparison.measure import measure
from qfolio.experiments.comparison.operations import _operations, operations_per_step
from qfolio.experiments.comparison.ranking import (
    Result,
    area,
    fewest_seeds,
    middle_steps,
    rank,
    steps_within,
)
from qfolio.experiments.comparison.run import Comparison, Entrant
from qfolio.experiments.presets import PRESETS, Preset
from qfolio.experiments.run import Run
from qfolio.portfolio.synthetic.kelly import Kelly
from qfolio.portfolio.synthetic.regime import Regime
from qfolio.report.comparison import comparison_data, render_comparison
from qfolio.report.figures.style import percent_tick
from qfolio.tasks.catch import Catch
from qfolio.tasks.pendulum import Pendulum

from jobs import Elsewhere
from listeners import Interrupt, Tell
from shell import qfolio

TASK: dict[str, Any] = {"horizon": 20}
TINY: dict[str, Any] = {
    "hidden": (8,), "num_envs": 2, "batch_size": 8, "replay_capacity": 200,
    "learning_starts": 16, "episode_steps": 0,
}  # fmt: skip


def tiny(seeds=3, episodes=6, **rates):
    """Entrants that differ in their learning rate, so that they share one program."""
    rates = rates or {"slow": 1e-3, "quick": 1e-2}
    agents = {name: DQN(**TINY, learning_rate=rate) for name, rate in rates.items()}
    budget = Budget(episodes)
    return {name: Entrant(Pendulum(**TASK), agent, name, budget) for name, agent in agents.items()}


def result(returns, *, curve=(-300.0, -200.0, -101.0), steps=1000, seconds=2.0, optimum=-100.0):
    """A result with seeds that learn alike and end as given."""
    returns = np.asarray(returns, dtype=float)
    points = np.linspace(0, steps, len(curve)).astype(int)
    return Result(
        returns=returns.tolist(), optimum=optimum, starts=1024, curve_starts=64,
        curve_steps=points.tolist(), curve_returns=[[x] * len(returns) for x in curve],
        curve_optimum=optimum, episodes=10, env_steps=steps, seconds_train=seconds * len(returns),
        seconds_compile=1.0, seconds_per_seed=seconds, steps_per_second=500.0,
        operations_per_step=12_500.0, state_bytes=4_200_000, policy_bytes=1836, parameters=459,
    )  # fmt: skip


@pytest.fixture(autouse=True, scope="module")
def short_chunks():
    """Several looks at a short training, which all tests share the programs of."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("qfolio.core.training.CHUNK", 20)
        yield


GOOD, ALIKE, BAD = np.arange(8) / 8 - 102, np.arange(8) / 8 - 102.05, np.arange(8) - 140.0


# What follows from results ----------------------------------------------------------------------


def test_steps_until_a_curve_stays_near():
    regrets = np.array([[2.0, 2.0, 0.05, 2.0], [0.05, 0.1, 0.05, 0.2], [0.2, 0.1, 0.0, 0.1],
                        [0.05, 0.1, 0.1, 0.2]])  # fmt: skip
    assert steps_within([0, 10, 20, 30], regrets, 0.1) == [30, 10, 0, None]
    assert steps_within([0], np.array([[math.nan]]), 0.1) == [None]


def test_seeds_that_never_arrive_are_the_slowest():
    # Of four seeds the middle two count; the fourth, which may be anything, does not.
    assert middle_steps([10, 40, 20, None]) == pytest.approx(30)
    assert middle_steps([10, None, 20, None]) is None
    assert middle_steps([None]) is None
    # Of five: 0.75 of the second, the third, 0.75 of the fourth.
    assert middle_steps([1, 2, 3, 4, None]) == pytest.approx((0.75 * 2 + 3 + 0.75 * 4) / 2.5)


def test_the_area_ends_where_the_shortest_training_does():
    # From 4 down to 2 over ten steps, then to 0 at twenty: 3 on average over the first ten,
    # and (30 + 17.5 / 2) / 15 over fifteen.
    values = np.array([[4.0, 8.0], [2.0, 8.0], [0.0, 8.0]])
    np.testing.assert_allclose(area([0, 10, 20], values, 10), [3.0, 8.0])
    np.testing.assert_allclose(area([0, 10, 20], values, 15), [(30 + 7.5) / 15, 8.0])
    np.testing.assert_allclose(area([20], values[2:], 20), values[2])  # earlier points were lost


def test_ranking_by_regret():
    ranking = rank({"bad": result(BAD), "good": result(GOOD, steps=500, seconds=4.0)})
    assert ranking["order"] == ["good", "bad"]
    assert ranking["common_steps"] == 500
    good = ranking["agents"]["good"]
    # The middle half of 2% to 1.125% below −100.
    assert good["final"]["iqm"] == pytest.approx(0.015625)
    assert good["final"]["worst"] == pytest.approx(0.02)
    low, high = good["final"]["interval"]
    assert 0.0125 < low < 0.015625 < high < 0.02
    # Regrets of the curve: 200% and 100% and 1%, at 0, 250 and 500 steps.
    assert good["area"]["iqm"] == pytest.approx((1.5 + 0.505) / 2)
    near = {entry["threshold"]: entry for entry in good["within"]}
    assert (near[0.1]["steps"], near[0.1]["seconds"], near[0.1]["reached"]) == (500, 4.0, 8)
    (pair,) = ranking["pairs"]
    assert (pair["first"], pair["second"], pair["probability"]) == ("good", "bad", 1.0)
    assert pair["p"] == pytest.approx(2 / math.comb(16, 8))
    assert pair["difference"] == pytest.approx(0.015625 - 0.365)
    json.dumps(ranking, allow_nan=False)


def test_an_optimum_of_zero_leaves_no_share_to_miss(tmp_path):
    """As in a market where staying out is best: the comparison still shows itself."""
    comparison = Comparison.create(tiny(), seeds=3, out=tmp_path / "c")
    found = result([-1.0, -2.0, 0.0], optimum=0.0)
    comparison.results = {"slow": found, "quick": found}
    assert "Comparison on pendulum" in comparison._repr_html_()
    measured = comparing._measures(found)
    assert measured == {"return": -1.0, "optimum": 0.0, "regret": None}


def test_a_curve_whose_optimum_is_zero_is_ranked_by_its_returns():
    """The curve has fewer starts than the grade, of which the optimum may not be zero."""
    found = dataclasses.replace(result(BAD), curve_optimum=0.0)
    ranking = rank({"slow": found, "quick": found})
    assert ranking["measure"] == "return"
    assert ranking["agents"]["slow"]["area"]["iqm"] == np.mean([-250.0, -150.5])
    json.dumps(ranking, allow_nan=False)


def test_ranking_by_return_where_no_optimum_is_known():
    best = result([480.0, 500.0, 500.0, 490.0], curve=(10.0, 460.0, 500.0), optimum=None)
    worse = result([120.0, 130.0, 110.0, 90.0], curve=(10.0, 100.0, 120.0), optimum=None)
    ranking = rank({"worse": worse, "best": best})
    assert (ranking["measure"], ranking["goal"]) == ("return", 500.0)
    assert ranking["order"] == ["best", "worse"]
    assert ranking["agents"]["best"]["final"]["worst"] == 480
    assert ranking["agents"]["best"]["within"][2]["steps"] == 500  # 460 is within 10% of 500
    assert ranking["agents"]["worse"]["within"][2]["steps"] is None
    first, second, last = conclusion(ranking)
    assert first == "best ends with the highest return: 495.0 (4 seeds, 480.0 to 500.0)."
    assert ranking["agents"]["best"]["final"]["interval"] is None
    assert ranking["pairs"][0]["probability_interval"] is None
    assert second == "With 4 seeds each it can be told apart from worse (115.0)."
    assert (
        last == "Only best settles within 10% of the best return, after 500 steps and 1 s a seed."
    )


def test_among_many_pairs_chance_needs_more_to_be_ruled_out():
    """Each of three pairs has 2 of the 12,870 ways to choose 8 of 16: three times as many count."""
    ranking = rank({name: result(GOOD - 10 * i) for i, name in enumerate("abc")})
    np.testing.assert_allclose([pair["p"] for pair in ranking["pairs"]], 3 * 2 / 12_870)


def test_the_time_to_arrive_is_a_share_of_the_training():
    """Half of the steps, at 4 s for all."""
    early = result(GOOD, curve=(-300.0, -105.0, -101.0), seconds=4.0)
    ranking = rank({"early": early, "late": result(BAD)})
    (near,) = (x for x in ranking["agents"]["early"]["within"] if x["threshold"] == 0.1)
    assert (near["steps"], near["seconds"]) == (500, 2.0)


def test_the_fewest_steps_and_the_least_time_may_be_those_of_two():
    frugal = result(GOOD, steps=500, seconds=2000.0)
    said = conclusion(rank({"frugal": frugal, "swift": result(ALIKE, seconds=1234.0)}))
    assert said[-1] == (
        "To settle within 10% of the optimum, frugal needs the fewest steps (500) and swift the "
        "least time (1,234 s a seed)."
    )


def test_agents_that_cannot_be_told_apart_are_said_so():
    said = conclusion(rank({"a": result(GOOD), "b": result(ALIKE), "c": result(BAD)}))
    assert said[0].startswith("a ends nearest to the exact optimum: its regret is 1.6% (95%")
    assert said[1] == (
        "With 8 seeds each it cannot be told apart from b (1.6%); c (36%) does worse."
    )
    assert len(said) == 3


def test_agents_with_equal_results_end_level():
    said = conclusion(rank({"a": result(GOOD), "b": result(GOOD), "c": result(BAD)}))
    assert said[0].startswith("a and b end nearest to the exact optimum: the regret of each is 1.6")
    assert said[1] == "With 8 seeds each they can be told apart from c (36%)."
    said = conclusion(rank({"a": result(GOOD), "b": result(GOOD)}))
    assert len(said) == 2


def test_an_agent_whose_seeds_mostly_end_better_is_named():
    """The one with the best interquartile mean can lose most pairs of seeds."""
    ahead = -101 - np.arange(15) / 100
    ahead[11:] = -1e8
    said = conclusion(rank({"a": result(ahead), "b": result(-102 - np.arange(15) / 100)}))
    assert said[0].startswith("b ends nearest")
    assert said[1].startswith("A seed of a (")
    assert "told apart" not in " ".join(said)


def test_agents_that_are_as_quick_are_named_together():
    twins = {"a": result(GOOD), "b": result(ALIKE), "c": result(BAD, curve=(-300.0,) * 3)}
    assert conclusion(rank(twins))[-1].startswith(
        "To settle within 10% of the optimum, a and b need the fewest steps (1,000) and the least "
        "time ("
    )


def test_a_critic_is_no_part_of_the_policy():
    agent = PPO(num_envs=2, rollout_length=10, batch_size=20, epochs=1, hidden=(8,))
    run = Run.create(Pendulum(**TASK), agent, episodes=2)
    run.train()
    measured = measure(run, 1)
    assert measured.parameters == 3 * 8 + 8 + 8 * 11 + 11
    assert measured.policy_bytes == 4 * measured.parameters


def test_a_best_return_of_zero_has_no_shares():
    ranking = rank({name: result([0.0, 0.0], curve=(0.0, 0.0), optimum=None) for name in "ab"})
    assert [entry["reached"] for entry in ranking["agents"]["a"]["within"]] == [0] * 6
    json.dumps(ranking, allow_nan=False)


def test_few_seeds_tell_nothing_apart():
    # Of three against three, two of twenty ways to choose are as extreme: 10%.
    assert [fewest_seeds(pairs) for pairs in (1, 3, 45)] == [4, 5, 7]
    said = conclusion(rank({"a": result(GOOD[:3]), "b": result(BAD[:3])}))
    assert said[1] == (
        "With 3 seeds each two agents cannot be told apart, whatever their results; this needs 4 "
        "seeds or more."
    )
    said = conclusion(rank({name: result(GOOD[:4]) for name in "abc"}))
    assert said[1].startswith("With 4 seeds each no two of 3 agents can be told apart, whatever")


def test_one_seed_has_no_intervals():
    ranking = rank({"a": result([-101.0]), "b": result([-110.0])})
    assert ranking["agents"]["a"]["final"]["interval"] is None
    assert ranking["pairs"][0]["probability_interval"] is None
    assert ranking["pairs"][0]["p"] == 1


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0%"), (2e-7, "0%"), (-2e-7, "0%"), (0.000193, "0.019%"), (0.0134, "1.3%"),
     (0.134, "13%"), (10.36, "1,036%"), (-0.004, "−0.40%"), (0.00005, "0.005%")],
)  # fmt: skip
def test_shares_show_the_digits_that_matter(value, text):
    assert share(value) == text


# Training ---------------------------------------------------------------------------------------


def test_operations_are_counted_by_hand():
    def operations(**settings):
        return operations_per_step(Pendulum(), DQN(**{**TINY, "num_envs": 4, **settings}))

    # A network 3 → 8 → 11 has 112 weights. Acting: 4 observations. Learning from 8: forward twice,
    # and backward to the weights of both layers and to the hidden one's values.
    act, learn = 2 * 4 * 112, 2 * 8 * (3 * 112 + 8 * 11)
    assert operations() == (act + learn) / 4
    assert operations(gradient_steps=3) == (act + 3 * learn) / 4
    assert operations(double=True) == (act + learn + 2 * 8 * 112) / 4


def test_operations_of_loops_branches_and_convolutions_by_hand():
    """A product of 2 × 3 and 3 × 4 takes 48, and one output of the convolution 2 · 3 · 4."""
    left, right, seen, kernel = (jnp.ones(x) for x in ((2, 3), (3, 4), (1, 3, 10), (5, 3, 4)))

    def twice(table):
        return table @ (right @ right.T)

    def count(function, *given):
        return _operations(jax.make_jaxpr(function)(*given).jaxpr)

    assert count(lambda x: x @ right, left) == 48
    assert count(lambda x: lax.scan(lambda y, _: (y, y @ right), x, length=5)[1], left) == 5 * 48
    assert count(twice, left) == 72 + 36
    branches = lambda x: lax.cond(x[0, 0] > 0, twice, lambda x: x @ jnp.ones((3, 3)), x)  # noqa: E731
    assert count(branches, left) == 72 + 36  # the larger one
    assert count(lambda x: lax.conv(x, kernel, (1,), "VALID"), seen) == 5 * 7 * 2 * 3 * 4


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A comparison that was never interrupted."""
    run = Comparison.create(tiny(), seeds=3, out=tmp_path_factory.mktemp("whole") / "run")
    seen = []

    def listen(job, done, share):
        return [Tell(lambda training, rows: seen.append((job.name, training.population.episodes)))]

    run.run(listen)
    episodes = [0, 2, 4, 6]  # warm-up first
    assert seen == [("slow", n) for n in episodes] + [("quick", n) for n in episodes]
    return run, run.finish()


def test_a_comparison_shows_itself_in_a_notebook(finished):
    run, content = finished
    wanted = f"2 of 2 agents finished, in {run.folder}>"
    assert repr(run) == f"<Comparison: slow, quick on pendulum, {run.config.seeds} seeds, {wanted}"
    shown = run._repr_html_()
    assert "2 of 2 agents" in shown
    assert html.escape(content["conclusion"][0]) in shown
    for name in ("slow", "quick"):
        assert f"<td>{name}</td>" in shown
        middle = float(interquartile_mean(content["results"][name]["returns"]))
        assert f"<td>{four_digits(middle)}</td>" in shown
        missed = regret(middle, content["results"][name]["optimum"])
        assert missed is not None
        assert f"<td>{share(float(missed))}</td>" in shown


def test_a_comparison_in_its_folder(finished):
    run, content = finished
    assert {path.name for path in run.folder.iterdir()} == {
        "comparison.json", "events.jsonl", "agents",
    }  # fmt: skip
    for name in ("slow", "quick"):
        measured, kept = content["results"][name], Run.open(run.place(name))
        assert kept.grade()["return_per_seed"] == pytest.approx(measured["returns"])
        assert measured["env_steps"] == 6 * 20
        assert np.shape(measured["curve_returns"])[1] == 3
        # Policy: 3 → 8 → 11 with biases. Training: at least three times that and a replay of 200.
        assert measured["parameters"] == 3 * 8 + 8 + 8 * 11 + 11
        assert measured["policy_bytes"] == 4 * measured["parameters"]
        assert measured["state_bytes"] > 4 * (4 * measured["parameters"] + 200 * 7)
        share = measured["seconds_train"] / math.ceil(3 / min(len(places()), 3))
        assert measured["seconds_per_seed"] == pytest.approx(share)
        assert measured["curve_steps"] == [0, 14, 54, 94, 120]  # warm-up first
    assert "fewer than 10 points" in content["notes"][0]
    again = Comparison.open(run.folder)
    assert again.results == run.results
    again.run(lambda *_: pytest.fail("all is trained"))
    assert again.finish() == content


def test_seeds_of_environments_in_python_take_turns_on_any_number_of_devices(finished, monkeypatch):
    kept = Run.open(finished[0].place("slow"))
    seconds = kept.summary()["seconds_train"]
    assert measure(kept, 4).seconds_per_seed == seconds
    monkeypatch.setattr("qfolio.experiments.comparison.measure.HostPopulation", object)
    assert measure(kept, 4).seconds_per_seed == seconds / 3


@pytest.mark.parametrize("stop", ["ctrl-c", "crash"])
def test_resuming_gives_the_same(finished, tmp_path, stop):
    run = Comparison.create(tiny(), seeds=3, out=tmp_path / "run")

    def crash(training, rows):
        if training.population.episodes == 2:
            raise RuntimeError("killed")

    at = {"crash": Tell(crash), "ctrl-c": Interrupt(lambda now: now.population.episodes == 2)}
    with pytest.raises(RuntimeError) if stop == "crash" else contextlib.nullcontext():
        run.run(lambda job, done, share: [at[stop]] if job.name == "quick" else [])
    assert run.interrupted == (stop == "ctrl-c")
    run = Comparison.open(tmp_path / "run")
    assert list(run.results) == ["slow"]
    trained = []

    def listen(job, done, share):
        trained.append((job.name, done, share))
        return []

    run.failures = {"quick": "It diverged."}
    run.run(listen)
    assert run.failures == {}  # it was tried again
    assert trained == [("quick", 0.5, 0.5)]  # of the whole, with what was done before
    for name, expected in finished[0].results.items():
        assert run.results[name].returns == expected.returns
        assert run.results[name].env_steps == expected.env_steps


@pytest.mark.slow
def test_on_workers_it_is_the_same(tmp_path):
    """Also for an agent that diverges, and for one whose seeds were trained in part."""
    rates, made = {"slow": 1e-3, "wild": 1e29, "quick": 1e-2}, list[Comparison]()
    for name in ("here", "stopped"):
        made.append(Comparison.create(tiny(**rates), seeds=3, out=tmp_path / name))
    here, stopped = made
    here.run()
    elsewhere = Elsewhere()

    def stop_in_the_last(job, done, share):
        return [Interrupt()] if job.name == "quick/2" else []

    stopped.run(stop_in_the_last, elsewhere)
    assert stopped.interrupted
    assert list(stopped.results) == ["slow"]
    assert elsewhere.ran == [f"{name}/{seed}" for name in rates for seed in range(3)]
    resumed, elsewhere = Comparison.open(tmp_path / "stopped"), Elsewhere()
    resumed.run(executor=elsewhere)
    assert elsewhere.ran == ["wild/0", "wild/1", "wild/2", "quick/2"]
    assert resumed.failures.keys() == {"wild"}
    assert re.match("The loss of seed 2 is no longer finite", resumed.failures["wild"])
    timeless = {name: strip(result) for name, result in here.results.items()}
    assert {name: strip(result) for name, result in resumed.results.items()} == timeless
    assert resumed.finish()["ranking"]["order"] == here.finish()["ranking"]["order"]


def test_what_workers_began_goes_on_here_in_the_same_log(tmp_path, monkeypatch):
    monkeypatch.setenv("NPROC", "1")  # a seed at a time

    def stop_in_the_second(job, done, share):
        return [Interrupt()] if job.name == "slow/1" else []

    stopped = Comparison.create(tiny(), seeds=3, out=tmp_path / "run")
    stopped.run(stop_in_the_second, Elsewhere())
    assert stopped.interrupted
    resumed = Comparison.open(stopped.folder)
    resumed.run()
    assert resumed.finished
    lines = (stopped.folder / "events.jsonl").read_text().splitlines()
    events = [json.loads(line) for line in lines]
    done = [event["job"] for event in events if event["event"] == "done"]
    assert sorted(done) == [f"{name}/{seed}" for name in ("quick", "slow") for seed in range(3)]
    recorded = {event["job"] for event in events if event["event"] == "record"}
    assert recorded == set(done)


def strip(result):
    """A result without the times that were measured."""
    return {name: value for name, value in vars(result).items() if "second" not in name}


def test_an_agent_that_diverges_does_not_stop_the_others(tmp_path):
    entrants = tiny(slow=1e-3, wild=1e29, quick=1e-2)
    run = Comparison.create(entrants, seeds=3, out=tmp_path / "run")
    run.run()
    content = run.finish()
    assert content["ranking"]["order"] in (["slow", "quick"], ["quick", "slow"])
    assert list(content["failures"]) == ["wild"]
    assert re.match(r"wild could not be trained. The loss of seed", content["notes"][0])
    assert Comparison.open(tmp_path / "run").finish() == content  # as qfolio report does
    run.failures = {}  # they are tried again, and the ranking waits for them
    run._write()
    kept = Comparison.open(tmp_path / "run").config
    assert (kept.ranking, kept.conclusion, kept.notes) == (None, [], [])
    alone = Comparison.create(tiny(wild=1e29, wilder=1e30), seeds=3, out=tmp_path / "alone")
    alone.run()
    with pytest.raises(QfolioError, match=r"fewer than two agents to compare\. wild: The loss"):
        alone.finish()


class Unpaid(Catch):
    """Its rewards are no numbers."""

    def step(self, state, action, key):
        return super().step(state, action, key)._replace(reward=jnp.array(jnp.nan))


@pytest.mark.parametrize("executor", [None, Elsewhere()])
def test_agents_that_cannot_be_graded_are_left_out(executor, tmp_path):
    """They never begin to learn, so their losses are finite."""
    agent, budget = DQN(**TINY | {"learning_starts": 190}), Budget(6)
    entrants = {name: Entrant(Unpaid(), agent, None, budget) for name in ("one", "other")}
    run = Comparison.create(entrants, seeds=2, out=tmp_path / "run")
    run.run(executor=executor)
    fault = "The reward of Unpaid is not finite at step 1 of an episode; check its step."
    assert run.failures == {"one": fault, "other": fault}
    assert run.finished


class Delayed(Kelly):
    """Its bets begin later, with the same odds."""

    delay: float = number(0.0)

    def reset_market(self, key):
        return super().reset_market(key) + self.delay


def noted(tmp_path, first, second, steps=1000, graded="ab"):
    """The notes on two agents with tasks of their own, as if they were trained.

    graded: those whose optimum is known.
    """
    agent = DQN(**TINY)
    optimum = first.optimum().returns(comparing.start_keys()).mean()
    other = second.optimum().returns(comparing.start_keys()).mean()
    entrants = {
        "a": Entrant(first, agent, None, Budget(1)),
        "b": Entrant(second, agent, None, Budget(1)),
    }
    run = Comparison.create(entrants, seeds=8, out=tmp_path / "run")
    run.results = {
        "a": result(GOOD, optimum=float(optimum) if "a" in graded else None, curve=[-1.0] * 20),
        "b": result(
            GOOD, optimum=float(other) if "b" in graded else None, curve=[-1.0] * 20, steps=steps
        ),
    }
    return run.notes()


def test_tasks_that_differ_are_checked(tmp_path):
    same = noted(tmp_path / "1", Regime(menu="grid:2"), Regime(menu="grid:10"))
    assert same == [
        "Task settings differ between agents: menu is grid:2 for a, grid:10 for b. Their start "
        "states, lengths of episodes and exact optima are the same (this was checked), so results "
        "are comparable."
    ]
    (other,) = noted(tmp_path / "2", Pendulum(horizon=20), Pendulum(horizon=20, mass=2.0))
    assert "Their exact optima differ, too: each regret is a share of the agent's own" in other
    (longer,) = noted(tmp_path / "3", Kelly(menu="grid:2"), Kelly(menu="grid:2", horizon=50))
    assert "Their lengths of episodes and exact optima differ" in longer
    task, likelier = Kelly(menu="grid:2"), Kelly(menu="grid:2", probability=0.531)
    (odds,) = noted(tmp_path / "7", task, likelier)
    assert "Their exact optima differ, too" in odds
    (budget,) = noted(tmp_path / "4", task, task, steps=1060)
    assert budget.startswith("Budgets differ: from 1,000 environment steps a seed (a) to 1,060")
    assert noted(tmp_path / "5", task, task, steps=1050) == []
    (begun,) = noted(tmp_path / "6", Delayed(menu="grid:2"), Delayed(menu="grid:2", delay=1.0))
    assert "Their start states differ, too: each regret is a share of the agent's own" in begun


def test_returns_without_an_optimum_are_comparable_if_tasks_are_alike(tmp_path):
    first, longer = Kelly(menu="grid:2"), Kelly(menu="grid:2", horizon=50)
    for known in ("", "a"):
        (unknown,) = noted(tmp_path / f"1{known}", first, longer, graded=known)
        assert "Their lengths of episodes differ, too: returns are not comparable." in unknown
    (alike,) = noted(tmp_path / "2", first, Kelly(menu="grid:4"), graded="")
    assert "Their start states and lengths of episodes are the same (this was checked)" in alike


def test_agents_that_do_not_fit_are_refused_before_anything_is_trained(tmp_path):
    entrants = tiny()
    any_torque = Pendulum(**TASK, torques=0)
    entrants["odd"] = dataclasses.replace(entrants["slow"], task=any_torque)
    with pytest.raises(QfolioError, match=r"^odd: dqn chooses among numbered actions"):
        Comparison.create(entrants, seeds=3, out=tmp_path / "run")
    entrants["odd"] = dataclasses.replace(entrants["slow"], task=Kelly(menu="grid:2"))
    with pytest.raises(QfolioError, match="has one task, but these are pendulum, market/kelly"):
        Comparison.create(entrants, seeds=3, out=tmp_path / "run")
    with pytest.raises(QfolioError, match="seeds is 0"):
        Comparison.create(tiny(), seeds=0, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


class Leaning(DQN):
    """Holds what is no setting."""

    towards: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(2))


def test_what_settings_do_not_describe_is_refused_before_a_folder_is_made(tmp_path):
    """It was made, and could not be opened."""

    class Local(DQN):
        pass

    for agent, says in (
        (Leaning(**TINY, towards=np.ones(2)), r"but towards of the agent .*:Leaning is no setting"),
        (Local(**TINY), "these do not make the agent .*:.*Local; define its class outside"),
    ):
        entrants = tiny()
        entrants["odd"] = dataclasses.replace(entrants["slow"], agent=agent)
        with pytest.raises(QfolioError, match=rf"^A comparison takes only what a name .*{says}"):
            Comparison.create(entrants, seeds=3, out=tmp_path / "run")
        assert not any(tmp_path.iterdir())
    entrants["odd"] = dataclasses.replace(entrants["slow"], agent=Leaning(**TINY))
    Comparison.create(entrants, seeds=3, out=tmp_path / "run")


@pytest.mark.parametrize(
    ("names", "says"),
    [(["Q fast", "q"], "An agent is called 'Q fast'; use letters"),
     (["q-a", "q:a"], "q-a and q:a would share a folder")],
)  # fmt: skip
def test_names_that_no_folder_can_have_are_refused(names, says, tmp_path):
    """Such a comparison was created and could not be opened."""
    entrants = dict(zip(names, tiny().values(), strict=True))
    with pytest.raises(QfolioError, match=says):
        Comparison.create(entrants, seeds=3, out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("damage", "message"),
    [({"format": 0}, "another format"), ({"kind": "backtest"}, "is a backtest, not a comparison"),
     ({"results": {"slow": {}}}, "damaged"), ({"results": {"who": None}}, "damaged"),
     ({"agents": {"../x": {}}}, "damaged"), ({"agents": {"x": {}}}, "agent is missing")],
)  # fmt: skip
def test_damaged_folders(finished, tmp_path, damage, message):
    content = json.loads((finished[0].folder / "comparison.json").read_text())
    (tmp_path / "comparison.json").write_text(json.dumps(content | damage))
    with pytest.raises(QfolioError, match=message):
        Comparison.open(tmp_path)


# The command and its report ---------------------------------------------------------------------


@pytest.fixture
def presets(monkeypatch):
    """Two tiny presets of DQN on the pendulum."""
    settings = {"fast": {**TINY}, "bold": {**TINY, "learning_rate": 1e-2}}
    tiny = {name: Preset("dqn", given, 6, 1, task=TASK) for name, given in settings.items()}
    monkeypatch.setitem(PRESETS, ("pendulum", "dqn"), tiny)


def test_the_command(presets, monkeypatch, capsys, tmp_path):
    folder = tmp_path / "run"
    arguments = ["compare", "pendulum", "--agents", "dqn,dqn:bold", "--seeds", 3, "--out", folder]
    assert qfolio(monkeypatch, *arguments, "--episodes", 4) == 0
    printed = capsys.readouterr().out
    assert "\n1 of 2: dqn\n" in printed
    assert "\n2 of 2: dqn:bold\n" in printed
    assert "two agents cannot be told apart" in printed.replace("\n", " ")
    assert f"Report: {folder / 'report.html'}" in printed.replace("\n", "").replace("R", "\nR")
    assert {path.name for path in folder.iterdir()} == {
        "comparison.json", "events.jsonl", "agents", "report.html", "learning_curves.png",
    }  # fmt: skip
    assert {path.name for path in (folder / "agents").iterdir()} == {"dqn", "dqn-bold"}
    content = json.loads((folder / "comparison.json").read_text())
    assert content["results"]["dqn"]["episodes"] == 4
    assert content["agents"]["dqn"]["preset"] == "fast"
    assert content["notes"][0].startswith("The length of training was set by hand")
    assert qfolio(monkeypatch, "evaluate", folder / "agents" / "dqn-bold", "--json") == 0
    graded = json.loads(capsys.readouterr().out)
    assert graded["return_per_seed"] == pytest.approx(content["results"]["dqn:bold"]["returns"])
    assert qfolio(monkeypatch, *arguments) == 2
    assert f"continue with --resume {folder}" in capsys.readouterr().err
    before = (folder / "comparison.json").read_text()
    assert qfolio(monkeypatch, "compare", "--resume", folder) == 0
    assert (folder / "comparison.json").read_text() == before


def test_a_comparison_that_is_stopped_says_how_to_go_on(presets, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(JobsProgress, "__call__", lambda *job: [Interrupt()])
    arguments = ["compare", "--agents", "dqn,dqn:bold", "--out", tmp_path / "run"]
    assert qfolio(monkeypatch, *arguments) == 130
    printed = capsys.readouterr().out.replace("\n", "")
    assert printed.endswith(f"Resume with: qfolio compare --resume {tmp_path / 'run'}")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--agents", "dqn,dqx"], "no agent 'dqx'"), (["--agents", "dqn:fst,dqn"], "preset 'fst'"),
        (["--agents", "dqn"], "two or more agents"), ([], "two or more agents"),
        (["--agents", "dqn,dqn:fast"], "the preset fast twice: dqn, dqn:fast"),
        (["--agents", "dqn,one:Mine,two:Mine", "--steps", 9], "two agents that are called Mine"),
        (["--agents", "dqn,pathwise"], "pathwise has no preset for pendulum"),
        (["pendulm", "--agents", "dqn,dqn:bold"], "no task 'pendulm'"),
        (["--agents", "dqn,dqn:bold", "--seeds", 0], "seeds is 0"),
        (["--agents", "dqn,dqn:bold", "--episodes", 4, "--steps", 9], "give one of them"),
        (["--agents", "dqn,dqn:bold", "--episodes", 0], "episodes is 0"),
        (["--resume", "nowhere"], "no comparison"),
        (["--resume", ".", "--seeds", 3], "add only --on, --track and --trust"),
    ],
)  # fmt: skip
def test_comparisons_that_are_refused(presets, monkeypatch, capsys, tmp_path, options, message):
    for name in ("one", "two"):
        module = types.ModuleType(name)
        vars(module)["Mine"] = type("Mine", (DQN,), {"__module__": name})
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.chdir(tmp_path)
    out = [] if "--resume" in options else ["--out", tmp_path / "run"]
    assert qfolio(monkeypatch, "compare", *options, *out) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert "Traceback" not in printed
    assert not (tmp_path / "run").exists()


def page(results, **changes):
    """The report on results as if they had been trained."""
    ranking = rank(results)
    entry = {"agent": "dqn", "preset": "fast", "agent_settings": {"hidden": [8]},
             "task_settings": {"horizon": 20}, "episodes": 1, "steps": None}  # fmt: skip
    content = {
        "task": "pendulum", "seeds": 8, "seed": 0, "version": "1", "device": "cpu",
        "command": "qfolio compare", "started": "2026-01-01T00:00:00",
        "agents": dict.fromkeys(results, entry), "ranking": ranking,
        "results": {name: dataclasses.asdict(x) for name, x in results.items()},
        "conclusion": conclusion(ranking), "notes": ["Mind <b>."], **changes,
    }  # fmt: skip
    return render_comparison(comparison_data(content))


def test_the_report():
    text = page({"a": result(GOOD), "b": result(ALIKE, steps=90_000), "c": result(BAD)})
    assert "Three agents on the pendulum" in text
    assert "Mind &lt;b&gt;." in text
    assert "cannot be told apart from b (1.6%)" in text
    # c is told apart from both, a and b are not: of six pairs, four are bold.
    table = text[text.index('class="grid"') : text.index("Computational cost")]
    assert len(re.findall(r"<b>(?:100|0)</b>", table)) == 4
    assert len(re.findall(r"<td class=\"(?:gain|loss)\d\">\d", table)) + 4 >= 5
    # Offline, without scripts, and in the colors of the page.
    assert not re.search(r"<script|https?://(?!www\.w3\.org)|url\((?!#)", text)
    assert text.count("<svg viewBox") == 4
    assert "var(--agent-3)" in text
    assert "#1b7a5a" not in text.split("</style>")[1]


def test_reports_of_hard_cases():
    # One seed each, at the optimum and beyond.
    exact = result([-100.0], curve=(-100.0,) * 3)
    above = result([-99.5], curve=(-400.0, -100.0, -99.0))
    text = page({"exact": exact, "above": above})
    assert re.search("above</th>\\s*<td>\N{MINUS SIGN}0.50", text)
    assert not re.search(r"\bnan\b|\binf\b", text)
    # More agents than colors, with budgets from ten steps to ten million.
    many = {f"agent{i}": result(GOOD[:2] - i, steps=10**i) for i in range(1, 8)}
    text = page(many)
    assert text.count('stroke-dasharray="8 3"') == 4  # the seventh, in each table and list
    assert '<th scope="col" title="agent7">7</th>' in text
    # No optimum.
    unknown = {
        name: result([value, value], curve=(9.0, value / 2, value), optimum=None)
        for name, value in (("x", 500.0), ("y", 20.0))
    }
    text = page(unknown)
    assert "No exact optimum is known here" in text
    assert "Regret" not in text


@pytest.mark.parametrize(
    ("tick", "label"),
    [(0.001, "0.1"), (0.024, "2.4"), (0.05, "5"), (0.00025, "0.025"), (5.0, "500")],
)
def test_ticks_have_the_digits_that_tell_them_apart(tick, label):
    assert percent_tick(tick) == f"{label}%"
