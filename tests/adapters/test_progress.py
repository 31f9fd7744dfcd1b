"""The bar of ``qfolio.Progress``, in a notebook (a stand-in for IPython) and without one."""

import re
import sys
import types

import pytest

import qfolio
from qfolio.experiments.log import Log


@pytest.fixture
def shown(monkeypatch):
    """What a notebook displays, picture after picture."""
    pictures: list[str] = []

    class Handle:
        def update(self, html):
            pictures.append(html)

    shell = types.SimpleNamespace(kernel=object())
    interactive = types.ModuleType("IPython")
    interactive.get_ipython = lambda: shell  # type: ignore[attr-defined]
    display = types.ModuleType("IPython.display")
    display.HTML = str  # type: ignore[attr-defined]
    display.display = lambda html, display_id: Handle()  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "IPython", interactive)
    monkeypatch.setitem(sys.modules, "IPython.display", display)
    return pictures


def train(task="pendulum"):
    with (
        qfolio.tracked(qfolio.Progress()),
        Log(None).opened(kind="backtest", agents=["dqn"], task=task) as log,
    ):
        log.queue(["a", "b"])
        log.write("running", job="a")
        log.job("a").record(5, {"return": [1.0, 3.0, None]}, share=0.5, rate=1234.5)
        log.write("done", job="a")
        log.write("done", job="b")


def test_a_notebook_shows_how_far_it_is(shown, monkeypatch):
    monkeypatch.setattr("qfolio.adapters.progress.EVERY", 0.0)
    train()
    assert any('value="0.2500"' in picture for picture in shown)
    assert any("0 of 2 jobs  return 2  1,234 steps/s" in picture for picture in shown)
    assert 'value="1.0000"' in shown[-1]
    assert "2 of 2 jobs" in shown[-1]


def test_jobs_that_come_later_leave_the_others_as_they_are(shown, monkeypatch):
    """So does a record without a share; returns that are no numbers do not count."""
    monkeypatch.setattr("qfolio.adapters.progress.EVERY", 0.0)
    with qfolio.tracked(qfolio.Progress()), Log(None).opened(kind="run") as log:
        log.queue(["a"])
        log.write("running", job="a")
        log.job("a").record(5, {"return": [1.0]}, share=0.5)
        log.queue(["a", "b"])
        assert 'value="0.2500"' in shown[-1]
        log.write("record", job="a", step=6, values={"return": [4.0, float("nan")]})
        assert 'value="0.2500"' in shown[-1]
        assert "return 4" in shown[-1]
        for job in "ab":
            log.write("done", job=job)
    assert re.search(r"100%  2 of 2 jobs  return 4  \d+\.\d s</div>", shown[-1])


def test_the_time_left_of_a_resumed_training_follows_from_what_was_done_since(shown, monkeypatch):
    monkeypatch.setattr("qfolio.adapters.progress.EVERY", 0.0)
    now = [1.0]
    monkeypatch.setattr("qfolio.adapters.progress.perf_counter", lambda: now[0])
    with qfolio.tracked(qfolio.Progress()), Log(None).opened(kind="run") as log:
        log.write("running", job="", share=0.6)
        assert "60%" in shown[-1]
        assert "left" not in shown[-1]
        now[0] = 11.0
        log.job().record(5, {"return": [1.0]}, share=0.7)
        assert "0:00:30 left" in shown[-1]


def test_a_training_that_was_stopped_does_not_seem_to_go_on(shown):
    with qfolio.tracked(qfolio.Progress()), Log(None).opened(kind="run") as log:
        log.write("running", job="")
        log.job("").record(5, {}, share=0.5)
        log.settle(finished=False)
    assert shown[-1].endswith("stopped</div>")
    assert "left" not in shown[-1]


def test_hostile_names_stay_text(shown):
    train("<img src=x onerror=alert(1)>")
    assert "&lt;img" in shown[-1]
    assert "<img" not in shown[-1]


def test_nothing_is_printed_where_there_is_no_terminal(capsys):
    train()
    assert capsys.readouterr().out == ""
