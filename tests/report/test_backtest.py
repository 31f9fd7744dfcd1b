"""The report of a backtest, from made-up track records, read as text and in a real browser."""

import base64
import hashlib
import json
import os
import re
import select
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.assessment import Strategy, assess
from qfolio.report.backtest.data import BacktestData, StrategySeries
from qfolio.report.backtest.page import render_backtest, write_backtest_report
from qfolio.report.backtest.payload import AREAS, NAMED, POINTS
from qfolio.report.rendering import source

ATTACK = "</script><script>hacked = 1</script><img src=x onerror='hacked = 1'>"
LINK = "<a href=\"javascript:hacked = 1\">%{x}</a> & 'quotes' $x^2$"


def make_series(
    rng: np.random.Generator, kind: str, seeds: int, days: int, assets: int, drift: float
) -> StrategySeries:
    weights = rng.dirichlet(np.ones(assets + 1), size=days)
    turnover = rng.uniform(0, 0.1, (seeds, days))
    returns = drift + 0.01 * rng.normal(size=(seeds, days))
    return StrategySeries(kind, returns, turnover, 0.001 * turnover, weights)


def make_data(
    strategies: dict[str, StrategySeries], dates: np.ndarray, assets: tuple[str, ...], **more: Any
) -> BacktestData:
    first, last = (str(dates[i].astype("datetime64[D]")) for i in (0, -1))
    data = BacktestData(
        title="A backtest",
        command="qfolio backtest --seeds 3",
        assessment=assess(
            {
                name: Strategy(series.kind, series.returns, series.turnover, series.cost)
                for name, series in strategies.items()
            },
            dates,
            periods_per_year=252,
            resamples=20,
        ),
        dates=dates,
        assets=assets,
        strategies=strategies,
        prices={
            "source": "made up",
            "rows": 1234,
            "assets": len(assets),
            "first": "1999-01-04",
            "last": last,
            "note": "These assets are survivors.",
            "digest": "sha256:0123456789",
        },
        config={
            "cost": 0.0025,
            "lag": 1,
            "train": "2y",
            "test": "6m",
            "expanding": False,
            "cap": 0.3,
            "agents": {"DQN": {"settings": {"discount": 0.98}}},
        },
        folds=[
            {
                "name": first,
                "train_first": "1999-01-04",
                "train_last": str(dates[0].astype("datetime64[D]") - 2),
                "test_first": first,
                "test_last": last,
            }
        ],
        notes=[],
    )
    return replace(data, **more)


def weekdays(start: str, count: int) -> np.ndarray:
    return np.busday_offset(start, np.arange(count), roll="forward").astype("datetime64[s]")


def usual(days: int = 300, seeds: int = 3, **more: Any) -> BacktestData:
    rng = np.random.default_rng(3)
    series = {
        "equal weight": make_series(rng, "baseline", 1, days, 4, 0.0003),
        "best of all": make_series(rng, "baseline", 1, days, 4, 0.003),
        "third": make_series(rng, "baseline", 1, days, 4, -0.001),
        "DQN": make_series(rng, "agent", seeds, days, 4, 0.0005),
        "pathwise": make_series(rng, "agent", seeds, days, 4, 0.02),
    }
    return make_data(series, weekdays("2001-01-02", days), ("A", "B", "C", "D"), **more)


def hostile() -> BacktestData:
    """Every text that a user can choose tries to inject markup."""
    data = usual(60)
    names = {"DQN": f"DQN {ATTACK}", "third": LINK}
    strategies = {names.get(name, name): series for name, series in data.strategies.items()}
    return make_data(
        strategies,
        data.dates,
        (ATTACK, LINK, "C", "\u2028</SCRIPT>"),
        title=f"Title {ATTACK}",
        command=f"qfolio {ATTACK}",
        notes=[f"Note {ATTACK}", LINK],
        prices={**data.prices, "source": ATTACK, "note": ATTACK, "digest": ATTACK},
        config={**data.config, "train": ATTACK, ATTACK: {ATTACK: [ATTACK]}},
        folds=[{**data.folds[0], "name": ATTACK}],
    )


class Page(HTMLParser):
    """The start tags of a page, its visible text, and the contents of its scripts."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[str] = []
        self.words: list[str] = []
        self._open = ""
        self.feed(page)
        self.text = " ".join("".join(self.words).split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self._open = tag
        if tag == "script":
            self.scripts.append("")

    def handle_endtag(self, tag: str) -> None:
        self._open = ""

    def handle_data(self, data: str) -> None:
        if self._open == "script":
            self.scripts[-1] += data
        elif self._open != "style":
            self.words.append(data)

    @property
    def data(self) -> Any:
        return json.loads(self.scripts[0])


@pytest.fixture(scope="module")
def data() -> BacktestData:
    return usual()


@pytest.fixture(scope="module")
def page(data: BacktestData) -> Page:
    return Page(render_backtest(data))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("new") / "report"
    write_backtest_report(folder, hostile())
    return folder


def plain(text: str) -> str:
    return " ".join(text.split())


# What it says --------------------------------------------------------------------------------


def test_leads_with_the_verdicts_and_says_no_more(data: BacktestData, page: Page) -> None:
    places = []
    for name in ("DQN", "pathwise"):
        entry = data.assessment.strategies[name]
        assert entry.to_reference is not None
        assert entry.to_best_baseline is not None
        for difference in (entry.to_reference, entry.to_best_baseline):
            places.append(page.text.index(plain(difference.verdict)))
    assert places == sorted(places)
    assert places[-1] < page.text.index("Mind the data") < page.text.index("What one unit")
    # Each claim is made once, and only the one that the interval allows.
    assert page.text.count("after costs:") == 4
    assert "No evidence that DQN beats equal weight after costs" in page.text
    assert "pathwise beats best of all after costs" in page.text


def test_says_what_the_test_is(page: Page) -> None:
    for sentence in (
        "made up: 4 assets, 1 234 rows from 1999-01-04",
        "The test covers 300 days, from 2001-01-02 to",
        "These assets are survivors.",
        "25 bp of the value of every purchase and every sale",
        "is carried out at the close of the next day",
        "1 in a row: training on 2y, then a test on 6m",
        "6: 2 agents × 3 seeds.",
        "no asset is given more than 30.0 %",
        "Market impact",
        "Taxes.",
        "cash earns nothing",
        "intervals of volatility are optimistic",
        "qfolio backtest --seeds 3",
        "DQN.settings.discount",
        "20 histories",
    ):
        assert sentence in page.text, sentence
    assert "Not all went as planned" not in page.text


def test_table_has_every_figure_with_its_intervals(data: BacktestData) -> None:
    page = render_backtest(data)
    table = page.split('aria-label="Table of statistics"')[1].split("</table>")[0]
    rows = re.findall(r"<tr class=\"(\w+)[^>]*><th[^>]*>(.*?)</th>(.*?)</tr>", table)
    assert [(kind, name) for kind, name, _ in rows] == [
        ("agent", "DQN"),
        ("agent", "pathwise"),
        ("baseline", "equal weight"),
        ("baseline", "best of all"),
        ("baseline", "third"),
    ]
    sharpe = data.assessment.strategies["DQN"].measures["sharpe"]
    assert sharpe.over_seeds is not None
    cell = rows[0][2].split("<td>")[3].replace("\N{MINUS SIGN}", "-").replace("\u202f", "")
    low, high = sharpe.over_time
    left, right = sharpe.over_seeds
    assert cell.startswith(f"{sharpe.mean:.2f}<small>{low:.2f} … {high:.2f}</small>")
    assert f'<small class="seeds">{left:.2f} … {right:.2f}</small>' in cell
    assert "seeds" not in rows[2][2]
    assert all(row.count("<td>") == 8 for _, _, row in rows)


def test_only_intervals_beside_zero_are_evidence() -> None:
    data = usual()
    entry = data.assessment.strategies["DQN"]
    assert entry.to_reference is not None
    near = replace(entry.to_reference, growth=0.01, growth_interval=(0.00004, 0.02))
    none = replace(near, growth_interval=(0.0, 0.02))

    def first_cell(difference: Any) -> str:
        strategies = {**data.assessment.strategies, "DQN": replace(entry, to_reference=difference)}
        changed = replace(data, assessment=replace(data.assessment, strategies=strategies))
        table = render_backtest(changed).split('aria-label="Table of differences"')[1]
        return table.split("<td", 2)[1]

    assert first_cell(near).startswith(' class="higher">▲ +1.0')
    assert "+0.004\u202f% … +2.0\u202f%" in first_cell(near)
    assert first_cell(none).startswith(' class="">+1.0')


def test_numbers_of_the_charts(data: BacktestData, page: Page) -> None:
    chart = page.data
    assert len(chart["dates"]) == 301  # the start and every day
    assert chart["dates"][:2] == ["2001-01-01", "2001-01-02"]
    dqn, pathwise, equal, *_ = chart["strategies"]
    series = data.strategies["DQN"]
    wealth = np.prod(1 + series.returns, axis=1)
    assert dqn["wealth"][0] == 1
    assert dqn["wealth"][-1] == pytest.approx(np.median(wealth), rel=1e-3)
    assert dqn["band"]["low"][-1] == pytest.approx(wealth.min(), rel=1e-3)
    assert dqn["band"]["high"][-1] == pytest.approx(wealth.max(), rel=1e-3)
    assert dqn["cost"][-1] == pytest.approx(1 - np.prod(1 - series.cost, axis=1).mean(), rel=0.01)
    january = data.dates.astype("datetime64[M]") == np.datetime64("2001-01")
    traded = series.turnover[:, january].sum(axis=1).mean()
    assert dqn["turnover"][0] == pytest.approx(traded, rel=1e-3)
    assert min(equal["drawdown"]) < 0 == max(equal["drawdown"])
    assert equal["band"] is None
    # Told apart without colours, too.
    looks = [(s["symbol"], s["dash"]) for s in chart["strategies"]]
    assert len(set(looks)) == len(looks)
    assert dqn["width"] == pathwise["width"] > max(s["width"] for s in chart["strategies"][2:])


def test_weights_are_grouped_and_add_up() -> None:
    rng = np.random.default_rng(0)
    series = {
        "agent": make_series(rng, "agent", 2, 40, 30, 0.0),
        "equal weight": make_series(rng, "baseline", 1, 40, 30, 0.0),
    }
    weights = np.zeros((40, 31))
    weights[:, 0] = 0.25
    weights[:, 7] = 0.75
    series["agent"] = replace(series["agent"], weights=weights)
    assets = tuple(f"asset {i}" for i in range(1, 31))
    shown = Page(render_backtest(make_data(series, weekdays("2020-01-01", 40), assets))).data
    for entry in shown["weights"]["series"]:
        assert len(entry["names"]) == NAMED + 2 == len(entry["values"])
        assert entry["names"][-1] == f"{30 - NAMED} others"
        np.testing.assert_allclose(np.sum(entry["values"], axis=0), 1, atol=0.01)
        assert sum(entry["average"]) == pytest.approx(1)
    agent = shown["weights"]["series"][0]
    assert agent["names"][:2] == ["Cash", "asset 7"]
    assert agent["average"][:2] == [0.25, 0.75]


def test_months_are_compounded() -> None:
    days = np.array(["2020-11-30", "2020-12-01", "2020-12-02", "2021-01-04"], "datetime64[s]")
    returns = np.array([[0.1, 0.1, 0.1, -0.5]])
    still = np.zeros((1, 4))
    weights = np.tile([0.0, 1.0], (4, 1))
    series = {"equal weight": StrategySeries("baseline", returns, still, still, weights)}
    page = render_backtest(make_data(series, days, ("A",)))
    table = page.split('data-months="0"')[1].split("</table>")[0].replace("\N{MINUS SIGN}", "-")
    rows = re.findall(r"<th scope=\"row\">(\d+)</th>(.*?)</tr>", table)
    cells = {year: re.findall(r"<td[^>]*>(.*?)</td>", row) for year, row in rows}
    assert cells["2020"] == [""] * 10 + ["10.0", "21.0", "33.1"]
    assert cells["2021"] == ["-50.0"] + [""] * 11 + ["-50.0"]
    assert "No agent was tested" in page


def test_troughs_survive_thinning() -> None:
    data = usual(2 * POINTS + 1)
    series = data.strategies["equal weight"]
    returns = np.zeros_like(series.returns)
    returns[0, 1000], returns[0, 1001] = -0.5, 1.0
    strategies = {**data.strategies, "equal weight": replace(series, returns=returns)}
    chart = Page(render_backtest(replace(data, strategies=strategies))).data
    assert len(chart["dates"]) <= POINTS + 1
    assert len(chart["weights"]["dates"]) <= AREAS
    assert chart["dates"][-1] == str(data.dates[-1])[:10]
    assert min(chart["strategies"][2]["drawdown"]) == -0.5


def test_total_loss_one_seed_and_the_shortest_test() -> None:
    data = usual(days=2, seeds=1)
    ruined = replace(data.strategies["DQN"], returns=np.array([[0.1, -1.0]]))
    strategies = {**data.strategies, "DQN": ruined}
    page = Page(render_backtest(make_data(strategies, data.dates, data.assets)))
    dqn = page.data["strategies"][0]
    assert dqn["wealth"] == [1, 1.1, None]
    assert dqn["band"] is None
    assert "nan" not in "".join(page.words).lower()


def test_page_of_a_long_backtest_stays_small(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    kinds = ["agent"] * 2 + ["baseline"] * 8
    series = {
        "equal weight" if i == 2 else f"strategy {i}": make_series(
            rng, kind, 5 if kind == "agent" else 1, 7000, 20, 0.0004
        )
        for i, kind in enumerate(kinds)
    }
    assets = tuple(f"asset {i}" for i in range(20))
    write_backtest_report(tmp_path, make_data(series, weekdays("1995-01-02", 7000), assets))
    size = (tmp_path / "report.html").stat().st_size
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert size < 8e6
    assert len(page.scripts[0]) < 1e6


def test_what_does_not_fit_is_refused() -> None:
    data = usual(20)
    fewer = {name: s for name, s in data.strategies.items() if name != "third"}
    with pytest.raises(QfolioError, match="other strategies"):
        render_backtest(replace(data, strategies=fewer))
    with pytest.raises(QfolioError, match="do not fit 20 dates and 3 assets"):
        render_backtest(replace(data, assets=("A", "B", "C")))


# What it must not do -------------------------------------------------------------------------


def test_everything_is_escaped(folder: Path) -> None:
    text = (folder / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert len(page.scripts) == 3
    assert "img" not in {tag for tag, _ in page.tags}
    assert [attributes["href"] for tag, attributes in page.tags if tag == "a"] == ["#test"]
    assert not any(name.startswith("on") for _, attributes in page.tags for name in attributes)
    assert page.text.count(ATTACK) >= 10
    assert ATTACK in page.data["weights"]["series"][0]["names"]
    assert not set("<>&'\u2028") & set(page.scripts[0])


def test_page_needs_nothing_else(folder: Path) -> None:
    page = Page((folder / "report.html").read_text(encoding="utf-8"))
    rest = re.sub(r"<script>.*?</script>", "", (folder / "report.html").read_text(), flags=re.S)
    assert "http:" not in rest
    assert "https:" not in rest
    assert "@import" not in rest
    for tag, attributes in page.tags:
        assert tag not in ("link", "iframe", "object", "embed")
        assert "src" not in attributes
    script = source("backtest.js")
    for word in ("http", "fetch", "eval(", "innerHTML", "insertAdjacentHTML", "import("):
        assert word not in script


def test_only_the_two_scripts_may_run(folder: Path) -> None:
    page = Page((folder / "report.html").read_bytes().decode())
    policies = [a["content"] for _, a in page.tags if a.get("http-equiv")]
    assert len(policies) == 1
    rules = dict(rule.strip().split(" ", 1) for rule in str(policies[0]).split(";"))
    assert rules["default-src"] == rules["connect-src"] == rules["form-action"] == "'none'"
    hashes = [base64.b64encode(hashlib.sha256(s.encode()).digest()) for s in page.scripts[1:]]
    assert rules["script-src"].split() == [f"'sha256-{value.decode()}'" for value in hashes]


def test_identifiers_are_unique_and_found(page: Page) -> None:
    identifiers = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(identifiers) == len(set(identifiers))
    assert set(re.findall(r'byId\("([\w-]+)"\)', source("backtest.js"))) <= set(identifiers)
    labelled = {attributes["for"] for tag, attributes in page.tags if tag == "label"}
    assert labelled == {a["id"] for tag, a in page.tags if tag == "select"}
    assert all("aria-label" in a for _, a in page.tags if a.get("role") in ("img", "region"))


def test_picture(folder: Path) -> None:
    assert {path.name for path in folder.iterdir()} == {"report.html", "wealth.png"}
    with Image.open(folder / "wealth.png") as image:
        assert image.width > 1000
        assert image.convert("RGB").getpixel((0, 0)) == (255, 255, 255)


def test_page_is_repeatable(data: BacktestData) -> None:
    assert render_backtest(data) == render_backtest(data)


# In a browser --------------------------------------------------------------------------------

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
