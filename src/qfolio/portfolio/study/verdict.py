"""The verdict of a study in sentences."""

from collections.abc import Mapping

from qfolio.portfolio.backtest.verdict import p_value
from qfolio.portfolio.study.folder import Result
from qfolio.portfolio.study.pooling import Pooled, Pools

_SPACE = "\N{NARROW NO-BREAK SPACE}"


def verdicts(agents: Mapping[str, Pools]) -> dict[str, list[str]]:
    """The sentences on each agent of the main variant: against its anchor, its best rebalancing,
    and where it did worst."""
    return {name: [*_claims(name, pools), _tables(pools)] for name, pools in agents.items()}


def _claims(name: str, pools: Pools) -> list[str]:
    anchor = next(iter(pools.evidence.values())).anchor.reference
    said = [f"{_claim(name, anchor, pools.anchor, pools)}: {_numbers(pools.anchor)}."]
    if pools.rebalanced.finding == "better":
        claim = f"{name} beats {anchor}, however it is rebalanced, in growth after costs"
    else:
        claim = f"No evidence that {name} beats the best rebalancing of {anchor}"
    return [*said, f"{claim}: {_numbers(pools.rebalanced)}."]


def _claim(name: str, anchor: str, pooled: Pooled, pools: Pools) -> str:
    over = f"over {counted(len(pools.evidence))}"
    if pooled.finding == "better":
        return f"{name} beats {anchor} in growth after costs {over}"
    if pooled.finding == "worse":
        return f"{name} falls short of {anchor} in growth after costs {over}"
    return f"No evidence that {name} beats {anchor} in growth after costs {over}"


def _numbers(pooled: Pooled) -> str:
    interval = f"95{_SPACE}% interval {percent(pooled.low)} to {percent(pooled.high)}"
    chance = "" if pooled.p_holm is None else f", corrected p {p_value(pooled.p_holm)}"
    return (
        f"the mean difference in annual growth is {percent(pooled.growth)} ({interval}); "
        f"Stouffer’s z is {decimal(pooled.z)}{chance}"
    )


def _tables(pools: Pools) -> str:
    worst = pools.evidence[pools.anchor.worst].anchor
    count, total = pools.anchor.positive, len(pools.evidence)
    grew = f"It grew more than {worst.reference} on {count} of {counted(total)}"
    return f"{grew}; its worst is {pools.anchor.worst}, {percent(worst.growth)} a year."


def looks_sentence(result: Result) -> str:
    """How many looks were taken, and what luck alone would reach."""
    earlier = (
        f"; {result.earlier:,} earlier looks at its tables are known" if result.earlier else ""
    )
    sentence = f"This study took {result.looks:,} look{'s' * (result.looks != 1)}{earlier}."
    if result.trials > 1:
        sentence += (
            f" The best of {result.trials:,} configurations without skill is expected to reach a "
            f"pooled z of {decimal(result.threshold)}."
        )
    return sentence


def counted(tables: int) -> str:
    return f"{tables} table{'s' * (tables != 1)}"


def percent(value: float | None) -> str:
    """A growth with its sign; two decimals if it is small."""
    if value is None:
        return "undefined"
    digits = 1 if abs(value) >= 0.0995 else 2
    return f"{_signed(100 * value, digits)}{_SPACE}%"


def decimal(value: float | None) -> str:
    return "undefined" if value is None else _signed(value, 2)


def _signed(value: float, digits: int) -> str:
    text = f"{value:+.{digits}f}"
    return text.lstrip("+-") if not text.strip("+-0.") else text.replace("-", "\N{MINUS SIGN}")
