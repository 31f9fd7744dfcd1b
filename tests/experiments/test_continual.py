import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.agents.dqn import DQN
from qfolio.agents.tabular import QLearning
from qfolio.commands.progress import BarProgress
from qfolio.core.errors import QfolioError
from qfolio.core.evaluation import start_keys
from qfolio.core.population import Population
from qfolio.experiments import continual
from qfolio.experiments.budget import Budget
from qfolio.experiments.continual import Course, Grades, Plan, compare, create, recovery, renew
from qfolio.experiments.events import read
from qfolio.experiments.fit import Listener
from qfolio.experiments.presets import preset
from qfolio.portfolio.synthetic.kelly import Kelly
from qfolio.portfolio.synthetic.no_trade import NoTrade
from qfolio.report.continual import render_page, verdict
from qfolio.tasks.catch import Catch
from qfolio.tasks.pendulum import Pendulum

from listeners import Interrupt
from shell import TINY, qfolio

OLD, NEW = Pendulum(horizon=20), Pendulum(horizon=20, mass=1.5)
AGENT = DQN(
    hidden=(8,), num_envs=2, batch_size=8, replay_capacity=100, learning_starts=10,
    learning_rate_final=0.0, learning_rate_steps=150.0,
)  # fmt: skip
EPISODES = 16


def trained(task, agent, episodes=EPISODES):
    population = Population(task, agent, [3, 4])
    while left := population.steps_left(episodes):
        population.advance(left)
    return population


PLAN = Plan(OLD, NEW, AGENT, EPISODES, seeds=2, seed=3)


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    folder = tmp_path_factory.mktemp("continual") / "whole"
    create(PLAN, folder, "qfolio continual <b>")
    return compare(folder)


class Names(list):
    """What is under way, noted; with Ctrl-C at one of them."""

    def __init__(self, stop=None, when=lambda training: True):
        self.stop, self.when = stop, when

    def __call__(self, name):
        self.append(name)
        return Interrupt(self.when) if name == self.stop else Listener()


def regrets(task, population):
    best = task.optimum().returns(start_keys()).mean()
    return (best - population.evaluate(start_keys(), tail=0).returns.mean(1)) / abs(best)


def test_frozen_is_the_trained_policy_in_both_worlds(content):
    course = content["courses"]["frozen"]
    assert course["steps"] == [0]
    first = trained(OLD, AGENT)
    np.testing.assert_allclose(course["other"], regrets(OLD, first), rtol=1e-5)
    there = Population(NEW, AGENT, [3, 4])
    there.restore(first.fetch())
    np.testing.assert_allclose(course["final"], regrets(NEW, there), rtol=1e-5)


def test_fresh_is_a_training_in_the_changed_world(content):
    course = content["courses"]["fresh"]
    np.testing.assert_allclose(course["final"], regrets(NEW, trained(NEW, AGENT)), rtol=1e-5)
    assert course["steps"][-1] == EPISODES * 20


def test_the_log_says_at_which_step_each_way_ends(tmp_path):
    create(PLAN, tmp_path)
    compare(tmp_path)
    events, _ = read(tmp_path / "events.jsonl")
    last = {e["job"]: e["step"] for e in events if e["event"] == "record"}
    assert {e["job"]: e["step"] for e in events if e["event"] == "done"} == last
    assert last["frozen"] == last["first training"] > 0
    # What was learned before the change is no part of going on.
    assert {e["share"] for e in events if e["event"] == "running"} == {0.0}


def test_every_way_begins_with_what_it_knows(content):
    courses = content["courses"]
    assert courses["going on"]["curve"][0] == courses["frozen"]["curve"][0]
    assert courses["renewed"]["curve"][0] == courses["frozen"]["curve"][0]
    assert courses["fresh"]["curve"][0] != courses["frozen"]["curve"][0]
    assert courses["going on"]["steps"][-1] == EPISODES * 20
    assert courses["renewed"]["steps"][-1] == EPISODES // 2 * 20


def test_going_on_needs_a_learning_rate():
    """That of the preset has fallen to zero: as it is, an agent would learn nothing."""
    plan = Plan(OLD, NEW, AGENT, EPISODES)
    assert plan.going_on == dataclasses.replace(
        AGENT, learning_rate_final=0.3, learning_rate_steps=1.0
    )
    first = trained(OLD, dataclasses.replace(AGENT, learning_rate_steps=100.0), 32)
    moved = {}
    for final in (0.0, 0.1):
        agent = dataclasses.replace(AGENT, learning_rate_steps=100.0, learning_rate_final=final)
        population = Population(NEW, agent, [3, 4])
        population.restore(first.fetch())
        population.advance(20)
        pairs = zip(*(jax.tree.leaves(p.weights()) for p in (population, first)), strict=True)
        moved[final] = max(np.abs(a - b).max() for a, b in pairs)
    assert moved[0.0] == 0
    assert moved[0.1] > 1e-4


@pytest.mark.parametrize("final", [0.0, 1.0])
def test_going_on_keeps_to_its_rate_wherever_the_schedule_was(final):
    agent = dataclasses.replace(AGENT, learning_rate_final=final)
    going_on = Plan(OLD, NEW, agent, EPISODES, rate=0.2).going_on
    assert isinstance(going_on, DQN)
    for update in (1, 100, 10_000):
        rate = float(going_on._schedule(jnp.array(update)))
        assert rate == pytest.approx(0.2 * agent.learning_rate)


def test_renewed_learning_knows_everything_and_remembers_nothing():
    plan = Plan(OLD, NEW, AGENT, EPISODES)
    assert plan.renewed == dataclasses.replace(
        AGENT, learning_rate_steps=75.0, importance_steps=5e4, epsilon_start=0.3
    )
    linear = dataclasses.replace(PLAN, agent=dataclasses.replace(AGENT, epsilon_steps=80.0)).renewed
    assert isinstance(linear, DQN)
    assert linear.epsilon_steps == 40
    learned, fresh = trained(OLD, AGENT).fetch(), Population(NEW, AGENT, [3, 4]).fetch()
    state = renew(AGENT, learned, fresh)
    for name in ("online", "target"):
        for new, old in zip(*(jax.tree.leaves(getattr(x.agent, name)) for x in (state, learned)),
                            strict=True):  # fmt: skip
            np.testing.assert_array_equal(new, old)
    assert np.any(learned.agent.replay.rows)
    assert not np.any(state.agent.replay.rows)
    counters = (state.agent.replay.size, state.agent.episodes, state.agent.steps, state.steps,
                *jax.tree.leaves(state.agent.optimizer))  # fmt: skip
    assert not any(np.any(x) for x in counters)
    assert np.any(learned.agent.episodes)


def test_recovery_is_staying_near_the_optimum():
    curve = [[0.5, 0.09, 0.9], [0.09, 0.11, 0.8], [0.03, 0.02, 0.7], [0.01, 0.1, 0.6]]
    found = recovery(Course([0, 10, 20, 30], curve, [], [], 0.0))
    assert found["per_seed"] == [10, 20, None]


@pytest.mark.parametrize("way", ["first training", "going on", "renewed"])
def test_an_interrupted_comparison_goes_on_as_if_it_never_was(content, way, tmp_path):
    create(PLAN, tmp_path / "stopped", "qfolio continual <b>")
    assert compare(tmp_path / "stopped", Names(stop=way)) is None
    done = Names()
    found = compare(tmp_path / "stopped", done)
    ways = ["first training", *continual.WAYS]
    assert done == ways[ways.index(way) :]

    def lasting(content):
        courses = {"training": content["training"], **content["courses"]}
        return {**content, "started": "", "training": "", "courses": {
            name: {**course, "seconds": 0.0} for name, course in courses.items()}}  # fmt: skip

    assert lasting(found) == lasting(content)
    names = {path.name for path in (tmp_path / "stopped").iterdir()}
    assert names == {"continual.json", "events.jsonl"}


@pytest.mark.parametrize("way", ["first training", "going on"])
def test_a_training_that_ends_while_it_is_stopped_is_kept(way, tmp_path):
    create(PLAN, tmp_path / "stopped", "qfolio continual")
    assert compare(tmp_path / "stopped", Names(way, lambda training: training.finished)) is None
    done = Names(way)
    assert compare(tmp_path / "stopped", done) is not None
    ways = ["first training", *continual.WAYS]
    assert done == ways[ways.index(way) + 1 :]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (Pendulum(horizon=20, torques=5), "only numbers"),
        (Pendulum(horizon=20), "nothing changes"),
    ],
)
def test_refuses_changes_that_make_no_sense(changed, message):
    with pytest.raises(QfolioError, match=message):
        Plan(OLD, changed, AGENT, EPISODES)


def test_an_agent_without_a_schedule_cannot_go_on():
    """It is refused before anything is trained, and before a folder is written."""
    with pytest.raises(QfolioError, match="QLearning has no learning-rate schedule"):
        Plan(OLD, NEW, QLearning(), EPISODES)


def test_what_settings_do_not_describe_is_refused_before_a_folder_is_made(tmp_path):
    class Local(DQN):
        pass

    plan = dataclasses.replace(PLAN, agent=Local(learning_rate_final=0.0))
    with pytest.raises(QfolioError, match=r"^Continual learning takes only what .*:.*Local"):
        create(plan, tmp_path / "run")
    assert not any(tmp_path.iterdir())


def test_there_is_no_share_of_an_optimum_of_zero():
    with pytest.raises(QfolioError, match=r"that of Kelly\(.*probability=0\.4.*\) is 0; choose"):
        Grades(Kelly(probability=0.4))


def test_a_task_without_numbers_cannot_change():
    with pytest.raises(QfolioError, match=r"only numbers .*; Catch has none\.$"):
        Plan(Catch(), Catch(rows=12), AGENT, EPISODES)


def test_only_the_inputs_of_a_program_are_named_as_numbers_that_may_change():
    """A constant such as a cost is a part of the program."""
    task = NoTrade()
    with pytest.raises(QfolioError, match=r"only numbers .*; NoTrade has rate, volatility, dt\.$"):
        Plan(task, dataclasses.replace(task, cost=0.02), AGENT, EPISODES)


def test_a_preset_in_steps_has_a_number_of_episodes(monkeypatch):
    made = []

    def stop(plan, *_):
        made.append(plan)
        raise QfolioError("enough.")

    monkeypatch.setattr(continual, "create", stop)
    words = ("market/liquidation", "--agent", "sac", "--change", "volatility=0.9")
    assert qfolio(monkeypatch, "continual", *words) == 2
    (plan,) = made
    assert preset("fast", "market/liquidation", "sac").budget == Budget(steps=30_000)
    assert plan.episodes == 30_000 / plan.task.horizon


def test_the_report_says_what_happened(content):
    page = render_page(content)
    assert "&lt;b&gt;" in page
    assert "mass from 1 to 1.5" in page
    for way in continual.WAYS:
        assert way in page
    assert "does not settle" in verdict(content)


@pytest.mark.parametrize(("own", "stated"), [(1.0, 0.3), (0.1, 0.1)])
def test_the_report_states_the_exploration_that_a_renewed_agent_begins_with(content, own, stated):
    """That of the experiment, or the agent's own if that is less."""
    plan = dataclasses.replace(PLAN, agent=dataclasses.replace(AGENT, epsilon_start=own))
    assert isinstance(plan.renewed, DQN)
    assert plan.renewed.epsilon_start == stated
    settings = content["agent_settings"] | {"epsilon_start": own}
    assert f"with ε from {stated}." in render_page(content | {"agent_settings": settings})


def test_the_verdict_says_which_way_had_too_few_steps_to_learn(content, tmp_path):
    slow = dataclasses.replace(AGENT, learning_starts=50)
    create(dataclasses.replace(PLAN, agent=slow, renewal=0.1), tmp_path / "run")
    result = compare(tmp_path / "run")
    assert result is not None
    found = verdict(result)
    assert (
        "Renewed learning learns nothing: it begins after 48 environment steps, and a seed has 40."
        in found
    )
    assert "A new agent does not settle" in found
    assert "Going on does not settle" in found
    assert "learns nothing" not in verdict(content)


def test_the_command_writes_a_folder(monkeypatch, tmp_path, capsys):
    folder = tmp_path / "there"
    words = ["continual", "pendulum", "--change", "mass=1.5", "--episodes", 8, "--seeds", 2]
    with monkeypatch.context() as stopping:
        stop = Interrupt().on_chunk
        stopping.setattr(BarProgress, "on_chunk", lambda self, *chunk: stop(*chunk))
        assert qfolio(monkeypatch, *words, "--out", folder, *TINY) == 130
    said = f"Resume with: qfolio continual --resume {folder}"
    assert capsys.readouterr().out.splitlines()[-1].endswith(said)
    assert qfolio(monkeypatch, *words, "--out", folder, *TINY) == 2
    assert f"continue with --resume {folder}" in capsys.readouterr().err
    assert qfolio(monkeypatch, "continual", "--resume", folder) == 0
    assert {path.name for path in folder.iterdir()} == {
        "continual.json", "events.jsonl", "report.html", "recovery.png",
    }  # fmt: skip
    content = json.loads((folder / "continual.json").read_text())
    assert content["changes"] == {"mass": [1.0, 1.5]}
    assert "--change mass=1.5" in content["command"]
    assert "frozen" in capsys.readouterr().out


def test_a_change_without_a_value_is_named_by_its_option(monkeypatch, capsys):
    assert qfolio(monkeypatch, "continual", "--change", "mass") == 2
    assert "--change takes name=value, for example mass=2; not 'mass'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--resume", "nowhere"], "no continual"),
        (["--resume", ".", "--change", "mass=2"], "add only --track and --trust"),
        (["--resume", ".", "--rate", 0.5], "add only --track and --trust"),
    ],
)
def test_resume_refuses_what_it_would_ignore(monkeypatch, capsys, options, message):
    assert qfolio(monkeypatch, "continual", *options) == 2
    assert message in capsys.readouterr().err
