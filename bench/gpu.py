"""The report's run for 1,024 agents in one program on a GPU: `make bench-gpu`.

Prints how long it took beside the limits from arithmetic and from memory, which default to those of
an H200 (float32 without tensor cores). docs/results/benchmarks.md says how they are counted.
"""

from time import perf_counter

from qfolio.core import devices

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


def main(
    agents: int = 1024,
    episodes: int = EPISODES,
    tflops: float = 67.0,
    terabytes: float = 4.8,
    allow_cpu: bool = False,
) -> None:
    """Train many agents with the report's settings in one program on a GPU.

    Args:
        agents: How many.
        episodes: Of each agent.
        tflops: The GPU's peak arithmetic, in 10¹² operations a second.
        terabytes: Its memory's bandwidth, in 10¹² bytes a second.
        allow_cpu: Go on without a GPU, to try the script out.
    """
    if jax.devices()[0].platform != "gpu" and not allow_cpu:
        print("jax finds no GPU here, so that there is nothing to measure.")
        return
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
    keys = start_keys(STARTS)
    optimum = float(task.optimum().returns(keys).mean())
    regrets = (optimum - population.evaluate(keys).returns.mean(1)) / abs(optimum)
    print(f"{agents:,} agents × {episodes} episodes on {devices.describe()}")
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
        f"worst {regrets.max():.2%}"
    )


if __name__ == "__main__":
    tyro.cli(main)
