"""The ledger of a run: a record of each allocation, with what is needed to reproduce it.

RUN/ledger/ holds a JSON file for each record (0001.json, 0002.json, …) and, as safetensors named by
their digest, the prices that it used. A record names the file of its policy, which is never
overwritten. Records are only ever added; of several for one date, the last one counts.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.files import locked, read_arrays, read_json, write_arrays, write_json
from qfolio.core.text import listed, quote
from qfolio.portfolio.desk.allocation import Allocation, turnover
from qfolio.portfolio.prices.stored import from_arrays, to_arrays
from qfolio.portfolio.prices.table import Prices

FORMAT = 1

FEES = 0.05
"""How far cash may be from what a record expects after its trades, as a share of what they move."""

DECIDES = frozenset({"agent", "policy", "settings"})
"""The inputs that decide; others, such as prices that were adjusted again, want about the same."""

# Names become paths.
PolicyName = Annotated[str, msgspec.Meta(pattern=r"^latest(-[0-9]+)?$")]


class Record(msgspec.Struct, kw_only=True, frozen=True):
    """An allocation on record; lists are by asset, weights have cash first.

    digests: SHA-256 of "prices" (the table as used), "policy" (its file; absent if nothing
    learned), "settings" (config.json of the run) and "holdings".
    """

    number: Annotated[int, msgspec.Meta(ge=1)]
    date: str  # of the last prices
    made: str  # when the record was written
    version: str  # of qfolio
    agent: str
    policy: PolicyName | None  # name of the agent's policy; None if nothing learned
    digests: dict[str, str]
    whole_shares: bool
    assets: list[str]
    prices: list[float | None]
    shares: list[float]  # held before
    cash: float
    trades: list[float]
    cash_after: float
    weights_before: list[float]
    target: list[float]
    weights_after: list[float]
    costs: dict[str, float]  # expected, in money, by kind
    supersedes: int | None = None  # number of the record of the same date that it replaces
    format: int = FORMAT

    def __post_init__(self) -> None:
        if self.format != FORMAT:
            raise ValueError(f"format {self.format} is of another version of qfolio")
        count = len(self.assets)
        lists = (self.prices, self.shares, self.trades)
        weights = (self.weights_before, self.target, self.weights_after)
        if any(len(x) != count for x in lists) or any(len(x) != count + 1 for x in weights):
            raise ValueError("its lists do not fit its assets")

    def replaces(self, band: float) -> bool:
        """Whether it takes the place of what remains of an earlier order.

        band: of the calendar, within which nothing is ordered.
        """
        return any(self.trades) or not band

    @property
    def turnover(self) -> float:
        """Sum of the absolute changes in the weights of the assets bought and sold."""
        return turnover(self.weights_before, self.weights_after, self.trades)

    @property
    def moment(self) -> np.datetime64:
        """The date of its last prices."""
        return np.datetime64(self.date.replace(" ", "T"), "s")


class Ledger:
    """Reads and appends records; ``folder`` is made with the first one."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def records(self) -> list[Record]:
        """All records, in the order in which they were made."""
        paths = self.folder.glob("[0-9]*.json") if self.folder.is_dir() else ()
        return sorted(map(self._read, paths), key=lambda record: record.number)

    def current(self, before: int | None = None) -> list[Record]:
        """The record that counts for each date, in order of date.

        before: number of a record; only those before it are known (default: all).
        """
        last = {
            record.moment: record
            for record in self.records()
            if before is None or record.number < before
        }
        return [last[moment] for moment in sorted(last)]

    def on(self, date: str) -> Record:
        """The record that counts for a date; for a day, that of its last moment.

        date: Such as 2025-12-31 or, where there are several a day, 2025-12-31 15:00.

        Raises QfolioError if there is none.
        """
        records, wanted = self.current(), date.replace("T", " ")
        moments = [str(record.moment).replace("T", " ") for record in records]
        # To the day, the minute or the second.
        found = [
            record
            for record, moment in zip(records, moments, strict=True)
            if wanted in (moment[:10], moment[:16], moment)
        ]
        if not found:
            known = ", ".join(record.date for record in records[-3:])
            raise QfolioError(
                f"The ledger has no allocation of {quote(date)}; "
                + (f"its latest are of {known}." if known else "it is empty.")
            )
        return found[-1]

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Nobody else adds a record within the block.

        Raises QfolioError if another process is about to.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        with locked(self.folder):
            yield

    def append(
        self,
        allocation: Allocation,
        prices: Prices,
        *,
        keep_prices: bool,
        then: Callable[[], object] = lambda: None,
        **facts: Any,
    ) -> tuple[Record, str]:
        """Adds a record, unless the last one of the same date has the same inputs and orders.

        Only for who holds the lock.

        Args:
            allocation: The allocation.
            prices: The table that it used.
            keep_prices: Whether to store the table; if not, it is needed again to reproduce.
            then: Called once there is a record; a new one goes again if this fails.
            facts: The other fields of the record, except number, date and what it supersedes.

        Returns:
            The record, and a sentence that says what was done.

        Raises:
            QfolioError: The trades of the last record of the same date have been made.
        """
        records = self.records()
        content = {**_of(allocation), **facts}
        before = next((r for r in reversed(records) if r.date == content["date"]), None)
        if before is not None and not (differing := _differing(before, content)):
            then()
            return before, f"This allocation is already record {before.number} of the ledger."
        if before is not None and _traded(before, content) and DECIDES.isdisjoint(differing):
            raise QfolioError(
                f"The holdings are those of record {before.number} of {before.date} after its "
                "trades, so that nothing more is ordered on these prices; allocate on later "
                "ones, or look with --dry-run."
            )
        record = msgspec.convert(
            {
                **content,
                "number": 1 + max((r.number for r in records), default=0),
                "supersedes": None if before is None else before.number,
            },
            Record,
        )
        if keep_prices:
            self._keep(prices)
        path = self.folder / f"{record.number:04d}.json"
        write_json(path, msgspec.to_builtins(record))
        try:
            then()
        except BaseException:
            path.unlink()
            raise
        said = f"Recorded in the ledger as {path}."
        if before is not None:
            others = [f"{'other' if key[-1] == 's' else 'another'} {key}" for key in differing]
            said += (
                f" It supersedes record {before.number} of the same date, which had "
                f"{listed(others)}."
            )
        return record, said

    def prices(self, record: Record, known: Prices) -> Prices:
        """The table that a record used: rows of ``known``, or the table that the ledger stored.

        Raises:
            QfolioError: The ledger did not store it, or its file is damaged.
        """
        wanted = record.digests["prices"]
        known = known.between(None, int((known.dates <= record.moment).sum()))
        if known.sha256 == wanted:
            return known
        path = self._prices(wanted)
        if not path.exists():
            raise QfolioError(f"{path} is missing; give the prices of record {record.number}.")
        arrays = read_arrays(path)
        try:
            table = from_arrays(
                arrays,
                tuple(record.assets),
                feature_names=known.feature_names,
                market_names=known.market_names,
                levels=known.levels,
            )
        except (KeyError, ValueError, QfolioError) as error:
            raise QfolioError(f"{path} is damaged ({error}); give the prices again.") from None
        if table.sha256 != wanted:
            raise QfolioError(f"{path} does not belong to record {record.number}; restore it.")
        return table

    def _keep(self, prices: Prices) -> None:
        path = self._prices(prices.sha256)
        if not path.exists():
            write_arrays(path, to_arrays(prices))

    def _prices(self, digest: str) -> Path:
        return self.folder / "prices" / f"{digest[:16]}.safetensors"

    def _read(self, path: Path) -> Record:
        try:
            record = msgspec.convert(read_json(path), Record)
            _ = record.moment
            if int(path.stem) != record.number or not {"prices", "settings", "holdings"} <= set(
                record.digests
            ):
                raise ValueError("its number or digests are wrong")
            if record.digests["holdings"] != holdings_digest(
                record.assets, np.array(record.shares), record.cash
            ):
                raise ValueError("its holdings do not have their digest")
        except (msgspec.ValidationError, ValueError) as error:
            raise QfolioError(f"{path} is damaged ({error}); restore it.") from None
        return record


def holdings_digest(assets: Sequence[str], shares: np.ndarray, cash: float) -> str:
    """SHA-256 of shares by asset, and cash, in the floats that a record holds."""
    return digest([list(assets), shares.astype(float).tolist(), float(cash)])


def digest(content: Any) -> str:
    """SHA-256 of a JSON value."""
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def file_digest(path: Path) -> str:
    """SHA-256 of a file's bytes."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _of(allocation: Allocation) -> dict[str, Any]:
    return {
        "date": allocation.date,
        "assets": list(allocation.assets),
        "prices": [None if np.isnan(price) else price for price in allocation.prices.tolist()],
        "shares": allocation.shares.tolist(),
        "cash": float(allocation.cash),
        "trades": allocation.trades.tolist(),
        "cash_after": float(allocation.cash_after),
        "weights_before": allocation.held.tolist(),
        "target": allocation.weights.tolist(),
        "weights_after": allocation.reached.tolist(),
        "costs": allocation.costs,
    }


def _inputs(record: Record | dict[str, Any]) -> dict[str, Any]:
    """The inputs that determine an allocation."""
    content = record if isinstance(record, dict) else msgspec.structs.asdict(record)
    names = ("prices", "policy", "settings", "holdings")
    digests = {name: content["digests"].get(name) for name in names}
    return {"agent": content["agent"], **digests, "rounding": content["whole_shares"]}


def _traded(before: Record, content: dict[str, Any]) -> bool:
    """Whether holdings are those of a record after its trades.

    Prices and fees decide on the cash: what differs by more is a deposit or a withdrawal.
    """
    after = np.add(before.shares, before.trades)
    traded = np.nansum(np.abs(np.multiply(before.trades, np.array(before.prices, float))))
    return (
        any(before.trades)
        and np.allclose(content["shares"], after, rtol=1e-9, atol=1e-5)
        and abs(content["cash"] - before.cash_after) <= FEES * traded
    )


def _differing(before: Record, content: dict[str, Any]) -> list[str]:
    """The inputs of an allocation that differ from those of a record, or else "orders" if they do.

    Orders also depend on earlier records, where a mandate limits the turnover of a year.
    """
    now = _inputs(content)
    inputs = [key for key, value in _inputs(before).items() if value != now[key]]
    same = np.allclose(before.weights_after, content["weights_after"], rtol=0, atol=1e-5)
    return inputs or ([] if same else ["orders"])
