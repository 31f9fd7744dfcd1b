"""What orders cost and when they are due, from the arguments of a backtest and its mandate."""

from typing import Any, NamedTuple

from qfolio.core.errors import require_type
from qfolio.core.settings import called
from qfolio.portfolio.mandate.mandate import Mandate

PROPORTIONAL = "proportional"
"""The default cost model."""


class TradingTerms(NamedTuple):
    """The arguments of ``Backtest.create`` of these names, after a mandate's own are applied."""

    mandate: Mandate | None
    cost: float
    cost_model: str
    calendar: str
    benchmark: Any

    @staticmethod
    def of(
        mandate: Any, cost: float, cost_model: str, calendar: str = "", benchmark: Any = None
    ) -> "TradingTerms":
        """A mandate's cost always applies, its other terms where an argument has its default.

        A cost model that is only named, as the mandate's own is, has the mandate's settings.
        A cost that is written into a cost model precedes both. Raises QfolioError if the mandate
        or the type of the cost model is invalid.
        """
        if mandate is not None:
            mandate = Mandate.of(mandate)
            cost = _number(mandate.costs.get("cost"), cost)
            unset = PROPORTIONAL, mandate.bare_cost_model
            cost_model = (cost_model in unset and mandate.cost_model) or cost_model
            calendar = calendar or mandate.trading.calendar
            benchmark = mandate.benchmark if benchmark is None else benchmark
        require_type("cost_model", cost_model, str, 'text, such as "itemized(fixed=5)"')
        written = called(cost_model)[1].get("cost")
        return TradingTerms(mandate, _number(written, cost), cost_model, calendar, benchmark)


def _number(written: float | str | None, otherwise: float) -> float:
    """A cost that may be written; one that is no number is judged later."""
    try:
        return float(otherwise if written is None else written)
    except (TypeError, ValueError):
        return otherwise
