"""Policies as scikit-learn estimators, for skfolio's model selection and reports.

>>> from qfolio.adapters.sklearn import PortfolioPolicy
>>> from skfolio.model_selection import WalkForward, cross_val_predict
>>> cross_val_predict(PortfolioPolicy(seeds=2), X, cv=WalkForward(train_size=1260, test_size=252))
"""

import inspect
from collections.abc import Mapping
from copy import copy
from typing import Any

import numpy as np
from skfolio import Portfolio
from skfolio.optimization import BaseOptimization
from sklearn.utils.validation import check_is_fitted, validate_data

from qfolio.core.errors import QfolioError, require_type, require_whole
from qfolio.core.registry import find
from qfolio.core.settings import names
from qfolio.experiments import presets
from qfolio.portfolio.backtest.simulation import Simulation, simulate
from qfolio.portfolio.calendars import band
from qfolio.portfolio.conditions import Conditions
from qfolio.portfolio.costs import grown
from qfolio.portfolio.mandate.limits import feasible, mandate_text, parse
from qfolio.portfolio.prices.frequency import dated, periods_per_year
from qfolio.portfolio.prices.table import Prices

OWN = ("cost", "lag", "max_weight", "window")
"""Settings of the portfolio task that are parameters of the estimator."""


class PortfolioPolicy(BaseOptimization):
    """A learned policy that trades every day, as an estimator.

    ``X`` holds simple returns, of shape (observations, assets), as in skfolio; each row is earned
    by the decision made ``lag`` + 1 rows before. The first decisions of a prediction therefore fall
    on the last rows of the training data, so the fitted estimator keeps the returns of these rows
    and of the policy's window. ``fit`` learns from all rows but the last ``lag``, which come after
    the first of those decisions. No decision depends on a later row.

    ``predict`` assumes that the rows of ``X`` follow the training rows. If both have dates, it
    looks up which rows came before, and if these are too few for a window (as on the training data
    themselves), it holds the portfolio without trading until there are enough. The policy does not
    see rows that a splitter purges in between; to the policy, the market stands still there.

    Parameters
    ----------
    agent : str, default="pathwise"
        Any agent with a preset for portfolios, such as "pathwise", "tilts" or "dqn".

    preset : str, default="fast"
        Name of the hyperparameters to start from.

    episodes : int, default=None
        Training episodes of each seed in ``fit``; the preset's if None.

    update_episodes : int, default=None
        Training episodes of each later ``partial_fit``; one for each of the agent's environments if
        None. Agents that weigh evidence, such as "tilts", learn anew; None means as long as before.

    seeds : int, default=None
        Number of agents trained; the policy follows their mean decision. The preset's if None.

    seed : int, default=0
        The first agent's seed; the others have the seeds that follow.

    window : int, default=None
        Rows of returns that the policy observes; the preset's if None.

    cost : float, default=0.001
        One-way trading cost, as a fraction of the value traded; both training rewards and predicted
        returns are exactly net of it.

    lag : int, default=1
        Rows between a decision and its execution.

    max_weight : float, default=1.0
        Largest weight of one asset.

    settings : dict, default=None
        Settings of the agent or of the portfolio task that replace the preset's, by name.

    portfolio_params : dict, default=None
        Parameters of the predicted portfolio, such as ``name`` or ``annualization_factor``.

    fallback, raise_on_failure :
        What happens when fitting fails, as in skfolio's other models.

    previous_weights : float, dict or array-like of shape (n_assets,), default=None
        Weights of the assets held at the close before the first predicted row (the rest is cash);
        all cash if None. skfolio's walk-forward functions pass on the last fold's weights.

    Attributes
    ----------
    policy_ : qfolio.portfolio.policy.Policy
        The learned policy.

    weights_ : ndarray of shape (n_assets,)
        Target weights after the last training row, for a holder of ``previous_weights``. They sum
        to less than 1 if the policy wants cash.

    returns_ : ndarray of shape (n_observations, n_assets)
        The last returns seen.

    observations_ : pandas.Index or None
        Their dates.

    periods_per_year_ : float
        Rows a year, from their dates; those of trading days without any.

    n_samples_seen_ : int
        Number of all rows seen, including those no longer kept.

    n_features_in_, feature_names_in_ :
        Number and names of the assets.
    """

    policy_: Any
    returns_: np.ndarray
    observations_: Any
    n_samples_seen_: int

    def __init__(
        self,
        agent: str = "pathwise",
        preset: str = "fast",
        episodes: int | None = None,
        update_episodes: int | None = None,
        seeds: int | None = None,
        seed: int = 0,
        window: int | None = None,
        cost: float = 0.001,
        lag: int = 1,
        max_weight: float = 1.0,
        settings: dict[str, Any] | None = None,
        portfolio_params: dict[str, Any] | None = None,
        fallback: Any = None,
        previous_weights: Any = None,
        raise_on_failure: bool = True,
    ) -> None:
        super().__init__(
            portfolio_params=portfolio_params,
            fallback=fallback,
            previous_weights=previous_weights,
            raise_on_failure=raise_on_failure,
        )
        self.agent = agent
        self.preset = preset
        self.episodes = episodes
        self.update_episodes = update_episodes
        self.seeds = seeds
        self.seed = seed
        self.window = window
        self.cost = cost
        self.lag = lag
        self.max_weight = max_weight
        self.settings = settings

    @property
    def needs_previous_weights(self) -> bool:
        """Always true: a fold starts with the last fold's weights and pays for its trades."""
        return True

    def fit(self, X: Any, y: Any = None) -> "PortfolioPolicy":
        """Learns a policy from simple returns of shape (n_observations, n_assets).

        Raises ValueError or QfolioError for invalid returns, holdings or settings.
        """
        from qfolio.core import devices
        from qfolio.portfolio.policy import train

        devices.configure()
        returns = validate_data(self, X, dtype=np.float64)
        require_whole("lag", self.lag, 0, len(returns) - 1)
        require_type("settings", self.settings or {}, Mapping, "a dict of settings by name")
        chosen, task = self._chosen()
        self.debts_ = self._allows_debts({**chosen.task, **task})
        self._held()  # rejects invalid holdings before training
        self.returns_, self.observations_ = returns, _dates(X)
        self.periods_per_year_ = _frequency(self.observations_)
        self.n_samples_seen_ = len(returns)
        self.policy_ = train(
            self._learned(),
            chosen,
            seeds=self.seeds,
            seed=self.seed,
            episodes=self.episodes,
            **task,
        )
        self.weights_ = self._next_weights()
        return self

    def partial_fit(self, X: Any, y: Any = None) -> "PortfolioPolicy":
        """Continues learning from returns of the same assets that follow those seen before.

        The first call is a ``fit``; later calls learn from as many of the latest rows as it had.
        Raises ValueError if rows are dated before the end of those seen.
        """
        self._validate_partial_fit_fallback()
        if not hasattr(self, "policy_"):
            return self.fit(X, y)
        returns, dates = validate_data(self, X, reset=False, dtype=np.float64), _dates(X)
        after = copy(self)  # if learning fails, this one is as before
        if dates is None or self.observations_ is None:
            after.observations_ = None
        else:
            if not dates[0] > self.observations_[-1]:
                raise ValueError(
                    f"X begins at {dates[0]}, but rows up to {self.observations_[-1]} have already "
                    "been learned from; partial_fit takes new rows only."
                )
            after.observations_ = self.observations_.append(dates)[-len(self.returns_) :]
        after.returns_ = np.concatenate([self.returns_, returns])[-len(self.returns_) :]
        after.n_samples_seen_ += len(returns)
        after.policy_ = self.policy_.update(after._learned(), self.update_episodes)
        after.weights_ = after._next_weights()
        self.__dict__.update(vars(after))
        return self

    def predict(self, X: Any) -> Any:
        """The portfolio that follows the policy, day by day, over the rows of ``X``.

        Returns
        -------
        PolicyPortfolio
            One return for each row, net of costs.
        """
        check_is_fitted(self, "weights_")
        if self.weights_ is None or getattr(self, "fallback_", None) is not None:
            return super().predict(X)
        returns = validate_data(self, X, reset=False, dtype=np.float64)
        simulation, ending = self._followed(self._before(X), returns)
        params = dict(self.portfolio_params or {})
        for name in ("transaction_costs", "management_fees", "previous_weights"):
            if name in params:
                raise QfolioError(
                    f"portfolio_params has {name!r}; a policy's returns are net of its own cost, "
                    "so set cost (or previous_weights) of the estimator."
                )
        params.pop("weight_drift", None)  # a policy's weights always drift
        params.setdefault("name", type(self).__name__)
        previous = self._held()[1:]
        return PolicyPortfolio(X, simulation, ending[1:], previous_weights=previous, **params)

    def _chosen(self) -> tuple[presets.Preset, dict[str, Any]]:
        """The preset with the settings that were changed, and the task's own parameters."""
        chosen = presets.preset(self.preset, "portfolio", self.agent)
        changes = dict(self.settings or {})
        for name in changes.keys() & set(OWN):
            raise QfolioError(f"{name} is a parameter of the estimator; leave it out of settings.")
        mine = names(find("agent", chosen.agent))
        of_agent = {name: value for name, value in changes.items() if name in mine}
        of_task = {name: value for name, value in changes.items() if name not in mine}
        window = {} if self.window is None else {"window": self.window}
        own = {"cost": self.cost, "lag": self.lag, "max_weight": self.max_weight}
        task = {**own, **window, **of_task}
        return chosen._replace(settings={**chosen.settings, **of_agent}), task

    def _allows_debts(self, task: Mapping[str, Any]) -> bool:
        """Whether the mandate allows loans or short sales; refuses settings that need dates."""
        given = task.get("mandate")
        text = mandate_text(given, self._assets()) if given else ""
        _require_undated(str(task.get("calendar", "")), text)
        every = np.ones(self.n_features_in_, bool)
        return bool(text) and not feasible(text, every, self.max_weight).long_only

    def _learned(self) -> Prices:
        """Prices of the rows to learn from: those up to the first decision of a prediction."""
        learned = self.returns_[: len(self.returns_) - self.lag]
        dropped = self.n_samples_seen_ - len(self.returns_)
        return _prices(learned, self._assets(), self.periods_per_year_, first=dropped)

    def _assets(self) -> tuple[str, ...]:
        named = getattr(self, "feature_names_in_", None)
        if named is None:
            return tuple(f"x{i}" for i in range(self.n_features_in_))
        return tuple(map(str, named))

    def _held(self) -> np.ndarray:
        """``previous_weights`` with cash first, of shape (n_assets + 1,).

        Raises ValueError if a weight is negative or their sum exceeds 1, unless the mandate allows
        debts.
        """
        weights = np.zeros(self.n_features_in_)
        if self.previous_weights is not None:
            weights = self._clean_previous_weights(n_assets=self.n_features_in_)
        if self.debts_ and np.isfinite(weights).all():
            return np.append(1 - weights.sum(), weights)
        if not (weights >= -1e-9).all() or not weights.sum() <= 1 + 1e-6:
            raise ValueError("previous_weights must not be negative, nor sum to more than 1.")
        weights = np.maximum(weights, 0)
        held = np.append(max(0.0, 1 - weights.sum()), weights)
        return np.asarray(held / held.sum())

    def _next_weights(self) -> np.ndarray:
        prices = _prices(self.returns_, self._assets(), self.periods_per_year_)
        targets, _ = self.policy_.decide(prices, len(prices) - 1, self._held(), 1)
        return np.asarray(targets[0, 1:])

    def _before(self, X: Any) -> np.ndarray:
        """The returns known before the first row of ``X``."""
        dates = _dates(X)
        if dates is None or self.observations_ is None:
            return self.returns_
        try:
            return self.returns_[: int(self.observations_.searchsorted(dates[0]))]
        except TypeError:  # labels of different kinds have no order
            if _are_dates(dates) and _are_dates(self.observations_):
                raise ValueError(
                    "Either the dates of X or those of the returns learned have a time zone, and "
                    "the others have none; give both or neither, such as by X.tz_localize(None)."
                ) from None
            return self.returns_

    def _followed(self, before: np.ndarray, returns: np.ndarray) -> tuple[Simulation, np.ndarray]:
        """The record of the policy over some rows, and the weights at their end, cash first."""
        task, days = self.policy_.task, len(returns)
        window, lag = task.window, task.lag
        # Rows missing before the first decision's window; their returns are zero.
        missing = max(0, window + lag - len(before))
        still = np.zeros((missing, returns.shape[1]))
        rows = np.concatenate([still, before, returns])
        prices = _prices(rows, self._assets(), self.periods_per_year_)
        values, last = prices.values, missing + len(before)  # the last row before X
        known = Conditions.of(prices, task.costs)

        def growth(weights: np.ndarray, start: int, end: int) -> Any:
            period = known.holding(np.array(start), np.array(end))
            return task.costs.growth(weights, values[end] / values[start], period)

        held = self._held()
        start = grown(held, 1 / growth(held, last - lag, last))
        decisions = np.full((days, 1 + returns.shape[1]), np.nan)  # NaN: no order
        if missing < days:
            first = last - lag + missing
            held = grown(start, growth(start, last - lag, first))
            decisions[missing:], _ = self.policy_.decide(prices, first, held, days - missing)
        simulation = simulate(
            values,
            decisions,
            first=last - lag,
            cost=task.costs,
            lag=lag,
            start=start,
            conditions=known,
            long_only=task.feasible.long_only,
        )
        traded, end = simulation.weights[-1], len(values) - 1
        return simulation, grown(traded, growth(traded, end - 1, end))


class PolicyPortfolio(Portfolio):
    """A portfolio whose weights a policy changes every day; its returns are net of costs.

    ``weights`` are means over the days, ``weights_per_observation`` those of each day, and
    ``turnover`` is the sum of all trades. ``simulation`` has the cash, turnover and cost of each
    day.
    """

    __slots__ = {"simulation"}
    _read_only_attrs = Portfolio._read_only_attrs | {"simulation"}

    def __init__(
        self, X: Any, simulation: Simulation, ending_weights: np.ndarray, **params: Any
    ) -> None:
        """ending_weights: after the last row, of shape (n_assets,)."""
        if "weights" in params:
            raise TypeError(
                "The weights of a policy change from day to day; its portfolio cannot be scaled, "
                "or combined with another."
            )
        path = simulation.weights[:, 1:]
        super().__init__(X, weights=path.mean(0), weight_drift=True, **params)
        own = {
            "returns": simulation.returns,
            "ending_weights": ending_weights,
            "simulation": simulation,
            "_weights_path": path,
        }
        for name, value in (("_loaded", False), *own.items(), ("_loaded", True)):  # else read-only
            setattr(self, name, value)

    @property
    def turnover(self) -> float:
        """Value bought plus value sold, over the wealth before each trade, summed over the days."""
        return float(self.simulation.turnover.sum())

    def contribution(self, *args: Any, **kwargs: Any) -> Any:
        """Not defined: skfolio's contributions are derivatives with respect to constant weights."""
        raise NotImplementedError("Contributions are not defined for weights that change daily.")

    def _get_init_params(self) -> dict[str, Any]:
        """The arguments that rebuild the portfolio, by name."""
        kept = set(inspect.signature(Portfolio.__init__).parameters)
        kept -= {"self", "kwargs", "weights", "weight_drift", "sample_weight"}
        params = {name: getattr(self, name) for name in sorted(kept)}
        own = {"simulation": self.simulation, "ending_weights": self.ending_weights}
        return {**params, "sample_weight": self._sample_weight, **own}


def _dates(X: Any) -> Any:
    """The row labels if they define an order; else None."""
    index: Any = getattr(X, "index", None)
    if not hasattr(index, "is_monotonic_increasing"):
        return None
    counted = index.dtype.kind == "i" and np.array_equal(index, np.arange(len(index)))
    ordered = index.is_monotonic_increasing and index.is_unique
    if not ordered and _are_dates(index):
        raise ValueError(
            "The dates of X are not in ascending order, or some repeat; sort its rows, such as by "
            "X.sort_index(), and keep one for each date."
        )
    return index if ordered and not counted else None


def _are_dates(labels: Any) -> bool:
    return getattr(getattr(labels, "dtype", None), "kind", "") == "M"


def _frequency(labels: Any) -> float:
    """Rows per year by the dates of the rows (default: 252, if they have no dates)."""
    labels = labels.to_timestamp() if hasattr(labels, "to_timestamp") else labels  # of periods
    dates = labels.to_numpy("datetime64[s]") if _are_dates(labels) else np.zeros(0, "M8[s]")
    return periods_per_year(dates)


def _require_undated(calendar: str, mandate: str) -> None:
    """Raises QfolioError for settings that depend on dates: rows here are only counted."""
    if calendar and not band(calendar):
        raise QfolioError(
            f"calendar is {calendar}, and the estimator counts rows from wherever its returns "
            "begin, without dates; take a band such as drift:0.05, or test the calendar with "
            "qfolio.Backtest."
        )
    if mandate and parse(mandate)[1].trading.turnover_a_year is not None:
        raise QfolioError(
            "The mandate limits the turnover of a calendar year, and the estimator counts rows "
            "without their dates; leave trading.turnover_a_year out, or test the mandate with "
            "qfolio.Backtest."
        )


def _require_returns(returns: np.ndarray) -> None:
    """Raises ValueError for what nobody earns: prices, or new over old prices."""
    if np.quantile(returns, 0.05) > 0.5:
        raise ValueError(
            "X looks like prices or price relatives: nearly all of its numbers are above 0.5; give "
            "simple returns, such as prices.pct_change().dropna()."
        )


def _prices(
    returns: np.ndarray, assets: tuple[str, ...], per_year: float, first: int = 0
) -> Prices:
    """Prices that start at 1 and have these simple returns.

    Their rows are counted from ``first``, and dated so that there are ``per_year`` a year.
    """
    _require_returns(returns)
    if not (returns > -1).all():
        row, asset = np.argwhere(~(returns > -1))[0]
        raise ValueError(
            f"The return of {assets[asset]!r} in row {row} is {returns[row, asset]:g}; a simple "
            "return must be above -1."
        )
    values = np.cumprod(np.concatenate([np.ones((1, len(assets))), 1 + returns]), axis=0)
    rows = np.arange(first, first + len(values))
    return Prices(dated(rows, per_year), assets, values)
