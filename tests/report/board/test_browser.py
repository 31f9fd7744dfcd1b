"""The board in a real browser: it moves, hostile names stay text, other pages see nothing."""

import itertools
import json
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from qfolio.experiments.events import EVENTS, read
from qfolio.report.board import shelf
from qfolio.report.board.server import Board

from browser import Browser

ELSEWHERE = """
import sys, time
from pathlib import Path
from qfolio.experiments.log import Log
folder = Path(sys.argv[1])
print("ready", flush=True)
sys.stdin.readline()
folder.mkdir()
with Log(folder).opened(kind="run", task="pendulum", agents=["dqn"], seeds=2) as log:
    job = log.job(members=["seed 0", "seed 1"])
    log.write("running", job="", step=0, members=job.members)
    for step in range(1, 60):
        job.record(100 * step, {"return": [-100.0 / step, -90.0 / step]}, share=step / 60)
        time.sleep(0.2)
"""

WATCH = """
window.shown = [];
(function look() {
  const line = document.querySelector("#charts .line");
  const points = line ? line.getAttribute("d").match(/[ML]/g).length : 0;
  if (points > (shown.at(-1)?.[0] || 0)) shown.push([points, Date.now() / 1000]);
  setTimeout(look, 20);
})();
"""
"""The page notes itself when its chart first shows how many points."""

HOSTILE = "<img src=x onerror=document.body.remove()>"


@pytest.fixture
def board(tmp_path: Path) -> Iterator[Board]:
    (tmp_path / "runs").mkdir()
    with Board(tmp_path / "runs", 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


def write(folder: Path, **about: object) -> None:
    folder.mkdir(parents=True)
    start = {"event": "start", "time": time.time(), "kind": "run", "pid": 1, "host": "h", **about}
    values = {HOSTILE: [1.0, 2.0], "return": [3.0, 4.0]}
    events = [
        start,
        {"event": "running", "time": 1, "job": HOSTILE, "worker": HOSTILE, "members": ["a", "b"]},
        *(
            {"event": "record", "time": 1, "job": HOSTILE, "step": k, "values": values}
            for k in "12"
        ),
        *(
            {"event": "record", "time": 1, "job": HOSTILE, "step": k, "values": values}
            for k in (1, 2)
        ),
        {"event": "result", "values": {HOSTILE: {HOSTILE: 1.0}}},
    ]
    (folder / EVENTS).write_text("".join(json.dumps(event) + "\n" for event in events))


def test_a_run_started_elsewhere_appears_and_moves(
    board: Board,
    browser: Browser,
    tmp_path: Path,
) -> None:
    browser.complaints.clear()
    with subprocess.Popen(
        [sys.executable, "-c", ELSEWHERE, str(tmp_path / "runs" / "elsewhere")],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=os.environ,
    ) as process:  # fmt: skip
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdout.readline()
        browser.show(board.url, 1280, "!document.getElementById('none').hidden")
        browser.evaluate(WATCH)
        process.stdin.write("go\n")
        process.stdin.flush()
        browser.wait("shown.length === 4")
        assert browser.evaluate("document.querySelector('#title').textContent") == "elsewhere"
        shown = browser.evaluate("shown")
        process.kill()
    events, _ = read(tmp_path / "runs" / "elsewhere" / EVENTS, 0)
    written = [event["time"] for event in events if event["event"] == "record"]
    first = 0  # of the records that the page does not show yet
    for points, moment in shown:
        assert moment - written[first] < 2
        first = points
    assert browser.complaints == []


def test_hostile_names_stay_text(
    board: Board,
    browser: Browser,
    tmp_path: Path,
) -> None:
    browser.complaints.clear()
    write(tmp_path / "runs" / HOSTILE, task=HOSTILE, agents=[HOSTILE])
    write(tmp_path / "runs" / "other", task="<script>", agents=["</script>"])
    browser.show(board.url, 1280, "document.querySelectorAll('#charts .line').length > 0")
    browser.evaluate("document.querySelectorAll('.pick').forEach((pick) => pick.click())")
    browser.evaluate("document.querySelectorAll('.pick').forEach((pick) => pick.click())")
    browser.evaluate("document.querySelectorAll('.item').forEach((item) => item.click())")
    browser.wait("document.querySelectorAll('#charts .chart').length === 2")
    text = browser.evaluate("document.body.innerText")
    assert HOSTILE in text
    assert browser.evaluate("document.querySelectorAll('img, script:not([src])').length") == 0
    assert browser.complaints == []


def test_runs_are_compared(board: Board, browser: Browser, tmp_path: Path) -> None:
    for name in ("first", "second"):
        write(tmp_path / "runs" / name, agents=["dqn"])
    browser.show(board.url, 1280, "document.querySelectorAll('#charts .line').length > 0")
    browser.click("#runs li:not(.chosen) .pick")
    browser.wait("document.querySelectorAll('#charts .chart:first-child .line').length === 2")
    lines = "[...document.querySelectorAll('#charts .chart:first-child .line')]"
    colors = browser.evaluate(f"{lines}.map((line) => getComputedStyle(line).stroke)")
    assert len(set(colors)) == 2
    names = browser.evaluate("document.getElementById('legend').innerText")
    assert "first" in names
    assert "second" in names


def test_the_report_that_is_opened_is_that_of_the_run_shown(
    board: Board, browser: Browser, tmp_path: Path
) -> None:
    for name in ("first", "second"):
        write(tmp_path / "runs" / name, agents=["dqn"])
        (tmp_path / "runs" / name / "report.html").write_text(f"<title>{name}</title>")
    browser.show(board.url, 1280, "document.querySelector('#lede a') !== null")
    title, link = (f"document.querySelector('{at}')" for at in ("#title", "#lede a"))
    shown = browser.evaluate(f"{title}.textContent"), browser.evaluate(f"{link}.href")
    browser.click("#runs li:not(.chosen) .item")
    browser.wait(f"{title}.textContent !== '{shown[0]}'")
    assert browser.evaluate(f"{link}.href") != shown[1]


def test_a_run_that_is_deleted_leaves_the_page(
    board: Board, browser: Browser, tmp_path: Path
) -> None:
    for name in ("first", "second"):
        write(tmp_path / "runs" / name, agents=["dqn"])
    browser.show(board.url, 1280, "document.querySelectorAll('#charts .line').length > 0")
    browser.click("#runs li:not(.chosen) .pick")
    browser.wait("document.getElementById('title').innerText === '2 runs side by side'")
    shutil.rmtree(tmp_path / "runs" / "first")
    browser.wait("document.getElementById('title').innerText === 'second'")
    shutil.rmtree(tmp_path / "runs" / "second")
    browser.wait("document.getElementById('shown').hidden")
    assert browser.evaluate("document.getElementById('counts').innerText") == "No runs yet"


def test_jobs_that_work_was_divided_into_before_leave_the_page(
    board: Board, browser: Browser, tmp_path: Path
) -> None:
    log = tmp_path / "runs" / "mine" / EVENTS
    log.parent.mkdir()

    def write(*events: dict[str, object]) -> None:
        with log.open("a") as file:
            file.writelines(json.dumps({"time": time.time(), **event}) + "\n" for event in events)

    def trained(job: str) -> dict[str, object]:
        return {"event": "record", "job": job, "step": 9, "values": {"return": [1.0]}}

    begin = {"event": "start", "kind": "comparison", "agents": ["dqn"], "pid": 1, "host": "h"}
    write(begin, trained("dqn/0"), trained("dqn/1"))
    said = "[...document.querySelectorAll('.cell')].map((cell) => cell.title.split(' ')[0]).join()"
    browser.show(board.url, 1280, f"{said} === 'dqn/0,dqn/1'")
    write(begin, trained("dqn"), {"event": "done", "job": "dqn"})
    browser.wait(f"{said} === 'dqn/0,dqn/1,dqn'")
    (line,) = browser.evaluate(
        "linesOf(groups()[0], 'return').map((line) => [line.job.name, line.alone])"
    )
    assert line == ["dqn", True]
    write({"event": "end", "state": "done", "pid": 1, "host": "h"})
    browser.wait("document.getElementById('jobs').hidden")
    jobs = "[...details.values()].flatMap((detail) => [...detail.jobs.keys()])"
    assert browser.evaluate(jobs) == ["dqn"]
    assert browser.evaluate("document.querySelectorAll('#charts .line').length") == 1


def test_a_metric_may_be_named_like_what_each_object_has(
    board: Board, browser: Browser, tmp_path: Path
) -> None:
    write(tmp_path / "runs" / "plain", agents=["dqn"])
    write(tmp_path / "runs" / "odd", agents=["dqn"])
    log = tmp_path / "runs" / "odd" / EVENTS
    log.write_text(log.read_text().replace('"return"', '"constructor"'))
    browser.show(board.url, 1280, "document.querySelectorAll('#charts .line').length > 0")
    browser.click("#runs li:not(.chosen) .pick")
    browser.wait("document.getElementById('charts').innerText.includes('Constructor')")
    # The runs have, after ten seconds without a sign of life.
    assert "server has stopped" not in browser.evaluate(
        "document.getElementById('counts').innerText"
    )


def test_agents_of_a_backtest_have_charts_of_their_own(
    board: Board, browser: Browser, tmp_path: Path
) -> None:
    folder = tmp_path / "runs" / "us20"
    folder.mkdir(parents=True)
    records = [("tilts/2001", 100_000, 0.001), ("tilts/2002", 90_000, 0.002), ("dqn/2001", 900, 9)]
    events = [
        {"event": "start", "time": 1, "kind": "backtest", "agents": ["tilts", "dqn"]},
        *(
            {"event": "record", "time": 1, "job": job, "step": step, "values": {"loss": [loss]}}
            for job, last, loss in records
            for step in (last / 2, last)
        ),
    ]
    (folder / EVENTS).write_text("".join(json.dumps(event) + "\n" for event in events))
    browser.show(board.url, 1280, "document.querySelectorAll('#charts .line').length === 3")
    charts = "[...document.querySelectorAll('#charts .chart')]"
    titles = browser.evaluate(
        f"{charts}.map((chart) => chart.querySelector('h3').innerText.trim())"
    )
    assert [title.split("\n")[0] for title in titles] == ["Loss · tilts", "Loss · dqn"]
    lines = browser.evaluate(f"{charts}.map((chart) => chart.querySelectorAll('.line').length)")
    assert lines == [2, 1]
    # The last step of each agent is at the right edge of its own chart.
    right = "getBoundingClientRect().right"
    ends = browser.evaluate(
        f"{charts}.map((chart) => chart.querySelector('svg').{right} - "
        f"Math.max(...[...chart.querySelectorAll('.line')].map((line) => line.{right})))"
    )
    assert all(0 <= end < 10 for end in ends)


def test_an_axis_far_from_zero_names_its_ticks_in_full(board: Board, browser: Browser) -> None:
    browser.show(board.url, 1280)
    axes = [[-1478, -1469], [101.2, 101.9], [-0.35, 0.2], [1.2345e6, 1.2352e6], [0, 3e12]]
    said = browser.evaluate(f"{axes}.map((axis) => labels(ticks(axis, 4)).join(' '))")
    assert said == [
        "−1477.5 −1475 −1472.5 −1470",
        "101.2 101.4 101.6 101.8",
        "−0.2 0 0.2",
        "1.2346M 1.2348M 1.235M 1.2352M",
        "0 1e+12 2e+12 3e+12",
    ]


def test_the_axis_of_a_number_that_is_rounded_twice_is_that_of_one(
    board: Board, browser: Browser
) -> None:
    browser.show(board.url, 1280)
    axes = browser.evaluate("[[0.2, 0.2], [0.2, 0.2 + 3e-9], [0, 0]].map((x) => range(x))")
    np.testing.assert_allclose(axes, [[0.1784, 0.2216]] * 2 + [[-1.08, 1.08]], rtol=1e-6)


def test_the_ticks_of_an_axis_have_one_unit(board: Board, browser: Browser) -> None:
    browser.show(board.url, 1280)
    axes = [[0, 2e6], [0, 10_240], [0, 9000], [0, 2.1e-5], [-4e-4, 0], [0, 0]]
    said = browser.evaluate(f"{axes}.map((axis) => labels(ticks(axis, 4)).join(' '))")
    assert said == [
        "0 0.5M 1M 1.5M 2M",
        "0 5k 10k",
        "0 2500 5000 7500",
        "0 1e−5 2e−5",
        "−0.0004 −0.0003 −0.0002 −0.0001 0",
        "0",
    ]


def test_a_time_of_almost_two_hours_is_two_hours(board: Board, browser: Browser) -> None:
    browser.show(board.url, 1280)
    times = [89, 90, 5369, 5370, 7169, 7170, 172_769, 172_770]
    said = browser.evaluate(f"{times}.map(span).map((text) => text.replaceAll(THIN, ' '))")
    hours = ["1 h 30 min", "1 h 59 min", "2 h 0 min", "47 h 59 min"]
    assert said == ["89 s", "2 min", "89 min", *hours, "2 days"]


def finished(folder: Path, kind: str, agents: list[str], *events: dict[str, Any]) -> None:
    """Writes the log of a run that has ended; each job of a record has one member."""
    folder.mkdir(parents=True)
    now, here = time.time(), {"pid": 1, "host": "h"}
    whole = [
        {"event": "start", "time": now, "kind": kind, "agents": agents, **here},
        *({"time": now, **event} for event in events),
        {"event": "end", "time": now, "state": "done", **here},
    ]
    (folder / EVENTS).write_text("".join(json.dumps(event) + "\n" for event in whole))


def curve(job: str, *values: float, of: str = "return", steps: float = 10) -> list[dict[str, Any]]:
    records = [
        {"event": "record", "job": job, "step": steps * k, "values": {of: [value]}}
        for k, value in enumerate(values, 1)
    ]
    members = {"event": "running", "job": job, "step": 0, "members": [job]}
    return [members, *records, {"event": "done", "job": job}]


def test_what_was_never_known_has_no_chart(board: Board, browser: Browser, tmp_path: Path) -> None:
    unknown = {"event": "record", "job": "", "step": 10, "values": {"overestimation": [None]}}
    finished(tmp_path / "runs" / "a", "run", ["dqn"], unknown, *curve("", 1.0, 2.0))
    browser.show(board.url, 1280, "document.querySelectorAll('#charts .line').length === 1")
    assert browser.evaluate("document.querySelectorAll('#charts .chart').length") == 1


def test_a_run_has_the_color_of_its_place_in_the_list(
    board: Board, browser: Browser, tmp_path: Path
) -> None:
    """The second run had the color of the first one's second job."""
    apart = [event for seed in "012" for event in curve(f"dqn/{seed}", 1.0, 2.0)]
    finished(tmp_path / "runs" / "seeds", "run", ["dqn"], *apart)
    both = [*curve("dqn", 3.0, 4.0), *curve("ppo", 5.0, 6.0)]
    finished(tmp_path / "runs" / "two", "comparison", ["dqn", "ppo"], *both)
    finished(tmp_path / "runs" / "one", "run", ["dqn"], *curve("", 7.0, 8.0))
    browser.show(board.url, 1280, "runs.size === 3")
    browser.evaluate("choose(['seeds', 'two', 'one'].map((name) => "
                     "[...runs.values()].find((run) => run.name === name).key))")  # fmt: skip
    browser.wait("document.querySelectorAll('#charts .line').length === 4")
    inside = "getComputedStyle(item.querySelector('.pick span')).backgroundColor"
    places = browser.evaluate(
        "Object.fromEntries([...document.querySelectorAll('#runs li')].map((item) => "
        f"[item.querySelector('.name').textContent, {inside}]))"
    )
    marks = browser.evaluate(
        "[...document.querySelectorAll('#legend li')].map((item) => { "
        "const style = getComputedStyle(item.querySelector('path')); "
        "return [item.textContent, style.stroke, style.strokeDasharray]; })"
    )
    assert [mark[0] for mark in marks] == ["seeds", "two · dqn", "two · ppo", "one"]
    assert len(set(places.values())) == 3
    assert [mark[1] for mark in marks] == [places[name] for name in ("seeds", "two", "two", "one")]
    dashes = [mark[2] for mark in marks]
    assert dashes[0] == dashes[1] == dashes[3] != dashes[2]


def test_forty_curves_differ_in_color_or_dash(
    board: Board, browser: Browser, tmp_path: Path
) -> None:
    jobs = [event for trial in range(40) for event in curve(f"trial {trial}", 1.0, 2.0)]
    finished(tmp_path / "runs" / "search", "search", ["dqn"], *jobs)
    browser.show(board.url, 1280, "document.querySelectorAll('#charts .line').length === 40")
    looks = browser.evaluate("groups().map((group) => group.color + group.dash)")
    assert len(set(looks)) == 40


def test_seeds_that_train_apart_are_drawn_as_if_together(
    board: Board, browser: Browser, tmp_path: Path
) -> None:
    """One is logged at other steps, and its last record comes a little earlier."""
    first, second = curve("dqn/0", 0.0, 10.0, 20.0), curve("dqn/1", 4.0, 24.0, steps=14)
    second[0]["members"] = ["seed 1", "seed 2", "seed 3"]
    finished(tmp_path / "runs" / "seeds", "run", ["dqn"], *first, *second)
    browser.show(board.url, 1280, "document.querySelectorAll('#charts .line').length === 1")
    assert browser.evaluate("document.querySelectorAll('#charts .band').length") == 1
    points = browser.evaluate("linesOf(groups()[0], 'return')[0].points")
    there = 4 + 20 * 6 / 14  # on the line between the second one's points
    assert points == [
        [10, 3, 0, 4],  # the second job has three of the four seeds
        [20, pytest.approx((10 + 3 * there) / 4), 10, pytest.approx(there)],
        [30, 23, 20, 24],
    ]
    assert browser.evaluate("document.querySelectorAll('.cell').length") == 2


RESULT = {"growth": -0.00001, "volatility": 0.10125, "sharpe": 0.5325, "drawdown": 0.1263,
          "turnover": 95.714, "cost_drag": 0.00038951, "regret": 7.8151}  # fmt: skip


def test_results_are_percents_where_they_are_shares(
    board: Board, browser: Browser, tmp_path: Path
) -> None:
    said = {"event": "result", "values": {"dqn": RESULT, "ppo": {"growth": -0.031, "regret": None}}}
    finished(tmp_path / "runs" / "us", "backtest", ["dqn", "ppo"], *curve("dqn/2001", 1.0), said)
    browser.show(board.url, 1280, "!document.getElementById('results').hidden")
    cells = "[...document.querySelectorAll('#results-rows tr')].map((row) => row.innerText)"
    first, second = (row.split("\t") for row in browser.evaluate(cells))
    assert first == ["dqn", "0.00%", "10.13%", "0.532", "12.63%", "95.71", "0.04%", "781.51%"]
    assert second == ["ppo", "−3.10%", "–", "–", "–", "–", "–", "–"]


def test_results_come_before_the_curves_and_keep_words_whole_on_a_phone(
    board: Board, browser: Browser, tmp_path: Path
) -> None:
    names = ["pathwise-together", "equal-weight", HOSTILE, "x" * 300]
    said = {"event": "result", "values": dict.fromkeys(names, RESULT)}
    finished(tmp_path / "runs" / "us", "backtest", ["dqn"], *curve("dqn/2001", 1.0), said)
    browser.show(board.url, 390, "!document.getElementById('results').hidden", phone=True)
    results, curves = (
        f"document.getElementById('{name}').offsetTop" for name in ("results", "curves")
    )
    assert browser.evaluate(f"{results} < {curves}")
    first = "[...document.querySelectorAll('#results-rows td:first-child')]"
    assert all(wide >= 112 for wide in browser.evaluate(f"{first}.map((cell) => cell.offsetWidth)"))
    lines = browser.evaluate(  # of each word, which a hyphen may divide
        f"{first}.slice(0, 2).map((cell) => {{ const text = cell.firstChild; let end = 0; "
        "return text.data.split(/(?<=-)/).map((word) => { const range = document.createRange(); "
        "range.setStart(text, end); range.setEnd(text, end += word.length); "
        "return new Set([...range.getClientRects()].map((box) => box.top)).size; }); })"
    )
    assert lines == [[1, 1], [1, 1]]
    assert browser.evaluate("document.documentElement.scrollWidth") <= 390


def test_results_of_a_backtest_fit_a_laptop(board: Board, browser: Browser, tmp_path: Path) -> None:
    values = {**RESULT, "sortino": 0.8124, "calmar": 0.4312, "growth": 1.2511}
    del values["regret"]
    said = {"event": "result", "values": {"equal-weight-monthly": values}}
    finished(tmp_path / "runs" / "us", "backtest", ["dqn"], *curve("dqn/2001", 1.0), said)
    browser.show(board.url, 1200, "!document.getElementById('results').hidden")
    frame = "document.querySelector('#results .scroll')"
    assert browser.evaluate(f"{frame}.scrollWidth <= {frame}.clientWidth")


def test_a_study_shows_what_it_found(board: Board, browser: Browser, tmp_path: Path) -> None:
    found = {"active_growth": 0.029, "low": 0.02, "high": 0.039, "z": 6.4}
    said = {"event": "result", "values": {"tilts": found}}
    finished(tmp_path / "runs" / "a", "study", ["tilts"], *curve("us/lag1/tilts/2001", 1.0), said)
    browser.show(board.url, 1280, "!document.getElementById('results').hidden")
    rows = browser.evaluate("document.getElementById('results-rows').innerText").split()
    assert rows == ["tilts", "2.90%", "2.00%", "3.90%", "6.40"]


def test_the_page_says_that_folders_were_left_out(
    board: Board, browser: Browser, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("first", "second", "third"):
        finished(tmp_path / "runs" / name, "run", ["dqn"], *curve("", 1.0))
    monkeypatch.setattr(shelf, "FOLDERS", 3)
    browser.show(board.url, 1280, "runs.size === 2")
    said = browser.evaluate("document.getElementById('counts').innerText")
    assert said == "2 done · only the nearest 3 folders are searched"


def test_a_filter_says_how_many_runs_match(board: Board, browser: Browser, tmp_path: Path) -> None:
    for name in ("first", "second", "third"):
        finished(tmp_path / "runs" / name, "run", ["dqn"], *curve("", 1.0))
    browser.show(board.url, 1280, "runs.size === 3")

    def found(text: str) -> list[str]:
        return browser.evaluate(
            f"find('filter').value = '{text}'; list(); "
            "['counts', 'unmatched'].map((id) => find(id).hidden ? '' : find(id).innerText)"
        )

    assert found("") == ["3 done", ""]
    assert found("dqn") == ["3 done", ""]
    assert found("second") == ["1 of 3 runs · 1 done", ""]
    assert found("xyz") == ["0 of 3 runs", "No run matches this filter."]


@pytest.mark.parametrize(("width", "phone"), [(1280, False), (390, True)])
def test_labels_of_an_axis_stay_in_its_column_and_are_spaced_evenly(
    board: Board, browser: Browser, tmp_path: Path, width: int, phone: bool
) -> None:
    values = curve("", 1000.018, 1000.019, 1000.022, of="loss", steps=100_000)
    finished(tmp_path / "runs" / "mine", "run", ["dqn"], *values)
    browser.show(board.url, width, "document.querySelectorAll('#charts .line').length === 1",
                 phone=phone)  # fmt: skip
    box = "getBoundingClientRect()"
    left, right, texts = browser.evaluate(
        f"(() => {{ const svg = document.querySelector('#charts svg'), at = svg.{box}; "
        "return [at.left, at.right, [...svg.querySelectorAll('text')].map((text) => "
        f"{{ const at = text.{box}; return [at.left, at.right, at.top]; }})]; }})()"
    )
    assert all(left - 1 <= text[0] and text[1] <= right + 10 for text in texts)
    low = max(text[2] for text in texts)
    middles = [(text[0] + text[1]) / 2 for text in texts if text[2] == low]
    gaps = [b - a for a, b in itertools.pairwise(middles)]
    assert len(gaps) >= 2
    assert max(gaps) - min(gaps) < 1


@pytest.mark.parametrize("content", ["", "no log"])
def test_a_log_that_says_nothing_has_no_time(
    board: Board, browser: Browser, tmp_path: Path, content: str
) -> None:
    folder = tmp_path / "runs" / "odd"
    folder.mkdir()
    (folder / EVENTS).write_text(content)
    os.utime(folder / EVENTS, (1, 1))
    browser.show(board.url, 1280, "!document.getElementById('shown').hidden")
    lede = browser.evaluate("document.getElementById('lede').innerText")
    assert lede == "Stopped. Its log says nothing that can be read."
    assert browser.evaluate("document.getElementById('facts').innerText") == ""


EVIL = """<!doctype html><script>
const target = "%s";
const tries = {
  read: () => fetch(target + "runs").then((answer) => answer.text()),
  opaque: () => fetch(target + "runs", {mode: "no-cors"}).then((answer) => answer.text()),
  script: () => new Promise((done, fail) => {
    const made = document.createElement("script");
    Object.assign(made, {src: target + "board.js", onload: done, onerror: fail});
    document.head.append(made);
  }),
  frame: () => new Promise((done, fail) => {
    const made = document.createElement("iframe");
    made.src = target;
    made.onload = () => {
      try { done(made.contentWindow.document.body.innerHTML); } catch (error) { fail(error); }
    };
    document.documentElement.append(made);
  }),
};
window.outcome = Promise.all(Object.entries(tries).map(([name, attempt]) =>
  attempt().then((found) => [name, "got " + found], () => [name, "failed"])
)).then(Object.fromEntries);
</script>"""


def test_another_page_cannot_read_it(
    board: Board,
    browser: Browser,
    tmp_path: Path,
) -> None:
    write(tmp_path / "runs" / "secret")

    class Evil(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            content = (EVIL % board.url).encode()
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *args: object) -> None:
            pass

    # A thread for each connection: Chromium opens one ahead, and says nothing there for a minute.
    with ThreadingHTTPServer(("127.0.0.1", 0), Evil) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser.show(f"http://127.0.0.1:{server.server_port}/", 800)
        outcome = browser.evaluate("window.outcome")
        server.shutdown()
    assert outcome.keys() == {"read", "opaque", "script", "frame"}
    assert set(outcome.values()) == {"failed"}
