"""Seconds that the runs of rl-baselines3-zoo take in stable-baselines3.

The settings and numbers of steps are those of its hyperparams/*.yml and benchmark.md. Each run is
timed in processor time for a while after a warm-up, and scaled to its number of steps. It needs the
peers' environment (.venv-bench, which ``make bench`` makes) and "gymnasium[box2d]".

    taskset -c 0 .venv-bench/bin/python bench/zoo.py
"""

import argparse
import os
from time import process_time
from typing import Any, NamedTuple

os.environ["OMP_NUM_THREADS"] = "1"

import stable_baselines3
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

_BIG = {"policy_kwargs": {"net_arch": [256, 256]}}

_ACROBOT_DQN = {
    "learning_rate": 2.5e-4, "batch_size": 512, "buffer_size": 100_000, "learning_starts": 0,
    "target_update_interval": 5000, "train_freq": 16, "gradient_steps": 4,
}  # fmt: skip


class Run(NamedTuple):
    """One of the zoo's runs."""

    environment: str
    algorithm: str
    steps: int
    num_envs: int
    normalize: bool
    settings: dict[str, Any]


RUNS = [
    Run("CartPole-v1", "PPO", 100_000, 8, False,
        {"n_steps": 32, "batch_size": 256, "n_epochs": 20, "learning_rate": 1e-3}),
    Run("CartPole-v1", "DQN", 50_000, 1, False, _ACROBOT_DQN),
    Run("Pendulum-v1", "SAC", 20_000, 1, False, {"learning_rate": 1e-3}),
    Run("MountainCarContinuous-v0", "SAC", 50_000, 1, False,
        {"batch_size": 512, "train_freq": 32, "gradient_steps": 32, "learning_starts": 0,
         "use_sde": True, "policy_kwargs": {"net_arch": [64, 64]}}),
    Run("Acrobot-v1", "PPO", 1_000_000, 16, True, {"n_steps": 256, "n_epochs": 4}),
    Run("Acrobot-v1", "DQN", 100_000, 1, False, _ACROBOT_DQN),
    Run("MountainCar-v0", "PPO", 1_000_000, 16, True, {"n_steps": 16, "n_epochs": 4}),
    Run("MountainCar-v0", "DQN", 120_000, 1, False,
        {"learning_rate": 4e-3, "batch_size": 128, "buffer_size": 10_000, "learning_starts": 1000,
         "train_freq": 16, "gradient_steps": 8, **_BIG}),
    Run("LunarLander-v3", "PPO", 1_000_000, 16, False,
        {"n_steps": 1024, "batch_size": 64, "n_epochs": 4}),
    Run("LunarLander-v3", "DQN", 100_000, 1, False,
        {"learning_rate": 8.8e-4, "batch_size": 32, "learning_starts": 0, "train_freq": 16,
         "gradient_steps": -1, **_BIG}),
]  # fmt: skip


def seconds(run: Run, least: float) -> float:
    """Processor time of a whole run, from at least so many seconds of it."""
    environment: Any = make_vec_env(run.environment, run.num_envs)
    if run.normalize:
        environment = VecNormalize(environment)
    kind = getattr(stable_baselines3, run.algorithm)
    model = kind("MlpPolicy", environment, device="cpu", seed=0, **run.settings)
    chunk = max(1000, run.settings.get("n_steps", 0) * run.num_envs)
    model.learn(chunk)  # fills the replay beyond learning's start
    begun, steps = process_time(), 0
    while (taken := process_time() - begun) < least:
        model.learn(chunk, reset_num_timesteps=False)
        steps += chunk
    return taken * run.steps / steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--least", type=float, default=20.0, help="seconds to time each run for")
    given = parser.parse_args()
    for run in RUNS:
        found = seconds(run, given.least)
        print(f"{run.environment:<26} {run.algorithm} {run.steps:>9,} steps {found:7,.0f} s")


if __name__ == "__main__":
    main()
