"""What a finished backtest found about an agent or another strategy, for those who follow it."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from qfolio.core.errors import QfolioError
from qfolio.core.files import read_json
from qfolio.core.text import figure, shell
from qfolio.portfolio.backtest.folder import followed
from qfolio.portfolio.backtest.statistics.verdict import seeds_lost

Kind = Literal["agent", "baseline", "strategy"]


@dataclass(frozen=True)
class Standing:
    """The verdict of a backtest on what ``allocate`` follows, all seeds of an agent together.

    agent: its name, or that of a baseline or a strategy of the user's own.
    verdict: the sentence of the report, or the measures of what is no agent; empty if the backtest
    is not finished.
    worse: whether an agent grows more slowly than the benchmark, or than its best rebalancing, or
    loses everything.
    """

    agent: str
    verdict: str
    worse: bool
    kind: Kind = "agent"

    @staticmethod
    def of(folder: Path, agent: str, kind: Kind = "agent") -> "Standing":
        """The standing of a strategy, from summary.json in the folder of its backtest.

        Raises:
            QfolioError: The file is damaged or does not contain the strategy.
        """
        path = folder / "summary.json"
        if not path.exists():
            return Standing(agent, "", False, kind)
        try:
            summary = read_json(path)
            strategies = summary.get("strategies", {})
            if kind != "agent":
                measured = _measured(kind, strategies[agent]["measures"])
                return Standing(agent, measured, False, kind)
            name = followed(agent, strategies)
            lost = seeds_lost(strategies[name]["measures"]["drawdown"]["per_seed"]) > 0
            worse = any(
                strategies[name][key] is not None
                and strategies[name][key]["growth"]["finding"] == "worse"
                for key in ("to_rebalanced", "to_reference")
            )
            return Standing(agent, str(summary["verdicts"][name][0]), lost or worse)
        except (AttributeError, IndexError, KeyError, QfolioError, TypeError, ValueError):
            raise QfolioError(
                f"{path} is damaged; write it again with qfolio backtest --resume {shell(folder)}."
            ) from None

    def require_sound(self, resume: str, named: bool) -> None:
        """Raises QfolioError unless the policy may be traded without an explicit override.

        Args:
            resume: The command line that finishes the backtest, for the message.
            named: Whether the user named this agent.
        """
        if self.kind != "agent":
            return
        if not self.verdict:
            raise QfolioError(
                f"The backtest is not finished, so it does not say how {self.agent} compares with "
                f"its benchmark; finish it with {resume}, or allocate with --anyway."
            )
        if self.worse and not named:
            raise QfolioError(
                f"In its own backtest, {self.verdict.rstrip('.')}; to trade it nevertheless, add "
                f"--agent {self.agent} or --anyway."
            )


def _measured(kind: Kind, measures: dict[str, dict[str, float]]) -> str:
    growth, sharpe, turnover = (measures[k]["mean"] for k in ("growth", "sharpe", "turnover"))
    return (
        f"This {kind}, which learned nothing, grew by {figure(growth, '.1%')} a year after "
        f"costs, with a Sharpe ratio of {figure(sharpe, '.2f')} and a "
        f"turnover of {figure(turnover, '.1f')} a year."
    )
