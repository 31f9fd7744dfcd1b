"""The verdict of a study in sentences."""

from collections.abc import Mapping

from qfolio.core.text import amount
from qfolio.portfolio.backtest.folder import EQUAL_WEIGHT
from qfolio.portfolio.backtest.verdict import p_value
from qfolio.portfolio.study.folder import Result
from qfolio.portfolio.study.pooling import Pooled, Pools


def verdicts(agents: Mapping[str, Pools]) -> dict[str, list[str]]:
    """Sentences on each agent: against the reference, its best rebalancing, and by table.

    Only equal weights are rebalanced at several speeds.
    """
    return {
        name: [
            f"{_claim(name, pools)}: {_numbers(pools.to_reference)}.",
            *(
                [f"{_claim_at_best(name, pools)}: {_numbers(pools.to_rebalanced)}."]
                if _reference(pools) == EQUAL_WEIGHT
                else []
            ),
            _tables(pools),
        ]
        for name, pools in agents.items()
    }


def _claim(name: str, pools: Pools) -> str:
    where = f"{_reference(pools)} in growth after costs over {amount(len(pools.evidence), 'table')}"
    if pools.to_reference.finding == "better":
        return f"{name} beats {where}"
    if pools.to_reference.finding == "worse":
        return f"{name} falls short of {where}"
    return f"No evidence that {name} beats {where}"


def _claim_at_best(name: str, pools: Pools) -> str:
    if pools.to_rebalanced.finding == "better":
        return f"{name} beats {_reference(pools)}, however it is rebalanced, in growth after costs"
    return f"No evidence that {name} beats the best rebalancing of {_reference(pools)}"


def _reference(pools: Pools) -> str:
    return next(iter(pools.evidence.values())).to_reference.reference


def _numbers(pooled: Pooled) -> str:
    interval = f"95% interval {percent(pooled.low)} to {percent(pooled.high)}"
    chance = "" if pooled.p_holm is None else f", corrected p {p_value(pooled.p_holm)}"
    return (
        f"the mean difference in annual growth is {percent(pooled.growth)} ({interval}); "
        f"Stouffer’s z is {decimal(pooled.z)}{chance}"
    )


def _tables(pools: Pools) -> str:
    worst = pools.evidence[pools.to_reference.worst].to_reference
    count, total = pools.to_reference.positive, len(pools.evidence)
    grew = f"It grew more than {worst.reference} on {count} of {amount(total, 'table')}"
    return f"{grew}; its worst is {pools.to_reference.worst}, {percent(worst.growth)} a year."


def looks_sentence(result: Result) -> str:
    """How many looks were taken, and which z luck alone is expected to reach."""
    earlier = (
        f"; {result.earlier:,} earlier looks at its tables are known" if result.earlier else ""
    )
    sentence = f"This study took {amount(result.looks, 'look')}{earlier}."
    if result.trials > 1:
        sentence += (
            f" The best of {result.trials:,} configurations without skill is expected to reach a "
            f"pooled z of {decimal(result.threshold)}."
        )
    return sentence


def percent(value: float | None) -> str:
    """A growth with its sign; two decimals if it is small."""
    if value is None:
        return "undefined"
    digits = 1 if abs(value) >= 0.0995 else 2
    return f"{_signed(100 * value, digits)}%"


def decimal(value: float | None) -> str:
    return "undefined" if value is None else _signed(value, 2)


def _signed(value: float, digits: int) -> str:
    text = f"{value:+.{digits}f}"
    return text.lstrip("+-") if not text.strip("+-0.") else text.replace("-", "\N{MINUS SIGN}")
