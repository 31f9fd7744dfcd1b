"""A policy from training to disk and on."""

import dataclasses
import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from leaning import Leaning
from qfolio.agents.dqn import DQN
from qfolio.agents.pathwise import Pathwise
from qfolio.agents.tilts import Tilts
from qfolio.core import population
from qfolio.core.errors import QfolioError
from qfolio.portfolio import policy as module
from qfolio.portfolio.following import begin, follow, on_table
from qfolio.portfolio.policy import Policy, train
from qfolio.portfolio.prices.table import Prices
from qfolio.portfolio.task import Portfolio

from listeners import Tell
from tables import featured_table, price_table, random_walk

ROWS, WINDOW = 80, 5
AGENTS: dict[str, tuple[Any, dict[str, Any]]] = {
    "dqn": (
        DQN(network="mlp", hidden=(8, 8), all_actions=True, num_envs=2, batch_size=8,
            learning_starts=20, replay_capacity=64, learning_rate=0.01),
        {"menu": "tilts:0.1"},
    ),
    "pathwise": (  # whose cosine comes to its end in training
        Pathwise(rollout_length=5, num_envs=4, hidden=(8, 8), learning_rate=0.01,
                 learning_rate_final=0.0, learning_rate_steps=6.0),
        {},
    ),
}  # fmt: skip


def table(rows=ROWS, features=1):
    return featured_table(rows, features, drift=0.003)


def learned(name, agent=None, **changes):
    chosen, task = AGENTS[name]
    own = {"window": WINDOW, "horizon": 10, "signals": "momentum:8-2", **task}
    options = {"seeds": 2, "episodes": 16, **own, **changes}
    return train(table().between(0, 60), agent or chosen, **options)


@pytest.fixture(scope="module", params=["pathwise", pytest.param("dqn", marks=pytest.mark.slow)])
def policy(request):
    return learned(request.param)


def leaves(tree):
    return [np.asarray(leaf) for leaf in jax.tree.leaves(tree)]


def same(one, two):
    return all(np.array_equal(x, y) for x, y in zip(leaves(one), leaves(two), strict=True))


def test_it_decides_by_the_mean_of_its_agents(policy):
    held = np.array([0.4, 0.3, 0.2, 0.1])
    task = on_table(policy.task, table())
    start = begin(task, np.tile(held, (2, 1)))
    each, _ = follow(task, policy.agent, policy.members, 70, start, 1)
    targets, after = policy.decide(table(), 70, held, 5)
    np.testing.assert_allclose(targets[0], each[:, 0].mean(0), atol=1e-6)
    moved = np.append(1, table().values[71] / table().values[70])
    np.testing.assert_allclose(after[0], targets[0] * moved / (targets[0] @ moved), atol=1e-6)
    again, _ = policy.decide(table(), 71, after[0], 4)
    np.testing.assert_allclose(again, targets[1:], atol=1e-5)
    np.testing.assert_allclose(targets.sum(1), 1, atol=1e-12)
    start = begin(task, held[None])
    found, then = follow(task, policy.agent, policy.members, 70, start, 5, together=True)
    for one, other in ((found, targets), (np.asarray(then.weights), after)):
        assert one.shape == (1, 5, 4)
        np.testing.assert_allclose(one[0], other, atol=1e-6)


def test_it_comes_back_from_disk(policy, tmp_path):
    policy.save(tmp_path / "kept")
    kept = Policy.open(tmp_path / "kept")
    assert (kept.assets, kept.features, kept.seeds, kept.rows) == (("a", "b", "c"), ("f0",), 2, 60)
    assert kept.weights(table()) == policy.weights(table())
    assert same(kept.learner, policy.learner)
    assert kept.learned == policy.learned == np.datetime64("2020-02-29")
    assert repr(kept).endswith(" on 3 assets, 2 seeds, learned until 2020-02-29>")
    assert repr(table()) == "<Prices: 80 rows of 3 assets, 2020-01-01 to 2020-03-20>"
    updated, kept_updated = (p.update(table(), 8) for p in (policy, kept))
    assert same(updated.learner, kept_updated.learner)
    updated.save(tmp_path / "updated")
    assert Policy.open(tmp_path / "updated").updates == 1
    with pytest.raises(QfolioError, match="not empty"):
        policy.save(tmp_path / "kept")


def test_one_with_an_anchor_comes_back_from_disk(tmp_path):
    changes = {"window": 1, "anchor": "equal-weight+minimum-variance", "episodes": 2, "seeds": 1}
    kept = learned("pathwise", Tilts(rollout_length=10, head=1), **changes)
    kept.save(tmp_path / "kept")
    assert Policy.open(tmp_path / "kept").weights(table()) == kept.weights(table())


def test_what_a_folder_does_not_hold_is_not_taken_from_the_defaults(tmp_path):
    agent = Leaning(rollout_length=5, num_envs=4, hidden=(8,), towards=np.array([0.0, 0, 0, 1]))
    kept = learned("pathwise", agent, episodes=2, seeds=1)
    kept.save(tmp_path / "kept")
    with pytest.raises(QfolioError, match="towards of the agent leaning:Leaning is no setting"):
        Policy.open(tmp_path / "kept")
    assert Policy.open(tmp_path / "kept", agent).weights(table()) == kept.weights(table())
    with pytest.raises(QfolioError, match="towards of the agent is not what"):
        Policy.open(tmp_path / "kept", dataclasses.replace(agent, towards=np.ones(4) / 4))


def test_a_damaged_folder_is_refused(policy, tmp_path):
    policy.save(tmp_path / "kept")
    path = tmp_path / "kept/policy.json"
    config = json.loads(path.read_text())
    other = "does not belong to the settings beside it"
    for name, value, said in (
        ("kind", "backtest", "is a backtest, not a policy"),
        ("agent", None, "agent: expected str"),
        ("agent", "ddqn", "no agent 'ddqn'"),
        ("assets", 3, "assets: expected array"),
        ("assets", [1, 2, 3], "expected str, got int"),
        ("assets", ["a", "b"], other),
        ("seeds", 3, other),
        ("seeds", 10**12, "seeds: expected int <="),
        ("rows", "many", "rows: expected int"),
        ("learned", "some day", "which is not a date"),
        ("task", {"window": 0}, "window is 0"),
        ("task", [], "task: expected object"),
        ("settings", {**config["settings"], "hidden": [9, 9]}, other),
    ):
        path.write_text(json.dumps({**config, name: value}))
        with pytest.raises(QfolioError, match=said):
            Policy.open(tmp_path / "kept")
    path.write_text(json.dumps({k: v for k, v in config.items() if k != "learns"}))
    with pytest.raises(QfolioError, match="damaged"):
        Policy.open(tmp_path / "kept")
    path.write_text(json.dumps(config))
    (tmp_path / "kept/learning.safetensors").write_bytes(b"none")
    with pytest.raises(QfolioError, match="safetensors"):
        Policy.open(tmp_path / "kept")


def test_it_goes_on_from_where_it_was(policy):
    before, environments = policy.learner, policy.agent.num_envs
    updated = policy.update(table(), 2 * environments)
    assert updated.updates == 1
    assert updated.rows == policy.rows
    np.testing.assert_array_equal(updated.task.scale, policy.task.scale)
    first = len(table()) - policy.rows
    assert int(updated.task.first_decision) == first + WINDOW
    assert int(updated.task.last_decision) == len(table()) - 3
    if isinstance(policy.agent, DQN):
        # 20 steps are learned from; 9 warm up the memory, and the rest of that episode is learned.
        steps = updated.learner.optimizer.count - before.optimizer.count
        np.testing.assert_array_equal(steps, 20 + 1)
        np.testing.assert_array_equal(updated.learner.replay.size, 60)
        np.testing.assert_array_equal(updated.learner.episodes, before.episodes + 6)
    else:
        np.testing.assert_array_equal(updated.learner.optimizer.count, before.optimizer.count + 4)
    moved = [abs(x - y).max() for x, y in zip(leaves(policy.members), leaves(updated.members),
             strict=True)]  # fmt: skip
    assert 0 < max(moved) < 25 * policy.agent.learning_rate * module.UPDATE_RATE * 4
    assert same(policy.update(table(), 2 * environments).learner, updated.learner)
    again = updated.update(table(ROWS + 1))
    assert again.updates == 2
    assert not same(again.learner, updated.learner)


def test_an_update_learns_at_a_constant_tenth_of_the_rate():
    """Although the cosine of the first training has come to its end."""
    agent: Any = module._slowed(AGENTS["pathwise"][0])
    rates = [float(agent._schedule(jnp.array(update))) for update in (1, 6, 1000)]
    np.testing.assert_allclose(rates, 0.001, rtol=1e-6)


@pytest.mark.parametrize("episodes", [None, 6])
def test_an_update_of_an_agent_that_weighs_evidence_learns_anew(episodes):
    """Its members would count as evidence what they had learned from before the table moved."""
    agent = Tilts(network="linear", members=2, blocks=4, num_envs=2, rollout_length=10, head=2)
    make = lambda seed: train(  # noqa: E731
        table().between(0, 60), agent, seeds=2, seed=seed, episodes=12, window=1, horizon=20,
        signals="momentum:8-2", anchor="equal-weight",
    )  # fmt: skip
    one, other = make(0), make(7)
    assert any(
        (x != y).any() for x, y in zip(leaves(one.learner), leaves(other.learner), strict=True)
    )
    assert (one.learner.optimizer.count == 12).all()
    updated = [each.update(table(), episodes) for each in (one, other)]
    learned_from = updated[0].task.extra[len(table()) - one.rows :]
    assert np.isfinite(learned_from).all(), "signals look back on the rows before"
    assert (updated[0].learner.optimizer.count == (episodes or 12)).all()
    for x, y in zip(*(leaves(each.learner) for each in updated), strict=True):
        np.testing.assert_array_equal(x, y)


def test_no_update_without_learning_state(policy):
    bare = Policy(policy.task, policy.agent, policy.members, policy.assets, policy.features)
    with pytest.raises(QfolioError, match="cannot be updated"):
        bare.update(table())
    with pytest.raises(QfolioError, match="features"):
        policy.update(table(features=2))
    with pytest.raises(QfolioError, match="too few"):
        policy.update(table().between(-12, None))
    with pytest.raises(QfolioError, match="episodes is 0"):
        policy.update(table(), 0)


def test_nothing_is_learned_twice(policy):
    with pytest.raises(QfolioError, match="up to 2020-02-29; give newer prices"):
        policy.update(table().between(0, 60))
    updated = policy.update(table().between(0, 61))
    assert updated.learned == np.datetime64("2020-03-01")
    with pytest.raises(QfolioError, match="2020-03-01; give newer"):
        updated.update(table().between(0, 61))


def test_an_update_learns_from_as_many_rows_as_before(policy):
    with pytest.raises(QfolioError, match=r"has 59 rows, .* learned from 60; give earlier prices"):
        policy.update(table().between(-59, None))
    assert policy.update(table().between(-60, None)).rows == policy.rows == 60


def test_an_asset_needs_a_price_all_over_the_window(policy):
    def joined(row):
        new = table()
        values = np.array(new.values)
        values[:row, 1] = np.nan
        return Prices(new.dates, new.assets, values, new.features, new.feature_names)

    last = ROWS - 1
    weights = policy.weights(joined(last - WINDOW))
    assert weights == policy.weights(table())  # nothing before the window matters
    with pytest.raises(QfolioError, match="begins on 2020-03-15, when there was no price of 'b'"):
        policy.weights(joined(last - WINDOW + 1))
    # What it may not hold may be younger, but needs a price to be sold at.
    task = dataclasses.replace(policy.task, limits=policy.task.limits.at[1].set(0.0))
    without = Policy(task, policy.agent, policy.members, policy.assets, policy.features)
    assert without.weights(joined(last), {"b": 0.5})["b"] == 0
    with pytest.raises(QfolioError, match="no price of 'b'"):
        without.weights(joined(ROWS))


def test_odd_holdings_are_refused(policy):
    for holdings, said in (({"a": "x"}, "'x'; it must be a number"), ({"a": None}, "None; it must"),
                           ({"a": -0.1}, "from 0 to 1"), ({"a": np.nan}, "from 0 to 1"),
                           ({"d": 0.5}, "'d'"), ({"a": 0.7, "b": 0.7}, "sum to 1.4"),
                           ({"a": 0.5, "cash": 0.4}, "sum to 0.9")):  # fmt: skip
        with pytest.raises(QfolioError, match=said):
            policy.weights(table(), holdings)
    for spent in (-1.0, float("nan"), float("inf")):
        with pytest.raises(QfolioError, match=f"spent is {spent}; it must be a number of at"):
            policy.weights(table(), spent=spent)


def test_programs_that_are_used_again_learn_the_same():
    """Members that share a program with earlier ones keep their own numbers and prices."""
    fast = dataclasses.replace(AGENTS["pathwise"][0], learning_rate=0.1)
    used = [learned("pathwise"), learned("pathwise", agent=fast), learned("pathwise")]
    assert same(used[0].learner, used[2].learner)
    assert not same(used[0].learner, used[1].learner)
    population.programs_of.cache_clear()
    assert same(learned("pathwise", agent=fast).learner, used[1].learner)


def test_a_mandate_that_cannot_be_met_is_refused_by_the_task():
    """So by everything that makes one: policies, the estimator and the Gymnasium environment."""
    mandate = {"assets": {"cap": 0.1}, "cash": {"max": 0.1}}
    prices = price_table(random_walk(120))
    with pytest.raises(QfolioError, match=r"caps of assets .* and cash of at most 10% clash"):
        Portfolio.of(prices, mandate=mandate)
    assert Portfolio.of(prices, mandate={**mandate, "cash": {"max": 0.7}}).mandate


def test_a_mandate_may_be_a_dictionary():
    limited = learned("pathwise", episodes=8, mandate={"assets": {"cap": np.float64(0.4)}})
    assert max(value for name, value in limited.weights(table()).items() if name != "cash") < 0.41


def test_a_policy_is_saved_into_a_new_folder_only(policy, tmp_path):
    policy.save(tmp_path / "policy")
    with pytest.raises(QfolioError, match=r"policy is not empty; name a new folder\.$"):
        policy.save(tmp_path / "policy")


def test_progress_and_settings():
    seen = []
    short = learned(
        "pathwise", episodes=8, listeners=[Tell(lambda training, rows: seen.append(training.share))]
    )
    assert seen == [1.0]
    assert short.task.window == WINDOW
    for options, said in (
        ({"episodes": None}, "needs episodes"),
        ({"episodes": 0}, "episodes is 0"),
        ({"seeds": 0}, "seeds is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"seed": 2**32 - 1}, "seed is 4294967295"),
        ({"windw": 3}, "did you mean window"),
        ({"agent": "dqm"}, "did you mean dqn"),
    ):
        with pytest.raises(QfolioError, match=said):
            learned("pathwise", **options)


def test_prices_of_another_frequency_are_refused(policy, tmp_path):
    """A signal over a year of months would be another one than that of days."""
    daily = table()
    monthly = dataclasses.replace(
        daily, dates=np.datetime64("2000-01", "M") + np.arange(ROWS, dtype="m8[M]")
    )
    policy.save(tmp_path / "policy")
    for one in (policy, Policy.open(tmp_path / "policy")):
        assert one.weights(daily).keys() == {"cash", "a", "b", "c"}
        with pytest.raises(QfolioError, match=r"about 12 rows a year, .* from prices with 365;"):
            one.weights(monthly)
