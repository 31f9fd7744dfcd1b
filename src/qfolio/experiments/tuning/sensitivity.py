"""The sensitivity of results to each hyperparameter, from the trials of a search.

Importance is the share of the variation of results that a setting explains by itself (fANOVA:
Hutter, Hoos and Leyton-Brown 2014), over the whole space. The effect of one setting comes from a
Gaussian process fitted to the trials: its prediction as that setting moves along its scale while
all others stay as in the best quarter of the trials.
"""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from qfolio.core.arrays import Bools, Floats
from qfolio.core.text import listed
from qfolio.experiments.tuning.journal import Trial
from qfolio.experiments.tuning.search import Dimension, positions

TOLERANCE = 0.05
"""Tolerated loss of a robust value, as a share of the optimum (or of the best return)."""

ENOUGH = 12
"""Fewest trials from which effects are estimated."""

MOST = 400
"""Maximum number of trials for the model, evenly spaced: its cost grows with their cube."""

POINTS = 41
"""Points on the scale of each setting at which its effect is estimated."""

_LEAST_REGRET = 1e-4


@dataclass(frozen=True)
class Outcome:
    """The scale of returns in figures (heights): higher is better.

    With a known optimum it is minus the logarithm of the regret, so that one outlier does not hide
    all other differences. Without one it is the return, and returns far below the median are
    clipped to ``floor``.
    """

    optimum: float | None
    best: float
    floor: float

    @classmethod
    def of(cls, returns: ArrayLike, optimum: float | None) -> "Outcome":
        optimum = optimum or None  # there is no share of zero
        finite = np.asarray(returns, float)
        finite = finite[np.isfinite(finite)]
        best, middle = float(finite.max()), float(np.median(finite))
        floor = finite.min() if optimum is not None else best - 3 * max(best - middle, 1e-9)
        return cls(optimum, best, float(max(floor, finite.min())))

    @property
    def tolerance(self) -> str:
        """The tolerated loss of a robust value, in words."""
        share = f"{100 * TOLERANCE:.0f}"
        if self.optimum is None:
            return f"{share}% of the best return"
        return f"{share} points of regret"

    @property
    def unit(self) -> float:
        """The return whose shares are lost: the optimum, or the best."""
        return max(abs(self.best if self.optimum is None else self.optimum), 1e-12)

    def height(self, returns: ArrayLike) -> Floats:
        """Heights of returns; NaN is worse than the worst by more than is tolerated."""
        values = np.asarray(returns, float)
        if self.optimum is None:
            values = np.maximum(values, self.floor)
        values = np.where(np.isnan(values), self.floor - 2 * TOLERANCE * self.unit, values)
        if self.optimum is None:
            return values
        regret = (self.optimum - values) / self.unit
        return np.asarray(-np.log10(np.maximum(regret, _LEAST_REGRET)))

    def loss(self, height: ArrayLike) -> Floats:
        """The loss at a height, as a share of the optimum (or of the best return)."""
        values = np.asarray(height, float)
        if self.optimum is None:
            return np.asarray((self.best - values) / self.unit)
        return np.asarray(10.0**-values)


@dataclass(frozen=True)
class Effect:
    """The effect of one setting."""

    dimension: Dimension
    share: float  # share of the variation that it explains by itself
    places: Floats  # on its scale: POINTS of them, or one for each choice
    heights: Floats  # predicted there, with all other settings as in the best quarter
    robust: Bools  # whether the expectation is within the tolerance of its best

    @property
    def range(self) -> tuple[float, float]:
        """The ends of the robust range around the best place."""
        low = high = int(self.heights.argmax())
        while low > 0 and self.robust[low - 1]:
            low -= 1
        while high + 1 < len(self.robust) and self.robust[high + 1]:
            high += 1
        return float(self.places[low]), float(self.places[high])

    @property
    def width(self) -> float:
        """Share of the searched range that is robust."""
        if self.dimension.choices:
            return float(self.robust.mean())
        low, high = self.range
        return high - low


@dataclass(frozen=True)
class Sensitivity:
    """The effects of all settings, most important first."""

    outcome: Outcome
    effects: list[Effect]
    explained: float  # R² of the fitted model on held-out trials


def sensitivity(
    space: Sequence[Dimension], trials: Sequence[Trial], optimum: float | None
) -> Sensitivity | None:
    """Importance and effect of each setting; None if trials are too few, or all alike."""
    values = [trial.value for trial in trials]
    if np.isfinite(values).sum() < ENOUGH:
        return None
    outcome = Outcome.of(values, optimum)
    heights = outcome.height(values)
    if np.ptp(heights) < 1e-9:
        return None
    table = np.stack([positions(space, trial.values) for trial in trials])
    shares = _shares(space, table, heights)
    kept = np.linspace(0, len(trials) - 1, min(MOST, len(trials))).astype(int)
    model = _Model(space, table[kept], heights[kept])
    best = table[np.argsort(-heights)[: max(4, len(trials) // 4)]]
    effects = []
    for column, dim in enumerate(space):
        count = len(dim.choices)
        places = (np.arange(count) + 0.5) / count if count else np.linspace(0, 1, POINTS)
        moved = np.repeat(best[None], len(places), 0)
        moved[:, :, column] = places[:, None]
        expected = model(moved.reshape(-1, len(space))).reshape(moved.shape[:2])
        expected = np.minimum(expected, heights.max()).mean(1)  # it overshoots next to cliffs
        robust = outcome.loss(expected) <= outcome.loss(expected.max()) + TOLERANCE
        effects.append(Effect(dim, shares[column], places, expected, robust))
    effects.sort(key=lambda effect: -effect.share)
    return Sensitivity(outcome, effects, model.explained)


def _shares(space: Sequence[Dimension], table: Floats, heights: Floats) -> list[float]:
    """The share of the variation that each setting explains by itself, from Optuna's fANOVA.

    fANOVA weights values evenly, so it is given positions on the scales instead of values.
    """
    import optuna
    from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution

    even: dict[str, BaseDistribution] = {
        dim.name: CategoricalDistribution(dim.choices) if dim.choices else FloatDistribution(0, 1)
        for dim in space
    }
    study = optuna.create_study(direction="maximize")
    for row, height in zip(table, heights, strict=True):
        params = {
            dim.name: dim.choices[int(place * len(dim.choices))] if dim.choices else float(place)
            for dim, place in zip(space, row, strict=True)
        }
        study.add_trial(
            optuna.trial.create_trial(params=params, distributions=even, value=float(height))
        )
    evaluator = optuna.importance.FanovaImportanceEvaluator(seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)  # of normalize
        found = optuna.importance.get_param_importances(study, evaluator=evaluator, normalize=False)
    return [float(found[dim.name]) for dim in space]


class _Model:
    """A Gaussian process over positions of configurations; choices are one-hot encoded."""

    def __init__(self, space: Sequence[Dimension], table: Floats, heights: Floats) -> None:
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.gaussian_process import GaussianProcessRegressor
        from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

        self._space = space
        inputs = self._inputs(table)
        lengths = np.ones(inputs.shape[1])
        kernel = ConstantKernel(1.0, (1e-2, 1e2)) * Matern(lengths, (0.2, 30), nu=1.5)
        kernel += WhiteKernel(0.1, (1e-4, 1.0))
        self._process = GaussianProcessRegressor(kernel, normalize_y=True, random_state=0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # a length scale reached its bound
            self._process.fit(inputs, heights)
        # Leave-one-out predictions (Rasmussen & Williams 2006, eq. 5.12).
        inverse = np.linalg.inv(self._process.kernel_(inputs))
        scaled = (heights - heights.mean()) / heights.std()
        errors = inverse @ scaled / np.diag(inverse)
        self.explained = float(1 - np.mean(errors**2))

    def __call__(self, table: Floats) -> Floats:
        return np.asarray(self._process.predict(self._inputs(table)))

    def _inputs(self, table: Floats) -> Floats:
        columns = []
        for dim, places in zip(self._space, table.T, strict=True):
            count = len(dim.choices)
            columns += [np.floor(places * count) == k for k in range(count)] if count else [places]
        return np.stack(columns, 1).astype(float)


def verdicts(found: Sensitivity | None, trials: Sequence[Trial]) -> list[str]:
    """Which settings matter, in sentences."""
    if found is None:
        if sum(math.isfinite(trial.value) for trial in trials) < ENOUGH:
            return [f"{ENOUGH} trials with a finite loss are needed to say what matters."]
        return ["All trials ended alike: within the searched ranges no setting matters."]
    effects = found.effects
    if found.explained < 0.2:
        return [
            f"{len(trials)} trials do not tell what matters: a model fitted to them predicts "
            f"held-out trials hardly better than their mean does (R² {found.explained:.2f})."
        ]
    drawn = [trial.value for trial in trials if trial.at_random]
    sentences = []
    if len(drawn) >= ENOUGH:
        loss = found.outcome.loss
        worst = loss(found.outcome.height(found.outcome.best)) + TOLERANCE
        good = int((loss(found.outcome.height(drawn)) <= worst).sum())
        sentences.append(
            f"Of {len(drawn)} configurations drawn at random, {good or 'none'} lost no more than "
            f"{found.outcome.tolerance} to the best."
        )
    loud = [e for e in effects if e.share >= 0.1]
    strong = [e for e in loud if e.width < 0.9]
    idle = [e for e in effects if e.share < 0.05 and e.width >= 0.75]
    if strong:
        names = listed([f"{e.dimension.name} ({e.share:.0%})" for e in strong])
        sentences.append(
            f"What matters most: {names}, by the share of the variation that each explains alone."
        )
    elif loud:
        names = listed([f"{e.dimension.name} ({e.share:.0%})" for e in loud])
        sentences.append(
            f"The variation comes from {names}, by the share that each explains alone, but hardly "
            f"any value costs more than {found.outcome.tolerance}."
        )
    else:
        sentences.append("No setting by itself explains a tenth of the variation.")
    if idle:
        names = listed([e.dimension.name for e in idle])
        verb = "matters" if len(idle) == 1 else "matter"
        sentences.append(
            f"{names} hardly {verb}: once the others are right, at least three quarters of the "
            f"searched range costs no more than {found.outcome.tolerance}."
        )
    narrow = min(effects, key=lambda e: e.width)
    if narrow.width < 0.5 and not narrow.dimension.choices:
        low, high = map(narrow.dimension.at, narrow.range)
        factor = "" if narrow.dimension.scale != "log" else f", a factor of {high / low:.2g}"
        sentences.append(
            f"The narrowest is {narrow.dimension.name}: {short(low)} to {short(high)} is robust"
            f"{factor}."
        )
    return sentences


def short(value: float) -> str:
    """A setting with two significant digits; near 1, those of its distance from 1."""
    if 0.9 < value < 1:
        return f"{value:.{1 - math.floor(math.log10(1 - value))}f}".rstrip("0")
    return f"{float(f'{value:.2g}'):g}"
