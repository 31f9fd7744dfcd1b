"""What is printed for those who trade: an allocation, and how live trading went."""

from typing import TYPE_CHECKING

from rich.text import Text

from qfolio.commands.console import console, print_table, say, tell
from qfolio.core.text import figure, printable

if TYPE_CHECKING:
    from qfolio.portfolio.desk.allocation import Allocation
    from qfolio.portfolio.desk.follow import Following
    from qfolio.portfolio.desk.standing import Standing


def print_allocation(
    allocation: "Allocation", standing: "Standing", trained: str | None, *, shares: bool
) -> None:
    """What is followed and what its backtest found, the trades, and their cost.

    trained: the date of the last row that the policy has learned from, if it has. shares: whether
    the prices are those of shares.
    """
    kind = standing.kind.capitalize()
    say(f"{kind}: {standing.agent}" + (f", trained on prices up to {trained}." if trained else "."))
    found = f"In its backtest: {standing.verdict or 'not finished, so there is no verdict.'}"
    if standing.worse:
        console.print(Text(f"WARNING. {printable(found)}", style="bold red"))
    else:
        tell(found)
    heads = ("asset", "price", "weight now", "target", "after", "trade, money", "trade, shares")
    rows: list[tuple[str, ...]] = []
    held, targets, after = allocation.held, allocation.weights, allocation.reached
    for i, asset in enumerate(allocation.assets):
        trade, price = allocation.trades[i], allocation.prices[i]
        if held[1 + i] or targets[1 + i] or trade:
            weights = (figure(float(x[1 + i]), ".2%") for x in (held, targets, after))
            money = figure(trade * price, "+,.2f")
            quoted, count = "–", "–"
            if shares:
                quoted = figure(price, ",.2f" if price >= 1 else ".4g")
                count = figure(trade, "+,.4g" if abs(trade) < 1000 else "+,.0f")
            rows.append((asset, quoted, *weights, money, count))
    cash = (figure(float(x[0]), ".2%") for x in (held, targets, after))
    print_table(heads, [*rows, ("cash", "", *cash, "", "")])
    hidden = len(rows) < len(allocation.assets)
    kinds = ", ".join(f"{kind} {figure(money, ',.2f')}" for kind, money in allocation.costs.items())
    say(
        f"After the close of {allocation.date}: wealth {figure(allocation.wealth, ',.2f')}, "
        f"expected cost {figure(allocation.cost, ',.2f')}"
        f"{f' ({kinds})' if len(allocation.costs) > 1 else ''}, "
        f"cash left {figure(allocation.cash_after, ',.2f')}."
        + " Assets that are neither held nor wanted are not shown."
        * hidden
    )


def print_following(following: "Following") -> None:
    """A row for live, the benchmark and the backtest, and what is to be said of them."""
    from qfolio.portfolio.desk.follow import URGENT

    forms = (".1%", ".1%", ".1%", ".2f", ".1%")
    print_table(
        ("net", "growth", "a year", "volatility", "Sharpe", "drawdown"),
        [(name, *map(figure, found.values(), forms)) for name, found in following.rows().items()],
    )
    for sentence in following.sentences():
        if sentence.startswith(URGENT):
            console.print(Text(printable(sentence), style="bold red"))
        else:
            tell(sentence)
