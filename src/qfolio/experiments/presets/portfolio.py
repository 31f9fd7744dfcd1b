"""Presets for portfolios of real assets."""

from typing import Any

from qfolio.experiments.presets.preset import Preset, Presets

_TASK = {"window": 60, "horizon": 50, "reward": "crra", "risk_aversion": 5.0}


SIGNALS = (
    "drift:1y-1d,drift:1y-2d,drift:1y-1w,drift:1y-2w,drift:1y-1m,drift:1y-3m,drift:1y-6m,"
    "momentum:1y-1m,volatility:1m,volatility:6m,volatility-ratio:1y-1m,high:1y,maximum:1m,"
    "beta:1y,residual-volatility:1y,correlation:1y,market-volatility:3m"
)


SHORT_SIGNALS = "momentum:1,momentum:2,momentum:5,momentum:10,momentum:21,moving-average:10"
"""Signals that pay off within days; for slower ones, values of single trades are too noisy."""


# As averse to risk as the investor of Brandt, Santa-Clara & Valkanov (2009).
_ON_ANCHOR = {
    "window": 1,
    "horizon": 84,
    "reward": "crra",
    "risk_aversion": 5.0,
    "signals": SIGNALS,
    "anchor": "equal-weight",
}


# More averse. The anchor is not minimum variance alone, which holds so few assets that there is
# little evidence for tilts.
_ON_LOW_RISK = {
    **_ON_ANCHOR,
    "risk_aversion": 20.0,
    "anchor": "equal-weight+minimum-variance-nonlinear",
}


_LOW_RISK = {"network": "linear", "tracking_aversion": 0.0}


_ON_MENU = {
    "window": 1,
    "horizon": 64,
    "reward": "log",
    "signals": SHORT_SIGNALS,
    "anchor": "equal-weight",
    "menu": "signals:2",
}


_ON_COVARIANCE = {"window": 504, "horizon": 63, "anchor": "equal-weight"}


_ON_SIGNALS = {
    "window": 1,
    "horizon": 50,
    "reward": "log",
    "active": True,
    "tracking_aversion": 10.0,
    "signals": SIGNALS,
    "anchor": "equal-weight",
}


# The values of actions differ little relative to the noise of daily returns: hence large batches,
# linear values of positions, and actions that have to be better by standard errors.
_DQN = {
    "network": "positions",
    "all_actions": True,
    "outcomes": 1,
    "market_baseline": True,
    "bootstrap_heads": 32,
    "caution": 2.5,
    "num_envs": 32,
    "batch_size": 256,
    "replay_capacity": 8192,
    "learning_starts": 4096,
    "target_update_interval": 1,
    "tau": 0.1,
    "discount": 0.95,
    "learning_rate": 0.01,
    "learning_rate_final": 0.0,
    "learning_rate_steps": 300.0,
    "reward_scale": 100.0,
}


_PATHWISE = {
    "hidden": (16, 16),
    "rollout_length": 25,
    "num_envs": 16,
    "learning_rate": 5e-4,
    "learning_rate_final": 0.0,
    "learning_rate_steps": 100.0,
    "reward_scale": 100.0,
    "max_grad_norm": 1.0,
}


# The agents below estimate gradients from the rewards of their own actions. They take small steps,
# because daily returns have far more noise than signal, discount strongly, because a trade pays off
# within days, and explore near their holdings, because trades cost.
_ON_POLICY = {
    "network": "positions",
    "num_envs": 16,
    "rollout_length": 50,
    "discount": 0.9,
    "learning_rate": 0.005,
    "learning_rate_final": 0.0,
    "initial_std": 0.3,
    "reward_scale": 100.0,
}


_PPO = {
    **_ON_POLICY,
    "epochs": 2,
    "batch_size": 400,
    "gae_lambda": 0.9,
    "learning_rate_steps": 1200.0,
}


_A2C = {**_ON_POLICY, "rollout_length": 25, "gae_lambda": 0.9, "learning_rate_steps": 600.0}


_REINFORCE = {**_ON_POLICY, "learning_rate_steps": 300.0}


# Values of orders are linear, so that without a small step an actor would go to one asset. Rewards
# are small, and an entropy that is worth more than they are would drown them.
_OFF_POLICY = {
    "network": "positions",
    "num_envs": 16,
    "batch_size": 256,
    "replay_capacity": 16384,
    "learning_starts": 256,
    "tau": 0.05,
    "discount": 0.9,
    "learning_rate": 0.004,
    "learning_rate_final": 0.0,
    "learning_rate_steps": 2400.0,
    "actor_learning_rate_ratio": 0.15,
    "reward_scale": 100.0,
}


_DDPG = {**_OFF_POLICY, "exploration_noise": 0.01}


_TD3 = {**_DDPG, "target_noise": 0.01, "target_noise_clip": 0.02}


_SAC = {**_OFF_POLICY, "initial_temperature": 0.001}


def _fast(
    agent: str, settings: dict[str, Any], episodes: int, task: dict[str, Any]
) -> dict[str, Preset]:
    return {"fast": Preset(agent, settings, episodes, seeds=5, task=task)}


def of_any(agent: str) -> Preset:
    """An agent's own defaults, on the other agents' task."""
    return Preset(agent, {}, episodes=800, seeds=5, task=_TASK)


PRESETS: Presets = {
    ("portfolio", "dqn"): _fast("dqn", _DQN, 224, _ON_MENU),
    ("portfolio", "pathwise"): _fast("pathwise", _PATHWISE, 800, _TASK),
    ("portfolio", "tilts"): {
        **_fast("tilts", {}, 1920, _ON_ANCHOR),
        "low-risk": Preset("tilts", _LOW_RISK, 1920, seeds=5, task=_ON_LOW_RISK),
    },
    ("portfolio", "mean-variance-learned"): _fast("mean-variance-learned", {}, 640, _ON_COVARIANCE),
    ("portfolio", "minimum-variance-learned"): _fast(
        "minimum-variance-learned", {}, 1920, _ON_COVARIANCE
    ),
    ("portfolio", "ppo"): _fast("ppo", _PPO, 4800, _ON_SIGNALS),
    ("portfolio", "a2c"): _fast("a2c", _A2C, 4800, _ON_SIGNALS),
    ("portfolio", "reinforce"): _fast("reinforce", _REINFORCE, 4800, _ON_SIGNALS),
    ("portfolio", "ddpg"): _fast("ddpg", _DDPG, 800, _ON_SIGNALS),
    ("portfolio", "td3"): _fast("td3", _TD3, 800, _ON_SIGNALS),
    ("portfolio", "sac"): _fast("sac", _SAC, 800, _ON_SIGNALS),
}
