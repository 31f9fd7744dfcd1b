"""Whether training converged: the returns of training episodes, fold by fold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from qfolio.core.arrays import Floats
from qfolio.report import palette
from qfolio.report.data import Numbers
from qfolio.report.figures.style import NARROW, colors, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POINTS = 20
"""Number of points of a curve: means over equally long, consecutive parts of the training."""

EVIDENCE = 2.0
"""Standard errors by which returns must rise to count as rising."""


@dataclass(frozen=True)
class FoldTraining:
    """The training of an agent in a fold.

    Attributes:
        curve: Mean return of the training episodes in each part of the training, all seeds, shape
            (POINTS,).
        rising: Whether the returns of the last quarter lie above those of the third by more than
            ``EVIDENCE`` standard errors.
    """

    curve: Floats
    rising: bool

    @classmethod
    def of(cls, returns: Numbers, episodes: Numbers | None = None) -> FoldTraining | None:
        """From the returns of all episodes in order of time; None if there are too few.

        episodes: their numbers, by which those of all seeds are put side by side: each part of the
        training then holds as many of each seed.
        """
        if len(returns) < 2 * POINTS:
            return None
        values = np.asarray(returns, dtype=float)
        if episodes is not None:
            values = values[np.argsort(episodes, kind="stable")]
        third, last = np.array_split(values, 4)[2:]
        error = np.sqrt(third.var(ddof=1) / len(third) + last.var(ddof=1) / len(last))
        curve = np.array([part.mean() for part in np.array_split(values, POINTS)])
        return cls(curve, bool(last.mean() - third.mean() > EVIDENCE * error))


def convergence_sentences(training: Mapping[str, Sequence[FoldTraining]]) -> list[str]:
    """A sentence per agent: in how many folds its returns were still rising at the end."""
    sentences = []
    for name, folds in training.items():
        rising = sum(fold.rising for fold in folds)
        found = (
            f"in {rising} of {len(folds)} folds the returns were still rising; "
            "training for longer may help"
            if rising
            else f"in none of {len(folds)} folds were the returns still rising"
        )
        sentences.append(f"{name}: {found}.")
    return sentences


def draw_convergence(training: Mapping[str, Sequence[FoldTraining]], width: float) -> Figure:
    """Draw a panel for each agent and a line for each fold, later ones darker."""
    columns = min(len(training), 1 if width <= NARROW else 3)
    rows = -(-len(training) // columns)
    figure = new_figure(width, 2.1 * rows + 0.3)
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True)
    share = 100 * (np.arange(POINTS) + 0.5) / POINTS
    shades = colors("folds", [palette.HAIRLINE, palette.ACCENT])
    for axes, (name, folds) in zip(panels.flat, training.items(), strict=False):
        for i, fold in enumerate(folds):
            shade = shades((i + 1) / len(folds))
            axes.plot(share, fold.curve, color=shade, linewidth=0.9)
        axes.set_title(name)
        axes.grid(axis="y")
        axes.set_xlim(0, 100)
        axes.locator_params(nbins=5)
    for axes in panels.flat[len(training) :]:
        axes.set_visible(False)
    for axes in panels[-1]:
        axes.set_xlabel("share of training, %")
    return figure
