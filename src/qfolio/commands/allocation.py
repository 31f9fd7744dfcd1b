"""Commands of the desk: compute tomorrow's trades, and follow the ledger of past allocations."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from qfolio.commands.arguments import File, Modules, Name, prepare
from qfolio.commands.parsing import Document
from qfolio.commands.tables import LATEST, ReadLatest, Returns
from qfolio.core.errors import QfolioError
from qfolio.core.text import discard

if TYPE_CHECKING:
    from qfolio.portfolio.desk.desk import Desk

UNPRINTED = 3
"""Exit code where the allocation is recorded, its orders are written, and only printing failed."""

Date = Annotated[str | None, arg(metavar="DATE", help_behavior_hint="")]


def allocate(
    folder: Positional[Path],
    *,
    prices: File = None,
    holdings: File = None,
    capital: Annotated[float | None, arg(metavar="X", help_behavior_hint="")] = None,
    agent: Name = None,
    anyway: bool = False,
    whole_shares: bool = False,
    as_of: Date = None,
    update: bool = False,
    orders: File = None,
    layout: str = "generic",
    currency: str = "USD",
    dry_run: bool = False,
    reproduce: Date = None,
    trust: Modules = (),
    latest: ReadLatest = LATEST,
    returns: Returns = None,
) -> Document:
    """Compute tomorrow's target weights, and the trades to reach them.

    The backtest's verdict on the agent is printed, too. If the first agent did worse than the
    benchmark, nothing is allocated without --agent or --anyway. Each allocation is recorded in the
    folder's ledger.

    Examples:
        qfolio allocate runs/mine --capital 10000
        qfolio allocate runs/mine --holdings holdings.csv --orders orders.csv

    Args:
        folder: Folder of a backtest, which also holds a policy trained on its latest rows.
        prices: Latest prices, CSV or Parquet, of the assets of the backtest (default: the prices
            of the backtest).
        holdings: Table with a column of assets (asset, symbol, ticker) and one of shares (shares,
            quantity, qty); a row "cash" holds money (default: all is cash). Shares sold short and
            loans are negative, where the mandate allows them.
        capital: Cash to invest, for holdings without a row of cash.
        agent: Agent to follow; or a baseline such as equal-weight, the benchmark or a strategy of
            your own, if the backtest has it (default: the first agent of the backtest).
        anyway: Allocate even if the backtest is not finished, or found the agent worse than the
            benchmark, or if a price of the last row is doubtful, or (without a record) if the
            policy has learned from later prices.
        whole_shares: Trade whole shares only.
        as_of: Day of the allocation; prices may be up to a week older, or more where their rows are
            farther apart than a day. For prices of several times a day it may be a time in UTC,
            such as 2025-12-31T15:00 (default: now).
        update: Have the policy learn from the latest rows first, if there are new ones, and store
            the new version beside the earlier ones.
        orders: Write the trades to this CSV file, outside of the folder.
        layout: Columns of that file: generic, ib for a basket of Interactive Brokers, or alpaca or
            schwab for the fields of an order in their APIs.
        currency: Currency in that file, where the layout names one.
        dry_run: Write nothing: no record in the ledger, no updated policy and no file of orders.
        reproduce: Recompute the allocation that the ledger records for this date, or time such as
            2025-12-31T15:00, and compare the two, with the inputs stored there or, if given,
            --prices and --holdings.
        trust: Modules of your own code that the folder may name (default: none).
        returns: Unit of the numbers in --prices, if they are returns; holdings in shares, whole
            shares and orders need prices (default: they are prices).
    """
    prepare(trust)
    from qfolio.commands import console
    from qfolio.commands.console.desk import print_allocation
    from qfolio.commands.console.tables import print_warnings
    from qfolio.core.text import listed
    from qfolio.portfolio.desk.desk import Desk
    from qfolio.portfolio.desk.orders_csv import require_apart

    if orders is not None:
        require_apart(orders, "--members", latest.members)
    latest.require_table(prices, returns)
    desk = Desk.open(folder, returns=returns, **latest.reading)
    if reproduce is not None:
        given = {
            "--agent": agent is not None, "--anyway": anyway, "--whole-shares": whole_shares,
            "--as-of": as_of is not None, "--update": update, "--orders": orders is not None,
            "--dry-run": dry_run,
        }  # fmt: skip
        if any(given.values()):
            raise QfolioError(
                "--reproduce takes its settings from the ledger and trades nothing; leave out "
                f"{listed([name for name, there in given.items() if there])}."
            )
        return _reproduce(desk, reproduce, prices, holdings, capital)

    def warn() -> None:
        if prices is not None:
            print_warnings(prices.name, desk.news)

    try:
        made = desk.allocate(
            agent,
            prices,
            holdings,
            capital,
            anyway=anyway,
            whole_shares=whole_shares,
            as_of=as_of,
            update=update,
            orders=orders,
            layout=layout,
            currency=currency,
            dry_run=dry_run,
        )
    except Exception:
        warn()  # the prices may explain it
        raise
    with _telling("" if dry_run else made.sentences[-1]):
        warn()
        shares = not made.prices.levels
        print_allocation(made.allocation, made.standing, made.trained, shares=shares)
        for line in made.sentences:
            console.tell(line)
    return made.to_json()


def follow(
    folder: Positional[Path],
    *,
    prices: File = None,
    returns: Returns = None,
    benchmark: File = None,
    out: File = None,
    trust: Modules = (),
    latest: ReadLatest = LATEST,
) -> Document:
    """Show what the allocations of a ledger have earned, compared with the backtest.

    The ledger is marked to market at every row of the prices. A sequential test says whether live
    returns are still consistent with the backtest; the report also says when to retrain.

    Examples:
        qfolio follow runs/mine --prices prices.csv

    Args:
        folder: Folder of a backtest with a ledger.
        prices: Prices with all rows since the first allocation, CSV or Parquet (default: the
            prices of the backtest).
        returns: Unit of the numbers in --prices, if they are returns (default: they are prices).
        benchmark: Latest file of the backtest's benchmark, if that is a strategy of your own
            (default: the data that the backtest read).
        out: CSV file with a row for each row of the prices, outside of the folder (default:
            follow.csv in it); a page is written beside it, with the suffix html.
        trust: Modules of your own code that the folder may name (default: none).
    """
    import numpy as np

    prepare(trust)
    from qfolio.commands import console
    from qfolio.commands.console.desk import print_following
    from qfolio.commands.console.tables import print_warnings
    from qfolio.core.files import write_text
    from qfolio.portfolio.desk.consistency import ALARM
    from qfolio.portfolio.desk.desk import Desk
    from qfolio.portfolio.desk.follow import follow as marked
    from qfolio.portfolio.desk.orders_csv import require_apart, require_outside
    from qfolio.report.follow import LiveRows, render_following

    path = folder / "follow.csv" if out is None else out
    if path.suffix == ".html":
        raise QfolioError(
            f"--out is {out}, the CSV file; name it *.csv, and the page is written beside it."
        )
    if path.resolve() != (folder / "follow.csv").resolve():
        require_outside(folder, path, "--out")
    read = {"--prices": prices, "--benchmark": benchmark, "--members": latest.members}
    for option, source in read.items():
        require_apart(path, option, source, by="--out", what="the rows")
    latest.require_table(prices, returns)
    desk = Desk.open(folder, returns=returns, **latest.reading)
    following = marked(desk, prices, benchmark)
    if prices is not None:
        print_warnings(prices.name, desk.news)
    following.write(path)
    page, live = path.with_suffix(".html"), following.live
    if len(live.returns):
        rows = LiveRows(
            live.dates,
            following.growth,
            np.cumprod(1 + following.reference),
            following.benchmark,
            following.band,
            following.evidence,
            ALARM,
        )
        title = f"{following.agent}, live and in the backtest"
        text = render_following(title, following.sentences(), rows, following.rows())
        write_text(page, text)
    print_following(following)
    console.say(f"Rows: {path}" + (f", page: {page}" if len(live.returns) else ""))
    return following.to_json()


@contextmanager
def _telling(done: str) -> Iterator[None]:
    """Ends the process with ``UNPRINTED`` where printing fails after something was done.

    Code 2 would mean that nothing was recorded. A reader who has gone, as in a pipe to head, is no
    failure. done: the sentence that says what was done; empty if nothing was.
    """
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        if not done:
            raise
        discard(sys.stdout)  # what is left to print
        said = f"The allocation cannot be printed ({error.strerror or error}). {done}"
        print(f"qfolio: {said}", file=sys.stderr)
        sys.exit(UNPRINTED)


def _reproduce(
    desk: "Desk",
    date: str,
    prices: Path | None,
    holdings: Path | None,
    capital: float | None,
) -> Document:
    """Recomputes an allocation of the ledger and prints the largest difference in weight."""
    from qfolio.commands import console
    from qfolio.core.text import listed
    from qfolio.portfolio.desk.holdings import read_holdings

    held = None
    if holdings is not None or capital is not None:
        held = read_holdings(holdings, desk.run.prices.assets, capital, debts=desk.debts)
    record, again = desk.reproduce(date, prices, held)
    off = max(abs(x - y) for x, y in zip(again.weights.tolist(), record.target, strict=True))
    same = listed(["prices", "settings", "holdings", *(["policy"] if record.policy else [])])
    console.say(
        f"Record {record.number} of {record.date} ({record.agent}, made {record.made} by qfolio "
        f"{record.version}) is reproduced: {same} have the digests of the ledger, and no target "
        f"weight is off by more than {off:.1g}."
    )
    return {"record": record.number, **again.to_json()}
