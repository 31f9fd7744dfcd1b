"""From an order to trades: when orders are given, and over how many rows they are filled.

The functions take numpy and jax arrays alike, so that training, replay and baselines share them.
"""

from typing import Any, NamedTuple


class Plan(NamedTuple):
    """What an account remembers of its orders."""

    spent: Any  # turnover since the calendar year began, ()
    order: Any  # the last order, drifted to now, (entry,)
    left: Any  # rows over which it is still to be filled, ()


class Terms(NamedTuple):
    """When orders are given, and how they are filled; arrays of numpy or jax.

    decides: whether a decision is due at each row, shape (row,); no rows if always. elapsed: years
    at each row, as ``calendars.calendar_years`` counts them, shape (row,); no rows unless
    ``turnover`` is limited. band: an order is given only if some weight, cash included, is to
    change by more. fill: rows over which an order is filled, in equal parts. turnover: maximum in a
    calendar year, bought plus sold, as a multiple of wealth. called: sum of the assets' absolute
    weights above which a decision is due at any row (a margin call).
    """

    decides: Any
    elapsed: Any
    band: float = 0.0
    fill: int = 1
    turnover: float = float("inf")
    called: float = float("inf")

    @property
    def remembers(self) -> bool:
        """Whether an account needs a plan."""
        return self.fill > 1 or self.turnover < float("inf")

    def due(self, row: Any, held: Any) -> Any:
        """Whether a decision is due at a row with some weights held; a bool, or an array ()."""
        decides = self.decides[row] if len(self.decides) else True
        return decides | self.calls(held)

    def calls(self, held: Any) -> Any:
        """Whether some weights held are a margin call."""
        return abs(held[1:]).sum() > self.called if self.called < float("inf") else False

    def beyond(self, held: Any, wanted: Any) -> Any:
        """Whether the holding is far enough from the target for an order, or a margin call."""
        far = abs(wanted - held).max() > self.band if self.band else True
        return far | self.calls(held)

    def begin(self, held: Any, spent: Any = 0.0) -> Plan | None:
        """The plan of an account without earlier orders; None if it needs none."""
        if not self.remembers:
            return None
        xp = held.__array_namespace__()
        return Plan(xp.asarray(spent, dtype=held.dtype), held, xp.asarray(0, dtype=xp.int32))

    def trade(
        self, held: Any, order: Any, given: Any, plan: Plan | None
    ) -> tuple[Any, Plan | None]:
        """The weights after the trade of a row, and the plan from there on.

        Each row buys and sells an equal part of what is left of the order, in shares. An order that
        is ``given`` at this row replaces what is left of the one before.
        """
        if given is True and plan is None:
            return order, None
        xp = held.__array_namespace__()
        if plan is None:
            return xp.where(given, order, held), None
        order = xp.where(given, order, plan.order)
        left = xp.where(given, self.fill, plan.left)
        part = xp.where(left > 1, held + (order - held) / xp.maximum(left, 1), order)
        target = xp.where(left > 0, part, held)
        spent = plan.spent + abs(target - held)[1:].sum()
        return target, Plan(spent, order, xp.maximum(left - 1, 0))

    def unspent(self, plan: Plan | None) -> Any:
        """The turnover that is left this year; None if turnover is not limited."""
        if plan is None or self.turnover == float("inf"):
            return None
        return plan.spent.__array_namespace__().maximum(self.turnover - plan.spent, 0.0)

    def next_row(self, row: Any, plan: Plan, order: Any) -> Plan:
        """The plan one row later; order: its order, drifted to that row."""
        spent = plan.spent
        if len(self.elapsed):
            xp = spent.__array_namespace__()
            after = xp.minimum(row + 1, len(self.elapsed) - 1)
            begins = xp.floor(self.elapsed[after]) > xp.floor(self.elapsed[row])
            spent = xp.where(begins, 0.0, spent)
        return Plan(spent, order, plan.left)
