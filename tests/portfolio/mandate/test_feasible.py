import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.portfolio.mandate.feasible import CappedSimplex
from qfolio.portfolio.mandate.limits import feasible, mandate_text
from qfolio.portfolio.mandate.projection import excess, nearest

LIMITS = [0.4, 0.0, 0.7]


def largest(violations):
    return np.max([np.max(amount) for amount in violations.values()])


def test_what_is_projected_or_drawn_is_allowed():
    feasible = CappedSimplex(jnp.array(LIMITS))
    wanted = jnp.asarray(np.random.default_rng(0).dirichlet(np.ones(4), 200), jnp.float32)
    projected = jax.vmap(feasible.project)(wanted, wanted)
    drawn = jax.vmap(feasible.draw)(jax.random.split(jax.random.key(0), 200))
    for weights in (projected, drawn):
        assert largest(feasible.violations(weights)) <= 1e-6
    assert float(drawn[:, 1].max()) > 0.39  # up to the limit
    again = jax.vmap(feasible.project)(projected, wanted)
    np.testing.assert_allclose(again, projected, atol=1e-6)
    np.testing.assert_allclose(
        feasible.project(jnp.array([0.1, 0.5, 0.3, 0.1]), wanted[0]), [0.5, 0.4, 0, 0.1], atol=1e-6
    )


def test_violations_are_named_and_measured():
    feasible = CappedSimplex(jnp.array(LIMITS))
    weights = np.array([[0.5, 0.5, 0.0, 0.0], [0.5, -0.2, 0.0, 0.7], [0.5, 0.4, 0.0, 0.2],
                        [np.nan] * 4])  # fmt: skip
    found = feasible.violations(weights)
    np.testing.assert_allclose(found["a weight is above its limit by"], [0.1, 0, 0, np.nan],
                               atol=1e-7)  # fmt: skip
    np.testing.assert_allclose(found["a weight is below 0 by"], [0, 0.2, 0, np.nan], atol=1e-7)
    np.testing.assert_allclose(found["the sum is off 1 by"], [0, 0, 0.1, np.nan], atol=1e-7)


MANDATE = {
    "assets": {"cap": 0.3, "floor": {"A0": 0.05}},
    "groups": {"sector": {"x": {"assets": ["A1", "A2", "A3"], "cap": 0.35, "floor": 0.1}}},
    "cash": {"max": 0.1},
}


def mandated(**trading):
    assets = [f"A{i}" for i in range(8)]
    made = feasible(mandate_text({**MANDATE, "trading": trading}, assets), np.ones(8, bool))
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), made)


@pytest.mark.parametrize(
    "trading",
    [{"turnover": 0.2}, {"turnover": 0.3, "holdings": 5, "smallest_trade": 0.02}],
)
def test_what_a_mandate_projects_or_draws_is_allowed(trading):
    made = mandated(**trading)
    drawn = jax.vmap(made.draw)(jax.random.split(jax.random.key(0), 200))
    assert largest(made.violations(drawn)) <= 2e-6
    wanted = jnp.asarray(np.random.default_rng(0).dirichlet(np.full(9, 0.7), 200), jnp.float32)
    project = jax.jit(jax.vmap(made.project))
    found = project(wanted, drawn)
    assert largest(made.violations(found, drawn)) <= 2e-6
    again = project(found, drawn)
    np.testing.assert_allclose(again, found, atol=2e-6)


def test_where_turnover_gives_way_no_other_limit_does_for_the_sake_of_small_trades():
    made = mandated(turnover=0.05, smallest_trade=0.002)
    rng = np.random.default_rng(0)
    wanted, held = (jnp.asarray(rng.dirichlet(np.full(9, 0.5), 300), jnp.float32) for _ in "ab")
    found = jax.jit(jax.vmap(made.project))(wanted, held)
    over = made.violations(found, held)
    assert float(over.pop("turnover is too high by").max()) > 0.1  # as other limits require
    del over["a trade is too small by"]
    assert largest(over) <= 2e-5  # with few steps in the first round, 0.3


def test_what_a_mandate_with_loans_draws_is_allowed():
    limits = {"cash": {"min": -1.0, "max": -0.2}, "exposure": {"gross": 2.0}}
    made = feasible(mandate_text(limits, "ABCDE"), np.ones(5, bool))
    drawn = jax.vmap(made.draw)(jax.random.split(jax.random.key(0), 100))
    assert largest(made.violations(drawn)) <= 2e-6
    assert float(drawn[:, 0].max()) <= -0.2 + 2e-6


@pytest.mark.parametrize(("left", "most"), [(0.1, 0.1), (0.5, 0.2)])
def test_an_order_spends_no_more_than_what_is_left_of_the_year(left, most):
    spending = mandated(turnover=0.2).spending(jnp.asarray(left))
    assert float(spending.limits.turnover) == pytest.approx(most)


def test_short_positions_add_to_the_gross_exposure():
    limits = {"assets": {"floor": -0.5}, "exposure": {"gross": 1.0}}
    made = feasible(mandate_text(limits, "AB"), np.ones(2, bool))
    found = made.violations(np.array([0.6, 0.8, -0.4]))
    assert found["gross exposure is too high by"] == pytest.approx(0.2)


def test_no_rounding_makes_a_loan():
    fully = feasible(mandate_text({"cash": {"max": 0.0}}, "ABCDE"), np.ones(5, bool))
    random = np.random.default_rng(1)
    wanted = random.dirichlet(np.full(6, 0.5), 5000).astype(np.float32)
    held = jax.vmap(fully.draw)(jax.random.split(jax.random.key(0), 5000))
    held *= np.exp(0.02 * random.standard_normal(held.shape))
    held /= held.sum(-1, keepdims=True)
    found = jax.jit(jax.vmap(fully.project))(wanted, held)
    assert float(found.min()) > -1.5e-7  # without the last division it is -2.4e-7
    assert largest(fully.violations(found)) <= 2e-6


def test_small_trades_are_left_out_and_others_made():
    made = mandated(smallest_trade=0.03)
    held = jnp.array([0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.2])
    near = held + jnp.array([0, 0.01, -0.01, 0, 0, 0.02, -0.02, 0, 0])
    np.testing.assert_array_equal(made.project(near, held)[1:], held[1:])
    far = held + jnp.array([0, 0.01, -0.01, 0, 0, 0.05, -0.05, 0, 0])
    moved = made.project(far, held) - held
    np.testing.assert_allclose(moved, [0, 0, 0, 0, 0, 0.05, -0.05, 0, 0], atol=1e-6)
    below = held.at[1].set(0.045).at[7].set(0.155)  # under its floor: a limit needs the trade
    np.testing.assert_allclose(made.project(below, below), below.at[:2].set([0.095, 0.05]),
                               atol=1e-6)  # fmt: skip


@pytest.mark.parametrize("more", [0.0, 0.01])
def test_small_trades_are_left_out_until_the_others_are_large_enough(more):
    """Without B's, D's is too small; then F's. G is sold, as one holding too many."""
    limits = {"cash": {"max": 0.0}, "trading": {"holdings": 5, "smallest_trade": 0.05}}
    made = feasible(mandate_text(limits, "ABDEFG"), np.ones(6, bool))
    made = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), made)
    held = jnp.array([0, 0.2, 0.2, 0.1, 0.3 - more, 0.2, more])
    wanted = jnp.array([0, 0.4, 0.16, 0.158, 0.1325, 0.1495, 0.0])
    expected = [0, 0.38375, 0.2, 0.1, 0.11625, 0.2, 0]
    np.testing.assert_allclose(made.project(wanted, held), expected, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limits", "turnover", "best", "longer", "longest"),
    [
        ({}, None, 1.0, 1.0, 1.0),
        (MANDATE, None, 0.93, 1.006, 1.24),
        (MANDATE, 0.6, 0.74, 1.05, 1.8),
    ],
)
def test_how_far_the_largest_weights_are_from_the_best_choice(
    limits, turnover, best, longer, longest
):
    """Against all 70 choices of 4 of 8 assets, in 300 cases: the distance to what is wanted."""
    trading = {"holdings": 4} | ({} if turnover is None else {"turnover": turnover})
    assets = [f"A{i}" for i in range(8)]
    made = feasible(mandate_text({**limits, "trading": trading}, assets), np.ones(8, bool))
    chosen = itertools.combinations(range(8), 4)
    others = np.array([[i not in some for i in range(8)] for some in chosen])
    with jax.enable_x64(True):
        made = jax.tree.map(jnp.asarray, made)
        wanted = jnp.asarray(np.random.default_rng(0).dirichlet(np.ones(9), 300))
        held = jax.vmap(made.draw)(jax.random.split(jax.random.key(0), 300)).astype(float)

        def of_choice(wanted, held, others):
            bounds = made.limits
            low, high = (jnp.where(others, 0.0, x) for x in (bounds.low, bounds.high))
            bounds = bounds._replace(low=low, high=high)
            found = nearest(wanted[1:], held[1:], bounds)
            fits = (excess(found, held[1:], bounds).max() <= 1e-7) & ~(
                others & (made.limits.low > 0)
            ).any()
            return jnp.where(fits, jnp.linalg.norm(found - wanted[1:]), jnp.inf)

        each = jax.vmap(jax.vmap(of_choice, (None, None, 0)), (0, 0, None))
        shortest = np.asarray(jax.jit(each)(wanted, held, jnp.asarray(others)).min(1))
        found = np.asarray(jax.jit(jax.vmap(made.project))(wanted, held))
    worst = np.max(list(made.violations(found, np.asarray(held)).values()), axis=0)
    assert np.isfinite(shortest).all()
    assert worst.max() <= 1e-6
    ratio = np.linalg.norm((found - np.asarray(wanted))[:, 1:], axis=1) / shortest
    assert (ratio < 1 + 1e-6).mean() >= best - 0.02
    assert ratio.mean() <= longer + 1e-6
    assert ratio.max() <= longest + 1e-6


def test_the_largest_weights_are_kept():
    made = mandated(holdings=4)
    wanted = jnp.array([0.02, 0.01, 0.02, 0.12, 0.01, 0.27, 0.05, 0.26, 0.24])
    found = np.asarray(made.project(wanted, wanted))
    assert np.flatnonzero(found[1:] > 0).tolist() == [0, 2, 4, 6]  # with those that floors need
    assert largest(made.violations(found)) <= 1e-6


def test_those_are_kept_that_turnover_allows():
    """The nearest two, B and C, need a sale of all of A; besides D, 29% may be traded, not 30%."""
    limits = {"assets": {"forbidden": ["D"]}, "trading": {"holdings": 2, "turnover": 0.59}}
    made = feasible(mandate_text(limits, "ABCD"), np.ones(4, bool))
    made = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), made)
    wanted, held = jnp.array([0.4, 0, 0.3, 0.3, 0]), jnp.array([0, 0.3, 0.2, 0.2, 0.3])
    np.testing.assert_allclose(made.project(wanted, held), [0.59, 0.21, 0.2, 0, 0], atol=1e-5)


def test_a_mandate_has_the_same_limits_whatever_can_be_traded():
    """Policies of several folds share their programs, and folders theirs shapes."""
    text = mandate_text({"assets": {"floor": {"c": -0.1}}}, ("a", "b", "c"))
    every, some = (feasible(text, np.array([True, True, c])) for c in (True, False))
    assert every.bounds == some.bounds
    assert every.limits.rows.shape == some.limits.rows.shape
