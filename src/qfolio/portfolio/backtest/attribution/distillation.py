"""A policy in one line: its active target weights as a linear rule in the signals.

Within each row, target weights and signals are taken less their mean over the assets; what remains
is pooled over rows. The rule is fitted on every other fold and tested on the others, whose agents
were trained anew: R² is out of sample in days and in policies.
"""

from collections.abc import Sequence

import msgspec
import numpy as np

from qfolio.portfolio.backtest.attribution.hac import Floats

_LEAST = 1e-6
"""Smaller active weights are rounding errors."""


class Term(msgspec.Struct, frozen=True):
    """A signal of the rule."""

    name: str
    coefficient: float  # active weight for one unit of the signal
    per_deviation: float  # for one standard deviation of it across assets


class Rule(msgspec.Struct, frozen=True):
    """The linear rule of an agent."""

    terms: list[Term]
    r2: float | None  # on the rows that it was not fitted on; None if no weight is active there
    shared: list[str]  # signals that are the same for all assets, which no such rule can use


def distil(
    targets: np.ndarray,
    anchor: np.ndarray,
    signals: np.ndarray,
    names: Sequence[str],
    tradable: np.ndarray,
    fitted: np.ndarray,
) -> Rule:
    """Fit the rule by least squares.

    Args:
        targets: Target weights of the assets, shape (D, N).
        anchor: The weights that they are active against, likewise.
        signals: Each asset's latest signals, shape (D, N, C).
        names: Of the signals.
        tradable: 1 for assets that may be held on a day, else 0, shape (D, N).
        fitted: Whether a row fits the rule (else it tests it), shape (D,).
    """
    count = np.maximum(tradable.sum(1, keepdims=True), 1)

    def centred(values: np.ndarray) -> Floats:
        mean = (values * tradable).sum(1, keepdims=True) / count
        return (values - mean) * tradable

    y = centred(targets.astype(float) - anchor)
    x = np.stack([centred(signals[..., c]) for c in range(len(names))], -1)
    spread = np.sqrt((x**2).sum((0, 1)) / max(1.0, float(tradable.sum())))
    used = spread > 1e-9
    scaled = x[..., used] / spread[used]
    seen = scaled[fitted].reshape(y[fitted].size, int(used.sum()))
    solved = np.linalg.lstsq(seen, y[fitted].ravel(), rcond=None)[0]
    total = float((y[~fitted] ** 2).sum())
    left = float(((y[~fitted] - scaled[~fitted] @ solved) ** 2).sum())
    known = [name for name, yes in zip(names, used, strict=True) if yes]
    terms = zip(known, (solved / spread[used]).tolist(), solved.tolist(), strict=True)
    return Rule(
        terms=[Term(*each) for each in terms],
        r2=1 - left / total if total > _LEAST**2 * y[~fitted].size else None,
        shared=[name for name, yes in zip(names, used, strict=True) if not yes],
    )
