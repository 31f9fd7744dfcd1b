"""What a GPU gains: `make bench-gpu`.

First the default backtest, on the GPU and on two cores of the same machine, and how much the
results differ. Then the report's run for 1,024 agents in one program, beside the limits from
arithmetic and from memory; docs/results/benchmarks.md says how they are counted.
"""

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

from qfolio.core import devices

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # the backtest's process shares it
devices.configure()

import jax  # noqa: E402
import numpy as np  # noqa: E402
import tyro  # noqa: E402

from qfolio.core.evaluation import start_keys  # noqa: E402
from qfolio.core.population import Population  # noqa: E402
from workload import EPISODES, bytes_moved, operations, report  # noqa: E402

TARGET = 180.0
"""Seconds for 1,024 agents of 600 episodes."""

STARTS = 128
"""Start states that the policies are graded on."""

TERABYTES = {"H100": 3.35, "H200": 4.8}
"""Bandwidth of a card's memory, in 10¹² bytes a second, from its maker's data sheet."""


def main(
    agents: int = 1024,
    episodes: int = EPISODES,
    tflops: float = 67.0,
    terabytes: float | None = None,
    backtest: bool = True,
    allow_cpu: bool = False,
) -> None:
    """Backtest on a GPU, then train many agents with the report's settings in one program.

    Args:
        agents: How many.
        episodes: Of each agent.
        tflops: The GPU's peak arithmetic in 10¹² operations a second (default: that of an H100 or
            H200 in float32, without tensor cores).
        terabytes: Its memory's bandwidth in 10¹² bytes a second (default: that of an H100 or
            H200, unknown for others).
        backtest: Whether to run the backtests, too.
        allow_cpu: Go on without a GPU, to try the script out.
    """
    if jax.devices()[0].platform != "gpu" and not allow_cpu:
        print("jax finds no GPU here, so that there is nothing to measure.")
        return
    if backtest:  # first, because training then keeps the GPU's memory
        compare_backtests()
    card = jax.devices()[0].device_kind
    known = (bandwidth for name, bandwidth in TERABYTES.items() if name in card)
    train(agents, episodes, tflops, terabytes or next(known, math.nan))


def train(agents: int, episodes: int, tflops: float, terabytes: float) -> None:
    task, agent = report()
    population = Population(task, agent, range(agents))
    start, compiled = perf_counter(), population.seconds_compile
    while steps := population.steps_left(episodes):
        population.advance(steps)
    compiled = population.seconds_compile - compiled
    seconds = perf_counter() - start - compiled

    steps = population.steps * agents
    work = steps * operations(task, agent)
    traffic = steps * bytes_moved(task, agent)
    keys, exact = start_keys(STARTS), task.optimum()
    assert exact is not None
    optimum = float(exact.returns(keys).mean())
    regrets = (optimum - population.evaluate(keys).returns.mean(1)) / abs(optimum)
    print(f"{agents:,} agents × {episodes} episodes on {devices.describe()}")
    precision = jax.config.jax_default_matmul_precision  # type: ignore[attr-defined]
    print(f"products    {precision} precision")
    print(f"training    {seconds:,.1f} s, and {compiled:,.1f} s of compiling")
    if (agents, episodes) == (1024, EPISODES):
        reached = "reached" if seconds <= TARGET else "not reached"
        print(f"target      {TARGET:,.0f} s: {reached}")
    print(f"rate        {steps / seconds:,.0f} agent steps a second")
    print(f"arithmetic  {work / seconds / 1e12:.3g} TFLOP/s of {tflops:g}")
    print(f"memory      {traffic / seconds / 1e12:.3g} TB/s at least, of {terabytes:g}")
    print(
        f"limits      {work / tflops / 1e12:,.1f} s from arithmetic, "
        f"{traffic / terabytes / 1e12:,.1f} s from memory"
    )
    print(
        f"regret      mean {regrets.mean():.2%}, median {np.median(regrets):.2%}, "
        f"worst {regrets.max():.2%}",
        flush=True,
    )


def compare_backtests() -> None:
    cores = devices.cores()
    with TemporaryDirectory() as folder:
        here, there = Path(folder, "gpu"), Path(folder, "cpu")
        on_gpu = _backtest(here, cores[:-2] or cores, {})
        on_cpu = _backtest(there, cores[-2:], {"JAX_PLATFORMS": "cpu"}, "--on", "processes:2")
        print(f"backtest    {on_gpu:,.0f} s on the GPU, {on_cpu:,.0f} s on two cores")
        for agent in ("tilts", "dqn"):
            growth = np.array([_growth(out, agent) for out in (here, there)])
            print(
                "{:<11} grew by {:.3%} and {:.3%} a year; ".format(agent, *growth.mean(1))
                + f"a seed by at most {np.ptp(growth, axis=0).max():.3%} more or less",
                flush=True,
            )


def _backtest(out: Path, cores: list[int], environment: dict[str, str], *options: str) -> float:
    """Seconds of the default backtest."""
    begun = perf_counter()
    subprocess.run(
        [sys.executable, "-m", "qfolio", "backtest", "--out", out, *options],
        env={**os.environ, "QFOLIO_CACHE": f"{out}-cache", **environment},
        preexec_fn=lambda: os.sched_setaffinity(0, cores),
        stdout=subprocess.DEVNULL,
        check=True,
    )
    return perf_counter() - begun


def _growth(out: Path, agent: str) -> list[float]:
    """Annual growth of an agent's seeds."""
    summary = json.loads((out / "summary.json").read_text())
    return list(summary["strategies"][agent]["measures"]["growth"]["per_seed"])


if __name__ == "__main__":
    tyro.cli(main)
