"""The page of a backtest in a real browser: legends, pointer, choices, phones."""

import json
import os
import select
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from qfolio.report.backtest.data import BacktestData
from qfolio.report.backtest.page import render_backtest

from backtests import ATTACK

_EXECUTE = """
import os, sys
os.dup2(int(sys.argv[1]), 3)
os.dup2(int(sys.argv[2]), 4)
os.execv(sys.argv[3], sys.argv[3:])
"""


class Browser:
    """Headless Chromium, driven over its DevTools protocol through a pair of pipes."""

    def __init__(self, program: str, profile: Path) -> None:
        import fcntl  # not on Windows

        commands, self._write = os.pipe()
        self._read, answers = os.pipe()
        # Chromium reads commands from descriptor 3 and answers on 4; keep ours clear of these.
        given = [fcntl.fcntl(end, fcntl.F_DUPFD, 10) for end in (commands, answers)]
        self._process = subprocess.Popen(
            [
                *(sys.executable, "-c", _EXECUTE, *map(str, given), program),
                *("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"),
                *("--no-first-run", "--disable-background-networking", "--remote-debugging-pipe"),
                *(f"--user-data-dir={profile}", "about:blank"),
            ],
            pass_fds=given,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for end in (commands, answers, *given):
            os.close(end)
        self.complaints: list[Any] = []
        self._received, self._count = b"", 0
        self._session: dict[str, str] = {}
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = {"sessionId": attached["sessionId"]}
        for domain in ("Page", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> Any:
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters, **self._session}
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while (answer := self._next()).get("id") != self._count:
            pass
        assert "error" not in answer, answer
        return answer["result"]

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._received:
            ready, _, _ = select.select([self._read], [], [], 60)
            chunk = os.read(self._read, 1 << 20) if ready else b""
            assert chunk, "Chromium does not answer."
            self._received += chunk
        first, _, self._received = self._received.partition(b"\0")
        message: dict[str, Any] = json.loads(first)
        if message.get("method") in (
            "Runtime.exceptionThrown",
            "Runtime.consoleAPICalled",
            "Log.entryAdded",
        ):
            self.complaints.append(message["params"])
        return message

    def evaluate(self, expression: str) -> Any:
        """The value of a JavaScript expression; a promise is waited for."""
        answer = self.call(
            "Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait(self, condition: str) -> None:
        self.evaluate(
            "new Promise((done, fail) => { const started = Date.now(); const look = () => "
            f"({condition}) ? done() : Date.now() - started > 20000 ? fail('never happened') : "
            "setTimeout(look, 20); look(); })"
        )

    def show(self, path: Path, width: int, *, phone: bool = False) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=900,
            deviceScaleFactor=1,
            mobile=phone,
        )
        self.call("Emulation.setTouchEmulationEnabled", enabled=phone)
        self.call("Page.navigate", url=path.as_uri())
        self.wait(
            "document.readyState === 'complete' && location.protocol === 'file:' "
            "&& document.querySelectorAll('.chart .main-svg').length >= 3"
        )

    def click(self, selector: str) -> None:
        """A real click in the middle of an element."""
        x, y = self.evaluate(
            f"(() => {{ const found = document.querySelector({json.dumps(selector)}); "
            "found.scrollIntoView({block: 'center'}); const box = found.getBoundingClientRect(); "
            "return [box.x + box.width / 2, box.y + box.height / 2]; })()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def touch(self, start: tuple[int, int], *path: tuple[int, int]) -> None:
        """A finger comes down, moves and goes up again."""
        for kind, place in (("touchStart", start), *(("touchMove", place) for place in path)):
            points = [{"x": place[0], "y": place[1]}]
            self.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)
        self.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def close(self) -> None:
        self._session = {}
        try:
            self.call("Browser.close")
            self._process.wait(10)
        except (AssertionError, OSError, subprocess.TimeoutExpired):
            self._process.kill()
            self._process.wait()
        os.close(self._write)
        os.close(self._read)


def find_chromium() -> str | None:
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
    chosen = os.environ.get("QFOLIO_CHROMIUM")
    return shutil.which(chosen) if chosen else next(filter(None, map(shutil.which, names)), None)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if os.name != "posix":
        pytest.skip("driving Chromium through pipes needs a POSIX system")
    program = find_chromium()
    if program is None:
        pytest.skip(
            "no Chromium found: install it (apt install chromium) or name it in QFOLIO_CHROMIUM"
        )
    browser = Browser(program, tmp_path_factory.mktemp("chromium"))
    yield browser
    browser.close()


VISIBLE = """
(index) => document.getElementById('%s').data.filter(
  (trace) => trace.meta === index).map((trace) => trace.visible)
"""


def test_legend_click_hides_the_lines(browser: Browser, folder: Path) -> None:
    browser.complaints.clear()
    browser.show(folder / "report.html", 1280)
    for chart in ("wealth", "costs"):
        assert set(browser.evaluate(f"({VISIBLE % chart})(0)")) == {True}
    paths = "document.querySelectorAll('#wealth .scatterlayer .trace').length"
    before = browser.evaluate(paths)
    browser.click("table[data-legend=wealth] button[data-strategy='0']")
    for chart in ("wealth", "costs"):
        assert set(browser.evaluate(f"({VISIBLE % chart})(0)")) == {False}
        assert set(browser.evaluate(f"({VISIBLE % chart})(1)")) == {True}
    assert browser.evaluate(paths) < before
    pressed = (
        "[...document.querySelectorAll('button[data-strategy=\"0\"]')].map(b => b.ariaPressed)"
    )
    assert browser.evaluate(pressed) == ["false", "false"]
    browser.click("table[data-legend=costs] button[data-strategy='0']")
    assert set(browser.evaluate(f"({VISIBLE % 'wealth'})(0)")) == {True}
    assert browser.evaluate(paths) == before
    assert browser.complaints == []


def test_pointer_reads_the_values(browser: Browser, data: BacktestData, tmp_path: Path) -> None:
    browser.complaints.clear()
    (tmp_path / "report.html").write_text(render_backtest(data), encoding="utf-8")
    browser.show(tmp_path / "report.html", 1280)
    cell = "document.querySelector('[data-value=wealth][data-strategy=\"0\"]').textContent"
    date = "document.querySelector('[data-legend=wealth] time').textContent"
    final = browser.evaluate(cell)
    assert final == f"{np.median(np.prod(1 + data.strategies['DQN'].returns, axis=1)):.2f}"
    x, y = browser.evaluate(
        "(() => { const plot = document.querySelector('#wealth .nsewdrag');"
        "plot.scrollIntoView({block: 'center'}); const box = plot.getBoundingClientRect();"
        "return [box.x + 0.3 * box.width, box.y + 0.5 * box.height]; })()"
    )
    last = str(data.dates[-1])[:10]
    for step in range(3):
        browser.call("Input.dispatchMouseEvent", type="mouseMoved", x=x + step, y=y)
    browser.wait(f"{date} !== '{last}'")
    there = np.flatnonzero(
        data.dates.astype("datetime64[D]") == np.datetime64(browser.evaluate(date))
    )
    wealth = np.median(np.prod(1 + data.strategies["DQN"].returns[:, : there[0] + 1], axis=1))
    assert browser.evaluate(cell) == f"{wealth:.2f}"
    browser.call("Input.dispatchMouseEvent", type="mouseMoved", x=5, y=5)
    browser.wait(f"{date} === '{last}'")
    assert browser.evaluate(cell) == final
    assert browser.complaints == []


def test_choosing_a_strategy(browser: Browser, folder: Path) -> None:
    browser.complaints.clear()
    browser.show(folder / "report.html", 1280)
    choose = (
        "(id) => { const list = document.getElementById(id); list.value = '2';"
        "list.dispatchEvent(new Event('change')); }"
    )
    first = browser.evaluate("document.getElementById('weights-list').textContent")
    assert ATTACK in first
    browser.evaluate(f"({choose})('weights-strategy')")
    assert browser.evaluate("document.getElementById('weights-list').textContent") != first
    browser.evaluate(f"({choose})('months-strategy')")
    shown = "[...document.querySelectorAll('[data-months]')].filter(t => t.offsetHeight > 0)"
    assert browser.evaluate(f"{shown}.map(t => t.dataset.months)") == ["2"]
    # A picture can be saved under the policy of the page.
    picture = "Plotly.toImage(document.getElementById('wealth'), {format: 'png'})"
    assert browser.evaluate(picture).startswith("data:image/png;base64,")
    assert browser.complaints == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_phone(browser: Browser, folder: Path, scheme: str) -> None:
    browser.complaints.clear()
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    browser.call("Emulation.setEmulatedMedia", features=features)
    browser.show(folder / "report.html", 375, phone=True)
    assert browser.evaluate("innerWidth") == 375
    assert browser.evaluate("document.documentElement.scrollWidth") == 375
    widths = "[...document.querySelectorAll('.chart .main-svg')].map(svg => svg.clientWidth)"
    assert 300 < min(browser.evaluate(widths)) <= max(browser.evaluate(widths)) <= 375
    paper = browser.evaluate("document.getElementById('wealth').layout.paper_bgcolor")
    assert paper == {"light": "#fdfdfb", "dark": "#14181d"}[scheme]
    # A tap reads the values; a finger that moves over the chart scrolls the page.
    browser.evaluate("document.getElementById('wealth').scrollIntoView()")
    before = browser.evaluate("scrollY")
    date = "document.querySelector('[data-legend=wealth] time').textContent"
    last = browser.evaluate(date)
    browser.touch((180, 150))
    browser.wait(f"{date} < '{last}'")
    browser.touch((180, 300), (180, 260), (180, 200), (180, 100))
    browser.wait(f"scrollY > {before + 50}")
    assert browser.evaluate("window.hacked") is None
    assert browser.complaints == []
