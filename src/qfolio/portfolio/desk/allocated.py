"""What the desk answers to a request for tomorrow's trades."""

from dataclasses import dataclass
from typing import Any

import msgspec

from qfolio.portfolio.desk.allocation import Allocation
from qfolio.portfolio.desk.drivers import Reason
from qfolio.portfolio.desk.ledger import Record
from qfolio.portfolio.desk.standing import Standing
from qfolio.portfolio.prices.table import Prices


@dataclass(frozen=True)
class Allocated:
    """The trades that ``Desk.allocate`` found, and what there is to say of them.

    standing: who is followed, and what the backtest found. trained: date of the last row that a
    policy has learned from; None if nothing learned. prices: the table of the decision. spent:
    turnover of the ledger's orders since the year began. reasons: of a policy's largest trades.
    sentences: these reasons and all other remarks, and what was written. record: that of the
    ledger; None if nothing was recorded.
    """

    allocation: Allocation
    standing: Standing
    trained: str | None
    prices: Prices
    spent: float
    reasons: list[Reason] | None
    sentences: list[str]
    record: Record | None

    def to_json(self) -> dict[str, Any]:
        """What ``qfolio allocate --json`` prints."""
        return {
            "agent": self.standing.agent,
            "trained_until": self.trained,
            "verdict": self.standing.verdict or None,
            "worse": self.standing.worse,
            "record": None if self.record is None else self.record.number,
            **self.allocation.to_json(),
            "spent": self.spent,
            "reasons": msgspec.to_builtins(self.reasons),
        }
