"""Picks the closing prices among columns of bars: open, high, low, close and volume.

Bars come with a header on two levels (yfinance: kind and ticker), with both in one name
(AAPL_Close, Close AAPL), or, for a single asset, with only the kinds as names (Stooq).
"""

import re
from collections.abc import Sequence
from typing import NamedTuple

from qfolio.core.text import quote
from qfolio.portfolio.prices.findings import Findings, listing
from qfolio.portfolio.prices.layout import Table
from qfolio.portfolio.prices.vocabulary import (
    ADJUSTED_NAMES,
    KINDS,
    is_price,
    kind,
    plain,
)

RANGE = frozenset({"open", "high", "low"})
TRADED = RANGE | {"volume"}
UNNAMED = "these bars"
LONGEST = 100  # characters of a name that is parsed

_WORDS = "|".join(
    re.escape(word).replace("\\ ", r"[\s_.-]*")
    for word in sorted((w for words in KINDS.values() for w in words), key=len, reverse=True)
)
_GAP = r"[\s_.:|/-]+"
_ENDS = re.compile(rf"(?P<asset>.+?){_GAP}(?P<kind>{_WORDS})", re.I)
_BEGINS = re.compile(rf"(?P<kind>{_WORDS}){_GAP}(?P<asset>.+)", re.I)


class Bar(NamedTuple):
    """One column of an asset's bars."""

    kind: str  # as the table calls it, such as Adj Close; empty if the name is only the asset's
    column: int


def pick_prices(
    table: Table, columns: Sequence[int], findings: Findings
) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """The assets of a wide table and the columns of their prices, adjusted ones if there are any.

    A note says which columns are left out.
    """
    others: list[int] = []
    if table.levels:
        groups = _of_levels(table, columns, findings)
    elif not (groups := _of_one_asset(table, columns, findings)):
        groups, others = _of_names(table, columns)
    assets = {j: table.names[j] for j in others}
    for asset, group in groups.items():
        prices = sorted((bar for bar in group if not bar.kind or is_price(bar.kind)), key=_rank)
        if not prices:
            findings.error(
                f"there is no close of {asset if asset == UNNAMED else quote(asset)}",
                advice="Add its column, or remove the asset.",
            )
            continue
        if len(prices) > 1 and not prices[-1].kind:
            both = " and ".join(quote(table.names[prices[i].column]) for i in (0, -1))
            findings.error(f"the columns {both} could both be the price", advice="Keep one.")
        assets[prices[0].column] = asset
    chosen = sorted(assets)
    if left := [table.names[j] for j in columns if j not in assets]:
        if groups:
            taken = [table.names[j] for j in chosen if j not in others]
            findings.note(f"prices are those of {listing(taken)}; left out: {listing(left)}")
        else:
            findings.note(f"left out, because they hold no prices: {listing(left)}")
    return tuple(assets[j] for j in chosen), tuple(chosen)


def columns_of_kind(table: Table, name: str) -> dict[str, int]:
    """The columns of this kind by asset, in a header on two levels."""
    for k in (0, 1):
        found = {pair[1 - k]: j for j, pair in table.levels.items() if pair[k] == name}
        if found and kind(name):
            return found
    return {}


def _rank(bar: Bar) -> int:
    names = KINDS["adjusted"] + KINDS["close"]
    return names.index(plain(bar.kind)) if bar.kind else len(names)


def _of_levels(table: Table, columns: Sequence[int], findings: Findings) -> dict[str, list[Bar]]:
    kinds = [sum(kind(pair[k]) is not None for pair in table.levels.values()) for k in (0, 1)]
    if kinds[0] == kinds[1]:
        which = "both levels name" if kinds[0] else "neither level names"
        findings.error(
            f"the header has two levels, and {which} a kind of price such as close",
            advice="Select one kind of price first, for example frame['Close'].",
        )
        return {}
    if single := [table.names[j] for j in columns if j not in table.levels]:
        findings.error(
            f"the header has two levels, but only one above {listing(single)}",
            advice="Remove these columns, or name them as features.",
        )
    k = kinds.index(max(kinds))
    groups: dict[str, list[Bar]] = {}
    for j in columns:
        if pair := table.levels.get(j):
            groups.setdefault(pair[1 - k], []).append(Bar(pair[k], j))
    return groups


def _of_one_asset(table: Table, columns: Sequence[int], findings: Findings) -> dict[str, list[Bar]]:
    """The bars of a table of one asset; none if the columns are prices of several."""
    bars = [Bar(table.names[j], j) for j in columns if kind(table.names[j])]
    closes = [bar for bar in bars if plain(bar.kind) in ("close", "price", *ADJUSTED_NAMES)]
    prices = [bar for bar in bars if is_price(bar.kind)]
    kinds = {kind(bar.kind) for bar in bars}
    # Low, Open and Last are names of assets, too: without a close, it takes more of them.
    enough = kinds >= RANGE or (prices and len(kinds & TRADED) >= 2)
    if not (enough or (closes and len(kinds) >= 2)):
        return {}
    if beside := [table.names[j] for j in columns if not kind(table.names[j])]:
        findings.error(
            f"{listing(bar.kind for bar in bars)} are columns of one asset, but there is also "
            f"{listing(beside)}",
            advice="Remove columns that are not prices, name features with features= (--features), "
            "or give a table with a column 'ticker'.",
        )
    return {min(prices, key=_rank).kind if prices else UNNAMED: bars}


def _of_names(table: Table, columns: Sequence[int]) -> tuple[dict[str, list[Bar]], list[int]]:
    """Bars by asset, from names such as AAPL_Volume, and the columns of other prices.

    High, Low and Vol may also be parts of assets' names (of factor portfolios, for instance): they
    count only beside a price of the same asset. Volumes are never prices.
    """
    names = {j: table.names[j] for j in columns if len(table.names[j]) <= LONGEST}
    matches = [
        {j: m for j, name in names.items() if not kind(name) and (m := form.fullmatch(name))}
        for form in (_ENDS, _BEGINS)
    ]
    groups: dict[str, list[Bar]] = {}
    for j, match in max(matches, key=len).items():
        groups.setdefault(match["asset"], []).append(Bar(match["kind"], j))
    for j, name in names.items():
        if name in groups:
            groups[name].append(Bar("", j))
    several = any(map(_are_bars, groups.values()))
    groups = {
        asset: bars
        for asset, bars in groups.items()
        if _are_bars(bars) or (several and is_price(bars[0].kind))
    }
    taken = {bar.column for bars in groups.values() for bar in bars}
    volumes = {j for j, name in names.items() if plain(name).split()[-1:] == ["volume"]}
    return groups, [j for j in columns if j not in taken | volumes]


def _are_bars(group: list[Bar]) -> bool:
    kinds = {kind(bar.kind) for bar in group}
    if kinds & {"adjusted", "close"} or kinds >= RANGE:
        return len(kinds) > 1
    return None in kinds and ("volume" in kinds or len(kinds & RANGE) >= 2)
