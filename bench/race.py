"""Contestants that run in turn, so that whatever else slows the machine slows all of them.

Needs nothing but Python: the peers' environment, which has no qfolio, imports it too.
"""

import json
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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


@contextmanager
def process(command: list[str], environment: dict[str, str] | None = None) -> Iterator[Contestant]:
    """A contestant in a process of its own, which is warm, and rests between rounds."""
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env=environment) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        questions, answers = process.stdin, process.stdout

        def read() -> str:
            line = answers.readline()
            if not line:
                raise RuntimeError(f"{' '.join(command)} ended; its last words are above.")
            return line

        def run(seconds: float) -> float:
            print(json.dumps({"seconds": seconds}), file=questions, flush=True)
            return json.loads(read())["rate"]

        read()  # it is warm
        yield run
        questions.close()  # which ends it


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
