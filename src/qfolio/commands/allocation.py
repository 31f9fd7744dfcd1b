"""Commands of the desk: compute tomorrow's trades, and follow the ledger of past allocations."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from qfolio.commands.arguments import File, Modules, Name, prepare
from qfolio.commands.parsing import Document
from qfolio.commands.tables import LATEST, ReadLatest, Returns
from qfolio.core.errors import QfolioError

if TYPE_CHECKING:
    from qfolio.portfolio.desk.desk import Desk

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
            benchmark, or (without a record) if the policy has learned from later prices.
        whole_shares: Trade whole shares only.
        as_of: Day of the allocation; prices may be up to a week older, or more where their rows are
            farther apart than a day (default: today).
        update: Update the policy on the new rows first, and store the new version beside the
            earlier ones.
        orders: Write the trades to this CSV file.
        layout: Columns of that file: generic, ib for a basket of Interactive Brokers, or alpaca or
            schwab for the fields of an order in their APIs.
        currency: Currency in that file, where the layout names one.
        dry_run: Write nothing: no record in the ledger, no updated policy and no file of orders.
        reproduce: Recompute the allocation that the ledger records for this date and compare the
            two, with the inputs stored there or, if given, --prices and --holdings.
        trust: Modules of your own code that the folder may name (default: none).
        returns: Unit of the numbers in --prices, if they are returns; holdings in shares, whole
            shares and orders need prices (default: they are prices).
    """
    inputs = {"--prices": prices, "--holdings": holdings, "--members": latest.members}
    for option, file in inputs.items():
        if orders is not None and file is not None and file.resolve() == orders.resolve():
            raise QfolioError(f"{option} and --orders name one file; give orders their own.")
    import msgspec
    import numpy as np

    from qfolio.core.files import write_csv

    prepare(trust)
    from qfolio.commands import console
    from qfolio.commands.console.desk import print_allocation
    from qfolio.commands.console.tables import print_warnings
    from qfolio.core.text import amount, listed
    from qfolio.portfolio.desk.allocation import Allocation, require_fresh
    from qfolio.portfolio.desk.desk import Desk
    from qfolio.portfolio.desk.drivers import reasons, sentence
    from qfolio.portfolio.desk.holdings import cashed_out, read_holdings
    from qfolio.portfolio.desk.orders_csv import order_rows
    from qfolio.portfolio.desk.standing import Standing
    from qfolio.portfolio.mandate.limits import lots
    from qfolio.portfolio.policy import Policy
    from qfolio.portfolio.prices.findings import day

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
    name = next(iter(desk.run.agents)) if agent is None else agent
    standing = Standing.of(folder, name, desk.kind(name))
    if not anyway:
        standing.require_sound(desk.resume, named=agent is not None)
    followed = desk.followed(name)
    table = desk.table(followed, prices)
    if table.levels and (holdings or whole_shares or orders):
        raise QfolioError(
            "Returns give no share prices; leave out --holdings, --whole-shares and --orders, or "
            "give a table of prices (--prices, without --returns)."
        )
    if table.levels and lots(followed.mandate) is not None:
        raise QfolioError(
            "The mandate has lots, but returns give no share prices; give a table of prices "
            "(--prices, without --returns)."
        )
    if prices is not None:
        print_warnings(prices.name, desk.news)
    require_fresh(table, as_of)
    held = read_holdings(holdings, table.assets, capital, debts=desk.debts)
    shares, cash, gone = cashed_out(*held, table)
    if update:
        if not isinstance(followed, Policy):
            raise QfolioError(f"{name} learns nothing; leave out --update.")
        followed = followed.update(table)
    hindsight = desk.hindsight(followed, table)
    if hindsight and not anyway:
        raise QfolioError(
            f"{hindsight}; give later prices, or add --anyway, which then records nothing."
        )
    spent = desk.spent(followed, table)
    allocation = Allocation.of(
        followed,
        table,
        shares,
        cash,
        whole_shares=whole_shares,
        spent=spent,
        debts=desk.debts,
    )
    rows = None if orders is None else order_rows(allocation, layout, currency)
    said, number = "A dry run: nothing is written.", None
    if orders is not None and rows is not None and not dry_run:
        write_csv(orders, *rows)  # first: what cannot be ordered is not recorded either
    if hindsight:
        said = f"{hindsight}, so that nothing is recorded."
    elif not dry_run:
        try:
            if update and isinstance(followed, Policy):
                desk.run.keep(name, followed)
            record, said = desk.record(name, allocation, table, whole_shares)
        except BaseException:
            if orders is not None:
                orders.unlink(missing_ok=True)
            raise
        number = record.number
    if rows is not None and not dry_run:
        said += f" {orders} has {amount(len(rows[1]), 'order')}."
    trained, why, notes = None, [], []
    if isinstance(followed, Policy):
        why = reasons(followed, table, allocation, spent)
        trained = "an unknown date" if np.isnat(followed.learned) else day(followed.learned)
    else:
        notes = followed.notes(table, allocation.held, spent=spent)
    print_allocation(allocation, standing, trained, shares=not table.levels)
    for reason in why:
        console.tell(f"Why {sentence(reason)}")
    for line in (*gone, *notes, *desk.terms(followed, table, allocation, spent), said):
        console.tell(line)
    return {
        "agent": name,
        "trained_until": trained,
        "verdict": standing.verdict or None,
        "worse": standing.worse,
        "record": number,
        **allocation.to_json(),
        "spent": spent,
        "reasons": msgspec.to_builtins(why),
    }


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
        out: CSV file with a row for each row of the prices (default: follow.csv in the folder); a
            page is written beside it, with the suffix html.
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
    from qfolio.report.follow import LiveRows, render_following

    if out is not None and out.suffix == ".html":
        raise QfolioError(
            f"--out is {out}, the CSV file; name it *.csv, and the page is written beside it."
        )
    latest.require_table(prices, returns)
    desk = Desk.open(folder, returns=returns, **latest.reading)
    following = marked(desk, prices, benchmark)
    if prices is not None:
        print_warnings(prices.name, desk.news)
    path = folder / "follow.csv" if out is None else out
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
