"""Training on tables of 20 to 1,000 assets: time an asset and decision, and memory.

Prints, for the presets of agents on made-up tables, the processor time of training divided by the
decisions that are made and by the assets, and the size of an agent's state. All sizes take turns,
so that other work on the machine slows all of them.
`python bench/assets.py 20 100 500 1000 --agents tilts dqn`
"""

import argparse
import statistics
from time import process_time

from qfolio.core import devices, settings

devices.configure()

import jax  # noqa: E402

from made_up import table  # noqa: E402
from qfolio.core.population import Population  # noqa: E402
from qfolio.core.training import chunk_steps  # noqa: E402
from qfolio.experiments.described import agent_of  # noqa: E402
from qfolio.experiments.presets import preset  # noqa: E402
from qfolio.portfolio.task import Portfolio  # noqa: E402

ROWS = 1300
"""Five years and a look-back."""

ROUNDS = 5


def population(name: str, assets: int) -> Population:
    """One member of a preset that has filled its memory and compiled its program."""
    given = preset("fast", "portfolio", name)
    task = Portfolio.of(table(assets, ROWS), **settings.convert(Portfolio, dict(given.task)))
    one = Population(task, agent_of(name, given.settings), [0])
    while not one.learning:
        one.advance(10**6)
    one.advance(one.agent.rollout_steps)
    return one


def measure(name: str, sizes: list[int]) -> tuple[list[float], list[int]]:
    """Seconds an asset and decision by size, and bytes of a member's state."""
    members = [population(name, size) for size in sizes]
    seconds: list[list[float]] = [[] for _ in sizes]
    for _ in range(ROUNDS):
        for member, size, found in zip(members, sizes, seconds, strict=True):
            # About as much work for each size, in whole rollouts.
            length = member.agent.rollout_steps
            steps = max(1, round(chunk_steps(member.task, member.agent) * 20 / size / length))
            begun = process_time()
            member.advance(steps * length)
            found.append((process_time() - begun) / (steps * length * member.agent.num_envs * size))
    memory = [sum(x.nbytes for x in jax.tree.leaves(member.fetch())) for member in members]
    return [statistics.median(each) for each in seconds], memory


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("sizes", nargs="*", type=int, default=[20, 100, 500, 1000])
    parser.add_argument("--agents", nargs="+", default=["tilts", "dqn", "pathwise", "ppo", "sac"])
    given = parser.parse_args()
    print(f"{'ns an asset and decision, and MB':<36}" + "".join(f"{n:>16,}" for n in given.sizes))
    for name in given.agents:
        seconds, memory = measure(name, given.sizes)
        cells = [f"{1e9 * s:8,.0f} {m / 1e6:7,.1f}" for s, m in zip(seconds, memory, strict=True)]
        print(f"{name:<36}" + "".join(cells), flush=True)


if __name__ == "__main__":
    main()
