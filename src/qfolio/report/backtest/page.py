"""The report of a backtest: one self-contained page with interactive charts, and one image.

The page holds plotly.js, its data and its own script, and its Content-Security-Policy lists the
hashes of these scripts: nothing else can run in it, and it loads nothing. All text that a user can
choose (titles, names of strategies and assets, settings) is escaped by the template or set as plain
text; plotly, which interprets markup in names, gets only numbers.
"""

from __future__ import annotations

import base64
import hashlib
import math
from pathlib import Path

from jinja2.utils import htmlsafe_json_dumps
from markupsafe import Markup

from qfolio.core.files import write_text
from qfolio.portfolio.backtest.statistics.assessment import JUDGED
from qfolio.portfolio.backtest.statistics.verdict import bound_sentence
from qfolio.report.backtest.charts import (
    chart_data,
    days_per_point,
    latest_values,
    rolling_window,
)
from qfolio.report.backtest.convergence import convergence_sentences, draw_convergence
from qfolio.report.backtest.data import (
    BacktestData,
    best_word,
    main_names,
    require_fit,
    shown_order,
)
from qfolio.report.backtest.facts import account, few_seeds, key_facts, unit_of
from qfolio.report.backtest.holdings import BLOCKS
from qfolio.report.backtest.looks import looks_of
from qfolio.report.backtest.opening import (
    best_sentence,
    conclusion,
    lead_name,
    rival_name,
    tiles,
    verdict_lines,
)
from qfolio.report.backtest.tables import (
    HEADINGS,
    RELATIVE_HEADINGS,
    capacity_table,
    cost_kinds,
    cost_rows,
    dearer_table,
    difference_headings,
    difference_rows,
    fold_rows,
    luck_rows,
    month_tables,
    rebalancing_rows,
    relative_rows,
    statistics_rows,
)
from qfolio.report.backtest.tearsheet import tear_sheet
from qfolio.report.backtest.verdicts import verdict_rows
from qfolio.report.backtest.wealth import draw_wealth
from qfolio.report.backtest.why import diagnoses, why_sections
from qfolio.report.figures.style import LEAD, save_png, svgs
from qfolio.report.rendering import render, setting_groups, source

SCRIPTS = ("tools.js", "backtest.js", "holdings.js")
"""The page's own script, in this order."""


def write_backtest_report(folder: Path, data: BacktestData) -> None:
    """Write report.html and wealth.png into a folder.

    Args:
        folder: The folder to write to; created if missing.
        data: The data of the report.

    Raises:
        OSError: A file cannot be written.
        QfolioError: Strategies, assessment, dates and assets do not fit together.
    """
    page = render_backtest(data)
    save_png(folder / "wealth.png", draw_wealth, data, LEAD)
    write_text(folder / "report.html", page)


def render_backtest(data: BacktestData) -> str:
    """Return the text of the page; see ``write_backtest_report``."""
    from plotly.offline import get_plotlyjs

    require_fit(data)
    names, lead = shown_order(data), main_names(data)
    looks = looks_of(names, data)
    payload = chart_data(names, looks, data)
    own = "\n".join(source(name) for name in SCRIPTS)
    scripts = [script.replace("\r\n", "\n") for script in (get_plotlyjs(), own)]
    return render(
        "backtest.html",
        data=data,
        test=data.assessment,
        scripts=[Markup(script) for script in scripts],
        hashes=[_hash(script) for script in scripts],
        payload=htmlsafe_json_dumps(payload, separators=(",", ":"), allow_nan=False),
        strategies=[
            (name, "agent" if data.strategies[name].kind in JUDGED else "baseline", looks[name])
            for name in names
        ],
        hidden=payload["hidden"],
        conclusion=conclusion(data),
        best=best_sentence(data),
        best_word=best_word(data.assessment.best_baseline, data),
        own=any(series.kind == "strategy" for series in data.strategies.values()),
        leading=(leading := lead_name(data)),
        rival=rival_name(data),
        start=names.index(leading or data.assessment.reference),
        tiles=tiles(data),
        lines=verdict_lines(data),
        verdicts=verdict_rows(names, data),
        sheet=tear_sheet(lead, data),
        rolling=rolling_window(data),
        facts=key_facts(data),
        why=why_sections(data),
        diagnoses=diagnoses(data),
        looks=looks,
        latest={
            name: latest_values(lines)
            for name, lines in zip(names, payload["strategies"], strict=True)
        },
        headings=HEADINGS,
        lead=len(lead),
        bound=bound_sentence(data.assessment),
        statistics=[(name, statistics_rows(name, data)) for name in names],
        relative_headings=RELATIVE_HEADINGS,
        relative=[(name, relative_rows(name, data)) for name in names],
        held=[name for name in names if data.strategies[name].weighted],
        difference_headings=difference_headings(data),
        differences=[(name, difference_rows(name, data)) for name in names],
        rebalancings=rebalancing_rows(data),
        cost_kinds=cost_kinds(data),
        costs=cost_rows(lead, data),
        cash_earns=bool(data.risk_free.any()),
        dearer=dearer_table(data),
        capacity=capacity_table(data),
        luck=luck_rows(lead, data),
        months=month_tables(names, data),
        folds=fold_rows(data.folds),
        fold_names=any(fold["name"] != fold["test_first"] for fold in data.folds),
        training=svgs(draw_convergence, data.training, LEAD) if data.training else None,
        converged=convergence_sentences(data.training),
        said=account(data),
        settings=setting_groups(data.config),
        thinned=days_per_point(len(data.dates)),
        several_seeds=any(entry.seeds > 1 for entry in data.assessment.strategies.values()),
        few_seeds=few_seeds(data.assessment),
        averaged=math.ceil(len(data.dates) / BLOCKS),
        unit=unit_of(data.assessment.periods_per_year),
    )


def _hash(script: str) -> str:
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"
