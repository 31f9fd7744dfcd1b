"""The conclusions of a comparison in sentences, and the format of its numbers."""

import math
from collections.abc import Callable
from typing import Any

from qfolio.core.text import amount, figure, four_digits, listed
from qfolio.experiments.comparison.ranking import HEADLINE


def conclusion(ranking: dict[str, Any]) -> list[str]:
    """The conclusions that a ranking supports, in sentences."""
    first, seeds = ranking["order"][0], ranking["seeds"]
    each = f"with {amount(seeds, 'seed')} each"
    level = best_of(ranking)
    tied: list[str] = []
    worse: list[str] = []
    better: list[str] = []
    for row in ranking["pairs"]:
        if row["first"] == first and (other := row["second"]) not in level:
            group = worse if row["probability"] > 0.5 else better
            group = group if row["told_apart"] else tied
            group.append(f"{other} ({result_of(ranking, other)})")
    end, they, their = ("ends", "it", "its regret")
    if len(level) > 1:
        end, they, their = ("end", "they", "the regret of each")
    best = (
        f"{listed(level)} {end} nearest to the exact optimum: {their} is"
        if ranking["measure"] == "regret"
        else f"{listed(level)} {end} with the highest return:"
    )
    sentence = (
        f"{each.capitalize()} {they} can be told apart from {listed(worse)}." if worse else ""
    )
    if tied:
        sentence = f"{each.capitalize()} {they} cannot be told apart from {listed(tied, 'or')}"
        sentence += f"; {listed(worse)} do{'es' * (len(worse) == 1)} worse." if worse else "."
    if seeds < ranking["seeds_needed"]:
        count = len(ranking["order"])
        none = f"no two of {count} agents can" if count > 2 else "two agents cannot"
        sentence = (
            f"{each.capitalize()} {none} be told apart, whatever their results; this needs "
            f"{ranking['seeds_needed']} seeds or more."
        )
    ahead = ""
    if better:
        ahead = f"A seed of {listed(better, 'or')} is more likely to end better, though."
    result = f"{best} {result_of(ranking, first, interval=True)}."
    said = [result, sentence, ahead, _quickest(ranking)]
    return [each for each in said if each]


def best_of(ranking: dict[str, Any]) -> list[str]:
    """The first agent of the ranking, and those with the same results."""
    results = {name: entry["final"]["per_seed"] for name, entry in ranking["agents"].items()}
    return [name for name in ranking["order"] if results[name] == results[ranking["order"][0]]]


def arrived(ranking: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What agents needed to settle near the goal, by name; those that never did are left out."""
    return {
        name: entry
        for name in ranking["order"]
        for entry in ranking["agents"][name]["within"]
        if entry["threshold"] == HEADLINE and entry["steps"] is not None
    }


def least(arrivals: dict[str, dict[str, Any]], key: str) -> tuple[float, list[str]]:
    """The least "steps" or "seconds" of some agents, and who needed no more."""
    needed = min(entry[key] for entry in arrivals.values())
    return needed, [name for name, entry in arrivals.items() if entry[key] == needed]


def result_of(ranking: dict[str, Any], name: str, *, interval: bool = False) -> str:
    """An agent's final regret or return as text.

    ``interval`` adds its 95% interval, or the range of the seeds if they are too few for one.
    """
    write = writer_of(ranking)
    final = ranking["agents"][name]["final"]
    text, values = write(final["iqm"]), final["per_seed"]
    if interval and final["interval"] is not None:
        text += f" (95% interval {' to '.join(map(write, final['interval']))})"
    elif interval and len(values) > 1:
        text += f" ({len(values)} seeds, {write(min(values))} to {write(max(values))})"
    return text


def writer_of(ranking: dict[str, Any]) -> Callable[[float], str]:
    """How a ranking's regrets or returns are written."""
    return share if ranking["measure"] == "regret" else four_digits


def share(fraction: float) -> str:
    """A fraction in percent, with two significant digits, down to a thousandth of a percent."""
    size = abs(100 * fraction)
    if size < 5e-4:
        return "0%"
    digits = min(3, max(0, 1 - math.floor(math.log10(size))))
    return f"{figure(100 * fraction, f',.{digits}f')}%"


def span(seconds: float) -> str:
    """Seconds as text, with two significant digits."""
    return f"{seconds:.2g} s" if seconds < 10 else f"{seconds:,.0f} s"


def _quickest(ranking: dict[str, Any]) -> str:
    """A sentence on which agents come near the goal in the fewest steps and the least time."""
    goal = "the optimum" if ranking["measure"] == "regret" else "the best return"
    near = f"within {HEADLINE:.0%} of {goal}"
    arrivals = arrived(ranking)
    if not arrivals:
        return f"No agent settles {near}."
    (fewest, frugal), (shortest, quick) = (least(arrivals, key) for key in ("steps", "seconds"))
    seconds = f"{span(shortest)} a seed"
    if len(arrivals) == 1:
        return f"Only {frugal[0]} settles {near}, after {fewest:,.0f} steps and {seconds}."
    need = "need" if len(frugal) > 1 else "needs"
    time = f"{listed(quick)} the least time" if quick != frugal else "the least time"
    return (
        f"To settle {near}, {listed(frugal)} {need} the fewest steps ({fewest:,.0f}) and {time} "
        f"({seconds})."
    )
