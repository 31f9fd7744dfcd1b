"""A policy in one line: its active target weights as a linear rule in the signals.

Within each row, target weights and signals are measured from their mean over the assets, and then
pooled over rows. The rule is fitted on every other fold and tested on the others, whose agents were
trained anew: R² is out of sample in days and in policies.
"""

from collections.abc import Sequence

import msgspec
import numpy as np

from qfolio.core.arrays import Floats

_LEAST = 1e-6
"""Smaller active weights are rounding errors."""

BLOCK = 1_000_000
"""Largest number of table entries in one QR factorization."""


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
        anchor: Weights of the same shape; active weights are the targets minus these.
        signals: Each asset's latest signals, shape (D, N, C).
        names: Names of the signals.
        tradable: 1 for assets that may be held on a day, else 0, shape (D, N).
        fitted: Whether the rule is fitted on a row (or else tested on it), shape (D,).
    """

    def triangle(days: np.ndarray) -> Floats:
        """The factor R of the QR factorization of [signals, weights].

        Least squares on R gives the same as on all rows, and R is small."""
        found = np.zeros((0, len(names) + 1))
        for some in np.array_split(days, max(1, days.size * signals[:1].size // BLOCK)):
            open_to = tradable[some, :, None]
            active = targets[some].astype(float) - anchor[some]
            table = np.concatenate([signals[some], active[..., None]], -1)
            mean = (table * open_to).sum(1, keepdims=True)
            mean /= np.maximum(open_to.sum(1, keepdims=True), 1)
            rows = ((table - mean) * open_to).reshape(-1, table.shape[-1])
            found = np.asarray(np.linalg.qr(np.concatenate([found, rows]), mode="r"))
        return found

    seen, tested = triangle(np.flatnonzero(fitted)), triangle(np.flatnonzero(~fitted))
    square = (seen[:, :-1] ** 2).sum(0) + (tested[:, :-1] ** 2).sum(0)
    spread = np.sqrt(square / max(1.0, float(tradable.sum())))
    used = np.append(spread > 1e-9, False)
    solved = np.linalg.lstsq(seen[:, used] / spread[used[:-1]], seen[:, -1], rcond=None)[0]
    total = float((tested[:, -1] ** 2).sum())
    left = float(((tested[:, -1] - tested[:, used] / spread[used[:-1]] @ solved) ** 2).sum())
    known = [name for name, yes in zip(names, used[:-1], strict=True) if yes]
    terms = zip(known, (solved / spread[used[:-1]]).tolist(), solved.tolist(), strict=True)
    return Rule(
        terms=[Term(*each) for each in terms],
        r2=1 - left / total if total > _LEAST**2 * targets[~fitted].size else None,
        shared=[name for name, yes in zip(names, used[:-1], strict=True) if not yes],
    )
