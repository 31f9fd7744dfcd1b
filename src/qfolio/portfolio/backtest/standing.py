"""The verdict on an agent of a finished backtest against equal weights."""

from dataclasses import dataclass
from pathlib import Path

from qfolio.core.errors import QfolioError
from qfolio.core.files import read_json
from qfolio.portfolio.backtest.folder import followed


@dataclass(frozen=True)
class Standing:
    """The verdict of a backtest on the policy that ``allocate`` follows, all seeds together.

    agent: its name.
    verdict: the sentence of the report; empty if the backtest is not finished.
    worse: whether it falls short of equal weights in growth, rebalanced at every row or at the best
    speed.
    """

    agent: str
    verdict: str
    worse: bool

    @staticmethod
    def of(folder: Path, agent: str) -> "Standing":
        """The standing of an agent, from summary.json in the folder of its backtest.

        Raises:
            QfolioError: The file is damaged or does not contain the agent.
        """
        path = folder / "summary.json"
        if not path.exists():
            return Standing(agent, "", False)
        summary = read_json(path)
        strategies = summary.get("strategies", {})
        try:
            agents = [name for name, entry in strategies.items() if entry["kind"] == "agent"]
            if agent not in agents:
                raise QfolioError(
                    f"The backtest has no agent {agent!r}; choose from {', '.join(agents)}."
                )
            name = followed(agent, strategies)
            worse = any(
                strategies[name][key] is not None
                and strategies[name][key]["growth"]["finding"] == "worse"
                for key in ("to_rebalanced", "to_reference")
            )
            return Standing(agent, str(summary["verdicts"][name][0]), worse)
        except (AttributeError, IndexError, KeyError, TypeError, ValueError):
            raise QfolioError(
                f"{path} is damaged; write it again with qfolio backtest --resume {folder}."
            ) from None

    def require_sound(self, folder: Path, named: bool) -> None:
        """Raise QfolioError unless the policy may be traded without an explicit override.

        Args:
            folder: The backtest's folder, for the message.
            named: Whether the user named this agent.
        """
        if not self.verdict:
            raise QfolioError(
                f"The backtest in {folder} is not finished, so it does not say how {self.agent} "
                f"compares with equal weights; finish it with qfolio backtest --resume {folder}, "
                "or allocate with --anyway."
            )
        if self.worse and not named:
            raise QfolioError(
                f"In its own backtest, {self.verdict.rstrip('.')}; to trade it nevertheless, add "
                f"--agent {self.agent} or --anyway."
            )
