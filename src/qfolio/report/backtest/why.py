"""The page's section that attributes the agents' returns: sentences, and positions of its marks.

Bars and lines are plain HTML and SVG: positions are in percent of their track or panel, and names
stand beside them as text.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from qfolio.portfolio.backtest.attribution.decomposition import AssetPart, Decomposition
from qfolio.portfolio.backtest.attribution.factors import Exposures
from qfolio.portfolio.backtest.attribution.importance import Worth
from qfolio.portfolio.backtest.attribution.slices import Slice, Slices
from qfolio.portfolio.backtest.attribution.why import AgentWhy
from qfolio.report.axis import Axis
from qfolio.report.backtest.data import BacktestData
from qfolio.report.rendering import number, percent

LISTED = 20
"""Number of assets, besides cash, whose parts of the return are listed; the rest is added up."""

SIGNIFICANT = 1.96
"""The t-statistic beyond which a figure is bold: 5% of those with no true effect exceed it."""

SHOWN = 5e-6
"""Signals that all move a weight by less are drawn without bars: their figures round to 0.000%."""

FAINT = 0.1
"""Signals that together move weights by less than this share of the linear rule's largest
coefficient do not explain it."""


def why_sections(data: BacktestData) -> list[dict[str, Any]]:
    """The section's content for each agent that has an attribution."""
    if data.why is None:
        return []
    begun = {fold["name"]: fold["test_first"] for fold in data.folds}
    return [
        {
            "name": name,
            "headline": headline(name, why.decomposition),
            "parts": _parts(why.decomposition),
            "folds": _folds(why.decomposition, begun),
            "last": data.folds[-1]["test_last"],
            "assets": _assets(why.decomposition),
            "others": len(why.decomposition.assets) > LISTED + 2,
            "exposures": _exposures(why.exposures, data.why.reference),
            "ignored": why.importance.ignored,
            "signals": _signals(why),
            "told": _told(why),
            "slices": _panels(why.slices),
            "asset": why.slices.asset,
            "partner": why.slices.partner,
        }
        for name, why in data.why.agents.items()
    ]


def diagnoses(data: BacktestData) -> list[str]:
    """All sentences about dead agents."""
    found = {} if data.why is None else data.why.diagnosis
    return [sentence for sentences in found.values() for sentence in sentences]


def headline(name: str, parts: Decomposition) -> str:
    """A sentence on the sources of the return, which add up."""
    digits = _digits([parts.tilts, parts.timing, parts.cost])
    said = {
        key: percent(value, digits, sign=key in ("tilts", "timing"))
        for key, value in (
            ("net", parts.net), ("equal", parts.equal), ("tilts", parts.tilts),
            ("timing", parts.timing), ("cost", parts.cost),
        )
    }  # fmt: skip
    return (
        f"{name} earned {said['net']} a year: {said['equal']} from equal weights, {said['tilts']} "
        f"from constant tilts and {said['timing']} from timing (t = {number(parts.active_t)} for "
        f"the two together), less {said['cost']} in costs."
    )


def _digits(values: Sequence[float]) -> int:
    """Decimals of a percentage that keep the parts apart: one, or two for small ones."""
    return 2 if max(map(abs, values)) < 0.01 else 1


def _parts(parts: Decomposition) -> list[dict[str, Any]]:
    """Bars of the parts of the agent's return over equal weights."""
    digits = _digits([parts.tilts, parts.timing, parts.cost])
    rows = [
        ("Constant tilts", parts.tilts, "mean weights, less equal weights"),
        ("Timing", parts.timing, f"with constant tilts, t = {number(parts.active_t)}"),
        ("Costs", -parts.cost, "of all trades"),
        ("Net of equal weights", parts.net - parts.equal, "the sum; these pay no costs here"),
    ]
    places = bars([value for _, value, _ in rows])
    return [
        {"name": name, "note": note, "value": percent(value, digits, sign=True), "bar": bar}
        for (name, value, note), bar in zip(rows, places, strict=True)
    ]


def _folds(parts: Decomposition, begun: Mapping[str, str]) -> list[dict[str, Any]]:
    """Bars and figures of the folds, each named by the first day of its test."""
    highest = max((abs(fold.timing) for fold in parts.folds), default=0.0) or 1.0
    return [
        {
            "name": begun.get(fold.name, fold.name),
            "height": round(50 * abs(fold.timing) / highest, 2),
            "side": "gain" if fold.timing >= 0 else "loss",
            "cells": [
                percent(value, 2, sign=True)
                for value in (fold.static, fold.timing, -fold.cost, fold.net)
            ],
        }
        for fold in parts.folds
    ]


def _assets(parts: Decomposition) -> list[dict[str, Any]]:
    """Cash and the assets in order; with many assets, those with the largest parts and the rest."""
    cash, *assets = parts.assets
    rest: list[AssetPart] = []
    if len(assets) > LISTED + 1:  # a single other would need a row as well
        assets.sort(key=lambda asset: -abs(asset.static + asset.timing))
        assets, rest = assets[:LISTED], assets[LISTED:]
    rows = [(asset.name, [asset]) for asset in (cash, *assets)]
    if rest:
        rows.append((f"{number(len(rest), 0)} others", rest))
    return [
        {
            "name": name,
            "cells": [
                percent(sum(asset.weight for asset in group)),
                percent(sum(asset.static for asset in group), 2, sign=True),
                percent(sum(asset.timing for asset in group), 2, sign=True),
            ],
        }
        for name, group in rows
    ]


def _exposures(found: Exposures | None, reference: str) -> dict[str, Any] | None:
    if found is None:
        return None
    rows = [("Alpha, a year", percent(found.alpha, 2, sign=True), found.alpha_t)]
    rows += [(each.name, number(each.beta, 3, sign=True), each.t) for each in found.factors]
    return {
        "rows": [
            {"name": name, "value": value, "t": number(t), "sure": abs(t) > SIGNIFICANT}
            for name, value, t in rows
        ],
        "about": f"Net returns less those of {reference} before its costs, regressed on factors "
        "made from the table. "
        f"R² {percent(found.r2, 0)}; {found.lags} lags.",
    }


def _signals(why: AgentWhy) -> list[dict[str, Any]]:
    """A row for each channel: its value, its effect on weights, and its coefficient in the rule."""
    worth = [*why.importance.signals, why.importance.everything]
    order = [*sorted(worth[:-1], key=lambda each: -each.lost), worth[-1]]
    places = bars([each.lost for each in order], [(each.low, each.high) for each in order])
    pulls = {each.name: each for each in why.gradients.pulls} if why.gradients else {}
    terms = {} if why.importance.ignored else {each.name: each for each in why.rule.terms}
    longest = max((each.size for each in pulls.values()), default=0.0) or 1.0
    digits = _digits([each.lost for each in order])
    rows = []
    for each, bar in zip(order, places, strict=True):
        pull, term = pulls.get(each.name), terms.get(each.name)
        rows.append(
            {
                "name": each.name,
                "shared": each.shared,
                "bar": bar,
                "lost": percent(each.lost, digits, sign=True),
                "t": number(each.t),
                "sure": abs(each.t) > SIGNIFICANT,
                "label": _label(each),
                "pull": None
                if pull is None
                else {
                    "width": round(100 * pull.size / longest, 2) if longest >= SHOWN else 0.0,
                    "size": percent(pull.size, 2 if longest > 1e-3 else 3),
                    "sign": "" if abs(pull.direction) < 0.2 else "▲" if pull.direction > 0 else "▼",
                },
                "term": None if term is None else percent(term.per_deviation, 3, sign=True),
            }
        )
    return rows


def _label(worth: Worth) -> str:
    return (
        f"{percent(worth.lost, 2, sign=True)} a year, from {percent(worth.low, 2, sign=True)} to "
        f"{percent(worth.high, 2, sign=True)} over the shuffles"
    )


def _told(why: AgentWhy) -> list[str]:
    """Remarks below the table of signals."""
    found, rule = why.importance, why.rule
    followed = "the mean of all seeds" if found.seeds > 1 else "one seed"
    shuffles = "one shuffle" if found.draws == 1 else f"{found.draws} shuffles"
    sentences = [f"Worth: {shuffles} of each signal, {followed}, {found.replays} replays in all."]
    if not found.signals:
        sentences.append(
            "There is too much to replay for each signal by itself, so only all together were "
            "shuffled."
        )
    if why.menu:
        sentences.append(
            "This agent chooses from a menu; its weights jump, so they have no gradients."
        )
    if found.ignored:
        sentences.append("No signal changes what it decides, so no rule of signals describes it.")
    elif rule.r2 is None:
        sentences.append("Its weights did not differ between assets, so no rule can describe them.")
    elif rule.terms:
        sentences.append(
            f"The linear rule explains {percent(max(rule.r2, 0.0), 0)} of the active weights in "
            "the folds that it was not fitted on (R²)."
        )
        largest = max(abs(term.per_deviation) for term in rule.terms)
        if why.gradients and why.gradients.whole < FAINT * largest:
            sentences.append(
                "Its orders hardly depend on the signals, so the rule describes how weights drift "
                "between trades, not what the agent learned."
            )
    return sentences


def _panels(slices: Slices) -> dict[str, Any]:
    """The panels of small multiples; those of the signals share one scale of weights."""
    values = [y for each in slices.signals for line in (*each.lines, *each.above) for y in line]
    ends = _range(values)
    held = slices.holding
    highest = max(held.x[-1], *(max(line) for line in held.lines))
    lowest = min(0.0, held.x[0], *(min(line) for line in held.lines))
    return {
        "holding": _panel(held, (lowest, highest), identity=True),
        "signals": [_panel(each, ends) for each in slices.signals],
    }


def _range(values: Sequence[float]) -> tuple[float, float]:
    """The ends of an axis: apart by a hundredth of the largest weight, where all are the same.

    Weights without shorts and loans have an axis within 0 and 1.
    """
    low, high = min(values, default=0.0), max(values, default=1.0)
    margin = max(0.06 * (high - low), 0.01 * max(abs(low), abs(high)), 5e-6)
    return max(min(low, 0.0), low - margin), min(max(high, 1.0), high + margin)


def _panel(each: Slice, ends: tuple[float, float], identity: bool = False) -> dict[str, Any]:
    x, (low, high) = np.array(each.x), ends
    across = 100 * (x - x[0]) / (np.ptp(x) or 1.0)

    def points(line: Any) -> str:
        up = 100 * (1 - (np.asarray(line) - low) / ((high - low) or 1.0))
        return " ".join(f"{a:.4g},{b:.4g}" for a, b in zip(across, up.clip(-5, 105), strict=True))

    digits = next((d for d in range(5) if (high - low) * 10 ** (d + 2) >= 4), 5)
    means = [np.mean(lines, axis=0) for lines in (each.lines, each.above) if lines]
    edges = points(means[0]) + " " + " ".join(reversed(points(means[-1]).split()))
    return {
        "name": each.name,
        "shared": each.shared,
        "lines": [points(line) for line in (*each.lines, *each.above)]
        if len(each.lines) > 1
        else [],
        "means": [points(mean) for mean in means],
        "band": edges if len(means) > 1 else "",
        "identity": points(x) if identity else "",
        "y": (percent(low, digits), percent(high, digits)),
        "x": tuple(
            percent(end, 0) if identity else _tick(end, float(np.ptp(x))) for end in (x[0], x[-1])
        ),
    }


def _tick(value: float, width: float) -> str:
    digits = next((d for d in range(5) if width * 10**d >= 10), 5)
    return number(value, digits)


def bars(
    values: Sequence[float], whiskers: Sequence[tuple[float, float]] = ()
) -> list[dict[str, Any]]:
    """Positions of bars from a common zero, in percent of their track."""
    ends = [*values, *(end for pair in whiskers for end in pair), 0.0]
    axis = Axis(min(ends), max(ends))
    found = []
    for i, value in enumerate(values):
        left, right = sorted((axis.at(0), axis.at(value)))
        bar: dict[str, Any] = {
            "left": left,
            "width": round(right - left, 2),
            "zero": axis.at(0),
            "side": "gain" if value >= 0 else "loss",
            "whisker": None,
        }
        if whiskers:
            bar["whisker"] = axis.span(value, whiskers[i])[:2]
        found.append(bar)
    return found
