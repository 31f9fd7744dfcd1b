"""The report on adaptation to a changed task: one self-contained page and its figure.

All data is in continual.json, so the report can be rewritten from it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from qfolio.core.files import write_text
from qfolio.core.statistics import band, interquartile_mean
from qfolio.experiments.continual import WAYS
from qfolio.report import palette
from qfolio.report.figures.style import (
    LEAD,
    NARROW,
    new_figure,
    percent_axis,
    save_png,
    short_tick,
    svgs,
)
from qfolio.report.looks import Look
from qfolio.report.rendering import duration, large, number, percent, render, setting_groups

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Content = dict[str, Any]
"""The type of continual.json's content."""

LOOKS = dict(zip(WAYS, map(Look, ("muted", "agent-3", "agent-1", "agent-2")), strict=True))
"""The look of each way."""

FLOOR = 1e-3
"""The smallest regret drawn on the logarithmic scale."""


def write_continual_report(folder: Path, content: Content) -> None:
    """Write report.html and recovery.png into a folder, which is created if missing."""
    save_png(folder / "recovery.png", draw_recovery, content, LEAD)
    write_text(folder / "report.html", render_page(content))


def render_page(content: Content) -> str:
    """Return the text of the page."""
    keys = ("agent", "episodes", "seeds", "seed", "rate", "renewal", "epsilon", "version")
    general = {key: content[key] for key in (*keys, "device", "started")}
    groups = {"task": content["task_settings"], "agent": content["agent_settings"]}
    return render(
        "continual.html",
        content=content,
        data={"command": content["command"]},
        change=change(content),
        verdict=verdict(content),
        facts=_facts(content),
        rows=[(way, WAYS[way], _row(content, way)) for way in WAYS],
        looks=LOOKS,
        within=percent(content["within"], 0),
        rate=percent(content["rate"], 0),
        renewal=percent(content["renewal"], 0),
        recovery=svgs(draw_recovery, content, LEAD),
        settings=setting_groups({**general, **groups}),
    )


def change(content: Content) -> str:
    """The changes as text."""
    changes = content["changes"].items()
    return ", ".join(f"{name} from {old:g} to {new:g}" for name, (old, new) in changes)


def verdict(content: Content) -> str:
    """Return the result in a few plain sentences."""
    worse = percent(_middle(content, "frozen"))
    before = percent(float(interquartile_mean(content["training"]["final"])))
    found = [f"The policy has a regret of {before} in the task it was trained on, and of {worse} "
             "after the change, without further learning."]  # fmt: skip
    for way in ("renewed", "going on", "fresh"):
        steps = content["recovery"][way]["middle"]
        name = {"going on": "Going on", "renewed": "Renewed learning", "fresh": "A new agent"}[way]
        why = content["courses"][way]["unlearned"]
        goal = f"within {percent(content['within'], 0)} of the new optimum"
        if why:
            found.append(f"{name} {why}")
        elif steps is None:
            found.append(f"{name} does not settle {goal} in {_learned(content, way)} steps.")
        else:
            found.append(f"{name} stays {goal} from {large(round(steps))} steps on.")
    return " ".join(found)


def _facts(content: Content) -> list[tuple[str, str, str]]:
    optimum = content["optimum"]
    training = content["training"]
    return [
        ("Optimum before", number(optimum["old"]), "exact"),
        ("Optimum after", number(optimum["new"]), "exact"),
        ("Regret before", percent(float(interquartile_mean(training["final"]))), "after training"),
        ("Regret at once", percent(_middle(content, "frozen")), "after the change"),
        ("First training", large(training["steps"][-1]), "steps of a seed"),
        ("Seeds", str(content["seeds"]), f"from {content['seed']} on"),
    ]


def _row(content: Content, way: str) -> list[tuple[str, str]]:
    """The results of one way to adapt: pairs of a value and a remark."""
    course, recovery = content["courses"][way], content["recovery"][way]
    reached = sum(step is not None for step in recovery["per_seed"])
    middle = recovery["middle"]
    seconds = course["seconds"]
    return [
        (percent(_middle(content, way)), f"worst {percent(max(course['final']))}"),
        ("–" if middle is None else large(round(middle)), f"{reached} of {content['seeds']}"),
        (_learned(content, way), duration(seconds) if seconds else ""),
        (percent(float(interquartile_mean(course["other"]))), ""),
    ]


def _learned(content: Content, way: str) -> str:
    """Environment steps of a seed after the change."""
    return large(content["courses"][way]["steps"][-1])


def _middle(content: Content, way: str) -> float:
    return float(interquartile_mean(content["courses"][way]["final"]))


def draw_recovery(content: Content, width: float) -> Figure:
    """Draw the regret in the changed world over the steps since the change."""
    figure = new_figure(width, 4.2 if width > NARROW else 3.9)
    axes = figure.subplots()
    axes.grid(axis="y")
    axes.set_xlabel("environment steps of a seed since the change")
    last = max(course["steps"][-1] for course in content["courses"].values())
    for way in reversed(WAYS):
        _draw_course(axes, content, way, last)
    axes.set_yscale("log")
    axes.set_xlim(0, last)
    axes.xaxis.set_major_formatter(lambda tick, _: short_tick(tick))
    axes.locator_params(axis="x", nbins=6 if width > NARROW else 4)
    percent_axis(axes.yaxis)
    axes.axhline(content["within"], color=palette.INK, linewidth=0.9, dashes=(4, 3), zorder=1.5)
    axes.set_title("Regret in the changed world")
    handles, labels = axes.get_legend_handles_labels()
    columns = len(WAYS) if width > NARROW else 2
    figure.legend(
        handles[::-1], labels[::-1], loc="outside upper left", ncols=columns,
        labelcolor=palette.INK, handlelength=2.2, columnspacing=1.6, borderpad=0.3,
    )  # fmt: skip
    return figure


def _draw_course(axes: Axes, content: Content, way: str, last: int) -> None:
    """Draw the interquartile mean over seeds and its band; a constant line without learning."""
    course = content["courses"][way]
    steps, curve = np.array(course["steps"]), np.array(course["curve"])
    if len(steps) == 1:
        steps, curve = np.array([0, last]), np.repeat(curve, 2, axis=0)
    look = LOOKS[way]
    color = palette.LIGHT[look.color]
    low, high, middle = (
        np.maximum(line, FLOOR) for line in (*band(curve), interquartile_mean(curve))
    )
    axes.fill_between(steps, low, high, color=color, alpha=0.16, linewidth=0)
    axes.plot(steps, middle, color=color, linewidth=look.width, label=way, clip_on=False)
