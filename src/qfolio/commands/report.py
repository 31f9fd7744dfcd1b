"""The command that rewrites a folder's report and can print it as PDF."""

from collections.abc import Callable
from pathlib import Path

from tyro.conf import Positional

from qfolio.commands import comparison, continual, training, tuning
from qfolio.commands.arguments import Modules, prepare
from qfolio.commands.parsing import PAGE, Document
from qfolio.core.errors import QfolioError

FILES = ("comparison.json", "continual.json", "study.json", "config.json")
"""The files that identify the kind of a folder."""

PDF = "report.pdf"


def report(folder: Positional[Path], *, pdf: bool = False, trust: Modules = ()) -> Document:
    """Rewrite the report of a finished run, and optionally print it as PDF.

    Examples:
        qfolio report runs/mine
        qfolio report runs/mine --pdf

    Args:
        folder: Folder of qfolio train, backtest, study, compare, tune or continual.
        pdf: Also write report.pdf, printed by Chromium or Chrome.
        trust: Modules of your own code that the folder may name (default: none).
    """
    from qfolio.commands import console
    from qfolio.report.printing import find_browser, print_pdf

    kind = _kind(folder)
    if pdf and find_browser() is None:
        print_pdf(folder / PAGE, folder / PDF)  # raises before anything is written
    prepare(trust)
    with console.working(f"Reading {folder}"):  # which may turn out to be unfinished
        WRITERS[kind](folder)
    console.say(f"Report: {folder / PAGE}")
    if pdf:
        with console.working("Printing"):
            print_pdf(folder / PAGE, folder / PDF)
        console.say(f"PDF: {folder / PDF}")
    return {"folder": folder, "report": folder / PAGE, "pdf": folder / PDF if pdf else None}


def _kind(folder: Path) -> str:
    from qfolio.core.files import read_json

    if not folder.is_dir():
        raise QfolioError(f"There is no folder {folder}.")
    path = next((folder / name for name in FILES if (folder / name).is_file()), None)
    kind = None if path is None else read_json(path).get("kind")
    if not isinstance(kind, str) or kind not in WRITERS:
        raise QfolioError(
            f"{folder} has no report; give the folder of a training, backtest, study, comparison, "
            "search or continual experiment."
        )
    return kind


def _backtest(folder: Path) -> None:
    from qfolio.portfolio.backtest.attribution.explain import explain
    from qfolio.portfolio.backtest.attribution.why import Why
    from qfolio.portfolio.backtest.folder import BacktestFolder
    from qfolio.portfolio.backtest.run import Backtest
    from qfolio.report.backtest.finish import write_page

    run = Backtest.open(folder)
    entries, notes = run.entries()
    known = (folder / "why.json").is_file()
    why = Why.read(BacktestFolder(folder).read_why()) if known else explain(run, entries)
    write_page(run, entries, run.assess(entries), notes, why)


def _study(folder: Path) -> None:
    from qfolio.portfolio.study.run import Study
    from qfolio.report.study import write_study_report

    write_study_report(Study.open(folder))


WRITERS: dict[str, Callable[[Path], None]] = {
    "backtest": _backtest,
    "study": _study,
    "run": training.write_again,
    "comparison": comparison.write_again,
    "search": tuning.write_again,
    "continual": continual.write_again,
}
"""The function that writes the report, by kind of folder."""
