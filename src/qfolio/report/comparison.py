"""The report of a comparison: one self-contained page without scripts, and its curves.

All data is in comparison.json, so the report can be rewritten from it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from qfolio.core.arrays import AnyFloats
from qfolio.core.files import write_text
from qfolio.core.statistics import FEWEST_SEEDS, band, interquartile_mean
from qfolio.core.text import amount, four_digits
from qfolio.experiments.comparison.conclusion import (
    arrived,
    best_of,
    least,
    span,
    writer_of,
)
from qfolio.experiments.comparison.ranking import HEADLINE, THRESHOLDS, Result, curve
from qfolio.report import palette, rendering
from qfolio.report.figures.style import (
    LEAD,
    NARROW,
    WIDE,
    dashes,
    new_figure,
    percent_axis,
    percent_tick,
    save_png,
    short_tick,
    svgs,
)
from qfolio.report.looks import Look
from qfolio.report.rendering import (
    THIN_SPACE,
    counted,
    duration,
    number,
    over_seeds,
    percent,
    render,
    setting_groups,
    typeset,
)
from qfolio.report.words import words_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FLOOR = 1e-4
"""The smallest regret drawn on a logarithmic scale."""

UNLIKE = 5.0
"""Budgets that differ by more than this factor are drawn on a logarithmic scale."""


@dataclass(frozen=True)
class ComparisonData:
    """The data of the figures: the content of comparison.json, with the agents best first."""

    content: dict[str, Any]
    results: dict[str, Result]
    looks: dict[str, Look]

    @property
    def ranking(self) -> dict[str, Any]:
        return self.content["ranking"]

    @property
    def graded(self) -> bool:
        """Whether there is an optimum, so that regrets are shown instead of returns."""
        return self.ranking["measure"] == "regret"

    @property
    def starts(self) -> int:
        return next(iter(self.results.values())).starts

    def write(self, value: float) -> str:
        """A regret or a return as text."""
        return typeset(writer_of(self.ranking)(value))


def comparison_data(content: dict[str, Any]) -> ComparisonData:
    """The figures' data, from the content of comparison.json."""
    order = content["ranking"]["order"]
    looks = {name: Look.of_agent(place) for place, name in enumerate(order)}
    return ComparisonData(
        content, {name: Result(**content["results"][name]) for name in order}, looks
    )


def write_comparison_report(folder: Path, content: dict[str, Any]) -> None:
    """Write report.html and learning_curves.png into a folder.

    Args:
        folder: The folder to write to; created if missing.
        content: The content of comparison.json, with its ranking.

    Raises:
        OSError: A file cannot be written.
    """
    data = comparison_data(content)
    save_png(folder / "learning_curves.png", draw_curves, data, LEAD)
    write_text(folder / "report.html", render_comparison(data))


def render_comparison(data: ComparisonData) -> str:
    """Return the text of the page; see ``write_comparison_report``."""
    content, ranking = data.content, data.ranking
    return render(
        "comparison.html",
        content=content,
        ranking=ranking,
        graded=data.graded,
        starts=data.starts,
        curve_starts=next(iter(data.results.values())).curve_starts,
        title=f"{counted(len(data.results), 'agent')} {words_of(content['task']).where}",
        lede=[typeset(sentence) for sentence in content["conclusion"]],
        notes=[typeset(sentence) for sentence in content["notes"]],
        looks=data.looks,
        intervals=ranking["seeds"] >= FEWEST_SEEDS,
        fewest=FEWEST_SEEDS,
        facts=_facts(data),
        reached=[(name, _reached(data, name)) for name in data.results],
        took=[(name, _took(result)) for name, result in data.results.items()],
        thresholds=[percent(threshold, 0) for threshold in THRESHOLDS],
        near=percent(HEADLINE, 0),
        within=[(name, _within(data, name)) for name in data.results],
        better=_better(data),
        curves=svgs(draw_curves, data, LEAD),
        finals=svgs(draw_finals, data, WIDE),
        common=rendering.large(ranking["common_steps"]),
        floor=percent_tick(_floor(data)) if _logarithmic(data) else None,
        runs=[(name, *_settings(data, name)) for name in data.results],
    )


# Figures -------------------------------------------------------------------------------------


def draw_curves(data: ComparisonData, width: float) -> Figure:
    """Draw the learning curves over environment steps and over seconds of training."""
    from matplotlib.ticker import LogLocator, NullFormatter

    rows = math.ceil(len(data.results) / (4 if width > NARROW else 2))
    height = (3.9 if width > NARROW else 6.4) + 0.22 * rows
    figure = new_figure(width, height)
    shape = (1, 2) if width > NARROW else (2, 1)
    axes = figure.subplots(*shape, squeeze=False, sharey=True)
    names = ("environment steps of a seed", "seconds of training a seed")
    paces = [
        dict.fromkeys(data.results, 1.0),
        {name: x.seconds_per_seed / max(x.env_steps, 1) for name, x in data.results.items()},
    ]
    for panel, name, pace in zip(axes.flat, names, paces, strict=True):
        ends = {key: result.curve_steps[-1] * pace[key] for key, result in data.results.items()}
        log = max(ends.values()) > UNLIKE * min(ends.values()) > 0
        panel.grid(axis="y")
        panel.set_xlabel(name)
        for key in reversed(data.results):
            _draw_curve(panel, data, key, pace[key], log)
        if log:
            panel.set_xscale("log")
            panel.xaxis.set_major_locator(LogLocator(numticks=6))
            panel.xaxis.set_minor_formatter(NullFormatter())
        else:
            panel.set_xlim(left=0)
            panel.locator_params(axis="x", nbins=5)
        panel.xaxis.set_major_formatter(lambda tick, _: short_tick(tick))
        panel.margins(x=0.02 if log else 0)
        _goal_line(panel, data)
    axes[0, 0].set_title("Regret of the greedy policy" if data.graded else "Greedy return")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(
        handles[::-1],
        labels[::-1],
        loc="outside upper left",
        ncols=4 if width > NARROW else 2,
        labelcolor=palette.INK,
        handlelength=2.4,
        columnspacing=1.6,
        borderpad=0.3,
    )
    return figure


def draw_finals(data: ComparisonData, width: float) -> Figure:
    """Draw each agent's seeds, and their interquartile mean with its interval."""
    names = list(data.results)
    figure = new_figure(width, 0.46 * len(names) + 0.7)
    axes = figure.subplots()
    log = _logarithmic(data)
    for row, name in enumerate(names):
        final = data.ranking["agents"][name]["final"]
        color = palette.LIGHT[data.looks[name].color]
        limit = (lambda x: np.maximum(x, FLOOR)) if log else np.asarray
        seeds = limit(final["per_seed"])
        axes.plot(seeds, np.full(len(seeds), row + 0.2), "|", color=color, markersize=7, alpha=0.75)
        if final["interval"] is not None:
            axes.plot(
                limit(final["interval"]), [row - 0.1] * 2, color=color, linewidth=4, alpha=0.4
            )
        marker = data.looks[name].marker.matplotlib
        axes.plot(limit([final["iqm"]]), [row - 0.1], marker, color=color, markersize=7)
    axes.set_yticks(range(len(names)), names)
    axes.tick_params(axis="y", labelcolor=palette.INK)
    axes.set_ylim(len(names) - 0.5, -0.6)
    axes.grid(axis="x")
    if log:
        axes.set_xscale("log")
        percent_axis(axes.xaxis)
    else:
        axes.xaxis.set_major_formatter(lambda tick, _: data.write(tick))
        axes.locator_params(axis="x", nbins=5 if width > NARROW else 4)
    axes.set_xlabel("regret, a share of the optimum" if data.graded else "return")
    return figure


def _draw_curve(axes: Axes, data: ComparisonData, name: str, pace: float, log: bool) -> None:
    """Draw the interquartile mean over seeds and its band."""
    result, look = data.results[name], data.looks[name]
    values = curve(result, data.ranking["measure"])
    x = np.array(result.curve_steps) * pace
    if log:  # which has no zero
        values, x = values[x > 0], x[x > 0]
    color = palette.LIGHT[look.color]
    low, high, middle = (
        np.maximum(line, _floor(data)) if _logarithmic(data) else line
        for line in (*band(values), interquartile_mean(values))
    )
    axes.fill_between(x, low, high, color=color, alpha=0.16, linewidth=0)
    style: dict[str, Any] = {
        "linewidth": look.width,
        "linestyle": dashes(look.dash, look.width),
        "marker": look.marker.matplotlib,
        "markevery": (palette.MARKERS.index(look.marker) % 4, 4) if len(x) > 6 else 1,
        "markersize": 5,
        "clip_on": False,
    }
    axes.plot(x, middle, color=color, label=name, **style)


def _goal_line(axes: Axes, data: ComparisonData) -> None:
    """Draw the threshold for being near the goal: a share of the optimum or of the best return."""
    if _logarithmic(data):
        axes.set_yscale("log")
        axes.set_ylim(bottom=_floor(data))
        percent_axis(axes.yaxis)
    elif data.graded:
        axes.yaxis.set_major_formatter(lambda tick, _: data.write(tick))
    goal = data.ranking["goal"]
    height = HEADLINE if data.graded else goal - HEADLINE * abs(goal)
    axes.axhline(height, color=palette.INK, linewidth=0.9, dashes=(4, 3), zorder=1.5)


def _logarithmic(data: ComparisonData) -> bool:
    """Whether regrets are drawn on a logarithmic scale: if they span more than a decade."""
    middles = _middles(data)
    return data.graded and middles.max() > 10 * max(middles.min(), FLOOR)


def _floor(data: ComparisonData) -> float:
    """The lower end of a logarithmic scale: below the curves, but not below ``FLOOR``."""
    least = min(max(_middles(data).min(), FLOOR), HEADLINE / 2)
    return float(10 ** math.floor(math.log10(least)))


def _middles(data: ComparisonData) -> AnyFloats:
    """All points of all curves that are drawn as lines."""
    measure = data.ranking["measure"]
    return np.concatenate([interquartile_mean(curve(x, measure)) for x in data.results.values()])


# Text ----------------------------------------------------------------------------------------


def _facts(data: ComparisonData) -> list[tuple[str, str, str]]:
    """Return the key figures: name, value and a remark."""
    ranking, results = data.ranking, data.results
    first = ranking["order"][0]
    optimum = next(iter(results.values())).optimum
    near = percent(HEADLINE, 0)
    facts = [("Agents", str(len(results)), f"{amount(ranking['seeds'], 'seed')} each")]
    if data.graded and optimum is not None:
        facts.append(
            (
                "Exact optimum",
                typeset(four_digits(optimum)),
                f"on {number(data.starts, 0)} fixed starts",
            )
        )
    final = data.write(ranking["agents"][first]["final"]["iqm"])

    def who(names: list[str]) -> str:
        return names[0] if len(names) == 1 else f"{len(names)} agents"

    best = "Lowest regret" if data.graded else "Highest return"
    facts.append((best, final, who(best_of(ranking))))
    if arrivals := arrived(ranking):
        (steps, frugal), (seconds, quick) = (least(arrivals, key) for key in ("steps", "seconds"))
        facts += [
            (f"Fewest steps to {near}", rendering.large(steps), who(frugal)),
            (f"Least time to {near}", typeset(span(seconds)), f"{who(quick)}, a seed"),
        ]
    total = sum(result.seconds_train for result in results.values())
    facts.append(("Training, in all", duration(total), "all agents and seeds"))
    return facts


def _headline(data: ComparisonData, name: str) -> dict[str, Any]:
    entries = data.ranking["agents"][name]["within"]
    return next(entry for entry in entries if entry["threshold"] == HEADLINE)


def _reached(data: ComparisonData, name: str) -> list[tuple[str, str]]:
    """An agent's results: pairs of a value and a remark."""
    agent = data.ranking["agents"][name]
    final, near = agent["final"], _headline(data, name)
    seeds = len(data.results[name].returns)

    def interval(ends: list[float] | None) -> str:
        return "" if ends is None else " … ".join(map(data.write, ends))

    def spread() -> str:
        if final["interval"] is not None or seeds == 1:
            return interval(final["interval"])
        return over_seeds(final["per_seed"], None, data.write)

    return [
        (data.write(final["iqm"]), spread()),
        (data.write(final["mean"]), ""),
        (data.write(final["worst"]), ""),
        ("not reached" if near["steps"] is None else rendering.large(near["steps"]),
         f"{near['reached']} of {seeds} seeds"),
        ("–" if near["seconds"] is None else typeset(span(near["seconds"])), ""),
        (data.write(agent["area"]["iqm"]), interval(agent["area"]["interval"])),
    ]  # fmt: skip


def _took(result: Result) -> list[str]:
    """An agent's costs."""
    operations = result.operations_per_step
    return [
        rendering.large(result.env_steps),
        typeset(span(result.seconds_per_seed)),
        rendering.large(result.steps_per_second),
        "–" if operations is None else _scaled(operations, ("", "k", "M", "G")),
        _scaled(result.state_bytes, ("B", "kB", "MB", "GB")),
        _scaled(result.policy_bytes, ("B", "kB", "MB", "GB")),
        number(result.parameters, 0),
    ]


def _scaled(value: float, units: tuple[str, ...]) -> str:
    """A number with three significant digits, in thousands or millions if it is large."""
    power = 0
    while value >= 999.5 and power < len(units) - 1:
        value, power = value / 1000, power + 1
    digits = 0 if power == 0 or value >= 100 else 1
    return f"{number(value, digits)}{THIN_SPACE}{units[power]}".strip()


def _within(data: ComparisonData, name: str) -> list[tuple[str, str]]:
    """For each threshold, the steps until an agent stays within it, and how many seeds do."""
    seeds = len(data.results[name].returns)
    return [
        ("–" if entry["steps"] is None else rendering.large(entry["steps"]),
         "" if entry["reached"] == seeds else f"{entry['reached']} of {seeds}")
        for entry in data.ranking["agents"][name]["within"]
    ]  # fmt: skip


def _better(data: ComparisonData) -> list[tuple[str, list[dict[str, Any] | None]]]:
    """Return a row for each agent: the probability that its seeds beat each other agent's."""
    cells: dict[tuple[str, str], dict[str, Any]] = {}
    for pair in data.ranking["pairs"]:
        a, b, probability = pair["first"], pair["second"], pair["probability"]
        ends = pair["probability_interval"] or [math.nan, math.nan]
        cells[a, b] = _cell(probability, ends, pair["told_apart"])
        cells[b, a] = _cell(1 - probability, [1 - end for end in ends[::-1]], pair["told_apart"])
    names = list(data.results)
    return [(a, [cells.get((a, b)) for b in names]) for a in names]


def _cell(probability: float, ends: list[float], told_apart: bool) -> dict[str, Any]:
    return {
        "value": number(100 * probability, 0),
        "interval": " … ".join(number(100 * end, 0) for end in ends) if ends[0] < ends[1] else "",
        "shade": rendering.shade(2 * probability - 1),
        "apart": told_apart,
    }


def _settings(data: ComparisonData, name: str) -> tuple[str, list[Any]]:
    """A line on an agent's training, and all its settings by group."""
    entry, result = data.content["agents"][name], data.results[name]
    preset = f"preset {entry['preset']}, " if entry["preset"] else ""
    line = f"{entry['agent']}, {preset}at least {rendering.large(result.episodes)} episodes a seed"
    groups = {"agent": entry["agent_settings"], "task": entry["task_settings"]}
    return line, setting_groups(groups)
