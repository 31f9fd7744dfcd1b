"""Usual column names of price tables."""

import re

DATE_NAMES = ("date", "dates", "datetime", "timestamp", "time", "open time", "window start")
ASSET_NAMES = ("asset", "ticker", "tic", "symbol", "name", "instrument")
SHARES_NAMES = ("shares", "quantity", "qty", "units", "position")
CASH = "cash"
ADJUSTED_NAMES = ("adjusted close", "adj close", "adjclose", "adjusted price", "adj price")
PRICE_NAMES = ("close", "price", "value")
NAV_NAMES = ("nav",)  # of a fund that is traded, it stands beside the price
RETURN_NAMES = ("return", "returns", "ret", "net return", "net returns", "daily return")
RATE_NAMES = (
    "rate", "rates", "yield", "yields", "riskfree", "risk free", "tbill", "tbills", "t bill",
    "t bills", "irx", "fvx", "tnx", "tyx", "vix", "euribor", "libor", "sofr", "fedfunds",
)  # fmt: skip
"""Words in the names of rates, yields and volatility indices, which are no prices."""
PRICED_NAMES = (
    "high yield", "dividend", "income", "equity", "floating rate", "fixed rate", "bond", "bonds",
    "etf", "fund", "futures", "note", "notes", "reit", "short", "trust",
)  # fmt: skip
"""Words in the names of assets that are named after such a rate."""
SETTINGS = (
    "security", "securities", "start date", "end date", "period", "periodicity", "currency",
)  # fmt: skip
"""Names of the settings that exports write in the lines above their column names."""
KINDS = {
    "adjusted": (*ADJUSTED_NAMES, "adjusted"),
    "close": ("close", "closing price", "close/last", "price", "last", "last price", "px last"),
    "open": ("open", "px open"),
    "high": ("high", "px high"),
    "low": ("low", "px low"),
    "volume": ("volume", "vol", "px volume", "total volume"),
    "other": (
        "adj open", "adj high", "adj low", "adj volume", "adjopen", "adjhigh", "adjlow",
        "adjvolume", "vwap", "trades", "transactions", "trade count", "number of trades",
        "openint", "open interest", "turnover", "market cap", "marketcap", "close time",
        "dividends", "dividend", "dividend amount", "divcash", "stock splits", "splits",
        "split coefficient", "split ratio", "splitfactor", "capital gains", "change", "change %",
        "chg%", "repaired?",
    ),
}  # fmt: skip
"""The kinds of columns of one asset, and their usual names."""

_KIND = {name: kind for kind, names in KINDS.items() for name in names}


def plain(name: str) -> str:
    """A column's name without capitals and punctuation: adj close for Adj_Close and <ADJ CLOSE>."""
    return " ".join(re.sub(r"[-_.<>\s]+", " ", name.lower()).split())


def is_cash(name: str) -> bool:
    """Whether this is the name of the money that is not invested."""
    return plain(name) == CASH


def is_rate(name: str) -> bool:
    """Whether the name says that a column holds a rate, a yield or a volatility index."""
    words = f" {' '.join(re.findall(r'[a-z0-9]+', name.lower()))} "
    rate, priced = (
        any(f" {each} " in words for each in names) for names in (RATE_NAMES, PRICED_NAMES)
    )
    return rate and not priced


def kind(name: str) -> str | None:
    """The kind of a column of this name (a key of ``KINDS``); None for any other name."""
    return _KIND.get(plain(name))


def is_price(name: str) -> bool:
    """Whether a column of this name holds closing prices, adjusted or not."""
    return kind(name) in ("adjusted", "close")
