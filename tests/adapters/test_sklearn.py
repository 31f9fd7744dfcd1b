"""The estimator inside skfolio's own machinery."""

import pickle

import numpy as np
import pandas as pd
import pytest
from skfolio import Population
from skfolio.model_selection import (
    CombinatorialPurgedCV,
    WalkForward,
    cross_val_predict,
    online_predict,
)
from skfolio.optimization import EqualWeighted
from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.utils.estimator_checks import estimator_checks_generator

from qfolio.adapters import sklearn as module
from qfolio.adapters.sklearn import PortfolioPolicy
from qfolio.core.errors import QfolioError
from qfolio.portfolio.costs import drift, remainder_factor

WINDOW, TRAIN = 5, 40
TINY = {"hidden": (8,), "num_envs": 4, "rollout_length": 5, "horizon": 10, "learning_rate": 0.03,
        "learning_rate_final": 1.0}  # fmt: skip


def returns(rows=70, seed=0):
    rng = np.random.default_rng(seed)
    days = pd.bdate_range("2020-01-01", periods=rows)
    return pd.DataFrame(rng.normal(0.003, 0.02, (rows, 3)), columns=list("ABC"), index=days)


def model(**changes):
    tiny = {"episodes": 80, "seeds": 2, "window": WINDOW, "cost": 0.01, "lag": 2, "settings": TINY}
    return PortfolioPolicy(**{**tiny, **changes})


@pytest.fixture
def decided(monkeypatch):
    """Every table of decisions that is replayed."""
    seen = []

    def spy(values, decisions, **options):
        seen.append(np.array(decisions))
        return simulate(values, decisions, **options)

    simulate = module.simulate
    monkeypatch.setattr(module, "simulate", spy)
    return seen


class Checked(PortfolioPolicy):
    """With this tag, scikit-learn draws no negative returns, and so none below −100%."""

    def __sklearn_tags__(self):
        tags = super().__sklearn_tags__()
        tags.input_tags.positive_only = True
        return tags


UNFIT = {
    "check_positive_only_tag_during_fit": "returns may be negative, but not below −100%",
    "check_fit_score_takes_y": "skfolio's fit_predict takes no y",
    "check_fit2d_1sample": "one row is refused by a sentence that names window and horizon",
    "check_methods_sample_order_invariance": "what is held depends on the order of days",
    "check_methods_subset_invariance": "what is held depends on the days before",
}
SLOW = {  # which compile a training for each of several shapes
    "check_estimators_overwrite_params", "check_dont_overwrite_parameters",
    "check_n_features_in_after_fitting", "check_estimators_dtypes", "check_dtype_object",
    "check_estimators_nan_inf", "check_f_contiguous_array_estimator", "check_fit2d_1feature",
    "check_estimators_pickle", "check_pipeline_consistency", "check_n_features_in",
    "check_fit_check_is_fitted", "check_estimators_fit_returns_self", "check_dict_unchanged",
    "check_readonly_memmap_input", "check_fit2d_predict1d", "check_fit1d",
    "check_fit_idempotent",
}  # fmt: skip


def checks():
    """What scikit-learn asks of every estimator."""
    tiny = {**TINY, "num_envs": 1, "rollout_length": 2, "horizon": 2, "hidden": (2,)}
    estimator = Checked(episodes=1, update_episodes=1, seeds=1, window=2, lag=0, settings=tiny)
    for number, (one, check) in enumerate(estimator_checks_generator(estimator)):
        name = check.func.__name__
        if name not in UNFIT:
            marks = [pytest.mark.slow] if name in SLOW else []
            yield pytest.param(one, check, id=f"{name}-{number}", marks=marks)


@pytest.mark.parametrize(("estimator", "check"), list(checks()))
def test_scikit_learns_own_checks(estimator, check, monkeypatch):
    monkeypatch.setattr(module, "_require_returns", lambda returns: None)  # its data are none
    check(estimator)


def test_it_keeps_scikit_learns_conventions():
    original = model(lag=1, previous_weights={"A": 0.5})
    copied = clone(original)
    assert copied is not original
    assert copied.get_params() == original.get_params()
    assert copied.settings == TINY
    assert copied.set_params(seeds=3, lag=0) is copied
    assert (copied.seeds, copied.lag, original.seeds) == (3, 0, 2)
    assert not [name for name in vars(original) if name.endswith("_")]
    with pytest.raises(NotFittedError):
        original.predict(returns())
    with pytest.raises(ValueError, match="parameter 'horizon'"):
        original.set_params(horizon=3)


def test_what_it_knows_once_fitted():
    x = returns()
    fitted = model().fit(x[:TRAIN])
    assert fitted.n_features_in_ == 3
    assert list(fitted.feature_names_in_) == ["A", "B", "C"]
    assert fitted.weights_.shape == (3,)
    assert 0 <= fitted.weights_.sum() <= 1 + 1e-9
    # Tomorrow's weights are those that the policy itself names after the last row.
    values = np.cumprod(np.vstack([np.ones(3), 1 + x[:TRAIN].to_numpy()]), axis=0)
    frame = pd.DataFrame(values, columns=list("ABC"), index=pd.bdate_range("2019", periods=41))
    expected = fitted.policy_.weights(frame)
    np.testing.assert_allclose(fitted.weights_, [expected[name] for name in "ABC"], atol=1e-5)
    with pytest.raises(ValueError, match="now missing"):
        fitted.predict(x[["A", "B"]])
    with pytest.raises(ValueError, match="2 features"):
        model().fit(x[:TRAIN].to_numpy()).predict(x.to_numpy()[:, :2])
    with pytest.raises(ValueError, match="feature names"):
        fitted.predict(x.rename(columns={"A": "Z"}))


def test_signals_look_back_further_than_the_window(decided):
    """A prediction knows the signals of all rows before it, as a policy does on a price table."""
    x = returns()
    fitted = model(settings={**TINY, "signals": "momentum:21,volatility:30"}).fit(x[:TRAIN])
    values = np.cumprod(np.vstack([np.ones(3), 1 + x.to_numpy()]), axis=0)
    frame = pd.DataFrame(values, columns=list("ABC"), index=pd.bdate_range("2019", periods=71))
    expected = fitted.policy_.weights(frame[: TRAIN + 1])
    np.testing.assert_allclose(fitted.weights_, [expected[name] for name in "ABC"], atol=1e-5)
    fitted.predict(x[TRAIN:])
    first = fitted.policy_.weights(frame[: TRAIN + 1 - 2])  # the lag is 2 rows
    np.testing.assert_allclose(decided[0][0, 1:], [first[name] for name in "ABC"], atol=1e-5)
    with pytest.raises(QfolioError, match="has 20 rows; the policy's signals look back on 30"):
        fitted.policy_.weights(frame[:20])


@pytest.mark.parametrize(
    ("index", "year"),
    [
        (pd.date_range("2000", periods=60, freq="B"), 252),
        (pd.date_range("2000", periods=60, freq="D"), 365),
        (pd.date_range("2000", periods=60, freq="W-FRI"), 52),
        (pd.date_range("2000", periods=60, freq="ME"), 12),
        (pd.date_range("2000", periods=60, freq="BQE"), 4),
        (pd.period_range("2000", periods=60, freq="M"), 12),
        (pd.RangeIndex(60), 252),
    ],
)
def test_signals_look_back_on_a_year_of_the_rows(index, year):
    given = returns(60)
    given.index = index
    fitted = model(episodes=8, seeds=1, settings={**TINY, "signals": "momentum:1m"}).fit(given)
    assert fitted.periods_per_year_ == float(fitted.policy_.task.year) == year
    assert len(fitted.predict(given.iloc[-5:]).returns) == 5


def test_odd_returns_are_refused():
    x = returns()
    for value, said in ((np.nan, "NaN"), (-1.0, "above -1")):
        odd = x.copy()
        odd.iloc[3, 1] = value
        with pytest.raises(ValueError, match=said):
            model().fit(odd)
    for prices in (100 * (1 + x).cumprod(), 1 + x):
        with pytest.raises(ValueError, match="looks like prices"):
            model().fit(prices)
    for wrong in (x[::-1], pd.concat([x, x[-1:]])):
        with pytest.raises(ValueError, match="not in ascending order, or some repeat"):
            model().fit(wrong)
    with pytest.raises(QfolioError, match="too few"):
        model().fit(x[:10])
    with pytest.raises(QfolioError, match="set agent to tilts and preset to low-risk"):
        model(agent="tilts:low-risk").fit(x)
    with pytest.raises(QfolioError, match=r"lag is 1\.5; it must be a whole number"):
        model(lag=1.5).fit(x)
    with pytest.raises(QfolioError, match="lag is 300; it must be from 0 to 69"):
        model(lag=300).fit(x)
    with pytest.raises(QfolioError, match=r"settings is .*; it must be a dict"):
        model(settings=[1]).fit(x)
    with pytest.raises(QfolioError, match="cost is a parameter"):
        model(settings={"cost": 0.1}).fit(x)
    with pytest.raises(QfolioError, match="did you mean horizon"):
        model(settings={"horizn": 4}).fit(x)
    with pytest.raises(ValueError, match="previous_weights"):
        model(previous_weights=[0.9, 0.9, 0.0]).fit(x[:TRAIN])


@pytest.mark.parametrize("lag", [0, 2])
def test_a_walk_forward_is_one_ledger(lag):
    """Folds follow one another without a gap: each begins with what the last one held, and every
    day's return is what is held, less the exact cost of getting there."""
    x = returns()
    path = cross_val_predict(model(lag=lag), x, cv=WalkForward(train_size=TRAIN, test_size=10))
    assert len(path) == 3
    moved = 1 + x[TRAIN:].to_numpy()
    weights = np.concatenate([p.simulation.weights for p in path])
    held, traded = np.eye(4)[0], 0
    for day, (after, growth) in enumerate(zip(weights, moved, strict=True)):
        remainder = remainder_factor(held, after, 0.01)
        expected = remainder * (after[0] + after[1:] @ growth) - 1
        np.testing.assert_allclose(path.returns[day], expected, atol=1e-9)
        traded += abs(remainder * after[1:] - held[1:]).sum()
        held = drift(after, growth)
    np.testing.assert_allclose(path.turnover.sum(), traded, atol=1e-9)
    np.testing.assert_allclose(path[-1].ending_weights, held[1:], atol=1e-9)
    np.testing.assert_allclose(
        path.weights_per_observation[list("ABC")], weights[:, 1:], atol=1e-12
    )
    assert weights[:, 0].min() >= 0
    assert traded > 0.5


@pytest.mark.parametrize("lag", [0, 2])
def test_it_does_not_look_ahead(lag, decided):
    """Changing every return after t changes no weight decided at t: not in what is predicted, and
    not through what is learned."""
    x = returns()
    fitted = model(lag=lag).fit(x[:TRAIN])
    fitted.predict(x[TRAIN:])
    for seed in range(6):
        rng = np.random.default_rng(seed)
        t = int(rng.integers(0, 29))  # row of the test
        other = x.copy()
        other.iloc[TRAIN + t + 1 :] = rng.normal(0, 0.1, other.iloc[TRAIN + t + 1 :].shape)
        fitted.predict(other[TRAIN:])
        # The decision at row t of the test earns row t + lag + 1.
        known = t + lag + 2
        np.testing.assert_array_equal(decided[-1][:known], decided[0][:known])
        if known < 30:
            assert not np.array_equal(decided[-1], decided[0])
    if lag:
        other = x[:TRAIN].copy()
        other.iloc[TRAIN - lag :] = 0.2
        again = model(lag=lag).fit(other)
        again.predict(x[TRAIN:])
        np.testing.assert_array_equal(decided[-1][0], decided[0][0])


def test_without_a_window_nothing_is_traded():
    """On the training data themselves, no row comes before the first."""
    x = returns()
    portfolio = model(previous_weights={"A": 0.25, "B": 0.5}).fit(x[:TRAIN]).predict(x[:TRAIN])
    turnover = portfolio.simulation.turnover
    np.testing.assert_array_equal(turnover[: WINDOW + 2], 0)
    assert turnover[WINDOW + 2] > 0
    first = 0.25 * x["A"].iloc[0] + 0.5 * x["B"].iloc[0]
    np.testing.assert_allclose(portfolio.returns[0], first, atol=1e-12)
    short = model(previous_weights={"A": 1.0}).fit(x[:TRAIN]).predict(x[:3])
    np.testing.assert_allclose(short.returns, x["A"].iloc[:3], atol=1e-12)


def test_arrays_are_taken_to_follow():
    x = returns()
    named = model().fit(x[:TRAIN]).predict(x[TRAIN:])
    numbers = x.to_numpy()
    plain = model().fit(numbers[:TRAIN])
    np.testing.assert_array_equal(plain.predict(numbers[TRAIN:]).returns, named.returns)
    counted = pd.DataFrame(numbers, columns=list("ABC"))  # rows counted from 0
    again = model().fit(counted[:TRAIN]).predict(counted[TRAIN:].reset_index(drop=True))
    np.testing.assert_array_equal(again.returns, named.returns)


def test_dates_with_and_without_a_time_zone_have_no_order():
    x = returns()
    fitted = model().fit(x[:TRAIN])
    with pytest.raises(ValueError, match=r"or those of the returns learned have a time zone"):
        fitted.predict(x[TRAIN:].tz_localize("UTC"))
    named = x[TRAIN:].set_axis([f"day {i:02}" for i in range(len(x) - TRAIN)])
    np.testing.assert_array_equal(fitted.predict(named).returns, fitted.predict(x[TRAIN:]).returns)


def test_agents_of_other_seeds_learn_otherwise():
    x = returns()
    first, again, other = (model(seed=n).fit(x[:TRAIN]) for n in (0, 0, 7))
    np.testing.assert_array_equal(first.weights_, again.weights_)
    assert not np.array_equal(first.weights_, other.weights_)


def test_combinatorial_folds():
    """Windows come from rows before the fold, even where later ones were trained on."""
    x = returns(80)
    cv = CombinatorialPurgedCV(n_folds=4, n_test_folds=2)
    paths = cross_val_predict(model(), x, cv=cv)
    assert len(paths) == 3
    for path in paths:
        np.testing.assert_array_equal(path.returns[: WINDOW + 2], 0)
        assert abs(path.returns).sum() > 0.1


def test_beside_skfolios_own_models():
    x = returns()
    cv = WalkForward(train_size=TRAIN, test_size=10, purged_size=1)
    named = [("learned", model()), ("equal", EqualWeighted())]
    population = cross_val_predict(named, x, cv=cv)
    assert isinstance(population, Population)
    assert [p.name for p in population] == ["learned", "equal"]
    assert population.summary(formatted=False).loc["Sharpe Ratio"].notna().all()
    assert population[0].n_observations == population[1].n_observations


def test_its_portfolio_can_be_sent_and_copied_but_not_scaled():
    x = returns()
    params = {"name": "mine", "annualization_factor": 12, "weight_drift": False}
    fitted = model(portfolio_params=params).fit(x[:TRAIN])
    portfolio = fitted.predict(x[TRAIN:])
    for other in (pickle.loads(pickle.dumps(portfolio)), portfolio.copy()):
        assert other.name == "mine"
        assert other.annualization_factor == 12
        np.testing.assert_array_equal(other.returns, portfolio.returns)
        assert other.turnover == portfolio.turnover
        pd.testing.assert_frame_equal(
            other.weights_per_observation, portfolio.weights_per_observation
        )
    np.testing.assert_allclose(portfolio.weights, portfolio.weights_per_observation.mean())
    with pytest.raises(TypeError, match="from day to day"):
        2 * portfolio
    with pytest.raises(NotImplementedError):
        portfolio.contribution("mean")
    assert fitted.score(x[TRAIN:]) == portfolio.sharpe_ratio
    again = pickle.loads(pickle.dumps(fitted))
    np.testing.assert_array_equal(again.predict(x[TRAIN:]).returns, portfolio.returns)
    with pytest.raises(QfolioError, match="transaction_costs"):
        fitted.set_params(portfolio_params={"transaction_costs": 0.1}).predict(x[TRAIN:])


@pytest.mark.parametrize("agent", ["pathwise", pytest.param("dqn", marks=pytest.mark.slow)])
def test_it_goes_on_learning_day_by_day(agent):
    x = returns()
    settings = TINY if agent == "pathwise" else {
        "hidden": (8,), "num_envs": 4, "batch_size": 8, "learning_starts": 20,
        "replay_capacity": 64, "horizon": 10,
    }  # fmt: skip
    learner = model(agent=agent, episodes=16, update_episodes=8, settings=settings)
    path = online_predict(learner, x[: TRAIN + 3], warmup_size=TRAIN, test_size=1)
    by_hand = clone(learner).partial_fit(x[:TRAIN])
    fitted = clone(learner).fit(x[:TRAIN])
    np.testing.assert_array_equal(by_hand.weights_, fitted.weights_)
    before = by_hand.policy_
    for day, predicted in enumerate(path):
        today = x[TRAIN + day : TRAIN + day + 1]
        expected = by_hand.predict(today)
        np.testing.assert_array_equal(predicted.returns, expected.returns)
        by_hand.set_params(previous_weights=expected.ending_weights_dict)
        by_hand.partial_fit(today)
    assert by_hand.policy_.updates == 3
    assert by_hand.returns_.shape == (TRAIN, 3)
    assert by_hand.n_samples_seen_ == TRAIN + 3
    assert by_hand.observations_.equals(x.index[3 : TRAIN + 3])
    old, new = (p.learner.optimizer.count for p in (before, by_hand.policy_))
    assert (new > old).all()
    if agent == "pathwise":  # three times 8 episodes of 10 steps, of which 4 × 5 make an update
        assert (new - old == 3 * 8 * 10 / (4 * 5)).all()
    with pytest.raises(ValueError, match="new rows only"):
        by_hand.partial_fit(x[TRAIN + 2 : TRAIN + 5])
    rows = x[TRAIN + 3 : TRAIN + 6]
    wrong = rows.copy()
    wrong.iloc[-1, 0] = -1.0  # too late to learn from, but the next weights depend on it
    latest = by_hand.policy_
    with pytest.raises(ValueError, match="must be above -1"):
        by_hand.partial_fit(wrong)
    assert by_hand.policy_ is latest
    assert by_hand.partial_fit(rows).n_samples_seen_ == TRAIN + 6


def test_a_fallback_takes_over():
    x = returns()
    fitted = model(fallback=EqualWeighted()).fit(x[:8])  # too few rows for a policy
    portfolio = fitted.predict(x[8:20])
    np.testing.assert_allclose(portfolio.returns, x[8:20].mean(axis=1))
    with pytest.raises(ValueError, match="fallback"):
        fitted.partial_fit(x[20:21])
    with pytest.warns(UserWarning, match="weights_ is set to None"):
        failed = model(raise_on_failure=False).fit(x[:8])
    assert np.isnan(failed.predict(x[8:20]).returns).all()


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"calendar": "monthly"}, "calendar is monthly, and the estimator counts rows"),
        ({"calendar": "21"}, "calendar is 21, and"),
        ({"mandate": {"trading": {"turnover_a_year": 0.2}}}, "limits the turnover of a calendar"),
    ],
)
def test_what_depends_on_dates_is_refused(settings, says):
    with pytest.raises(QfolioError, match=says):
        model(settings={**TINY, **settings}).fit(returns())


def test_a_mandate_with_short_sales_can_be_walked_forward():
    mandate = {"assets": {"floor": {"A": -0.3}, "cap": {"A": -0.1}}}
    short = model(settings={**TINY, "mandate": mandate, "calendar": "drift:0.01"})
    folds = cross_val_predict(short, returns(), cv=WalkForward(train_size=TRAIN, test_size=15))
    first, second = folds.portfolios
    assert first.ending_weights[0] < -0.05
    np.testing.assert_array_equal(second.previous_weights, first.ending_weights)


def test_interest_moves_the_weights_at_the_end():
    costs = "itemized(cash_rate=0.25)"
    x = returns()
    lends = model(max_weight=0.1, settings={**TINY, "cost_model": costs})  # most of it is cash
    found = lends.fit(x[:TRAIN]).predict(x[TRAIN:])
    before, after = found.simulation.weights[-1], found.ending_weights
    assert lends.weights_.max() <= 0.1 + 1e-6
    grown = after / before[1:] / (1 + x.iloc[-1].to_numpy())
    np.testing.assert_allclose(grown, grown[0], rtol=1e-12)
    interest = (1 - after.sum()) / before[0] / grown[0] - 1
    assert 0.25 / 365 / 2 < interest < 0.25 / 365 * 4  # of a day, or of one after a weekend
