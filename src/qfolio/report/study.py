"""The report of a study: one self-contained page without scripts.

All of its numbers are in study.json, so the report can be rewritten from it.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import msgspec

from qfolio.core.files import write_text
from qfolio.core.text import amount, listed, plural
from qfolio.portfolio.backtest.statistics.verdict import p_text
from qfolio.portfolio.study.evidence import Active, Evidence
from qfolio.portfolio.study.folder import Result, StudyConfig, StudyFolder
from qfolio.portfolio.study.pooling import Pools
from qfolio.portfolio.study.run import Study
from qfolio.portfolio.study.verdict import decimal, growth_text, looks_sentence
from qfolio.report import rendering
from qfolio.report.axis import Axis, ticks_around
from qfolio.report.rendering import THIN_SPACE, counted, number, render, setting_groups

REACH = 1.6
"""The axis extends this many times beyond the estimates; longer intervals are cut off."""

HIDDEN = ("prices", "assets", "feature_names", "command", "lag", "cost", "trials")
"""Settings of a backtest that differ between tables or are shown elsewhere."""


class Bar(NamedTuple):
    """An interval on the axis: places in percent of its width, and which ends are cut off."""

    left: float
    width: float
    dot: float
    cut_left: bool
    cut_right: bool


class Row(NamedTuple):
    """A table in the forest plot."""

    name: str
    link: str | None
    period: str
    years: str
    bar: Bar | None
    side: str  # above, below or neither: where the interval lies
    size: float  # of the mark, in pixels
    worst: bool
    cells: list[tuple[str, ...]]  # values, each with remarks
    label: str  # of the bar, for readers who do not see it


def write_study_report(study: Study) -> None:
    """Write report.html into the folder of a finished study.

    Raises:
        QfolioError: The study is not finished, or a backtest's folder is damaged.
        OSError: The file cannot be written.
    """
    result = study.config.result or study.result()
    first = study.backtest(next(iter(study.config.tables))).config
    settings = {k: v for k, v in msgspec.to_builtins(first).items() if k not in HIDDEN}
    files, main = StudyFolder(study.folder), study.config.variants[0]
    pages = {name: files.place(name, main) / "report.html" for name in study.config.tables}
    links = {
        name: page.relative_to(study.folder).as_posix()
        for name, page in pages.items()
        if page.exists()
    }
    page = render_study(study.config, result, settings, links)
    write_text(study.folder / "report.html", page)


def render_study(
    config: StudyConfig, result: Result, settings: dict[str, Any], links: dict[str, str]
) -> str:
    """Return the text of the page.

    Args:
        config: The study.
        result: Its pooled evidence.
        settings: Settings of its backtests, to list them.
        links: Links to the reports that exist, by table.
    """
    main, agents = result.variants[0], " and ".join(config.agents)
    tables = len(config.tables)
    on = next(iter(config.tables)) if tables == 1 else amount(tables, "table")
    notes: dict[str, list[str]] = {}
    for name, table in config.tables.items():
        if table.note:
            notes.setdefault(table.note, []).append(name)
    return render(
        "study.html",
        data=config,
        title=f"{agents} on {on}",
        spelled=main.variant.text,
        facts=_facts(config, result),
        looks=looks_sentence(result),
        notes=[(listed(names), note) for note, names in notes.items()],
        agents=[
            {
                "name": name,
                "verdicts": result.verdicts[name],
                "to_reference": next(iter(pools.evidence.values())).to_reference.reference,
                **_forest(pools, links),
                "variants": _variants(result, name),
            }
            for name, pools in main.agents.items()
        ],
        counted=counted(tables, "table"),
        several=tables > 1,
        repeats=f"The same {plural('table', tables)} and seeds give the same results",
        subject="study",
        settings=setting_groups(settings),
    )


def _facts(config: StudyConfig, result: Result) -> list[tuple[str, str, str]]:
    """The key figures: name, value and a remark."""
    main = result.variants[0]
    known = list(next(iter(main.agents.values())).evidence.values())
    tables, variants = len(config.tables), len(config.variants)
    several = "all tables together"
    tested = several if tables > 1 else rendering.years(known[0].first, known[0].last)
    earlier = f", {number(result.earlier, 0)} earlier" if result.earlier else ""
    return [
        (plural("Table", tables), str(tables), f"{len(config.left_out)} left out"),
        ("Tested", f"{number(sum(one.years for one in known))} years", tested),
        ("Folds", config.test, f"after {config.train} of training"),
        ("Cost", f"{main.variant.bps:g}{THIN_SPACE}bp", f"lag {main.variant.lag}"),
        ("Looks", number(result.looks, 0), f"{amount(variants, 'variant')}{earlier}"),
        ("z by luck", decimal(result.threshold), f"best of {amount(result.trials, 'trial')}"),
    ]


def _forest(pools: Pools, links: dict[str, str]) -> dict[str, Any]:
    """The rows of the forest plot, the best first, the pooled row, and the axis."""
    actives = {name: known.to_reference for name, known in pools.evidence.items()}
    pooled, several = pools.to_reference, len(actives) > 1
    points = [x for one in actives.values() if (x := one.growth) is not None]
    points += [x for x in (pooled.low, pooled.growth, pooled.high, 0.0) if x is not None]
    ends = [x for one in actives.values() for x in (one.low, one.high) if x is not None]
    low = max(min([*points, *ends]), REACH * min(points) - 0.25 * max(points))
    high = min(max([*points, *ends]), REACH * max(points) - 0.25 * min(points))
    ticks, digits = ticks_around(low, high)
    axis = Axis(min(low, ticks[0]), max(high, ticks[-1]))

    def bar(growth: float | None, left: float | None, right: float | None) -> Bar | None:
        if growth is None or left is None or right is None:
            return None
        return Bar(*axis.span(growth, (left, right)), left < axis.low, right > axis.high)

    longest = max(known.years for known in pools.evidence.values())
    order = sorted(actives, key=lambda name: _or(actives[name].growth), reverse=True)
    rows = [
        Row(
            name=name,
            link=links.get(name),
            period=rendering.years(known.first, known.last),
            years=number(known.years),
            bar=bar(one.growth, one.low, one.high),
            side=_side(one.low, one.high),
            size=round(6 + 6 * math.sqrt(known.years / longest), 1),
            worst=several and name == pooled.worst,
            cells=_cells(known),
            label=_label(one.growth, one.low, one.high),
        )
        for name in order
        for one, known in [(actives[name], pools.evidence[name])]
    ]
    rest = pools.to_rebalanced
    return {
        "rows": rows,
        "pooled": {
            "years": number(sum(known.years for known in pools.evidence.values())),
            "bar": bar(pooled.growth, pooled.low, pooled.high),
            "side": _side(pooled.low, pooled.high),
            "cells": [
                (growth_text(pooled.growth), _interval(pooled.low, pooled.high)),
                ("",),
                (f"z {decimal(pooled.z)}", _chance(pooled.p_holm)),
                (growth_text(rest.growth), f"z {decimal(rest.z)}", _chance(rest.p_holm)),
                (decimal(pools.sharpe.difference), f"z {decimal(pools.sharpe.z)}"),
            ],
            "label": _label(pooled.growth, pooled.low, pooled.high),
        },
        "ticks": [(rendering.percent(tick, digits, sign=True), axis.at(tick)) for tick in ticks],
        "zero": axis.at(0.0),
        "mean": axis.at(pooled.growth) if several and pooled.growth is not None else None,
        "cut": any(row.bar and (row.bar.cut_left or row.bar.cut_right) for row in rows),
    }


def _cells(known: Evidence) -> list[tuple[str, ...]]:
    active, rest = known.to_reference, known.to_rebalanced
    return [
        (growth_text(active.growth), _interval(active.low, active.high)),
        (decimal(active.information_ratio), f"TE {_spread(active)}"),
        (decimal(active.t),),
        (growth_text(rest.growth), f"t {decimal(rest.t)}"),
        (decimal(known.sharpe), f"t {decimal(known.sharpe_t)}", known.baseline),
    ]


def _variants(result: Result, agent: str) -> dict[str, Any] | None:
    """The pooled results by lag (rows) and cost (columns); none if there is one variant."""
    if len(result.variants) < 2:
        return None
    pools = {(each.variant.lag, each.variant.bps): each.agents[agent] for each in result.variants}
    main = next(iter(pools))
    lags, costs = sorted({lag for lag, _ in pools}), sorted({bps for _, bps in pools})
    return {
        "costs": [f"{bps:g}{THIN_SPACE}bp" for bps in costs],
        "rows": [
            (f"Lag {lag}", [_cell(pools[lag, bps], (lag, bps) == main) for bps in costs])
            for lag in lags
        ],
    }


def _cell(pools: Pools, main: bool) -> dict[str, Any]:
    pooled = pools.to_reference
    return {
        "growth": growth_text(pooled.growth),
        "interval": _interval(pooled.low, pooled.high),
        "z": decimal(pooled.z),
        "rest": decimal(pools.to_rebalanced.z),
        "shade": rendering.shade(round(pooled.z or 0.0) / 5),
        "main": main,
    }


def _side(low: float | None, high: float | None) -> str:
    if low is not None and low > 0:
        return "above"
    return "below" if high is not None and high < 0 else "neither"


def _interval(low: float | None, high: float | None) -> str:
    if low is None or high is None:
        return "no interval"
    return f"{growth_text(low)} … {growth_text(high)}"


def _label(growth: float | None, low: float | None, high: float | None) -> str:
    return f"{growth_text(growth)}, 95% interval {_interval(low, high)}"


def _chance(p: float | None) -> str:
    return "" if p is None else f"p {p_text(p)}"


def _spread(active: Active) -> str:
    spread = active.tracking_error
    return "undefined" if spread is None else rendering.percent(spread)


def _or(value: float | None) -> float:
    return -math.inf if value is None else value
