"""The board in a real browser: it moves, hostile names stay text, other pages see nothing."""

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

import pytest

from qfolio.experiments.events import EVENTS, read
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
    browser.show(board.url, 1280, "document.querySelectorAll('#charts .line').length === 2")
    write(begin, trained("dqn"), {"event": "done", "job": "dqn"})
    browser.wait("document.querySelectorAll('#charts .line').length === 3")
    write({"event": "end", "state": "done", "pid": 1, "host": "h"})
    browser.wait("document.querySelectorAll('#charts .line').length === 1")
    assert "dqn/0" not in browser.evaluate("document.body.innerText")


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
    axes = [[-1478, -1469], [101.2, 101.9], [-0.35, 0.2], [0, 2e6], [1.2345e6, 1.2352e6], [0, 3e12]]
    said = browser.evaluate(f"{axes}.map((axis) => ticks(axis, 4).map(short).join(' '))")
    assert said == [
        "−1477.5 −1475 −1472.5 −1470",
        "101.2 101.4 101.6 101.8",
        "−0.2 0 0.2",
        "0 500k 1M 1.5M 2M",
        "1.2346M 1.2348M 1.235M 1.2352M",
        "0 1e+12 2e+12 3e+12",
    ]


def test_a_time_of_almost_two_hours_is_two_hours(board: Board, browser: Browser) -> None:
    browser.show(board.url, 1280)
    times = [89, 90, 5369, 5370, 7169, 7170, 172_769, 172_770]
    said = browser.evaluate(f"{times}.map(span).map((text) => text.replaceAll(THIN, ' '))")
    hours = ["1 h 30 min", "1 h 59 min", "2 h 0 min", "47 h 59 min"]
    assert said == ["89 s", "2 min", "89 min", *hours, "2 days"]


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
