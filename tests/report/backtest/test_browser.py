"""The page of a backtest in a real browser: legends, pointer, choices, phones."""

import dataclasses
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from qfolio.report.backtest.data import BacktestData, shown_order
from qfolio.report.backtest.opening import lead_name
from qfolio.report.backtest.page import render_backtest
from qfolio.report.printing import find_browser, print_pdf

from backtests import ATTACK, Page, make_data, usual
from browser import Browser

DRAWN = "location.protocol === 'file:' && document.querySelectorAll('.chart .main-svg').length >= 3"

TURNED = "[...document.querySelectorAll('.xtick text')].map(t => t.getAttribute('transform'))"

VISIBLE = """
(index) => document.getElementById('%s').data.filter(
  (trace) => trace.meta === index).map((trace) => trace.visible)
"""


@pytest.fixture(scope="module")
def page_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("usual") / "report.html"
    path.write_text(render_backtest(usual(60)), encoding="utf-8")
    return path


def test_legend_click_hides_the_lines(browser: Browser, folder: Path) -> None:
    browser.complaints.clear()
    browser.show((folder / "report.html").as_uri(), 1280, DRAWN)
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
    browser.show((tmp_path / "report.html").as_uri(), 1280, DRAWN)
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
    # Both are read at once, because the page may still be following the pointer.
    day, shown = browser.evaluate(f"[{date}, {cell}]")
    there = np.flatnonzero(data.dates.astype("datetime64[D]") == np.datetime64(day))
    wealth = np.median(np.prod(1 + data.strategies["DQN"].returns[:, : there[0] + 1], axis=1))
    assert shown == f"{wealth:.2f}"
    browser.call("Input.dispatchMouseEvent", type="mouseMoved", x=5, y=5)
    browser.wait(f"{date} === '{last}'")
    assert browser.evaluate(cell) == final
    assert browser.complaints == []


def test_choosing_a_strategy(browser: Browser, folder: Path) -> None:
    browser.complaints.clear()
    browser.show((folder / "report.html").as_uri(), 1280, DRAWN)
    choose = (
        "(id) => { const list = document.getElementById(id); list.value = '1';"
        "list.dispatchEvent(new Event('change')); }"
    )
    first = browser.evaluate("document.getElementById('weights-list').textContent")
    assert ATTACK in first
    browser.evaluate(f"({choose})('weights-strategy')")
    assert browser.evaluate("document.getElementById('weights-list').textContent") != first
    browser.evaluate(f"({choose})('months-strategy')")
    shown = "[...document.querySelectorAll('[data-months]')].filter(t => t.offsetHeight > 0)"
    assert browser.evaluate(f"{shown}.map(t => t.dataset.months)") == ["1"]
    # A picture can be saved under the policy of the page.
    picture = "Plotly.toImage(document.getElementById('wealth'), {format: 'png'})"
    assert browser.evaluate(picture).startswith("data:image/png;base64,")
    assert browser.complaints == []


@pytest.mark.parametrize("days", [60, 250, 516])
def test_dates_are_level_on_a_phone(browser: Browser, tmp_path: Path, days: int) -> None:
    (tmp_path / "report.html").write_text(render_backtest(usual(days)), encoding="utf-8")
    browser.show((tmp_path / "report.html").as_uri(), 390, DRAWN, phone=True)
    assert not any("rotate" in (each or "") for each in browser.evaluate(TURNED))


@pytest.mark.parametrize("width", [390, 1280])
def test_the_ends_of_long_names_are_seen(browser: Browser, tmp_path: Path, width: int) -> None:
    data = usual(60)
    names = tuple(f"A company with a very long name, class {i}" for i in range(len(data.assets)))
    page = render_backtest(dataclasses.replace(data, assets=names))
    (tmp_path / "report.html").write_text(page, encoding="utf-8")
    browser.show((tmp_path / "report.html").as_uri(), width, DRAWN, phone=width < 500)
    rows = "[...document.querySelectorAll('#weights-list .row')]"
    assert set(browser.evaluate(f"{rows}.map(row => row.textContent)")) == {*names, "Cash"}
    seen = "row.lastChild.getBoundingClientRect().right <= row.getBoundingClientRect().right + 1"
    assert browser.evaluate(f"{rows}.every(row => {seen})")
    assert browser.evaluate(f"{rows}.every(row => row.scrollWidth <= row.clientWidth)")


@pytest.mark.parametrize("width", [390, 1280])
def test_long_names_fit_beside_the_ends_of_lines(
    browser: Browser, tmp_path: Path, width: int
) -> None:
    data = usual(60)
    names = {
        "best of all": "equal-weight-1-percent-a-day",
        "DQN": "tilts:low-risk",
        "DQN-together": "tilts:low-risk, seeds together",
    }
    series = {names.get(name, name): each for name, each in data.strategies.items()}
    page = render_backtest(make_data(series, data.dates, data.assets))
    (tmp_path / "report.html").write_text(page, encoding="utf-8")
    browser.show((tmp_path / "report.html").as_uri(), width, DRAWN, phone=width < 500)
    labels = "[...document.querySelectorAll('#wealth-labels span')]"
    assert {*names.values()} <= set(browser.evaluate(f"{labels}.map(each => each.textContent)"))
    cut = "each.scrollWidth > each.clientWidth || each.scrollHeight > each.clientHeight"
    assert browser.evaluate(f"{labels}.filter(each => {cut}).map(each => each.textContent)") == []
    boxes = f"{labels}.map(each => each.getBoundingClientRect()).sort((a, b) => a.top - b.top)"
    apart = "(box, i, all) => !i || box.top > all[i - 1].bottom - 1"
    assert browser.evaluate(f"{boxes}.every({apart})")
    assert browser.evaluate(f"{boxes}.every(box => box.right <= innerWidth)")


OVERLAPS = """
(() => {
  const meet = (a, b) => a.left < b.right && b.left < a.right
    && a.top < b.bottom && b.top < a.bottom;
  const box = (text) => text.getBoundingClientRect();
  return [...document.querySelectorAll('.chart')].flatMap((chart) => {
    const titles = [...chart.querySelectorAll('.annotation-text')];
    const numbers = [...chart.querySelectorAll('.ytick text, .y2tick text')];
    return titles.flatMap((title) => numbers.filter((each) => meet(box(title), box(each)))
      .map((each) => [title.textContent, each.textContent]));
  });
})()
"""


@pytest.mark.parametrize("paper", [False, True])
def test_titles_and_numbers_of_charts_keep_apart(
    browser: Browser, tmp_path: Path, paper: bool
) -> None:
    (tmp_path / "report.html").write_text(render_backtest(usual(400)), encoding="utf-8")
    browser.show((tmp_path / "report.html").as_uri(), 1280, DRAWN)
    browser.evaluate("document.getElementById('sheet').open = true")
    browser.wait("document.querySelectorAll('#rolling .main-svg').length > 0")
    if paper:
        browser.evaluate("dispatchEvent(new Event('beforeprint'))")
        browser.wait("document.getElementById('costs').layout.width === 660")
    assert browser.evaluate("document.querySelectorAll('.chart .annotation-text').length") == 8
    assert browser.evaluate(OVERLAPS) == []
    assert not any("rotate" in (each or "") for each in browser.evaluate(TURNED))


def test_tables_stay_whole_on_paper(browser: Browser, folder: Path) -> None:
    browser.show((folder / "report.html").as_uri(), 1280, DRAWN)
    browser.call("Emulation.setEmulatedMedia", media="print")
    style = "getComputedStyle(document.querySelector('%s')).%s"
    parts = (".wide-table", "breakInside"), (".wide-table ~ .printed", "breakBefore")
    found = [browser.evaluate(style % part) for part in parts]
    browser.call("Emulation.setEmulatedMedia", media="")
    assert found == ["avoid", "avoid"]


def test_the_command_does_not_fill_a_page_alone(tmp_path: Path) -> None:
    """Where it has no room after the section before, it takes that along."""
    read = shutil.which("pdftotext")
    if find_browser() is None or read is None:
        pytest.skip("no Chromium or no pdftotext found")
    page, printed = tmp_path / "report.html", tmp_path / "report.pdf"
    page.write_text(render_backtest(usual()), encoding="utf-8")
    print_pdf(page, printed)
    text = subprocess.run([read, printed, "-"], capture_output=True, text=True, check=True).stdout
    last = text.rstrip("\f").split("\f")[-1]
    for heading in ("Not modeled", "Reproduce"):  # the section before may begin on an earlier page
        assert heading in last


def test_names_stand_where_lines_end(browser: Browser, folder: Path) -> None:
    browser.complaints.clear()
    browser.show((folder / "report.html").as_uri(), 1280, DRAWN)
    names = "[...document.querySelectorAll('#wealth-labels span')].map(s => s.textContent)"
    browser.wait(f"{names}.length === 5")  # three agents, the reference and the best baseline
    assert f"DQN {ATTACK}" in browser.evaluate(names)
    tops = browser.evaluate(
        "[...document.querySelectorAll('#wealth-labels span')].map(s => parseFloat(s.style.top))"
    )
    assert min(np.diff(sorted(tops))) > 10  # none covers another
    browser.click("table[data-legend=wealth] button[data-strategy='0']")
    browser.wait(f"{names}.length === 4")
    assert f"DQN {ATTACK}" not in browser.evaluate(names)
    assert browser.complaints == []


def test_names_are_whole_on_a_phone(browser: Browser, page_path: Path) -> None:
    browser.show(page_path.as_uri(), 390, DRAWN, phone=True)
    spans = "[...document.querySelectorAll('#wealth-labels span')]"
    browser.wait(f"{spans}.length === 5")
    cut = f"{spans}.filter(s => s.scrollWidth > s.clientWidth).map(s => s.textContent)"
    assert browser.evaluate(cut) == []
    lows, highs = browser.evaluate(
        f"(() => {{ const boxes = {spans}.map(s => s.getBoundingClientRect())"
        ".sort((a, b) => a.top - b.top);"
        "return [boxes.slice(1).map(b => b.top), boxes.slice(0, -1).map(b => b.bottom)]; })()"
    )
    assert np.all(np.array(lows) - highs > -0.5)  # none covers another


def test_the_rolling_chart_is_followed_after_printing(browser: Browser, tmp_path: Path) -> None:
    (tmp_path / "report.html").write_text(render_backtest(usual(400)), encoding="utf-8")
    browser.show((tmp_path / "report.html").as_uri(), 1280, DRAWN)
    for event in ("beforeprint", "afterprint"):
        browser.evaluate(f"dispatchEvent(new Event('{event}'))")
    browser.click("#sheet summary")
    browser.wait("document.querySelectorAll('#rolling .main-svg').length > 0")
    heard = "document.getElementById('rolling')._ev.listeners('plotly_hover').length"
    browser.wait(f"{heard} === 1")


def test_rolling_lines_begin_at_the_axis(browser: Browser, tmp_path: Path) -> None:
    """An axis from the first day would leave the first year empty."""
    page = render_backtest(usual(400))
    (tmp_path / "report.html").write_text(page, encoding="utf-8")
    browser.show((tmp_path / "report.html").as_uri(), 1280, DRAWN)
    browser.click("#sheet summary")
    browser.wait("document.querySelectorAll('#rolling .main-svg').length > 0")
    chart = Page(page).data
    first = next(i for i, value in enumerate(chart["strategies"][0]["sharpe"]) if value is not None)
    shown = browser.evaluate("document.getElementById('rolling').layout.xaxis.range")
    assert [day[:10] for day in shown] == [chart["dates"][first], chart["dates"][-1]]


def test_tear_sheet_opens_and_draws(browser: Browser, tmp_path: Path) -> None:
    browser.complaints.clear()
    (tmp_path / "report.html").write_text(render_backtest(usual(400)), encoding="utf-8")
    browser.show((tmp_path / "report.html").as_uri(), 1280, DRAWN)
    drawn = "document.querySelectorAll('#rolling .main-svg').length > 0"
    assert not browser.evaluate(drawn)
    browser.click("#sheet summary")
    browser.wait(drawn)
    parts = "[...document.querySelectorAll('[data-sheet]')].filter(p => p.offsetHeight > 0)"
    data = usual(400)
    lead = str(shown_order(data).index(lead_name(data) or ""))
    assert browser.evaluate(f"{parts}.map(p => p.dataset.sheet)") == [lead]
    browser.evaluate(
        "(() => { const list = document.getElementById('sheet-strategy'); list.value = '3';"
        "list.dispatchEvent(new Event('change', {bubbles: true})); })()"
    )
    assert browser.evaluate(f"{parts}.map(p => p.dataset.sheet)") == ["3"]
    browser.click("table[data-legend=rolling] button[data-strategy='1']")
    assert set(browser.evaluate(f"({VISIBLE % 'rolling'})(1)")) == {False}
    assert browser.complaints == []


def test_the_other_baselines_are_one_click_away(browser: Browser, folder: Path) -> None:
    browser.show((folder / "report.html").as_uri(), 1280, DRAWN)
    rows = "[...document.querySelectorAll('table[data-legend=wealth] tr[data-rest]')]"
    shown = f"{rows}.filter(r => r.offsetHeight > 0).length"
    assert browser.evaluate(shown) == 0
    browser.click(".rest")
    assert browser.evaluate(shown) == browser.evaluate(f"{rows}.length") > 0
    last = browser.evaluate(f"{rows}.at(-1).querySelector('button').dataset.strategy")
    browser.click(f"table[data-legend=wealth] button[data-strategy='{last}']")
    assert set(browser.evaluate(f"({VISIBLE % 'wealth'})({last})")) == {True}


def test_intervals_are_bars_until_numbers_are_wanted(browser: Browser, folder: Path) -> None:
    browser.show((folder / "report.html").as_uri(), 1280, DRAWN)
    shown = "document.querySelector('.wide-table td small').offsetHeight > 0"
    assert not browser.evaluate(shown)
    browser.click("#numbers")
    assert browser.evaluate(shown)


def test_wide_tables_say_so_on_a_phone(browser: Browser, folder: Path) -> None:
    url, label = (folder / "report.html").as_uri(), "Table of statistics"
    for whole in (label, "Table of probabilistic and deflated Sharpe ratios"):
        assert not browser.cued(url, 1200, whole)
    assert browser.cued(url, 375, label)
    frame = f"document.querySelector('[aria-label=\"{label}\"]')"
    browser.evaluate(f"{frame}.scrollTo(10000, 0)")
    browser.wait(f"getComputedStyle({frame}).getPropertyValue('--fade') === '0px'")
    name, frame_left = browser.evaluate(
        f"[{frame}.querySelector('tbody th').getBoundingClientRect().left,"
        f"{frame}.getBoundingClientRect().left]"
    )
    assert name == pytest.approx(frame_left, abs=1)  # names stay in sight


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_phone(browser: Browser, folder: Path, scheme: str) -> None:
    browser.complaints.clear()
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    browser.call("Emulation.setEmulatedMedia", features=features)
    browser.show((folder / "report.html").as_uri(), 375, DRAWN, phone=True)
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
