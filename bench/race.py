"""Contestants that run in turn, so that whatever else slows the machine slows all of them.

Needs nothing but Python: the peers' environment, which has no qfolio, imports it too.
"""

import json
import statistics
import sys
from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter, sleep
from typing import TextIO

Contestant = Callable[[float], float]
"""Runs for about that many seconds and returns environment steps a second."""

Rates = dict[str, list[float]]
"""Each contestant's steps a second, round by round."""

PAUSE = 0.3
"""Seconds between contestants: OpenMP's threads keep spinning for a while after their work."""


@dataclass(frozen=True)
class Ratio:
    """Of two contestants, over the rounds."""

    median: float
    low: float
    high: float


def timed(advance: Callable[[], int]) -> Contestant:
    """A contestant that calls ``advance``, which returns the steps it made, until time is up."""

    def run(seconds: float) -> float:
        steps, start = 0, perf_counter()
        while (elapsed := perf_counter() - start) < seconds:
            steps += advance()
        return steps / elapsed

    return run


def serve(run: Contestant, answers: TextIO) -> None:
    """Runs a round for each question on standard input and answers with its rate."""
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        print(json.dumps({"rate": run(json.loads(line)["seconds"])}), file=answers, flush=True)


def race(contestants: dict[str, Contestant], rounds: int, seconds: float) -> Rates:
    """``rounds`` rounds of all contestants, one after the other."""
    rates: Rates = {name: [] for name in contestants}
    for _ in range(rounds):
        for name, run in contestants.items():
            sleep(PAUSE)
            rates[name].append(run(seconds))
    return rates


def ratio(rates: Rates, one: str, other: str) -> Ratio:
    """How many times as fast ``one`` is as ``other``, each round compared with itself."""
    ratios = [a / b for a, b in zip(rates[one], rates[other], strict=True)]
    return Ratio(statistics.median(ratios), min(ratios), max(ratios))
