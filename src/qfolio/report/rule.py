"""The numbers that describe learned policies, compared with those of the exact policy."""

from typing import Any, NamedTuple


class Row(NamedTuple):
    """One number; None if a policy has none."""

    name: str
    exact: float | None
    mean: float | None  # of the seeds that have one
    farthest: float | None  # of the seed farthest from exact; None if a seed has none


def rows(rule: dict[str, Any] | None) -> list[Row]:
    """The rows of a summary's rule."""
    if rule is None:
        return []
    found = []
    for name, exact in rule["exact"].items():
        learned = [seed[name] for seed in rule["per_seed"]]
        known = [value for value in learned if value is not None]
        mean = sum(known) / len(known) if known else None
        if exact is None:
            farthest = known[0] if known else None
        elif len(known) < len(learned):
            farthest = None
        else:
            farthest = max(known, key=lambda value: abs(value - exact))
        found.append(Row(name, exact, mean, farthest))
    return found
