"""The command that runs one configuration over many price tables and pools the evidence."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from unicodedata import normalize

from tyro.conf import Positional, arg

from qfolio.commands.arguments import prepare
from qfolio.commands.backtesting import DEFAULTS, Shared, basis_points
from qfolio.commands.parsing import Document, outcome
from qfolio.core.errors import QfolioError
from qfolio.core.registry import again

if TYPE_CHECKING:
    from qfolio.portfolio.backtest.run import Backtest
    from qfolio.portfolio.prices.table import Prices
    from qfolio.portfolio.study.folder import Variant

Sets = Annotated[tuple[str, ...], arg(metavar="[NAME=]FILE …", help_behavior_hint="")]
Numbers = Annotated[str | None, arg(metavar="N,N", help_behavior_hint="")]
Folders = Annotated[tuple[Path, ...], arg(metavar="DIR …", help_behavior_hint="")]


def study(
    sets: Positional[Sets] = (),
    *,
    options: Shared = DEFAULTS,
    lags: Numbers = None,
    costs_bps: Numbers = None,
    after: Folders = (),
) -> Document:
    """Backtest one configuration on many price tables and pool the evidence.

    Examples:
        qfolio study us.csv europe.csv --agents tilts
        qfolio study us.csv eu=europe.csv --lags 2 --costs-bps 20,50

    Args:
        sets: CSV or Parquet files with prices, one table each, as qfolio backtest reads them;
            NAME= names a table (default: the file's name).
        lags: Further lags, besides --lag, at which to train and test everything (default: none).
        costs_bps: Further costs in basis points, besides --cost-bps; every lag is combined with
            every cost (default: none).
        after: Folders of earlier studies; their looks at the same tables are counted, and those
            of their --trials (default: none).
    """
    import msgspec

    prepare(options.trust)
    from qfolio.adapters.trackers import trackers
    from qfolio.commands import console
    from qfolio.commands.console.study import describe_study, print_study
    from qfolio.commands.progress import JobsProgress, stop
    from qfolio.experiments.interrupts import resumable
    from qfolio.experiments.log import tracked
    from qfolio.portfolio.backtest.notes import beforehand
    from qfolio.portfolio.study.run import Study
    from qfolio.report.backtest.finish import write_page
    from qfolio.report.study import write_study_report

    executor, following = options.executor, trackers(options.track)
    if options.resume is None:
        basis_points("--cost-bps", options.cost_bps)  # refuses a wrong one by its own name
        costs = _numbers("--costs-bps", costs_bps, options.cost_bps)
        run = Study.create(
            _tables(sets, options.load),
            options.presets(),
            lags=[_whole("--lags", lag) for lag in _numbers("--lags", lags, options.lag)],
            costs=[basis_points("--costs-bps", cost) for cost in costs],
            after=after,
            out=options.folder("study"),
            **options.settings(),
        )
    elif options.only_resumes() and not sets:
        run = Study.open(options.resume)
    else:
        raise QfolioError(
            "--resume keeps the study's settings; add only --on, --track and --trust."
        )
    console.say(*describe_study(run))
    resume = again("qfolio study --resume", run.folder, *run.parts, on=options.on)
    with resumable(resume), console.bar("") as update, tracked(*following):

        def listen(table: str, variant: "Variant", backtest: "Backtest") -> Any:
            place = run.places.index((table, variant)) + 1
            console.say(f"{place} of {len(run.places)}: {table}, {variant.text}")
            if variant == run.config.variants[0]:  # the notes of a table's others are the same
                for note in beforehand(backtest.config.agents, backtest.replay):
                    console.tell(note)
            return JobsProgress(update)

        run.run(listen, write_page, executor)
    if run.interrupted:
        stop(resume)
    with resumable(resume), console.working("Weighing the evidence and writing the report"):
        result = run.result()
        write_study_report(run)
    print_study(result)
    return outcome(run.folder, msgspec.to_builtins(result))


def _tables(sets: tuple[str, ...], load: Any) -> "dict[str, Prices]":
    """The tables by name, in the order of the command line."""
    files: dict[str, Path] = {}
    for entry in sets:
        before, _, after = entry.partition("=")
        name = normalize("NFC", before)  # macOS writes ö as o and its dots, which are no letter
        file = Path(after)
        if not (after and re.fullmatch(r"[\w-]+", name)):
            file = Path(entry)
            name = re.sub(r"[^\w-]+", "-", normalize("NFC", file.stem))
        same = next((each for each in files if each.casefold() == name.casefold()), None)
        if same is not None:  # some systems do not tell folders a and A apart
            raise QfolioError(
                f"{files[same]} and {file} are both called {name}; name one with NAME=FILE."
            )
        files[name] = file
    return {name: load(file) for name, file in files.items()}


def _numbers(option: str, text: str | None, main: float) -> list[float]:
    """The main value, and the others of a list such as "10,20,50"."""
    try:
        others = [float(part) for part in (text or "").split(",") if part.strip()]
    except ValueError:
        raise QfolioError(
            f"{option} is {text!r}; it must be numbers separated by commas, for example 1,2."
        ) from None
    return list(dict.fromkeys([float(main), *others]))


def _whole(option: str, value: float) -> int:
    if not value.is_integer():
        raise QfolioError(f"{option} has {value:g}; lags are whole numbers of rows.")
    return int(value)
