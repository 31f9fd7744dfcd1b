"""The attributions of a backtest, as why.json keeps them."""

from collections.abc import Mapping
from typing import Any

import msgspec

from qfolio.core.errors import QfolioError
from qfolio.portfolio.backtest.attribution.decomposition import Decomposition
from qfolio.portfolio.backtest.attribution.distillation import Rule
from qfolio.portfolio.backtest.attribution.factors import Exposures
from qfolio.portfolio.backtest.attribution.gradients import Gradients
from qfolio.portfolio.backtest.attribution.importance import Importance
from qfolio.portfolio.backtest.attribution.slices import Slices


class AgentWhy(msgspec.Struct, frozen=True):
    """The attributions of one agent."""

    decomposition: Decomposition
    exposures: Exposures | None  # none if there are too few days
    importance: Importance
    slices: Slices
    gradients: Gradients | None  # none for agents that choose from a menu
    rule: Rule
    menu: bool


class Why(msgspec.Struct, frozen=True):
    """The attributions of a backtest.

    agents: by the name of the strategy that follows all seeds. diagnosis: sentences about dead
    agents, by strategy.
    """

    reference: str  # the strategy that active returns are measured against
    agents: dict[str, AgentWhy]
    diagnosis: dict[str, list[str]]

    @staticmethod
    def read(content: Mapping[str, Any]) -> "Why":
        """The attributions in the content of why.json; raises QfolioError if it is damaged."""
        try:
            return msgspec.convert(content, Why)
        except msgspec.ValidationError as error:
            raise QfolioError(
                f"The attributions of the backtest are damaged ({error}); write them again with "
                "qfolio backtest --resume FOLDER."
            ) from None

    def to_json(self) -> dict[str, Any]:
        """The attributions as JSON values."""
        plain: dict[str, Any] = msgspec.to_builtins(self)
        return plain
