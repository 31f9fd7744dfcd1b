"""A mandate over a whole backtest: of agents, ensembles, baselines and tomorrow's orders."""

import json

import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.core.errors import QfolioError
from qfolio.core.mdp import Box
from qfolio.experiments.presets import Preset
from qfolio.portfolio.anchors import path
from qfolio.portfolio.backtest.attribution.decomposition import decompose
from qfolio.portfolio.backtest.attribution.explain import open_to
from qfolio.portfolio.backtest.baselines.equal_weight import EqualWeight
from qfolio.portfolio.backtest.notes import mandated
from qfolio.portfolio.backtest.replay import Stretch
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.desk.desk import Desk
from qfolio.portfolio.itemized import Itemized
from qfolio.portfolio.mandate.limits import buyable, feasible
from qfolio.portfolio.prices.table import Prices

from tables import price_table, random_walk
from tiny import DQN

ASSETS = ("A", "B", "C", "D", "E")

MANDATE = {
    "assets": {"cap": {"A": 0.35, "B": 0.5}, "floor": {"C": 0.04}, "forbidden": ["E"]},
    "groups": {"kind": {"x": {"assets": ["B", "D"], "cap": 0.55, "floor": 0.2}}},
    "cash": {"min": 0.02, "max": 0.15},
    "trading": {"smallest_trade": 0.004, "turnover": 0.6},
}

AGENTS = {
    "pathwise": Preset(
        "pathwise", {"rollout_length": 10, "num_envs": 4, "hidden": (8, 8)},
        episodes=8, seeds=2, task={"window": 10, "horizon": 20},
    ),
    "dqn": DQN._replace(episodes=8),
}  # fmt: skip


def table(late: int = 0) -> Prices:
    values = random_walk(200, 5, drift=3e-4, volatility=0.02)
    values[:late, 3] = np.nan
    return price_table(values, ASSETS, note="made up")


def create(mandate, folder=None, prices=None, agents=AGENTS, **more) -> Backtest:
    options = {"train": "100d", "test": "50d", "seeds": 2, "expanding": False,
               "baselines": ["equal-weight-monthly", "minimum-variance"], **more}  # fmt: skip
    prices = table() if prices is None else prices
    return Backtest.create(prices, agents, mandate=mandate, out=folder, **options)


def test_a_mandate_names_costs_calendar_and_benchmark(tmp_path):
    path = tmp_path / "mandate.toml"
    path.write_text(
        'benchmark = "A"\n[assets]\ncap = 0.5\n[trading]\ncalendar = "weekly"\n'
        "[costs]\ncost = 0.002\nminimum = 1.5\ncash_rate = 0.03\n"
    )
    backtest = create(path)
    config, task = backtest.config, backtest.tasks["pathwise"]
    assert (config.benchmark, config.calendar, config.cost) == ("A", "weekly", 0.002)
    assert isinstance(task.costs, Itemized)
    assert (task.costs.cost, task.costs.minimum, task.costs.cash_rate) == (0.002, 1.5, "0.03")
    assert task.calendar == "weekly"
    assert "costs" not in task.mandate  # which holds the limits alone
    other = create(path, calendar="monthly", cost_model="itemized(fixed=2)", benchmark="B").config
    assert (other.benchmark, other.calendar) == ("B", "monthly")
    assert other.cost_model == "itemized(fixed=2)"
    assert create(path, cost_model="itemized").config.cost_model == config.cost_model
    path.write_text("[costs]\nfee = 1.0\n")
    with pytest.raises(QfolioError, match="Itemized has no setting 'fee'"):
        create(path)


@pytest.mark.slow
def test_every_order_obeys_the_mandate(tmp_path):
    backtest = create(MANDATE, tmp_path / "run")
    backtest.run()
    backtest = Backtest.open(tmp_path / "run")
    assert "mandate" in json.loads((tmp_path / "run" / "config.json").read_text())
    text = backtest.tasks["dqn"].mandate
    made = feasible(text, np.ones(5, bool))
    entries, notes = backtest.entries()
    assert {"dqn", "dqn-together", "pathwise", "equal-weight", "minimum-variance"} < set(entries)
    prices, first = backtest.prices.values, backtest.folds[0].decisions.start
    for name, entry in entries.items():
        checked = 0
        for decisions in entry.decisions:
            held = np.eye(6)[0]
            for day, decided in enumerate(decisions):
                if not np.isnan(decided).any():
                    # What brings a holding back within its limits may be small, and the first
                    # purchases, for the range of cash, need more turnover than there may be.
                    outside = max(made.violations(held).values()) > 0
                    for said, amount in made.violations(decided, held).items():
                        if not (outside and said.startswith(("turnover", "a trade"))):
                            assert amount <= 2e-5, (name, day, said)
                            checked += 1
                    held = decided
                drifted = held[1:] * prices[first + day + 1] / prices[first + day]
                held = np.append(held[0], drifted) / (held[0] + drifted.sum())
        assert checked, name
    assert not any("yields" in note for note in notes)
    for name in ("pathwise", "minimum-variance", "equal-weight"):
        followed = Desk.open(tmp_path / "run").followed(name)
        weights = followed.weights(backtest.prices, {"cash": 0.1, "A": 0.3, "B": 0.4, "C": 0.2})
        amounts = made.violations(np.array(list(weights.values()))).values()
        assert max(float(amount) for amount in amounts) <= 2e-5, name


@pytest.mark.slow
def test_agents_and_baselines_keep_risk_and_turnover_of_a_year_at_every_order(tmp_path):
    mandate = {"risk": {"tracking_error": 0.04}, "trading": {"turnover_a_year": 1.5, "fill": 2}}
    agents = {"pathwise": AGENTS["pathwise"]}
    backtest = create(mandate, tmp_path / "run", agents=agents, baselines=["momentum"])
    backtest.run()
    backtest = Backtest.open(tmp_path / "run")
    entries, notes = backtest.entries()
    prices = backtest.prices
    rows = backtest.folds[0].decisions.start + np.arange(backtest.folds[-1].decisions.stop)
    for name in ("pathwise", "pathwise-together", "momentum"):
        for weights in entries[name].simulation.weights:
            held, traded = np.eye(6)[0], 0.0
            for row, after in zip(rows, weights, strict=False):
                traded += abs(after - held)[1:].sum()
                moved = after[1:] * prices.values[row + 2] / prices.values[row + 1]
                held = np.append(after[0], moved) / (after[0] + moved.sum())
            assert 0.2 < traded <= 1.55, name  # all of it is in one year
    (said,) = (note for note in notes if note.startswith("Trades that leave a tracking error"))
    assert "above 0.04: pathwise (" in said  # on the way from cash


@pytest.mark.slow
def test_orders_of_a_calendar_obey_although_holdings_drift_between_them():
    mandate = {"assets": {"cap": 0.25}, "trading": {"holdings": 4}}
    backtest = create(mandate, agents={"pathwise": AGENTS["pathwise"]}, calendar="weekly")
    backtest.run()
    made = feasible(backtest.tasks["pathwise"].mandate, np.ones(5, bool))
    decides = np.asarray(backtest.tasks["pathwise"].decides)[backtest.folds[0].decisions]
    for name, entry in backtest.entries()[0].items():
        ordered = entry.decisions[:, : len(decides)][:, decides]
        ordered = ordered[~np.isnan(ordered).any(-1)]
        assert max(np.max(x) for x in made.violations(ordered).values()) <= 1e-5, name


@pytest.mark.slow
def test_floors_yield_to_assets_that_start_late():
    mandate = {"assets": {"cap": 0.3}, "cash": {"max": 0.2},
               "groups": {"kind": {"x": {"assets": ["D"], "floor": 0.1}}}}  # fmt: skip
    backtest = create(mandate, prices=table(late=40), agents={"pathwise": AGENTS["pathwise"]})
    backtest.run()
    entries, notes = backtest.entries()
    first = backtest.folds[0].name
    note = f"In fold {first} the mandate is relaxed to fit the assets that can be traded: kind x"
    assert note in str(notes)
    held = entries["pathwise"].decisions[:, :, 4]
    assert (held[:, :50] == 0).all()
    assert (held[:, 50:] >= 0.1 - 1e-5).all()


LEVERED = {"assets": {"cap": 2}, "cash": {"min": -1, "max": -0.5}, "exposure": {"gross": 2}}


def test_caps_above_1_hold_for_agents_and_baselines():
    agents, own = {"pathwise": AGENTS["pathwise"]}, np.tile([-0.5, 1.5, 0, 0, 0, 0], (200, 1))
    backtest = create(LEVERED, agents=agents, strategies={"own": own})
    task = backtest.tasks["pathwise"]
    assert isinstance(task.actions, Box)
    assert task.actions.bound == 2
    held, wanted = jnp.eye(6)[0], jnp.array([2.0, 0, 0, 0, 0])
    order = task.wanted(task.first_decision, task.hold(held), wanted)
    np.testing.assert_allclose(order, [-1, 2, 0, 0, 0, 0], atol=1e-6)
    entries, notes = backtest.replay.others(backtest.baselines, backtest._own, "equal-weight")
    weights = entries["minimum-variance"].simulation.weights[0]
    assert weights[:, 1:].sum(1).min() > 1.3
    assert not any("more than the cap" in note for note in notes)


def test_baselines_leave_no_cash_in_place_of_assets_that_may_not_be_held(tmp_path):
    mandate = {"assets": {"forbidden": ["E"], "cap": {"A": 0}}}
    backtest = create(mandate, tmp_path / "run", agents={"pathwise": AGENTS["pathwise"]})
    entries, _ = backtest.replay.others(backtest.baselines, {}, "equal-weight")
    for name, entry in entries.items():
        ordered = entry.decisions[0][~np.isnan(entry.decisions[0]).any(1)]
        np.testing.assert_allclose(ordered[:, [0, 1, 5]], 0, atol=1e-9, err_msg=name)
    np.testing.assert_allclose(entries["equal-weight"].decisions[0, :, 2:5], 1 / 3)
    target = Desk.open(tmp_path / "run").followed("equal-weight").weights(backtest.prices)
    assert list(target.values()) == pytest.approx([0, 0, 1 / 3, 1 / 3, 1 / 3, 0])


class Capped(EqualWeight):
    """Remembers the caps that it was told of."""

    def decide(self, history, held):
        self.caps = {*getattr(self, "caps", ()), history.cap}
        return super().decide(history, held)


def test_a_baseline_knows_the_largest_cap_of_its_mandate():
    capped = Capped()
    agents = {"pathwise": AGENTS["pathwise"]}
    create({"assets": {"cap": {"A": 0.3, "B": 0.4, "C": 0.4, "D": 0.4, "E": 0.4}}}, agents=agents,
           cap=0.9).replay.baseline("baseline", "capped", capped)  # fmt: skip
    assert capped.caps == {0.4}


def test_equal_weights_are_those_of_what_a_mandate_allows():
    """As an anchor and where a return is explained; an index may hold what is forbidden."""
    limits = {"assets": {"forbidden": ["E"], "cap": {"A": 0}}, "risk": {"tracking_error": 0.9}}
    backtest = create(limits, agents={"pathwise": AGENTS["pathwise"]})
    task = backtest.tasks["pathwise"]
    np.testing.assert_allclose(task.benchmarks, 0.2, rtol=1e-6)
    anchor = path("equal-weight", backtest.prices, buyable(task.mandate))
    np.testing.assert_allclose(anchor, np.tile([0, 1 / 3, 1 / 3, 1 / 3, 0], (200, 1)))

    part = backtest._plan.part
    stretches = [Stretch(part("pathwise", fold.name), None, fold) for fold in backtest.folds]
    entries, _ = backtest.replay.others(backtest.baselines, {}, "equal-weight")
    entry = entries["equal-weight"].simulation
    parts = decompose(
        entry.returns[0], entry.weights[0], backtest.replay.growth - 1, {}, ASSETS, 252,
        open_to(stretches),
    )  # fmt: skip
    # Equal weights tilt nowhere, but for what drifts from a decision to its trade and the first
    # row, at which nothing is held yet.
    assert abs(parts.equal) > 0.1
    assert parts.tilts == pytest.approx(0, abs=0.02 * abs(parts.equal))


@pytest.mark.parametrize(
    ("trading", "calendar", "rows"),
    [({"turnover": 0.3}, "monthly", 64), ({"turnover": 0.1}, "", 10), ({"fill": 5}, "", 5)],
)
def test_what_is_bought_once_is_bought_whole(trading, calendar, rows):
    """However slowly equal weights are rebalanced: agents are compared with them."""
    prices = price_table(random_walk(400, 3))
    options = {"train": "200d", "calendar": calendar, "baselines": ["buy-and-hold"]}
    backtest = create({"trading": trading}, prices=prices, **options)
    entries, _ = backtest.replay.others(backtest.baselines, backtest._own, "equal-weight")
    for name in ("buy-and-hold", "equal-weight at 0", "equal-weight at 0.01"):
        cash = entries[name].simulation.weights[0, :, 0]
        assert cash[0] > 0.5
        np.testing.assert_allclose(cash[rows + 21 :], 0, atol=1e-6)
    assert abs(entries["buy-and-hold"].simulation.turnover.sum() - 1) < 0.05  # nothing is sold
    held, never = entries["buy-and-hold"], entries["equal-weight at 0"]
    np.testing.assert_array_equal(held.simulation.returns, never.simulation.returns)


def test_a_mandate_that_cannot_be_met_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(QfolioError, match=r"caps of assets \(10%\) and cash of at most 5% clash"):
        create({"assets": {"cap": 0.1}, "cash": {"max": 0.05}}, tmp_path / "run")
    with pytest.raises(QfolioError, match="names 'Z'"):
        create({"assets": {"forbidden": ["Z"]}}, tmp_path / "run")
    with pytest.raises(
        QfolioError, match=r"volatility is at least .* with cash of at most 5%, and"
    ):
        create({"risk": {"volatility": 0.02}, "cash": {"max": 0.05}}, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_tracking_error_is_against_the_benchmark_of_the_backtest():
    def against(limits, **given):
        backtest = create(limits, agents={"pathwise": AGENTS["pathwise"]}, **given)
        return backtest.tasks["pathwise"].written.risk.benchmark

    risk = {"tracking_error": 0.03}
    assert against({"risk": risk}) == "equal-weight"
    assert against({"risk": risk}, benchmark="B") == "B"
    assert against({"risk": risk}, benchmark="minimum-variance") == "minimum-variance"
    assert against({"risk": risk, "benchmark": "A"}, benchmark="B") == "A"
    assert against({"risk": {**risk, "benchmark": "A"}}, benchmark="B") == "A"
    assert against({"risk": {"volatility": 9}}, benchmark="B") is None
    own, message = np.zeros(200), "tracking error cannot be measured against the benchmark '"
    with pytest.raises(QfolioError, match=message + "benchmark', which is no asset"):
        against({"risk": risk}, benchmark=own)
    with pytest.raises(QfolioError, match=message + "house'"):
        against({"risk": risk}, strategies={"house": own}, benchmark="house")


def test_without_a_mandate_the_program_is_as_before():
    backtest = create(None, agents={"pathwise": AGENTS["pathwise"]})
    task = backtest.tasks["pathwise"]
    assert task.allowed is None
    assert type(task.feasible).__name__ == "CappedSimplex"
    assert mandated(backtest.replay) == []
    capped = create(None, agents={"pathwise": AGENTS["pathwise"]}, cap=0.15).replay
    assert mandated(capped) == ["The cap of 15% for each of 5 assets forces at least 25% cash."]


@pytest.mark.parametrize(("turnover", "said"), [(0.08, 1), (0.2, 0)])
def test_a_band_in_which_all_orders_end_is_named(turnover, said):
    given = {"trading": {"turnover": turnover, "calendar": "drift:0.05"}}
    found = mandated(create(given, agents={"pathwise": AGENTS["pathwise"]}).replay)
    assert len(found) == said
    assert all("turnover of at most 8% that exchange assets" in note for note in found)
