"""The data of the report of a hyperparameter search, and its verdicts in words."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from qfolio.core.statistics import mean_interval
from qfolio.experiments.tuning import search
from qfolio.experiments.tuning.journal import Trial, best_of
from qfolio.experiments.tuning.search import Dimension, Value
from qfolio.experiments.tuning.sensitivity import Sensitivity, sensitivity, verdicts
from qfolio.report.data import decimals
from qfolio.report.rendering import counted, number, over_seeds
from qfolio.report.words import agent_name, words_of

if TYPE_CHECKING:
    from qfolio.experiments.tuning.run import Tuning


@dataclass(frozen=True)
class Sweep:
    """The data of a search's report."""

    config: dict[str, Any]
    space: list[Dimension]
    trials: list[Trial]
    own: dict[str, Value]  # the preset's values
    summary: dict[str, Any]  # the results of the final comparison
    found: Sensitivity | None
    command: str

    @property
    def title(self) -> str:
        agent, task = self.config["agent"], self.config["task"]
        return f"Hyperparameters of {agent_name(agent)} {words_of(task).where}"

    @property
    def verdicts(self) -> list[str]:
        return [*verdicts(self.found, self.trials), self.comparison]

    @property
    def comparison(self) -> str:
        """Whether the best configuration beats the preset, in a sentence."""
        best, preset = (
            np.array(self.summary[row], float)
            for row in ("return_per_seed", "preset_return_per_seed")
        )
        gains = best - preset
        seeds = counted(len(gains), "fresh seed").lower()
        if not np.isfinite(gains).all():
            failed = "best" if not np.isfinite(best).all() else "preset"
            return (
                f"With {seeds}, training diverged for the {failed}, which settles the comparison."
            )
        digits = decimals(self.summary["optimum"] or best.mean())
        found = best_of(self.trials)
        if found is not None and found.is_preset:
            return (
                f"None of {len(self.trials)} configurations did better than the preset itself, "
                f"which returns {number(preset.mean(), digits)} with {seeds} and the graded starts."
            )
        says = (
            f"With {seeds}, on the starts for grading, the best of {len(self.trials)} "
            f"configurations returns {number(best.mean(), digits)}, the preset "
            f"{number(preset.mean(), digits)}"
        )
        if len(gains) == 1:
            return f"{says}; a single seed allows no further conclusion."
        interval = mean_interval(gains)
        gap = number(gains.mean(), digits, sign=True)
        spread = over_seeds(gains, interval, lambda gain: number(gain, digits, sign=True))
        if interval is None:
            return f"{says} ({gap}; {spread}): too few seeds for a verdict."
        low, high = interval
        kind = "better" if low > 0 else "worse" if high < 0 else "no clear difference"
        return f"{says}: {kind} ({gap}; {spread})."


def sweep(work: Tuning, summary: dict[str, Any], command: str) -> Sweep:
    """The data of the report, from a search and its final comparison."""
    trials = work.journal.trials()
    return Sweep(
        config=msgspec.to_builtins(work.config),
        space=work.space,
        trials=trials,
        own={dim.name: search.own_value(work.agent, dim) for dim in work.space},
        summary=summary,
        found=sensitivity(work.space, trials, summary["optimum_tuned_on"]),
        command=command,
    )
