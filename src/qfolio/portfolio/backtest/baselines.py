"""Classical allocators, with skfolio behind one function, that decide as an agent does.

At the start of each fold an allocator is fitted to the returns of the fold's training rows; its
weights are then the target of every day of the fold, so that drift is traded back daily. Buy and
hold orders once, at the very first decision.
"""

import warnings
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from qfolio.core.errors import QfolioError

Floats = NDArray[np.float64]


@runtime_checkable
class Fold(Protocol):
    """Rows of the price table: where to learn and where to decide."""

    @property
    def name(self) -> str: ...
    @property
    def train(self) -> slice: ...
    @property
    def decisions(self) -> slice: ...


class Decided(NamedTuple):
    """Decisions of shape (D, N + 1), cash first, NaN for no order, and what went wrong on the way.

    Notes are sentences for the person who reads the results.
    """

    decisions: Floats
    notes: tuple[str, ...]


def _inverse_volatility(cap: float) -> Any:
    from skfolio.optimization import InverseVolatility

    return InverseVolatility()


def _minimum_variance(cap: float) -> Any:
    from skfolio.optimization import MeanRisk

    return MeanRisk(max_weights=cap)


def _maximum_ratio(cap: float) -> Any:
    from skfolio.optimization import MeanRisk, ObjectiveFunction

    return MeanRisk(objective_function=ObjectiveFunction.MAXIMIZE_RATIO, max_weights=cap)


def _risk_budgeting(cap: float) -> Any:
    from skfolio.optimization import RiskBudgeting

    return RiskBudgeting(max_weights=cap)


def _hierarchical_risk_parity(cap: float) -> Any:
    from skfolio.optimization import HierarchicalRiskParity

    return HierarchicalRiskParity(max_weights=cap)


BASELINES: dict[str, Callable[[float], Any] | None] = {
    "equal-weight": None,
    "buy-and-hold": None,
    "inverse-volatility": _inverse_volatility,
    "minimum-variance": _minimum_variance,
    "maximum-ratio": _maximum_ratio,
    "risk-budgeting": _risk_budgeting,
    "hierarchical-risk-parity": _hierarchical_risk_parity,
}
"""Names, and what makes the skfolio estimator for a cap on weights; None has equal weights."""


def weights(name: str, returns: ArrayLike, *, cap: float = 1.0) -> tuple[Floats, tuple[str, ...]]:
    """Fit an allocator to returns; where that fails, weights are equal and a note says so.

    Args:
        name: One of BASELINES.
        returns: Simple returns of shape (days, N), without gaps, N at least 1.
        cap: Most that one asset may weigh, above 0. Where the allocator itself knows no such bound,
            the excess goes to the assets below it, in proportion to their weights. Where the
            assets cannot hold everything within the cap, all are at the cap and the rest is cash.

    Returns:
        Weights of the assets, of shape (N,), and notes.

    Raises:
        QfolioError: There is no such allocator.
    """
    sample = np.asarray(returns, dtype=float)
    assets = sample.shape[1]
    make = _maker(name)
    equal = np.full(assets, min(1 / assets, cap))
    if make is None or cap * assets <= 1 + 1e-9:
        return equal, ()

    from skfolio.exceptions import SkfolioError

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            # skfolio says ValueError where no portfolio has a positive return or returns are few.
            fitted = np.maximum(make(cap).fit(sample).weights_, 0)
            if not 0 < fitted.sum() < np.inf:
                raise ValueError("the weights found are not numbers")
        except (SkfolioError, ValueError) as error:
            return equal, (f"no solution, so weights are equal: {_line(error)}",)
    notes = dict.fromkeys(f"skfolio warns: {_line(w.message)}" for w in caught)
    return _capped(fitted, cap), tuple(notes)


def decisions(
    name: str,
    folds: Sequence[Fold],
    values: ArrayLike,
    *,
    tradable: ArrayLike | None = None,
    cap: float = 1.0,
) -> Decided:
    """Decide for every day of the folds, seeing prices up to each fold's first decision only.

    Args:
        name: One of BASELINES.
        folds: Folds whose decisions follow one another without a gap, in order of time. The
            training rows of a fold end with the row of its first decision or earlier.
        values: Prices of shape (rows, N); NaN before an asset's first price.
        tradable: Which assets a fold may hold, of shape (folds, N); those with prices in all of
            its training rows if None. The others have weight 0.
        cap: Most that one asset may weigh when it is ordered, see `weights`.

    Returns:
        Decisions for the rows from the first to the last fold's, and notes that name the fold.

    Raises:
        QfolioError: There is no such allocator, the folds have a gap or look ahead, a fold may
            hold no asset, or an asset that it may hold has no price in its training rows.
    """
    prices = np.asarray(values, dtype=float)
    rows, assets = prices.shape
    hold = name == "buy-and-hold"
    _check(folds)
    parts, notes = [], []
    for number, fold in enumerate(folds):
        window = prices[fold.train]
        priced = ~np.isnan(window).any(axis=0)
        held = priced if tradable is None else np.asarray(tradable, dtype=bool)[number]
        if not held.any() or (held & ~priced).any():
            raise QfolioError(
                f"Fold {fold.name} has no asset to hold, or one without a price in its training "
                "rows; begin later or drop the assets that start late."
            )
        part = np.full((len(range(rows)[fold.decisions]), assets + 1), np.nan)
        if not (hold and number):
            window = window[:, held]
            fitted, more = weights(name, window[1:] / window[:-1] - 1, cap=cap)
            part[: 1 if hold else None] = _with_rest_in_cash(fitted, held)
            notes += [f"{name}, fold {fold.name}: {note}" for note in more]
        parts.append(part)
    return Decided(np.concatenate(parts), tuple(notes))


def _maker(name: str) -> Callable[[float], Any] | None:
    if name not in BASELINES:
        raise QfolioError(f"There is no baseline {name!r}; there are {', '.join(BASELINES)}.")
    return BASELINES[name]


def _check(folds: Sequence[Fold]) -> None:
    if not folds:
        raise QfolioError("There is no fold to decide for; the prices are too few.")
    for fold in folds:
        if fold.train.stop > fold.decisions.start + 1:
            raise QfolioError(
                f"Fold {fold.name} trains on rows up to {fold.train.stop - 1}, but decides from "
                f"row {fold.decisions.start} on; end its training there or earlier."
            )
    for one, following in pairwise(folds):
        if one.decisions.stop != following.decisions.start:
            raise QfolioError(
                f"Fold {following.name} decides from row {following.decisions.start} on, but fold "
                f"{one.name} before row {one.decisions.stop}; leave no gap between them."
            )


def _with_rest_in_cash(fitted: Floats, held: NDArray[np.bool_]) -> Floats:
    row = np.zeros(len(held) + 1)
    row[1:][held] = fitted
    row[0] = max(0.0, 1 - fitted.sum())
    return row


def _capped(proposed: Floats, cap: float) -> Floats:
    """Weights of sum 1 that are at most the cap; those below it keep their proportions."""
    capped = proposed / proposed.sum()
    free = np.ones(len(capped), dtype=bool)
    while (over := free & (capped > cap)).any():
        free &= ~over
        capped[~free] = cap
        rest = 1 - cap * (~free).sum()
        share = capped[free].sum()
        capped[free] = capped[free] * (rest / share) if share > 0 else rest / free.sum()
    return capped


def _line(message: Any) -> str:
    return " ".join(str(message).split())
