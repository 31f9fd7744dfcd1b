import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from qfolio.agents import ddpg, sac
from qfolio.agents.actor_critic import Batch, Critics, critic_loss
from qfolio.agents.ddpg import DDPG
from qfolio.agents.sac import SAC
from qfolio.agents.td3 import TD3
from qfolio.core.errors import QfolioError
from qfolio.core.mdp import Box, Discrete, Simplex, Transition
from qfolio.core.population import Population
from qfolio.experiments.presets import preset
from qfolio.experiments.run import train
from qfolio.learning.distributions import Gaussian, LogisticNormal, Squashed
from qfolio.learning.exploration import OrnsteinUhlenbeck, uniform
from qfolio.learning.replay import Experience
from qfolio.learning.targets import Scale, squash, unsquash
from qfolio.portfolio.synthetic.garleanu_pedersen import GarleanuPedersen
from qfolio.portfolio.synthetic.merton import Merton
from qfolio.tasks.pendulum import Pendulum

from populations import assert_same, first_member, train_to
from probes import Aim, AimNumbered, AimPlainWeights, AimWeights, OneState

DISCOUNT = 0.8
ANY = [-jnp.inf, jnp.inf]  # rewards that allow every value
STATES = jnp.array([[0.5], [-0.5]])
BEST = jnp.array([[1.0], [-1.0]])
SMALL: dict[str, Any] = {
    "hidden": (64, 64), "num_envs": 4, "batch_size": 64, "replay_capacity": 4000,
    "learning_starts": 400, "discount": DISCOUNT, "tau": 0.05, "learning_rate": 3e-3,
    "learning_rate_final": 0.0,
}  # fmt: skip


def learned(task, agent, steps=2000):
    agent = eqx.tree_at(lambda a: a.learning_rate_steps, agent, float(steps))
    return first_member(train_to(Population(task, agent, [0]), steps).fetch().agent.learned)


def begun(agent, bound=2.0, seed=3):
    """What an agent begins with, for observations and actions of one number."""
    return begin(agent, Aim(bound), jnp.zeros(1), jax.random.key(seed))


@eqx.filter_jit
def begin(agent, task, observation, key):
    return agent.begin(task, observation, key)


@eqx.filter_jit
def updated(agent, learned, steps, discount=None, rewards=ANY):
    batch = Batch(steps, agent.discount if discount is None else discount, jnp.array(rewards))
    return agent.update(learned, batch, jax.random.key(0))[0]


@eqx.filter_jit
def adams_first_step(loss, weights, rate):
    """Where Adam's first step goes: g / (|g| + 10⁻⁸) down the gradient g."""
    gradient = jax.grad(loss)(weights)
    return jax.tree.map(lambda w, g: w - rate * g / (jnp.abs(g) + 1e-8), weights, gradient)


def assert_close(one, other, atol):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=atol), one, other)


@eqx.filter_jit
def batch_of(n=6, actions=None):
    keys = jax.random.split(jax.random.key(7), 4)
    return Experience(
        observation=jax.random.normal(keys[0], (n, 1)),
        action=uniform(actions or Box(1, 2.0), keys[1], n),
        reward=jax.random.normal(keys[2], (n,)),
        next_observation=jax.random.normal(keys[3], (n, 1)),
        terminal=jnp.arange(n) % 3 == 0,
    )


# Values and policies that are known by hand


@pytest.mark.parametrize(
    ("kind", "rescale"),
    [
        (DDPG, False),
        pytest.param(DDPG, True, marks=pytest.mark.slow),
        pytest.param(TD3, False, marks=pytest.mark.slow),
    ],
)
def test_a_deterministic_actor_finds_the_best_action_and_its_value(kind, rescale):
    noise = {"target_noise": 0.2, "target_noise_clip": 0.1} if kind is TD3 else {}
    end = learned(Aim(), kind(**SMALL, exploration_noise=0.2, value_rescaling=rescale, **noise))
    np.testing.assert_allclose(end.actor(STATES), BEST, atol=0.08)  # 2% of the range
    values = end.critics(STATES, BEST).mean(0)
    # Noise on the target's actions takes its variance off each later step.
    lost = clipped_variance(0.2, 0.1) if kind is TD3 else 0.0
    later = DISCOUNT / (1 - DISCOUNT) * (1 - lost)
    np.testing.assert_allclose(values, [1 + later, 1], rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("late", [False, True])
def test_numbered_states_are_no_quantities(late):
    """Critics read their numbers one-hot, as actors do."""
    task, agent = AimNumbered(), DDPG(**SMALL, exploration_noise=0.2, late_action=late)
    end = learned(task, agent)
    seen = jax.vmap(task.observe)(STATES[:, 0])
    np.testing.assert_allclose(end.actor(seen), BEST, atol=0.16)  # 4% of the range
    later = DISCOUNT / (1 - DISCOUNT)
    np.testing.assert_allclose(end.critics(seen, BEST)[0], [1 + later, 1], rtol=0.02)


@pytest.mark.slow
def test_returns_over_steps_lead_to_the_same_policy():
    """Rewards between now and the value that follows are those of actions with noise."""
    noise = 0.2
    end = learned(Aim(horizon=50), DDPG(**SMALL, exploration_noise=noise, n_steps=3))
    np.testing.assert_allclose(end.actor(STATES), BEST, atol=0.16)  # 4%: returns vary more
    later = sum(DISCOUNT**k * (1 - noise**2 * (k % 3 > 0)) for k in range(1, 100))
    np.testing.assert_allclose(end.critics(STATES, BEST)[0], [1 + later, 1], rtol=0.02)


def clipped_variance(scale, clip):
    """Of a normal number that is brought to ±clip."""
    z = clip / scale
    tail = 1 - 0.5 * (1 + math.erf(z / math.sqrt(2)))
    density = math.exp(-(z**2) / 2) / math.sqrt(2 * math.pi)
    return scale**2 * (1 - 2 * tail - 2 * z * density) + 2 * tail * clip**2


@pytest.mark.slow
def test_a_soft_actor_finds_the_best_distribution_its_value_and_its_temperature():
    """For a reward of −(a/2)² the best soft policy is normal with variance 2α."""
    end = learned(Aim(math.inf), SAC(**SMALL, spread=1.0, initial_temperature=0.2))
    entropy = math.log(2)  # that of a number uniform on ±1
    temperature = math.exp(2 * entropy) / (4 * math.pi * math.e)
    np.testing.assert_allclose(jnp.exp(end.log_temperature), temperature, rtol=0.03)
    policy = end.actor(STATES)
    np.testing.assert_allclose(policy.mean, BEST, atol=0.04)
    np.testing.assert_allclose(jnp.exp(policy.log_std), math.sqrt(2 * temperature), rtol=0.05)
    # V = 1 + α log ∫ exp(−a²/4α) da
    value = 1 + temperature * math.log(4 * math.pi * temperature) / 2
    later = DISCOUNT / (1 - DISCOUNT) * value
    np.testing.assert_allclose(end.critics(STATES, BEST).mean(0), [1 + later, 1], rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("rescale", [False, True])
def test_a_soft_choice_among_numbered_actions(rescale):
    agent = SAC(**SMALL, spread=0.5, value_rescaling=rescale)
    end = learned(OneState(), agent, 1500)
    values = agent.action_values(sac.Policy(end.actor, end.critics), jnp.ones((1, 1)))
    assert values is not None
    np.testing.assert_allclose(values, [[0, 1]], atol=0.02)
    # Values 0 and 1 at temperature α: the second is chosen with p = σ(1/α), of entropy log 1.5.
    p = 0.86
    assert -(p * math.log(p) + (1 - p) * math.log(1 - p)) == pytest.approx(math.log(1.5), rel=2e-2)
    chosen = jax.nn.softmax(end.actor(jnp.ones((1, 1))).logits)[0, 1]
    np.testing.assert_allclose(chosen, p, rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("agent", "task"),
    [
        (DDPG(**SMALL, exploration_noise=0.1), AimWeights()),
        (SAC(**SMALL, spread=0.02), AimWeights()),
        (SAC(**SMALL, spread=0.02), AimPlainWeights()),
    ],
)
def test_weights_on_a_simplex(agent, task):
    end = learned(task, agent)
    weights = sac.Policy(end.actor, None) if isinstance(agent, SAC) else end.actor
    view = jax.vmap(task.observe)(STATES[:, 0])
    np.testing.assert_allclose(agent.policy(weights, view), [[0.2, 0.5, 0.3]] * 2, atol=0.03)


# What each step does


def test_the_targets_action_is_smoothed_and_the_smaller_value_taken():
    agent = TD3(hidden=(8,), target_noise=0.5, target_noise_clip=0.1)
    start = begun(agent)
    # An actor on the upper bound: noise beyond it is cut off, and below it is clipped at 0.1 · 2.
    actor = eqx.tree_at(lambda a: a.network.mlp.biases[-1], start.target_actor, jnp.full(1, 50.0))
    start = eqx.tree_at(lambda x: x.target_actor, start, actor)
    seen = []

    class Spy(eqx.Module):
        def __call__(self, observation, action):
            seen.append(action)
            return jnp.stack([action.sum(-1), 3 - action.sum(-1)])

    spied = eqx.tree_at(lambda x: x.target_critics, start, Spy())
    observation = jnp.zeros((1000, 1))
    values = agent.following(spied, observation, jax.random.key(0))
    (action,) = seen
    assert action.max() == 2.0
    np.testing.assert_allclose(action.min(), 1.8, rtol=1e-6)
    total = np.asarray(action.sum(-1))
    np.testing.assert_allclose(values, np.minimum(total, 3 - total), rtol=1e-6)


def test_the_actor_climbs_the_smaller_value():
    """Of a² and 2 − 2a at a = 1 it is the second, which falls with a."""
    critics = lambda observation, a: jnp.stack([a[:, 0] ** 2, 2 - 2 * a[:, 0]])  # noqa: E731
    np.testing.assert_allclose(actor_slope(Box(1), critics, 1.0), 2)
    np.testing.assert_allclose(actor_slope(Box(1), critics, 0.5), -1)


def test_outputs_come_back_from_where_tanh_is_flat():
    """The critics want ever more of the action; 0.1 (5 − 4)² pulls stronger there, not before."""
    critics = lambda observation, a: a.T  # noqa: E731
    flat = lambda x: 3 / np.cosh(x) ** 2  # the slope of 3 tanh(x)  # noqa: E731
    np.testing.assert_allclose(actor_slope(Box(1, 3.0), critics, 5.0), 0.2 - flat(5), rtol=1e-4)
    np.testing.assert_allclose(actor_slope(Box(1, 3.0), critics, -5.0), -0.2 - flat(5), rtol=1e-4)
    np.testing.assert_allclose(actor_slope(Box(1, 3.0), critics, 3.9), -flat(3.9), rtol=1e-4)
    np.testing.assert_allclose(actor_slope(Box(1), critics, 5.0), -1)
    # Without the penalty only the critics count, as in the papers.
    np.testing.assert_allclose(actor_slope(Box(1, 3.0), critics, 5.0, 0.0), -flat(5), rtol=1e-3)


def actor_slope(actions, critics, output, penalty=0.1):
    """Of the actor's loss, in what its network puts out."""

    def loss(output):
        actor = ddpg.Actor(lambda observation: output[None, None], actions)
        return ddpg.actor_loss(actor, critics, jnp.zeros((1, 1)), penalty)[0]

    return jax.grad(loss)(jnp.array(output))


@pytest.mark.parametrize("pessimistic", [True, False])
def test_td3s_actor_climbs_the_smaller_value_or_the_first_critics(pessimistic):
    agent = TD3(hidden=(8,), policy_delay=1, pessimistic_actor=pessimistic, saturation_penalty=0.0)
    start, batch = begun(agent), batch_of()
    after = updated(agent, start, batch)

    def loss(actor):
        q = after.critics(batch.observation, actor(batch.observation))
        return -(q.min(0) if pessimistic else q[0]).mean()

    rate = agent.learning_rate * agent.actor_learning_rate_ratio
    assert_close(after.actor, adams_first_step(loss, start.actor, rate), 1e-5)


def test_actor_and_targets_wait_for_the_critics():
    agent = TD3(hidden=(8,), policy_delay=3, tau=0.25)
    now, moved = begun(agent), []
    for _ in range(6):
        before, now = now, updated(agent, now, batch_of())
        same = lambda name: eqx.tree_equal(getattr(before, name), getattr(now, name))  # noqa: B023, E731
        assert not same("critics")
        assert same("actor") == same("target_critics") == same("target_actor")
        moved.append(not same("actor"))
    assert moved == [False, False, True, False, False, True]


@pytest.mark.parametrize("agent", [DDPG(hidden=(8,)), TD3(hidden=(8,)), SAC(hidden=(8,))])
def test_the_actors_step_leaves_the_critics_alone_and_targets_follow(agent):
    """Critics learn the same whether the actor moves or not; targets go a share of the way."""
    start = begun(agent)
    other = begun(agent, seed=4)
    start = eqx.tree_at(lambda x: x.target_critics, start, other.critics)
    start = eqx.tree_at(lambda x: x.critic_adam.count, start, jnp.array(1, jnp.int32))
    still = updated(dataclasses.replace(agent, actor_learning_rate_ratio=0.0), start, batch_of())
    after = updated(agent, start, batch_of())
    assert eqx.tree_equal(still.critics, after.critics)
    assert eqx.tree_equal(still.actor, start.actor)
    assert not eqx.tree_equal(after.actor, start.actor)
    rate = agent.tau
    follow = lambda target, online: (1 - rate) * target + rate * online  # noqa: E731
    expected = jax.tree.map(follow, start.target_critics, after.critics)
    assert_close(after.target_critics, expected, 1e-6)


def test_nothing_follows_what_is_terminal():
    """The first step of Adam goes where the gradient of the critics' loss says, the target held."""
    agent = DDPG(hidden=(8,), discount=0.9, reward_scale=0.5, learning_rate=0.01)
    start, batch = begun(agent), batch_of()
    q_next = start.critics(batch.next_observation, start.actor(batch.next_observation))[0]
    following = jnp.array([0.9, 0.81, 0.9, 0.81, 0.729, 0.9])  # as returns over steps end
    target = 0.5 * batch.reward + following * ~batch.terminal * q_next
    expected = adams_first_step(
        lambda c: critic_loss(c, batch, target, jnp.inf)[0], start.critics, 0.01
    )
    assert_close(updated(agent, start, batch, following).critics, expected, 1e-5)


def test_the_critics_weights_decay():
    """At a price above all else, Adam's first step takes its rate off each weight's size."""
    agent = DDPG(hidden=(8,), critic_weight_decay=1e8, learning_rate=1e-3)
    start = begun(agent)
    expected = jax.tree.map(lambda w: w - 1e-3 * jnp.sign(w), start.critics)
    assert_close(updated(agent, start, batch_of()).critics, expected, 1e-6)


def test_the_action_may_enter_at_the_second_layer():
    """Written out, with an action in units of its bound."""
    start, batch = begun(DDPG(hidden=(8, 4), late_action=True)), batch_of()
    first, later = jax.tree.map(
        lambda x: x[0], (start.critics.networks.first, start.critics.networks.later)
    )
    x = np.maximum(batch.observation @ first.mlp.weights[0] + first.mlp.biases[0], 0)
    x = np.concatenate([x, batch.action], 1)
    assert jnp.abs(later.mlp.weights[0][8:]).max() < 0.5 / 9**0.5
    x = np.maximum(x @ later.mlp.weights[0] + later.mlp.biases[0], 0)
    expected = x @ later.mlp.weights[1] + later.mlp.biases[1]
    np.testing.assert_allclose(
        start.critics(batch.observation, batch.action)[0], expected[:, 0], rtol=1e-5
    )


def test_last_layers_start_small():
    start = begun(DDPG(hidden=(64,), last_layer_bound=3e-3))
    for mlp in (start.actor.network.mlp, start.critics.networks.mlp):
        assert jnp.abs(mlp.weights[0]).max() > 0.3  # as elsewhere
        assert 2.7e-3 < jnp.abs(mlp.weights[1]).max() < 3e-3
        assert jnp.abs(mlp.biases[1]).max() < 3e-3
    assert eqx.tree_equal(start.actor, start.target_actor)
    assert eqx.tree_equal(start.critics, start.target_critics)


def test_what_follows_is_brought_to_what_rewards_allow():
    """Rewards from −2 to 1, halved, with γ = 0.9: values from −10 to 5."""
    agent = DDPG(hidden=(8,), discount=0.9, reward_scale=0.5)
    steps = batch_of(4)._replace(reward=jnp.zeros(4), terminal=jnp.array([False] * 3 + [True]))
    batch = Batch(steps, 0.9, jnp.array([-2.0, 1.0]))
    target = agent.target(batch, jnp.array([-99.0, 99.0, 3.0, 99.0]))
    np.testing.assert_allclose(target, [-9, 4.5, 2.7, 0], rtol=1e-5)
    # Entropy that is worth 0.1 a step adds to what is possible, and one that costs takes away.
    target = agent.target(batch, jnp.array([-99.0, 99.0, 3.0, 99.0]), (0.0, 0.1))
    np.testing.assert_allclose(target, [-9, 5.4, 2.7, 0], rtol=1e-5)
    target = agent.target(batch, jnp.array([-99.0, 99.0, 3.0, 99.0]), (-0.1, 0.0))
    np.testing.assert_allclose(target, [-9.9, 4.5, 2.7, 0], rtol=1e-5)
    # The papers believe what their critics say.
    plain = dataclasses.replace(agent, clip_bootstrap=False)
    target = plain.target(batch, jnp.array([-99.0, 99.0, 3.0, 99.0]))
    np.testing.assert_allclose(target, [-89.1, 89.1, 2.7, 0], rtol=1e-5)


def test_critics_learn_roots_of_values():
    """√(1 + |v|) − 1 with the sign of v; the critics' own numbers stay values."""
    values, roots = jnp.array([0.0, 3.0, -8.0, 99.0]), jnp.array([0.0, 1.0, -2.0, 9.0])
    np.testing.assert_allclose(squash(values), roots, atol=1e-6)
    np.testing.assert_allclose(unsquash(roots), values, atol=1e-6)
    plain, rescaled = begun(DDPG(hidden=(8,))), begun(DDPG(hidden=(8,), value_rescaling=True))
    batch = batch_of()
    output = plain.critics(batch.observation, batch.action)
    np.testing.assert_allclose(
        rescaled.critics(batch.observation, batch.action), unsquash(output), rtol=1e-6
    )
    target = jnp.linspace(-8.0, 3.0, 6)
    loss, _ = critic_loss(rescaled.critics, batch, target, math.inf)
    expected, _ = critic_loss(plain.critics, batch, squash(target), math.inf)
    np.testing.assert_allclose(loss, expected, rtol=1e-5)


def test_all_rewards_count_however_old():
    agent = DDPG(hidden=(8,), num_envs=2, replay_capacity=2, learning_starts=2)
    state = agent.init(Aim(), jax.random.key(0))
    for reward in ([0.5, -3.0], [2.0, 0.0], [0.0, 0.0]):
        state = agent.observe(state, rollout_of(jnp.array([reward])))
    np.testing.assert_array_equal(state.rewards, [-3, 2])


def rollout_of(reward):
    """A step of Aim in each environment that paid ``reward``."""
    no, zero = jnp.zeros(reward.shape, bool), jnp.zeros(reward.shape)
    view = zero[..., None]
    return Transition(zero, view, view, reward, zero, view, no, no)


def central(loss, weights, step=1e-6):
    """The slope of a loss along a random direction: by differences, and by its gradient."""
    random = np.random.default_rng(0)
    along = jax.tree.map(lambda x: random.normal(size=x.shape), weights)
    at = lambda t: jax.tree.map(lambda x, d: x + t * d, weights, along)  # noqa: E731
    both = jax.jit(jax.value_and_grad(lambda t: loss(at(t))))
    return (both(step)[0] - both(-step)[0]) / (2 * step), both(0.0)[1]


def test_gradients_against_differences():
    with jax.enable_x64(True):
        double = lambda tree: jax.tree.map(  # noqa: E731
            lambda x: x.astype(jnp.float64) if jnp.issubdtype(x.dtype, jnp.floating) else x, tree
        )
        key = jax.random.key(5)
        batch = double(batch_of())
        target = jnp.linspace(-1.0, 1.0, 6)
        deterministic, soft = double(begun(DDPG(hidden=(8, 8)))), double(begun(SAC(hidden=(8, 8))))
        rescaled = double(begun(DDPG(hidden=(8, 8), value_rescaling=True)))
        weighed = SAC(hidden=(8, 8))
        view = jax.vmap(AimWeights().observe)(batch.observation[:, 0])
        view_of_one = jax.tree.map(lambda x: x[0], view)
        weighed = double(begin(weighed, AimWeights(), view_of_one, jax.random.key(3)))
        numbered = SAC(hidden=(8, 8))
        numbered = double(begin(numbered, OneState(), jnp.zeros(1), jax.random.key(3)))
        numbers = double(batch_of(actions=Discrete(2)))
        temperature = jnp.array(0.3)

        def soft_loss(x, observation=batch.observation):
            return lambda actor: sac.actor_loss(actor, x.critics, temperature, observation, key)[0]

        cases = {
            "critic": (lambda c: critic_loss(c, batch, target, jnp.inf)[0], soft.critics),
            "critic of numbers": (
                lambda c: critic_loss(c, numbers, target, jnp.inf)[0],
                numbered.critics,
            ),
            "critic of roots": (
                lambda c: critic_loss(c, batch, target, jnp.inf)[0],
                rescaled.critics,
            ),
            "actor by roots": (
                lambda a: ddpg.actor_loss(a, rescaled.critics, batch.observation, 0.1)[0],
                rescaled.actor,
            ),
            "deterministic actor": (
                lambda a: ddpg.actor_loss(a, deterministic.critics, batch.observation, 0.1)[0],
                deterministic.actor,
            ),
            "soft actor": (soft_loss(soft), soft.actor),
            "soft weights": (soft_loss(weighed, view), weighed.actor),
            "soft choice": (soft_loss(numbered), numbered.actor),
        }
        for name, (loss, weights) in cases.items():
            by_difference, by_gradient = central(loss, weights)
            assert abs(by_gradient) > 1e-5, name
            np.testing.assert_allclose(by_gradient, by_difference, rtol=1e-5, err_msg=name)


def test_soft_values_by_hand():
    """Two actions with min Q = (1, 2) and probabilities (¼, ¾)."""

    class Fixed(eqx.Module):
        output: jax.Array

        def __call__(self, observation):
            return jnp.broadcast_to(self.output, (len(observation), 2))

    class FixedCritics(Critics):
        def __init__(self):
            self.networks = Fixed(jnp.array([[1.0, 5.0], [4.0, 2.0]]))
            self.scale = Scale(roots=False)

    actor = sac.Actor(Fixed(jnp.log(jnp.array([1.0, 3.0]))), Discrete(2))
    q, entropy = sac.expectations(actor, FixedCritics(), jnp.zeros((1, 1)), jax.random.key(0))
    np.testing.assert_allclose(q, 0.25 * 1 + 0.75 * 2, rtol=1e-6)
    np.testing.assert_allclose(entropy, 2 * math.log(2) - 0.75 * math.log(3), rtol=1e-6)
    loss, _ = sac.actor_loss(
        actor, FixedCritics(), jnp.array(0.5), jnp.zeros((1, 1)), jax.random.key(0)
    )
    np.testing.assert_allclose(loss, -(1.75 + 0.5 * entropy[0]), rtol=1e-6)


def test_the_soft_target_counts_the_next_steps_entropy():
    """The critics' first step goes towards r + γ (min Q' + α H)."""
    agent = SAC(hidden=(8,), discount=0.9, learning_rate=0.01, initial_temperature=0.7)
    task = OneState()
    start = begin(agent, task, jnp.zeros(1), jax.random.key(3))
    batch = batch_of(actions=Discrete(2))
    q, entropy = eqx.filter_jit(sac.expectations)(
        start.actor, start.critics, batch.next_observation, jax.random.key(0)
    )
    target = batch.reward + 0.9 * (q + 0.7 * entropy) * ~batch.terminal
    expected = adams_first_step(
        lambda c: critic_loss(c, batch, target, jnp.inf)[0], start.critics, 0.01
    )
    assert_close(updated(agent, start, batch).critics, expected, 1e-5)
    # A last reward of −1, with a policy that is as random as now, is the most that can follow.
    most = -1 + 0.7 * entropy.mean()
    assert ((q + 0.7 * entropy) > most).any()
    target = batch.reward + 0.9 * jnp.minimum(q + 0.7 * entropy, most) * ~batch.terminal
    expected = adams_first_step(
        lambda c: critic_loss(c, batch, target, jnp.inf)[0], start.critics, 0.01
    )
    bounded = updated(agent, start, batch, rewards=[-jnp.inf, -1.0])
    assert_close(bounded.critics, expected, 1e-5)


@pytest.mark.parametrize(
    ("wanted", "entropy", "most"), [(-1.0, 2.0, 2.0), (-1.0, -2.0, 0.0), (1.0, -2.0, 1.0)]
)
def test_entropy_to_come_is_believed_where_no_reward_has_been_seen(wanted, entropy, most):
    """With rewards of 0 a policy that stays as random as it is has the value of α H for ever."""
    agent = SAC(hidden=(8,), discount=0.9)
    steps = batch_of(2)._replace(reward=jnp.zeros(2), terminal=jnp.zeros(2, bool))
    batch = Batch(steps, 0.9, jnp.zeros(2))
    entropies = jnp.array([entropy - 1, entropy + 1])
    bonus = agent.bonus(jnp.array(wanted), entropies, jnp.array(0.5))
    forever = 0.5 * most / (1 - 0.9)
    target = agent.target(batch, jnp.array([forever, 999.0]), bonus)
    np.testing.assert_allclose(target, 0.9 * forever, rtol=1e-5)


@pytest.mark.parametrize(("spread", "rises"), [(0.01, False), (0.99, True)])
def test_the_temperature_goes_where_the_entropy_is_wanted(spread, rises):
    agent = SAC(hidden=(8,), spread=spread)
    start = begun(agent)
    after = updated(agent, start, batch_of())
    assert (after.log_temperature > start.log_temperature) == rises


def test_target_entropies_by_hand():
    entropy = sac.target_entropy
    np.testing.assert_allclose(entropy(Box(3, 1.0), math.exp(-1) / 2), -3, rtol=1e-6)
    np.testing.assert_allclose(entropy(Box(1, 2.0), 1.0), math.log(4), rtol=1e-6)
    np.testing.assert_allclose(entropy(Box(1), 0.5), 0, atol=1e-6)
    # The simplex of three entries is a triangle of area ½ over the two assets' weights.
    np.testing.assert_allclose(entropy(Simplex(2), 1.0), math.log(0.5), rtol=1e-6)
    np.testing.assert_allclose(entropy(Discrete(11), 1.0), math.log(11), rtol=1e-6)
    np.testing.assert_allclose(entropy(Discrete(11), 0.1), math.log(2), rtol=1e-6)


# Actions


@pytest.mark.parametrize("actions", [Box(2, 3.0), Box(2), Simplex(2), Discrete(3)])
def test_the_first_actions_are_uniform(actions):
    drawn = np.asarray(uniform(actions, jax.random.key(0), 20_000))
    if isinstance(actions, Discrete):
        np.testing.assert_allclose(np.bincount(drawn) / 20_000, 1 / 3, atol=0.02)
    elif isinstance(actions, Simplex):
        np.testing.assert_allclose(drawn.sum(1), 1, rtol=1e-5)
        # Each entry of a uniform draw from the triangle has mean 1/3 and variance 1/18.
        np.testing.assert_allclose(drawn.mean(0), 1 / 3, atol=0.01)
        np.testing.assert_allclose(drawn.var(0), 1 / 18, rtol=0.05)
    else:
        unit = 3.0 if actions.bound == 3.0 else 1.0
        np.testing.assert_allclose(np.abs(drawn).max(), unit, rtol=0.01)
        np.testing.assert_allclose(drawn.var(0), unit**2 / 3, rtol=0.05)


def test_noise_stays_among_the_actions():
    network = lambda output: lambda observation: output  # noqa: E731
    box = ddpg.Actor(network(None), Box(2, 3.0))
    given = box.perturb(jnp.array([[0.0, 2.0]]), jnp.array([[0.5, 0.5]]))
    np.testing.assert_allclose(given, [[1.5, 3.0]])
    weights = ddpg.Actor(network(None), Simplex(2))
    given = weights.perturb(jnp.array([[0.2, 0.5, 0.3]]), jnp.array([[-0.4, 0.2, 0.2]]))
    np.testing.assert_allclose(given, [[0.0, 0.6, 0.4]], atol=1e-6)


def test_noise_lasts_and_starts_anew_with_each_episode():
    """Lillicrap et al.: θ = 0.15. Of n steps the variance is Σ 0.85²ⁱ, and 0.85 of a step stays."""
    theta, n = 0.15, 50_000
    first = OrnsteinUhlenbeck.begin(jax.random.key(0), (n, 1))
    second = first.step(theta, jnp.zeros(n, bool))
    third = second.step(theta, jnp.arange(n) < n // 2)
    np.testing.assert_allclose(first.value.std(), 1, rtol=0.02)
    np.testing.assert_allclose(second.value.var(), 1 + 0.85**2, rtol=0.02)
    np.testing.assert_allclose((first.value * second.value).mean(), 0.85, rtol=0.03)
    ended, others = np.split(np.asarray(third.value), 2)
    np.testing.assert_allclose(ended.var(), 1, rtol=0.03)
    np.testing.assert_allclose(others.var(), 1 + 0.85**2 + 0.85**4, rtol=0.03)


def test_an_actor_explores_by_noise_that_lasts():
    agent = DDPG(hidden=(8,), num_envs=2, noise_theta=0.15, exploration_noise=0.2)
    state, observation = agent.init(Aim(), jax.random.key(0)), jnp.zeros((2, 1))
    for _ in range(2):
        action = agent.explore(state, observation, jax.random.key(1))
        assert state.noise is not None
        expected = agent.policy(state.learned.actor, observation) + 2 * 0.2 * state.noise.value
        np.testing.assert_allclose(action, jnp.clip(expected, -2, 2), rtol=1e-6)
        before, state = state.noise, agent.observe(state, rollout_of(jnp.zeros((1, 2))))
        assert state.noise is not None
        assert (state.noise.value != before.value).all()
    # Independent noise leaves no trace in a checkpoint.
    assert DDPG(hidden=(8,)).init(Aim(), jax.random.key(0)).noise is None


def test_noise_starts_anew_where_an_episode_ends_or_is_cut():
    agent = DDPG(hidden=(8,), num_envs=3, noise_theta=0.25)
    state = agent.init(Aim(), jax.random.key(0))
    assert state.noise is not None
    step = rollout_of(jnp.zeros((1, 3)))._replace(
        terminated=jnp.array([[False, True, False]]), truncated=jnp.array([[False, False, True]])
    )
    after = agent.observe(state, step).noise
    drawn = state.noise.step(1.0, jnp.ones(3, bool))
    assert after is not None
    kept = 0.75 * state.noise.value * jnp.array([[1], [0], [0]])
    np.testing.assert_allclose(after.value, kept + drawn.value, rtol=1e-5, atol=1e-6)


def test_soft_actor_critic_explores_by_noise_that_lasts():
    """Each draw alone is the policy's; 1 − θ = 0.6 of the last step's noise stays."""
    task, n = Aim(), 20_000
    agent = SAC(hidden=(8,), num_envs=n, noise_theta=0.4, replay_capacity=n, learning_starts=0)
    state, observation = agent.init(task, jax.random.key(0)), jnp.ones((n, 1))
    policy, draws = state.learned.actor(observation), []
    assert isinstance(policy, Squashed)
    for _ in range(8):
        state = agent.observe(state, rollout_of(jnp.zeros((1, n))))
        action = agent.explore(state, observation, jax.random.key(1))
        draws.append(
            (jnp.arctanh(action / 2) - policy.normal.mean) / jnp.exp(policy.normal.log_std)
        )
    before, last = np.asarray(draws[-2]), np.asarray(draws[-1])
    np.testing.assert_allclose([last.mean(), last.std()], [0, 1], atol=0.02)
    np.testing.assert_allclose((before * last).mean(), 0.6, atol=0.02)
    numbered = SAC(noise_theta=0.4)
    with pytest.raises(QfolioError, match="those of Pendulum are numbered"):
        numbered.init(Pendulum(torques=3), jax.random.key(0))


def test_nothing_of_old_episodes_goes_on_with_other_data():
    """Neither their sums of rewards nor their noise; the scale of rewards is kept."""
    agent = DDPG(**SMALL, noise_theta=0.2, normalize_rewards=True)
    old, fresh = (Population(Aim(1.0), agent, [seed, seed + 1]).fetch().agent for seed in (0, 2))
    more = jax.tree.map(lambda x: x + 5, old.normalizer.rewards)
    old = eqx.tree_at(lambda s: s.normalizer.rewards, old, more)
    new = agent.carry_over(old, fresh)
    assert_same((new.noise, new.replay, new.rewards), (fresh.noise, fresh.replay, fresh.rewards))
    assert_same(new.learned, old.learned)
    assert_same(new.normalizer.rewards.returns, np.zeros((2, 4)))
    assert_same(new.normalizer.rewards.moments, old.normalizer.rewards.moments)


def test_warm_up_explores_at_random_and_learning_by_the_actor():
    agent = DDPG(hidden=(8,), num_envs=500, learning_starts=1000, exploration_noise=0.0)
    state = agent.init(Pendulum(torques=0), jax.random.key(0))
    observation = jnp.ones((500, 3))
    random = agent.act(state, observation, jax.random.key(1))
    np.testing.assert_allclose(random.std(), 2 / math.sqrt(3), rtol=0.1)
    state = eqx.tree_at(lambda s: s.steps, state, jnp.array(agent.warm_up(), jnp.int32))
    learned = agent.act(state, observation, jax.random.key(1))
    np.testing.assert_array_equal(learned, agent.policy(state.learned.actor, observation))


def test_each_kind_of_action_has_its_distribution():
    make = lambda actions: sac.Actor(lambda observation: observation, actions)(  # noqa: E731
        jnp.array([[0.5, 1.0, 2.0, -99.0]])
    )
    squashed = make(Box(2, 3.0))
    assert isinstance(squashed, Squashed)
    np.testing.assert_allclose(squashed.mode(), 3 * np.tanh([[0.5, 1.0]]), rtol=1e-6)
    np.testing.assert_allclose(squashed.normal.log_std, [[2, -10]])
    assert isinstance(make(Box(2)), Gaussian)
    three = sac.Actor(lambda observation: observation, Simplex(2))(jnp.array([[0.5, 1, 2, 0, 0.1]]))
    assert isinstance(three, LogisticNormal)
    odds = np.exp([0.5, 1, 2])
    np.testing.assert_allclose(three.mode()[0], odds / odds.sum(), rtol=1e-6)


# Fit to tasks


@pytest.mark.parametrize("kind", [DDPG, TD3])
def test_numbered_actions_are_refused(kind):
    with pytest.raises(QfolioError, match=f"{kind.__name__.lower()} needs continuous actions"):
        kind().init(Pendulum(), jax.random.key(0))


@pytest.mark.parametrize("kind", [DDPG, TD3, SAC])
@pytest.mark.parametrize("network", ["flat", "mlp"])
@pytest.mark.parametrize("task", [Merton(), GarleanuPedersen()])
def test_fits_markets(kind, network, task):
    agent = kind(
        network=network, hidden=(8,), num_envs=3, batch_size=4, replay_capacity=30,
        learning_starts=3,
    )  # fmt: skip
    key = jax.random.key(0)

    def step():
        state = agent.init(task, key)
        view = jax.vmap(lambda key: task.observe(task.reset(key)))(jax.random.split(key, 3))
        action = agent.act(state, view, key)
        batch = Experience(view, action, jnp.zeros(3), view, jnp.zeros(3, bool))
        return state.learned, updated(agent, state.learned, batch)

    before, after = jax.eval_shape(step)
    same = eqx.tree_equal(before, after)
    assert same, "the program's state changes its shape or type"


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        (DDPG, {"exploration_noise": -0.1}), (DDPG, {"batch_size": 0}), (TD3, {"policy_delay": 0}),
        (DDPG, {"noise_theta": 1.5}), (DDPG, {"critic_weight_decay": -0.1}),
        (DDPG, {"last_layer_bound": -0.1}),
        (TD3, {"target_noise": -1.0}), (SAC, {"spread": 0.0}), (SAC, {"spread": 15.5}),
        (SAC, {"initial_temperature": 0.0}),
        (SAC, {"discount": 1.5}), (SAC, {"learning_starts": 100, "replay_capacity": 50}),
        (SAC, {"network": "mpl"}), (SAC, {"hidden": ()}),
    ],
)  # fmt: skip
def test_refuses_what_makes_no_sense(kind, settings):
    with pytest.raises(QfolioError, match=next(iter(settings))):
        kind(**settings)


def test_a_spread_that_no_policy_has_is_refused():
    """At the largest one the policy has its largest standard deviation, or is uniform."""
    most = 0.5 * math.log(2 * math.pi * math.e) + sac.LOG_STD[1]
    assert float(sac.target_entropy(Box(1), sac.MOST_SPREAD)) < most
    assert float(sac.target_entropy(Box(1), sac.MOST_SPREAD + 0.5)) > most
    for task in (Aim(1.0), OneState()):
        with pytest.raises(QfolioError, match=r"spread is 1\.0; it must be below 1: no"):
            SAC(**SMALL, spread=1.0).init(task, jax.random.key(0))
    SAC(**SMALL, spread=1.0).init(Aim(math.inf), jax.random.key(0))


def test_the_spread_of_each_member_is_checked_whatever_ran_before():
    few, many = SAC(**SMALL, spread=0.5), SAC(**SMALL, spread=5.0)
    Population(OneState(), few, [0])  # compiles the program of both
    for agents in ([many], [few, many]):
        with pytest.raises(QfolioError, match=r"spread is 5\.0; it must be below 1: no"):
            Population(OneState(), agents, range(len(agents)))


@pytest.mark.optimized
@pytest.mark.parametrize("agent", [pytest.param("ddpg", marks=pytest.mark.long), "td3", "sac"])
def test_fast_presets_swing_the_pendulum_up(agent):
    """What docs/algorithms/actor_critic.md says of every seed; an idle agent loses 900%."""
    fast = preset("fast", "pendulum", agent)
    task = Pendulum(**fast.task)
    run = train(task, fast.build(), episodes=fast.episodes, seeds=1, seed=100)
    (regret,) = run.grade()["regret_per_seed"]
    assert regret <= 0.05
    assert regret > -0.005, "nothing beats the optimum"
