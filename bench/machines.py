"""A backtest of 36 made-up stocks in one process, and in a process for each core.

Prints the time and the processors' time of each, and their ratio. Needs a machine on which nobody
else computes.
"""

import os
import resource
import sys
import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np

import qfolio
from qfolio.core import devices
from qfolio.experiments import presets
from qfolio.portfolio.prices.table import Prices


def table(rows: int = 1500, assets: int = 36) -> Prices:
    rng = np.random.default_rng(0)
    values = 50 * np.exp(np.cumsum(rng.normal(3e-4, 0.01, (rows, assets)), axis=0))
    dates = np.datetime64("2015-01-01") + np.arange(rows, dtype="m8[D]")
    return Prices(dates, tuple(f"A{i}" for i in range(assets)), values)


def seconds(on: str, episodes: int, out: Path) -> tuple[float, float]:
    """Seconds of a backtest by the clock, and of all its processes' processors."""
    preset = presets.preset("fast", "portfolio", "pathwise")._replace(episodes=episodes)
    backtest = qfolio.Backtest.create(
        table(), {"pathwise": preset}, train="700d", test="80d", expanding=False, seeds=2, out=out
    )
    begun, used = perf_counter(), _used()
    backtest.run(executor=qfolio.on(on))
    return perf_counter() - begun, _used() - used


def _used() -> float:
    kinds = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
    return sum(sum(resource.getrusage(kind)[:2]) for kind in kinds)


def main() -> None:
    devices.configure()
    episodes = int(sys.argv[1]) if len(sys.argv) > 1 else 1500
    places = ["here", f"processes:{len(os.sched_getaffinity(0))}"]
    with tempfile.TemporaryDirectory() as folder:
        for place in places:  # compiles
            seconds(place, 8, Path(folder) / f"first-{place.partition(':')[0]}")
        found = {}
        for place in places:
            found[place] = seconds(place, episodes, Path(folder) / place.partition(":")[0])
            print("{:<14}{:8.1f} s {:8.1f} s of processors".format(place, *found[place]))
    (here, here_used), (processes, processes_used) = found.values()
    print(f"speed of the processes: {here / processes:.2f} × that of one process")
    print(f"work of the processes: {processes_used / here_used:.2f} ×")


if __name__ == "__main__":
    main()
