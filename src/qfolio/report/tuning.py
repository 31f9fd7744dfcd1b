"""The report of a hyperparameter search: one self-contained page and its figures."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from qfolio.core.files import write_text
from qfolio.core.statistics import mean_interval, regret
from qfolio.core.text import amount
from qfolio.experiments.tuning.journal import best_of
from qfolio.experiments.tuning.sensitivity import Effect, short
from qfolio.report.data import decimals
from qfolio.report.figures.style import LEAD, WIDE, save_png
from qfolio.report.figures.tuning import draw_pair, draw_progress, draw_sensitivity, shaded_svgs
from qfolio.report.rendering import number, over_seeds, percent, render, setting_groups
from qfolio.report.sweep import Sweep

TOP = 10
"""Number of rows in the table of the best trials."""


def write_tuning_report(folder: Path, data: Sweep) -> None:
    """Writes report.html, progress.png and, if there are enough trials, further figures."""
    save_png(folder / "progress.png", draw_progress, data, LEAD)
    figures = {"sensitivity.png": (draw_sensitivity, LEAD), "pair.png": (draw_pair, WIDE)}
    for name, (draw, width) in figures.items():
        if data.found is None or (draw is draw_pair and len(data.space) < 2):
            (folder / name).unlink(missing_ok=True)
        else:
            save_png(folder / name, draw, data, width)
    write_text(folder / "report.html", render_page(data))


def render_page(data: Sweep) -> str:
    """Return the text of the page."""
    pair = data.found is not None and len(data.space) > 1
    return render(
        "tuning.html",
        data=data,
        config=data.config,
        found=data.found,
        far=_far(data.config),
        facts=_facts(data),
        effects=[_row(effect, data) for effect in data.found.effects] if data.found else [],
        finals=_finals(data),
        names=[dim.name for dim in data.space],
        top=_top(data),
        sensitivity=shaded_svgs(draw_sensitivity, data, LEAD) if data.found else None,
        pair=shaded_svgs(draw_pair, data, WIDE) if pair else None,
        progress=shaded_svgs(draw_progress, data, WIDE),
        settings=setting_groups(data.config),
    )


def _far(config: dict[str, Any]) -> str:
    unit = "steps" if config["episodes"] is None else "episodes"
    return f"{number(config[unit], 0)} {unit}"


def _facts(data: Sweep) -> list[tuple[str, str, str]]:
    """Return the key figures: name, value and a remark."""
    best = best_of(data.trials)
    assert best is not None
    digits = decimals(data.summary["optimum"] or best.value)
    failed = sum(math.isnan(trial.value) for trial in data.trials)
    config = data.config
    trained = np.array(data.summary["return_per_seed"], float)
    graded = float(np.mean(trained))
    seeds = amount(len(data.summary["seeds"]), "seed")
    note = f"retrained, {seeds}, graded starts"
    if data.summary["optimum"] is not None:
        note = f"retrained, {seeds}; optimum {number(data.summary['optimum'], digits)}"
    hour = 3600 / float(np.mean([trial.seconds for trial in data.trials]))
    return [
        (
            "Trials",
            number(len(data.trials), 0),
            f"{amount(config['seeds'], 'seed')} each, {failed} diverged",
        ),
        ("Best found", number(best.value, digits), f"trial {best.number + 1}, on tuning starts"),
        ("Best, graded", "diverged" if math.isnan(graded) else number(graded, digits), note),
        ("Trials an hour", number(hour, 0), f"{config['batch']} at once"),
    ]


def _row(effect: Effect, data: Sweep) -> dict[str, Any]:
    """Return a setting's row of the table; places are percentages of its scale."""
    dim = effect.dimension
    best = best_of(data.trials)
    assert best is not None
    assert data.found is not None
    values = {"best": best.values[dim.name], "preset": data.own[dim.name]}
    shown = {
        name: value if isinstance(value, str) else short(value) for name, value in values.items()
    }
    if dim.choices:
        kept = [c for c, good in zip(dim.choices, effect.robust, strict=True) if good]
        half = 50 / len(dim.choices)
        spans = [(100 * place - half, 2 * half) for place in effect.places[effect.robust]]
        robust = " | ".join(kept)
        searched = " | ".join(dim.choices)
    else:
        low, high = effect.range
        spans = [(100 * low, 100 * (high - low))]
        robust = f"{short(dim.at(low))} to {short(dim.at(high))}"
        searched = f"{short(dim.low)} to {short(dim.high)}"
    inside = {name: 100 * dim.position(v) for name, v in values.items() if dim.covers(v)}
    return {
        "name": dim.name,
        "share": percent(effect.share, 0),
        "bar": 100 * effect.share / max(e.share for e in data.found.effects),
        "searched": searched,
        "robust": robust,
        "spans": spans,
        "places": inside,
        **shown,
    }


def _finals(data: Sweep) -> list[tuple[str, list[str]]]:
    """Return a row for the best and one for the preset: mean, spread, worst seed, regret."""
    optimum = data.summary["optimum"]
    rows = []
    for name, key in (("Best", "return_per_seed"), ("Preset", "preset_return_per_seed")):
        returns = np.array(data.summary[key], float)
        if not np.isfinite(returns).all():
            rows.append((name, ["diverged", "–", "–", "–"]))
            continue
        digits = decimals(optimum or returns.mean())
        spread = over_seeds(returns, mean_interval(returns), partial(number, digits=digits))
        missed = regret(returns.mean(), optimum)
        share = "–" if missed is None else percent(float(missed), 1)
        cells = [number(returns.mean(), digits), spread, number(returns.min(), digits), share]
        rows.append((name, cells))
    return rows


def _top(data: Sweep) -> list[tuple[str, str, list[str]]]:
    """Return rank, return and settings of the best trials, and of the preset at any rank."""
    ranked = sorted(data.trials, key=lambda trial: -np.nan_to_num(trial.value, nan=-np.inf))
    digits = decimals(data.summary["optimum_tuned_on"] or ranked[0].value)
    rows = []
    for rank, trial in enumerate(ranked, 1):
        if rank <= TOP or trial.is_preset:
            values = [trial.values[dim.name] for dim in data.space]
            cells = [value if isinstance(value, str) else short(value) for value in values]
            name = f"{rank} (preset)" if trial.is_preset else str(rank)
            rows.append((name, number(trial.value, digits), cells))
    return rows
