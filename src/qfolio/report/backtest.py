"""Writing the report of a backtest: one self-contained page with live charts, and one picture.

The page holds plotly.js, its data and its own script, and its Content-Security-Policy names these
scripts by their hashes: nothing else can run in it, and nothing is loaded from anywhere. All words
that a user can choose (titles, names of strategies and assets, settings) are escaped by the
template or set as plain text; plotly, which reads markup in names, gets only numbers.
"""

from __future__ import annotations

import base64
import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jinja2.utils import htmlsafe_json_dumps
from markupsafe import Markup
from numpy.typing import NDArray

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.assessment import Assessment, Difference
from qfolio.portfolio.backtest.performance import drawdown, monthly
from qfolio.report import palette
from qfolio.report.data import Floats
from qfolio.report.figures import LEAD, new_figure, save_png
from qfolio.report.rendering import THIN_SPACE, number, percent, render, setting_groups, source

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POINTS = 1500
"""Most points that a line of the page is drawn with; more days are thinned out evenly."""

AREAS = 300
"""Most points of the areas that show weights; each is the mean over some days in a row."""

NAMED = 10
"""How many assets the picture of a strategy's weights names; the others are taken together."""

_DASHES = ("6 3", "2 2", "7 2 2 2", "9 3", "2 4", "7 2 2 2 2 2", "4 4")
_Year = tuple[int, list[tuple[str, str]]]

_SYMBOLS = ("circle", "square", "diamond", "triangle-up", "triangle-down", "pentagon")
_PERCENT = ("growth", "volatility", "drawdown", "cost_drag")
_HEADINGS = {
    "growth": "Growth",
    "volatility": "Volatility",
    "sharpe": "Sharpe",
    "sortino": "Sortino",
    "drawdown": "Drawdown",
    "calmar": "Calmar",
    "turnover": "Turnover",
    "cost_drag": "Cost drag",
}


@dataclass(frozen=True)
class StrategySeries:
    """What one strategy did on D days of the test, with S seeds (1 for a baseline) and N assets.

    Attributes:
        kind: 'agent' or 'baseline'.
        returns: Simple returns net of costs, shape (S, D).
        turnover: Value bought plus value sold as a share of the wealth, shape (S, D).
        cost: Share of the wealth that each day's trade cost, shape (S, D).
        weights: Weights after the trade, cash first, the mean over the seeds, shape (D, N + 1).
    """

    kind: str
    returns: Floats
    turnover: Floats
    cost: Floats
    weights: Floats


@dataclass(frozen=True)
class BacktestData:
    """Everything the report of a backtest shows.

    Attributes:
        title: Heading of the page.
        command: Command line that repeats the backtest; may have several lines.
        assessment: The statistics of these strategies on these days.
        dates: Days on which the returns were earned, shape (D,), strictly increasing.
        assets: Names of the N assets, in the order of the weights.
        strategies: By the names that the assessment has, too.
        prices: Where the prices come from: source, rows, assets, first and last (dates), note
            (what has to be said wherever a result on them is shown, such as survivorship; may be
            empty) and digest.
        config: All settings, a nested dictionary. Where it has cost (one way, a fraction), lag
            (in rows), cap, train, test (lengths) and expanding, the page also says them in words.
        folds: For each fold name, train_first, train_last, test_first and test_last (ISO dates).
        notes: What did not go as planned, in sentences.
    """

    title: str
    command: str
    assessment: Assessment
    dates: NDArray[np.datetime64]
    assets: tuple[str, ...]
    strategies: dict[str, StrategySeries]
    prices: dict[str, Any]
    config: dict[str, Any]
    folds: list[dict[str, Any]]
    notes: list[str]


@dataclass(frozen=True)
class _Look:
    """How a strategy is drawn, in every figure alike: agents strong, baselines thin and grey."""

    colour: str  # a key of palette.LIGHT and palette.DARK
    width: float
    dash: str  # lengths as in SVG; '' is solid
    symbol: int | None  # place in _SYMBOLS; none for baselines


def write_backtest_report(folder: Path, data: BacktestData) -> None:
    """Write report.html and wealth.png into a folder.

    Args:
        folder: Where to write; made if missing.
        data: What to report.

    Raises:
        OSError: A file cannot be written.
        QfolioError: Strategies, assessment, dates and assets do not fit together.
    """
    page = render_backtest(data)
    folder.mkdir(parents=True, exist_ok=True)
    save_png(folder / "wealth.png", draw_wealth, data, LEAD)
    # Bytes, because scripts whose line ends are changed no longer have the hash that lets them run.
    (folder / "report.html").write_bytes(page.encode("utf-8"))


def render_backtest(data: BacktestData) -> str:
    """Return the text of the page; see ``write_backtest_report``."""
    from plotly.offline import get_plotlyjs

    _check(data)
    names = _order(data)
    looks = _looks(names, data)
    payload = _payload(names, looks, data)
    scripts = [get_plotlyjs().replace("\r\n", "\n"), source("backtest.js").replace("\r\n", "\n")]
    return render(
        "backtest.html",
        data=data,
        test=data.assessment,
        scripts=[Markup(script) for script in scripts],
        hashes=[_hash(script) for script in scripts],
        payload=htmlsafe_json_dumps(payload, separators=(",", ":"), allow_nan=False),
        strategies=[(name, data.strategies[name].kind, looks[name]) for name in names],
        markers=palette.MARKER_PATHS,
        verdicts=_verdicts(names, data),
        facts=_facts(data),
        latest={
            name: _latest(lines) for name, lines in zip(names, payload["strategies"], strict=True)
        },
        headings=_HEADINGS,
        statistics=[(name, _statistics(name, data)) for name in names],
        differences=[(name, _differences(name, data)) for name in names],
        luck=_luck(names, data),
        months=_months(names, data),
        folds=_folds(data.folds),
        fold_names=any(fold["name"] != fold["test_first"] for fold in data.folds),
        said=_said(data),
        settings=setting_groups(data.config),
        thinned=_thinned(len(data.dates)),
        averaged=math.ceil(len(data.dates) / AREAS),
        unit=_unit(data.assessment.periods_per_year),
    )


def draw_wealth(data: BacktestData, width: float) -> Figure:
    """Draw wealth on a log axis and the fall below its peak, in the light scheme."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, PercentFormatter

    figure = new_figure(width, 5.4)
    axes = figure.subplots(2, 1, sharex=True, height_ratios=[2.4, 1])
    days = data.dates.astype("datetime64[s]")
    names = _order(data)
    looks = _looks(names, data)
    handles = []
    for name in reversed(names):
        look, series = looks[name], data.strategies[name]
        colour = palette.LIGHT[look.colour]
        middle, low, high = _across(_wealth(series))
        style: dict[str, Any] = {
            "color": colour,
            "linewidth": 0.75 * look.width,
            # Lengths are in widths of the line.
            "linestyle": (0, tuple(float(part) / look.width for part in look.dash.split()))
            if look.dash
            else "solid",
        }
        if look.symbol is not None:
            start = (0.03 + 0.05 * look.symbol) % 0.14
            marker: dict[str, Any] = {
                "marker": palette.MARKERS[look.symbol],
                "markersize": 5.5,
                "markeredgecolor": palette.PAPER,
                "markevery": (round(start * len(days)), max(1, len(days) // 7)),
            }
            if len(series.returns) > 1:
                axes[0].fill_between(days, low, high, color=colour, alpha=0.15, linewidth=0)
        else:
            marker = {}
        handles += axes[0].plot(days, middle, **style, **marker, label=name)
        axes[1].plot(days, -_fall(series), **{**style, "linewidth": 0.5 * look.width})
    axes[0].set_yscale("log")
    axes[0].yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes[0].yaxis.set_major_formatter(FuncFormatter(lambda tick, _: f"{tick:g}"))
    axes[0].yaxis.set_minor_formatter(NullFormatter())
    axes[0].tick_params(axis="y", which="minor", length=0)
    axes[0].set_title("Wealth, from 1 (log scale)")
    axes[1].set_title("Below the peak so far")
    axes[1].yaxis.set_major_formatter(PercentFormatter(1, decimals=0))
    for panel in axes:
        panel.grid(axis="y")
        panel.margins(x=0)
    figure.legend(
        handles=handles[::-1], loc="outside right upper", labelcolor=palette.INK, handlelength=2.6
    )
    return figure


# What is drawn -------------------------------------------------------------------------------


def _check(data: BacktestData) -> None:
    if set(data.strategies) != set(data.assessment.strategies):
        raise QfolioError(
            "The series are of other strategies than the statistics; report those of one backtest."
        )
    days = (len(data.dates),)
    for name, series in data.strategies.items():
        shape = series.returns.shape
        fits = shape[1:] == days and series.turnover.shape == series.cost.shape == shape
        if not fits or series.weights.shape != (*days, len(data.assets) + 1):
            raise QfolioError(
                f"The series of {name} do not fit {days[0]} dates and {len(data.assets)} assets."
            )


def _order(data: BacktestData) -> list[str]:
    """Agents first, then the baselines they are compared with, then the others."""
    test = data.assessment
    agents = [name for name, series in data.strategies.items() if series.kind == "agent"]
    return list(dict.fromkeys([*agents, test.reference, test.best_baseline, *data.strategies]))


def _looks(names: list[str], data: BacktestData) -> dict[str, _Look]:
    looks, agents, others = {}, 0, 0
    for name in names:
        if data.strategies[name].kind == "agent":
            dash = "" if agents < palette.AGENTS else "8 3"
            colour = f"agent-{agents % palette.AGENTS + 1}"
            looks[name] = _Look(colour, 2.2, dash, agents % len(_SYMBOLS))
            agents += 1
        elif name == data.assessment.reference:
            looks[name] = _Look("muted", 1.5, "", None)
        elif name == data.assessment.best_baseline:
            looks[name] = _Look("muted", 1.5, _DASHES[0], None)
        else:
            others += 1
            looks[name] = _Look("faint", 1.1, _DASHES[others % len(_DASHES)], None)
    return looks


def _payload(names: list[str], looks: dict[str, _Look], data: BacktestData) -> dict[str, Any]:
    """Return the numbers of the charts, few enough to be drawn at once."""
    days = len(data.dates)
    # The last day of every stretch, and before them all the start.
    ends = np.arange(days - 1, -1, -_thinned(days))[::-1]
    start = data.dates[:1] - min(np.timedelta64(1, "D"), *np.diff(data.dates[:2]))
    months, firsts = np.unique(data.dates.astype("datetime64[M]"), return_index=True)
    blocks = np.arange(0, days, math.ceil(days / AREAS))
    return {
        "themes": {"light": palette.LIGHT, "dark": palette.DARK},
        "dates": _texts(np.concatenate([start, data.dates[ends]])),
        "months": _texts(months.astype("datetime64[D]")),
        "strategies": [
            {
                "colour": looks[name].colour,
                "width": looks[name].width,
                "dash": looks[name].dash,
                "symbol": None if (place := looks[name].symbol) is None else _SYMBOLS[place],
                **_lines(data.strategies[name], ends, firsts),
            }
            for name in names
        ],
        "weights": {
            "dates": _texts(data.dates[np.append(blocks[1:], days) - 1]),
            "series": _areas(
                [data.strategies[name].weights for name in names], data.assets, blocks
            ),
        },
    }


def _lines(
    series: StrategySeries, ends: NDArray[np.intp], months: NDArray[np.intp]
) -> dict[str, Any]:
    middle, low, high = (np.append(1, line[ends]) for line in _across(_wealth(series)))
    # The deepest fall since the point before, so that thinning hides no trough.
    deepest = np.maximum.reduceat(_fall(series), np.append(0, ends[:-1] + 1))
    several = len(series.returns) > 1
    return {
        "wealth": _compact(middle, positive=True),
        "band": {"low": _compact(low, positive=True), "high": _compact(high, positive=True)}
        if several
        else None,
        "drawdown": _compact(np.append(0, -deepest)),
        "cost": _compact(np.append(0, _paid(series)[ends])),
        "turnover": _compact(np.add.reduceat(series.turnover.mean(axis=0), months)),
    }


def _areas(
    weights: list[Floats], assets: tuple[str, ...], blocks: NDArray[np.intp]
) -> list[dict[str, Any]]:
    """Return, for each strategy, its weights by block of days: cash, the largest, and the rest.

    An asset has the same colour wherever it is named, as long as there are colours.
    """
    colours: dict[int, str] = {}
    result = []
    for table in weights:
        mean = table.mean(axis=0)
        ranked = (np.argsort(-mean[1:], kind="stable") + 1).tolist()
        # One asset left over is better named than called others.
        count = NAMED if len(ranked) > NAMED + 1 else len(ranked)
        top, rest = ranked[:count], ranked[count:]
        for asset in top:
            colours.setdefault(asset, palette.ASSETS[len(colours) % len(palette.ASSETS)])
        groups = [[0], *([asset] for asset in top), *([rest] if rest else [])]
        by_block = np.add.reduceat(table, blocks, axis=0)
        by_block /= by_block.sum(axis=1, keepdims=True)
        result.append(
            {
                "names": ["Cash", *(assets[asset - 1] for asset in top)]
                + [f"{len(rest)} others"] * bool(rest),
                "colours": ["cash", *(colours[asset] for asset in top)] + ["hairline"] * bool(rest),
                "values": [_compact(by_block[:, group].sum(axis=1), 3) for group in groups],
                "average": [float(mean[group].sum()) for group in groups],
            }
        )
    return result


def _wealth(series: StrategySeries) -> Floats:
    """Wealth after each day, from 1 at the start, of shape (seeds, days)."""
    return np.cumprod(1 + series.returns, axis=1)


def _across(values: Floats) -> tuple[Floats, Floats, Floats]:
    """The median, the least and the greatest over the seeds."""
    return np.median(values, axis=0), values.min(axis=0), values.max(axis=0)


def _fall(series: StrategySeries) -> Floats:
    """How far the wealth lies below its peak so far: the median over the seeds, positive."""
    return np.asarray(np.median(drawdown(series.returns), axis=0))


def _paid(series: StrategySeries) -> Floats:
    """By what share the costs so far have made the wealth smaller, the mean over the seeds."""
    return np.asarray((1 - np.cumprod(1 - series.cost, axis=1)).mean(axis=0))


def _thinned(days: int) -> int:
    """How many days there are to a point of a line."""
    return math.ceil(days / POINTS)


def _texts(dates: NDArray[np.datetime64]) -> list[str]:
    """Dates as plotly and people read them, with the time of day where there is one."""
    whole = (dates == dates.astype("datetime64[D]")).all()
    texts = np.datetime_as_string(dates, unit="D" if whole else "m").tolist()
    return [text.replace("T", " ") for text in texts]


def _compact(values: Floats, digits: int = 4, *, positive: bool = False) -> list[float | None]:
    """Numbers with few digits; None for those that cannot be drawn."""
    return [
        float(f"{value:.{digits}g}")
        if math.isfinite(value) and (value > 0 or not positive)
        else None
        for value in values.tolist()
    ]


# What is said --------------------------------------------------------------------------------


def _verdicts(names: list[str], data: BacktestData) -> dict[str, Any]:
    """Return each agent's sentences, and where on a common axis (in %) its intervals lie."""
    test = data.assessment
    agents: list[tuple[str, list[Difference]]] = []
    for name in names:
        entry = test.strategies[name]
        if entry.kind == "agent":
            pair = (entry.to_reference, entry.to_best_baseline)
            kept = {each.reference: each for each in pair if each is not None}
            agents.append((name, list(kept.values())))
    ends = [
        end
        for _, differences in agents
        for each in differences
        for end in (each.growth, *each.growth_interval)
        if math.isfinite(end)
    ]
    low, high = min(ends, default=0.0), max(ends, default=0.0)
    ticks = _ticks(min(low, 0), max(high, 0))
    low, high = min(low, ticks[0]), max(high, ticks[-1])
    margin = 0.04 * (high - low) or 1.0  # any, where there is nothing to show

    def place(value: float) -> float:
        share = (value - low + margin) / (high - low + 2 * margin)
        return round(100 * min(max(share, 0.0), 1.0), 2)

    def row(each: Difference) -> dict[str, Any]:
        finding, middle, numbers = each.verdict.rpartition(": the difference in ")
        left, right = (place(end) for end in each.growth_interval)
        known = not any(map(math.isnan, (each.growth, *each.growth_interval)))
        return {
            "finding": finding,
            "numbers": middle.removeprefix(":") + numbers,
            "span": (left, round(right - left, 2), place(each.growth)) if known else None,
            "label": f"{percent(each.growth, sign=True)}, 95 % interval "
            + " to ".join(percent(end, sign=True) for end in each.growth_interval),
        }

    return {
        "agents": [(name, [row(each) for each in differences]) for name, differences in agents],
        "ticks": [(percent(tick, _digits(ticks), sign=True), place(tick)) for tick in ticks],
        "zero": place(0),
    }


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers around an interval that contains zero, at most six."""
    width = max(high - low, 1e-4)
    power = 10 ** math.floor(math.log10(width))
    step = next(k * power for k in (0.2, 0.5, 1, 2, 5, 10) if width / (k * power) <= 4)
    return [k * step for k in range(math.ceil(low / step - 0.5), math.floor(high / step + 0.5) + 1)]


def _digits(ticks: list[float]) -> int:
    """How many decimals tell these fractions apart as percentages."""
    return next(
        (d for d in range(5) if all(abs(100 * t - round(100 * t, d)) < 1e-9 for t in ticks)), 5
    )


def _facts(data: BacktestData) -> list[tuple[str, str, str]]:
    """Return the key figures of the test: name, value and a remark."""
    test, settings, unit = data.assessment, data.config, _unit(data.assessment.periods_per_year)
    agents = [entry.seeds for entry in test.strategies.values() if entry.kind == "agent"]
    facts = [
        (
            "Tested over",
            f"{number(test.periods / test.periods_per_year)} years",
            f"{test.first_date[:4]} to {test.last_date[:4]}",
        ),
        ("Assets", number(len(data.assets), 0), "and cash, long only"),
    ]
    if "cost" in settings:
        facts.append(("Cost", _basis_points(settings["cost"]), "of the value traded"))
    if "lag" in settings:
        facts.append(("Lag", _counted(settings["lag"], unit), "decision to trade"))
    if data.folds:
        remark = "walk-forward"
        if "train" in settings and "test" in settings:
            remark = f"train {settings['train']}, test {settings['test']}"
        facts.append(("Folds", str(len(data.folds)), remark))
    facts.append(("Trials", str(test.trials), _seeds(agents)))
    return facts


def _counted(count: int, noun: str) -> str:
    return f"{number(count, 0)} {noun}{'' if count == 1 else 's'}"


def _unit(periods_per_year: float) -> str:
    """What a period is called."""
    known = {"day": (240, 370), "week": (48, 54), "month": (11, 13)}
    fitting = (name for name, (low, high) in known.items() if low <= periods_per_year <= high)
    return next(fitting, "period")


def _seeds(agents: list[int]) -> str:
    """For each agent its number of seeds, in words."""
    if len(set(agents)) == 1:
        return f"{_counted(len(agents), 'agent')} × {_counted(agents[0], 'seed')}"
    return f"{_counted(len(agents), 'agent')}, {_counted(sum(agents), 'seed')} in all"


def _basis_points(fraction: float) -> str:
    return f"{1e4 * fraction:.6g}{THIN_SPACE}bp"


def _said(data: BacktestData) -> dict[str, Any]:
    """Return what the account of the test needs to know; None for what the settings do not say."""
    test, settings = data.assessment, data.config
    seeds = [entry.seeds for entry in test.strategies.values() if entry.kind == "agent"]
    return {
        "cost": _basis_points(settings["cost"]) if "cost" in settings else None,
        **{key: settings.get(key) for key in ("lag", "train", "test", "expanding", "cap")},
        "seeds": _seeds(seeds),
        "beside": test.trials - sum(seeds),
    }


def _latest(lines: dict[str, Any]) -> dict[str, str]:
    """The values at the end, which the legends show until a pointer asks for others."""
    wealth = lines["wealth"][-1] or 0
    return {
        "wealth": number(wealth, 0 if wealth >= 100 else 1 if wealth >= 10 else 2),
        **{key: percent(lines[key][-1]) for key in ("drawdown", "cost", "turnover")},
    }


def _statistics(name: str, data: BacktestData) -> list[dict[str, str]]:
    entry = data.assessment.strategies[name]

    def written(key: str, value: float) -> str:
        return percent(value) if key in _PERCENT else number(value, 1 if key == "turnover" else 2)

    return [
        {
            "value": written(key, measure.mean),
            "time": " … ".join(written(key, end) for end in measure.over_time),
            "seeds": " … ".join(written(key, end) for end in measure.over_seeds or ()),
        }
        for key, measure in ((key, entry.measures[key]) for key in _HEADINGS)
    ]


def _differences(name: str, data: BacktestData) -> list[dict[str, str] | None]:
    """Growth and Sharpe ratio less those of the reference, and of the best baseline."""
    entry = data.assessment.strategies[name]
    cells: list[dict[str, str] | None] = []
    for each in (entry.to_reference, entry.to_best_baseline):
        if each is None:
            cells += [None, None]
            continue
        for value, (low, high), write, scale, digits in (
            (each.growth, each.growth_interval, percent, 100, 1),
            (each.sharpe, each.sharpe_interval, number, 1, 2),
        ):
            ends = (write(end, _telling(scale * end, digits), sign=True) for end in (low, high))
            cells.append(
                {
                    "value": write(value, digits, sign=True),
                    "interval": " … ".join(ends),
                    "side": "higher" if low > 0 else "lower" if high < 0 else "",
                }
            )
    return cells


def _telling(value: float, digits: int) -> int:
    """How many decimals it takes, if more than usual, until a small number does not look like 0."""
    if value == 0 or not math.isfinite(value):
        return digits
    return next((d for d in range(digits, 6) if round(value, d)), digits)


def _luck(names: list[str], data: BacktestData) -> list[dict[str, Any]]:
    rows = []
    for name in names:
        entry = data.assessment.strategies[name]
        test = entry.sharpe_test
        # Probabilities are rounded down: 94.96 must not read as 95.0.
        certain, deflated = (
            f"{percent(math.floor(1000 * p) / 1000)}" if math.isfinite(p) else "–"
            for p in (test.probabilistic, test.deflated)
        )
        rows.append(
            {
                "name": name,
                "agent": entry.kind == "agent",
                "sentence": test.sentence,
                "sharpe": number(entry.measures["sharpe"].mean, 2),
                "certain": certain,
                "threshold": number(test.threshold, 2),
                "deflated": deflated,
                "years": number(test.minimum_years),
                "shape": f"{number(test.skewness)} / {number(test.kurtosis)}",
            }
        )
    return rows


def _months(names: list[str], data: BacktestData) -> list[tuple[str, list[_Year]]]:
    """Return for each strategy its returns by month, the mean over the seeds, with shades."""
    tables = []
    for name in names:
        years, table = monthly(data.strategies[name].returns, data.dates)
        empty = np.isnan(table).all(axis=-1, keepdims=True)
        whole = np.where(empty, np.nan, np.nanprod(1 + table, axis=-1, keepdims=True) - 1)
        tables.append((years, np.concatenate([table, whole], axis=-1).mean(axis=0)))
    sizes = np.abs([table[:, :12] for _, table in tables])
    scale = float(np.nanquantile(sizes, 0.95)) or 1.0  # of all, so that shades can be compared

    def cell(value: float) -> tuple[str, str]:
        if math.isnan(value):
            return "", ""
        level = min(math.ceil(5 * abs(value) / scale - 1e-9), 5)
        shade = f"{'gain' if value > 0 else 'loss'}{level}" if level else ""
        return number(100 * value), shade

    return [
        (
            name,
            [
                (year, [cell(v) for v in row])
                for year, row in zip(years, table.tolist(), strict=True)
            ],
        )
        for name, (years, table) in zip(names, tables, strict=True)
    ]


def _folds(folds: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the folds with the places of their stretches on the whole span, in %."""
    if not folds:
        return []
    keys = ("train_first", "train_last", "test_first", "test_last")
    days = np.array([[fold[key] for key in keys] for fold in folds], dtype="datetime64[D]")
    days = days.astype(float)
    places = 100 * (days - days.min()) / max(np.ptp(days), 1)
    return [
        {**fold, "train": (a, b - a), "test": (c, d - c)}
        for fold, (a, b, c, d) in zip(folds, places.round(2).tolist(), strict=True)
    ]


def _hash(script: str) -> str:
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"
