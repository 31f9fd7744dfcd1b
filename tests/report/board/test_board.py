"""The board's reading of logs, and its server."""

import http.client
import json
import os
import threading
import time
from itertools import count
from pathlib import Path
from unittest.mock import Mock

import pytest

from qfolio.core.errors import QfolioError
from qfolio.experiments import events
from qfolio.experiments.events import EVENTS, SILENT
from qfolio.experiments.log import Log
from qfolio.report.board import experiment as experiments
from qfolio.report.board import shelf as shelves
from qfolio.report.board.experiment import POINTS, Experiment
from qfolio.report.board.server import Board
from qfolio.report.board.shelf import Shelf


def write(folder, *events):
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / EVENTS).open("a") as file:
        file.writelines(json.dumps({"time": time.time(), **event}) + "\n" for event in events)


def start(**about):
    return {"event": "start", "kind": "run", "agents": ["dqn"], "pid": 1, "host": "h", **about}


def record(step, value, job=""):
    return {"event": "record", "job": job, "step": step, "share": 0.5,
            "values": {"return": [value, value + 2]}}  # fmt: skip


RUNNING = {"event": "running", "job": "", "step": 0, "members": ["a", "b"]}
END = {"event": "end", "state": "done", "pid": 1, "host": "h"}


def read_again(folder):
    experiment = Experiment(folder.name, folder / EVENTS)
    experiment.refresh(1)
    return experiment


def test_states_follow_from_the_log_and_its_touch(tmp_path):
    write(tmp_path, start(), RUNNING)
    assert read_again(tmp_path).state == "running"
    silent = time.time() - SILENT - 1
    os.utime(tmp_path / EVENTS, (silent, silent))  # killed
    assert read_again(tmp_path).state == "stopped"
    write(tmp_path, start(pid=2), {**END, "pid": 2})  # resumed
    assert read_again(tmp_path).state == "done"


@pytest.mark.parametrize("hours", [-1, 1])
def test_a_run_moves_whatever_the_clock_says(tmp_path, hours):
    """A run that was killed before the clock was put back would run until that time came again."""
    write(tmp_path, start(), RUNNING)
    there = time.time() + 3600 * hours
    os.utime(tmp_path / EVENTS, (there, there))
    experiment = read_again(tmp_path)
    assert experiment.state == "stopped"
    os.utime(tmp_path / EVENTS, (there + 2, there + 2))  # it lives, on a server with that clock
    experiment.refresh(2)
    assert experiment.state == "running"


def test_a_search_runs_as_long_as_one_of_its_processes_does(tmp_path):
    write(tmp_path, start(kind="search"), start(kind="search", pid=2), END)
    assert read_again(tmp_path).state == "running"
    write(tmp_path, {**END, "pid": 2, "state": "stopped"})
    assert read_again(tmp_path).state == "stopped"


def test_a_search_that_was_killed_was_paused_until_it_goes_on(tmp_path):
    write(tmp_path, start(kind="search", time=0.0), {**RUNNING, "time": 100.0})
    write(tmp_path, start(kind="search", pid=2, time=130.0))  # joins it
    assert read_again(tmp_path).paused == 0
    write(tmp_path, start(kind="search", pid=3, time=86_530.0), {**END, "pid": 3, "time": 86_540.0})
    experiment = read_again(tmp_path)
    assert (experiment.paused, experiment.state) == (86_400.0, "done")


def test_a_resumed_job_counts_nothing_twice(tmp_path):
    write(tmp_path, start(), RUNNING, *(record(step, step) for step in (10, 20, 30)))
    write(tmp_path, start(), {**RUNNING, "step": 20}, *(record(step, -step) for step in (30, 40)))
    curve = read_again(tmp_path).jobs[""].curves["return"]
    assert [point[:2] for point in curve.points] == [(10, 11), (20, 21), (30, -29), (40, -39)]


def test_pauses_are_no_work_and_old_jobs_are_no_backlog(tmp_path):
    """A backtest that was killed on workers and resumed a day later in other groups."""
    groups = {"event": "queued", "jobs": ["dqn/1", "dqn/2"]}
    write(tmp_path, start(time=0.0), groups, {**RUNNING, "job": "dqn/1", "time": 1.0},
          {**record(9, 1.0, "dqn/1"), "share": 0.9, "left": 1.0, "time": 10.0})  # fmt: skip
    write(tmp_path, start(time=86_410.0), {"event": "queued", "jobs": ["dqn"]},
          {**RUNNING, "job": "dqn/1", "time": 86_411.0, "share": 0.2})  # fmt: skip
    experiment = read_again(tmp_path)
    assert experiment.summary("k")["paused"] == 86_400.0
    job = experiment.jobs["dqn/1"]
    assert (job.share, job.left) == (0.2, None)  # from its last checkpoint
    write(tmp_path, {**RUNNING, "job": "dqn"}, {"event": "done", "job": "dqn"}, END)
    done = read_again(tmp_path).summary("k")
    assert (done["jobs"], done["share"]) == ({"done": 1}, 1.0)
    experiment.refresh(2)
    assert experiment.detail(2)["names"] == ["dqn"]  # a page that was open forgets the others


def test_a_run_that_has_stopped_has_no_workers(tmp_path):
    job = {**RUNNING, "job": "dqn/0", "worker": "process 7 on h"}
    write(tmp_path, start(), job, {**record(9, 1.0, "dqn/0"), "rate": 100.0})
    summary = read_again(tmp_path).summary("k")
    assert (summary["workers"], summary["rate"]) == (1, 100.0)
    write(tmp_path, {**END, "state": "stopped"})  # Ctrl-C ends workers at once
    summary = read_again(tmp_path).summary("k")
    assert (summary["workers"], summary["rate"]) == (0, None)


def test_it_reads_on_where_it_stopped(tmp_path):
    write(tmp_path, start(), RUNNING, record(1, 1.0))
    experiment = read_again(tmp_path)
    first, *others = (tmp_path / EVENTS).read_bytes().splitlines(keepends=True)
    unreadable = b"?" * (sum(map(len, others)) - 1) + b"\n"
    (tmp_path / EVENTS).write_bytes(first + unreadable)  # is not read again
    write(tmp_path, record(2, 2.0))
    experiment.refresh(2)
    assert [point[0] for point in experiment.jobs[""].curves["return"].points] == [1, 2]


def test_another_run_in_the_same_folder_takes_the_place_of_the_first(tmp_path):
    """Its log may even have the same inode."""
    jobs = [{**RUNNING, "job": name} for name in ("a", "b")]
    write(tmp_path, start(task="old"), *jobs, record(1, 1.0, "a"), {**END, "state": "failed"})
    experiment, log = read_again(tmp_path), tmp_path / EVENTS
    before = log.read_bytes()
    log.write_bytes(b"")
    later = {"time": time.time() + 60}
    write(tmp_path, start(task="new", **later), {**RUNNING, "job": "b"})
    write(tmp_path, *(record(step, step, "b") for step in range(20)))
    assert log.stat().st_size > len(before)
    experiment.refresh(2)
    found = experiment.summary("key")
    assert (found["task"], found["state"], found["begun"]) == ("new", "running", later["time"])
    detail = experiment.detail(0)
    assert [job["name"] for job in detail["jobs"]] == detail["names"] == ["b"]
    assert len(detail["jobs"][0]["curves"]["return"]) == 20


def test_a_log_that_was_cut_is_read_again(tmp_path):
    write(tmp_path, start(), RUNNING, *(record(step, step) for step in range(9)))
    experiment, log = read_again(tmp_path), tmp_path / EVENTS
    log.write_bytes(b"".join(log.read_bytes().splitlines(keepends=True)[:4]))
    experiment.refresh(2)
    assert len(experiment.jobs[""].curves["return"].points) == 2
    write(tmp_path, record(20, 1.0))
    experiment.refresh(3)
    assert [point[0] for point in experiment.jobs[""].curves["return"].points] == [0, 1, 20]


def test_a_long_log_is_read_in_several_answers(tmp_path, monkeypatch):
    """On a clock on which each look at it takes a second."""
    monkeypatch.setattr(events, "CHUNK", 100)
    monkeypatch.setattr(experiments, "time", Mock(perf_counter=count().__next__, time=time.time))
    write(tmp_path, start(), RUNNING, *(record(step, step) for step in range(50)))
    experiment = Experiment(tmp_path.name, tmp_path / EVENTS)
    known = []
    for version in range(20):
        experiment.refresh(version, until=5 * (version + 1))
        known.append(len(experiment.jobs[""].curves["return"].points))
    assert 0 < known[0] < known[1] < 50
    assert known[-1] == 50


def test_a_log_that_is_still_being_read_has_no_state_yet(tmp_path, monkeypatch):
    """A finished run was shown as stopped until the end of its log had been read."""
    monkeypatch.setattr(shelves, "FRESH", -1.0)
    for name in ("a", "b"):
        write(tmp_path / name, start(), {**END, "state": "done"})
    shelf = Shelf(tmp_path)
    monkeypatch.setattr(shelves, "READING", -1.0)  # no time to read anything
    news = shelf.runs(0)
    assert (news["keys"], news["runs"], news["reading"]) == ([], [], 2)
    monkeypatch.setattr(shelves, "READING", 60.0)
    news = shelf.runs(news["version"])
    assert [run["state"] for run in news["runs"]] == ["done", "done"]
    assert (len(news["keys"]), news["reading"]) == (2, 0)


def test_a_page_gets_few_points_of_many_curves(monkeypatch, tmp_path):
    monkeypatch.setattr(experiments, "SHOWN", 60)
    jobs = [{**RUNNING, "job": name} for name in "abc"]
    write(
        tmp_path,
        start(),
        *jobs,
        *(record(step, step, name) for step in range(90) for name in "abc"),
    )
    for job in read_again(tmp_path).detail(0)["jobs"]:
        points = job["curves"]["return"]
        assert 10 <= len(points) <= 20
        assert points[-1][0] == 89


def test_long_logs_are_kept_short(tmp_path):
    write(tmp_path, start(), RUNNING, *(record(step, step) for step in range(20_000)))
    points = read_again(tmp_path).jobs[""].curves["return"].points
    assert POINTS / 3 < len(points) <= POINTS
    assert points[0][0] == 0
    assert points[-1][0] == 19_999  # what the page shows as the current value


@pytest.mark.parametrize(
    "line",
    [
        '{"event":"record","job":[],"step":0,"values":{}}',
        '{"event":"record","job":"","step":1,"values":{"return":"<b>"}}',
        '{"event":"record","time":1,"job":"","step":1e999,"values":{"return":[null]}}',
        '{"event":"start","time":"now"}',
        '{"event":"__class__"}',
        '{"event":"end","time":1,"state":"<script>"}',
    ],
)
def test_hostile_lines_do_no_harm(tmp_path, line):
    (tmp_path / EVENTS).write_text(line + "\n")
    write(tmp_path, start(), RUNNING, record(1, 1.0))
    experiment = read_again(tmp_path)
    assert experiment.summary("key")["state"] == "running"
    assert [point[:2] for point in experiment.jobs[""].curves["return"].points] == [(1, 2)]


@pytest.mark.parametrize("content", ["", "no log\n" * 9, '{"event": "start", "time": "now"}\n'])
def test_nothing_is_made_up_of_a_log_that_says_nothing(tmp_path, content):
    """It was shown as stopped in 1970."""
    (tmp_path / EVENTS).write_text(content)
    summary = read_again(tmp_path).summary("key")
    assert [summary[key] for key in ("begun", "last", "share")] == [None, None, None]


@pytest.mark.parametrize(("said", "shown"), [(-3, 0), (7, 1), (1e300, 1), (0.25, 0.25)])
def test_a_share_lies_between_nothing_and_all(tmp_path, said, shown):
    write(tmp_path, start(), {**RUNNING, "share": said})
    experiment = read_again(tmp_path)
    assert experiment.summary("key")["share"] == shown
    write(tmp_path, {**RUNNING, "share": 0.5}, {**record(1, 1.0), "share": said})
    experiment.refresh(2)
    assert experiment.summary("key")["share"] == shown


def test_a_name_that_is_no_text_does_not_hide_the_others(tmp_path):
    write(tmp_path / "good", start(), RUNNING)
    write(Path(os.fsdecode(os.fsencode(tmp_path) + b"/bad\xff")), start(), RUNNING)
    names = {run["name"] for run in Shelf(tmp_path).runs(0)["runs"]}
    assert names == {"good", "bad\N{REPLACEMENT CHARACTER}"}
    json.dumps(sorted(names)).encode()
    assert Shelf(Path(os.fsdecode(os.fsencode(tmp_path) + b"/bad\xff"))).runs(0)["root"] == (
        "bad\N{REPLACEMENT CHARACTER}"
    )


def test_hundreds_of_runs_that_write(tmp_path, monkeypatch):
    monkeypatch.setattr(shelves, "FRESH", 0.0)
    folders = [tmp_path / f"group-{i % 7}" / f"run-{i}" for i in range(300)]
    for folder in folders:
        write(folder, start(), RUNNING, *(record(step, step) for step in range(50)))
    shelf = Shelf(tmp_path)
    version = shelf.runs(0)["version"]
    for folder in folders[:100]:
        write(folder, record(60, 60))
    begun = time.process_time()
    news = shelf.runs(version)
    assert len(news["runs"]) == 100
    assert len(news["keys"]) == 300
    assert time.process_time() - begun < 1  # a hundredth of it, of this process alone
    assert shelf.runs(news["version"])["runs"] == []


def test_runs_are_found_however_deep_they_lie(tmp_path):
    write(tmp_path.joinpath(*"abcdefgh"), start())
    write(tmp_path / "a" / "near", start())
    news = Shelf(tmp_path).runs(0)
    assert {run["name"] for run in news["runs"]} == {"a/near", "a/b/c/d/e/f/g/h"}
    assert news["searched"] is None


def test_of_too_many_folders_the_nearest_are_searched(tmp_path, monkeypatch):
    for i in range(5):
        write(tmp_path / f"near-{i}", start())
        write(tmp_path / "others" / f"far-{i}", start())
    monkeypatch.setattr(shelves, "FOLDERS", 8)  # the root, the six in it, and one more
    news = Shelf(tmp_path).runs(0)
    names = [run["name"] for run in news["runs"]]
    assert sum(name.startswith("near") for name in names) == 5
    assert len(names) == 6
    assert news["searched"] == 8
    monkeypatch.setattr(shelves, "FOLDERS", 12)
    news = Shelf(tmp_path).runs(0)
    assert (len(news["runs"]), news["searched"]) == (10, None)


def test_only_jobs_that_changed_are_told_again(tmp_path, monkeypatch):
    monkeypatch.setattr(shelves, "FRESH", 0.0)
    jobs = [{**RUNNING, "job": name} for name in ("a", "b")]
    write(tmp_path / "run", start(), *jobs, record(1, 1, "a"), record(1, 1, "b"))
    shelf = Shelf(tmp_path)
    (key,) = shelf.runs(0)["keys"]
    told = shelf.run(key, 0)
    assert told is not None
    assert [job["name"] for job in told["jobs"]] == ["a", "b"]
    write(tmp_path / "run", record(2, 2, "b"))
    again = shelf.run(key, told["version"])
    assert again is not None
    assert [job["name"] for job in again["jobs"]] == ["b"]


def test_what_lies_in_an_experiment_belongs_to_it(tmp_path):
    write(tmp_path / "comparison", start())
    write(tmp_path / "comparison" / "agents" / "dqn", start())
    write(tmp_path / ".hidden", start())
    (tmp_path / "link").symlink_to(tmp_path / "comparison")
    write(tmp_path / "run", start())
    write(tmp_path / "run" / "contrast", start())  # trained when the run has ended
    (tmp_path / "comparison" / "contrast").symlink_to(tmp_path / ".hidden")
    names = [run["name"] for run in Shelf(tmp_path).runs(0)["runs"]]
    assert sorted(names) == ["comparison", "run", "run/contrast"]


def test_the_log_of_a_training_is_understood(tmp_path):
    with Log(tmp_path).opened(kind="run", agents=["dqn"]) as log:
        log.queue(["a"])
        log.job("a", ["x"]).record(3, {"loss": [float("nan")], "return": [1.0]})
        log.write("failed", job="a", error="why")
    experiment = read_again(tmp_path)
    assert (experiment.state, experiment.jobs["a"].state) == ("done", "failed")
    assert experiment.jobs["a"].curves["loss"].points == []
    assert experiment.jobs["a"].curves["return"].points == [(3, 1, 1, 1)]


# The server --------------------------------------------------------------------------------------


@pytest.fixture
def board(tmp_path):
    root = tmp_path / "runs"
    write(root / "mine", start(), RUNNING, record(1, 1))
    (root / "mine" / "report.html").write_text("<script>1</script>")
    (root / "mine" / "config.json").write_text("secret")
    part = root / "mine" / "tables" / "us" / "lag1-10bp"
    part.mkdir(parents=True)
    (part / "report.html").write_text("part")
    (root / "mine" / "tables" / "us" / "linked").mkdir()
    (root / "mine" / "tables" / "us" / "linked" / "report.html").symlink_to("/etc/hostname")
    (tmp_path / "report.html").write_text("outside")
    with Board(root, 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server
        server.shutdown()


def ask(board, path, method="GET", host=None):
    connection = http.client.HTTPConnection("127.0.0.1", board.server_port, timeout=60)
    connection.putrequest(method, path, skip_host=True)
    if host != "":
        connection.putheader("Host", host or f"127.0.0.1:{board.server_port}")
    connection.endheaders()
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    return answer, content


def key_of(board):
    (key,) = json.loads(ask(board, "/runs")[1])["keys"]
    return key


def test_it_listens_to_this_machine_alone(board):
    assert board.server_address[0] == "127.0.0.1"


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1", "localhost:1", "127.0.0.1.evil", ""])
def test_other_names_of_this_machine_are_refused(board, host):
    for path in ("/", "/runs", "/board.js"):
        assert ask(board, path, host=host)[0].status == 403
    assert ask(board, "/runs", host=f"localhost:{board.server_port}")[0].status == 200


def test_every_answer_forbids_what_it_does_not_need(board):
    for path in ("/", "/runs", "/board.css", "/none", f"/reports/{key_of(board)}/report.html"):
        answer, _ = ask(board, path)
        headers = {name.lower(): value for name, value in answer.getheaders()}
        assert not any(name.startswith("access-control") for name in headers)
        assert "default-src 'none'" in headers["content-security-policy"]
        assert "frame-ancestors 'none'" in headers["content-security-policy"]
        assert headers["cross-origin-resource-policy"] == "same-origin"
        assert headers["cross-origin-opener-policy"] == "same-origin"
        assert headers["x-frame-options"] == "DENY"
        assert headers["referrer-policy"] == "no-referrer"
        assert headers["cache-control"] == "no-store"
        assert headers["x-content-type-options"] == "nosniff"


def test_reports_have_no_origin(board):
    answer, content = ask(board, f"/reports/{key_of(board)}/report.html")
    policy = answer.getheader("Content-Security-Policy")
    assert content == b"<script>1</script>"
    assert policy.startswith("sandbox allow-scripts;")
    assert "allow-same-origin" not in policy
    assert "connect-src" not in policy  # so that default-src forbids it


def test_only_a_report_that_is_served_is_offered(board, monkeypatch):
    monkeypatch.setattr(shelves, "FRESH", -1.0)
    report = board.shelf.root / "mine" / "report.html"
    place, since = f"/reports/{key_of(board)}/report.html", 0

    def offered():
        nonlocal since
        news = json.loads(ask(board, f"/runs?since={since}")[1])
        since = news["version"]
        return [run["report"] for run in news["runs"]]

    assert (offered(), ask(board, place)[0].status) == ([True], 200)
    report.unlink()
    report.symlink_to(board.shelf.root.parent / "report.html")
    assert (offered(), ask(board, place)[0].status) == ([False], 404)
    report.unlink()
    report.write_text("again")
    assert (offered(), ask(board, place)[0].status) == ([True], 200)


def test_parts_have_reports_too(board):
    place = f"/reports/{key_of(board)}/tables/us/lag1-10bp/report.html"
    assert ask(board, place)[1] == b"part"


@pytest.mark.parametrize(
    "name",
    ["config.json", "events.jsonl", "../report.html", "%2e%2e/report.html", "..%2freport.html",
     "../../report.html", "//etc/hostname", "tables/us/linked/report.html", "tables/../report.html",
     "tables/us/lag1-10bp/../../../../../report.html", "report.html%00", "*"],
)  # fmt: skip
def test_only_known_names_are_served(board, name):
    assert ask(board, f"/reports/{key_of(board)}/{name}")[0].status == 404


@pytest.mark.parametrize(
    "path", ["/../x", "/runs/0123456789abcdef", "/runs/x", "/style.css", "http://[x/"]
)
def test_other_paths_are_not_there(board, path):
    assert ask(board, path)[0].status == 404


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS", "PATCH"])
def test_it_is_read_only(board, method):
    answer, _ = ask(board, "/runs", method)
    assert answer.status == 501
    assert answer.getheader("Access-Control-Allow-Origin") is None


def test_a_number_that_is_none_is_the_beginning(board):
    for since in ("x", "-1", "", "9" * 5000, "%C2%B2"):
        answer, content = ask(board, f"/runs?since={since}")
        assert answer.status == 200
        assert len(json.loads(content)["runs"]) == 1


def test_a_folder_that_is_none_and_a_port_that_is_taken(board, tmp_path):
    with pytest.raises(QfolioError, match="is not a folder"):
        Board(Path("/nowhere"), 0)
    with pytest.raises(QfolioError, match="choose another one with --port"):
        Board(tmp_path, board.server_port)
