"""The verdict of a study in sentences."""

from collections.abc import Mapping

from qfolio.core.text import amount, figure, plural
from qfolio.portfolio.backtest.folder import EQUAL_WEIGHT
from qfolio.portfolio.backtest.statistics.bootstrap import LEVEL
from qfolio.portfolio.backtest.statistics.verdict import at_any_speed, at_best_speed, p_text
from qfolio.portfolio.study.folder import Result
from qfolio.portfolio.study.pooling import Pooled, Pools

_VERBS = {"better": "{} beats", "worse": "{} falls short of", "none": "No evidence that {} beats"}


def verdicts(agents: Mapping[str, Pools], threshold: float = 0.0) -> dict[str, list[str]]:
    """Sentences on each agent: growth, the same against another speed, by table, Sharpe ratio.

    threshold: the z that luck is expected to reach after all looks.
    """
    return {
        name: [*_findings(name, pools, threshold), *_tables(pools), _sharpe(pools)]
        for name, pools in agents.items()
    }


def _findings(name: str, pools: Pools, threshold: float) -> list[str]:
    """The claim about an agent with its numbers; equal weights have a second sentence.

    Equal weights that are rebalanced at every row pay for trades that earn nothing. To beat them
    alone is therefore no claim: an agent that merely trades less does so on random walks.
    """
    reference, alone, best = _reference(pools), pools.to_reference, pools.to_rebalanced
    total = len(pools.evidence)
    of_alone, of_best = (_numbers(each, threshold, total) for each in (alone, best))
    over = f"on {next(iter(pools.evidence))}" if total == 1 else f"over {amount(total, 'table')}"
    where = f"in growth after costs {over}"
    found = f"{_VERBS[alone.finding or 'none'].format(name)} {reference} {where}"
    if reference != EQUAL_WEIGHT:
        return [f"{found}: {of_alone}."]
    at_best = at_best_speed(reference)
    if best.finding == "better":
        found = f"{name} beats {at_any_speed(reference)} {where}"
        also = f"Against {reference} itself, rebalanced as often as it may be"
    elif alone.finding == "better":
        found = f"No evidence that {name} beats {at_best} {where}"
        also = f"It beats {reference} itself, as trading less may do without any skill"
    else:
        return [f"{found}: {of_alone}.", f"Against {at_best}: {of_best}."]
    return [f"{found}: {of_best}.", f"{also}: {of_alone}."]


def _reference(pools: Pools) -> str:
    return next(iter(pools.evidence.values())).to_reference.reference


def _numbers(pooled: Pooled, threshold: float, tables: int) -> str:
    interval = f"95% interval {growth_text(pooled.low)} to {growth_text(pooled.high)}"
    chance = "" if pooled.p_holm is None else f", corrected p {p_text(pooled.p_holm)}"
    if pooled.finding == "none" and pooled.p_holm is not None and pooled.p_holm <= 1 - LEVEL:
        chance += f", but luck is expected to reach a z of {decimal(threshold)} after all looks"
    difference, z = ("difference", "z") if tables == 1 else ("mean difference", "Stouffer’s z")
    return (
        f"the {difference} in annual log growth is {growth_text(pooled.growth)} ({interval}); "
        f"{z} is {decimal(pooled.z)}{chance}"
    )


def _tables(pools: Pools) -> list[str]:
    """On how many tables it grew more, and the worst; nothing on a table alone."""
    if len(pools.evidence) == 1:
        return []
    worst = pools.evidence[pools.to_reference.worst].to_reference
    count, total = pools.to_reference.positive, len(pools.evidence)
    grew = f"It grew more than {worst.reference} on {count} of {amount(total, 'table')}"
    if worst.reference == EQUAL_WEIGHT:
        grew += f", and more than its best rebalancing on {pools.to_rebalanced.positive}"
    least = f"{pools.to_reference.worst} ({growth_text(worst.growth)} a year)"
    return [f"{grew}. Its worst table is {least}."]


def _sharpe(pools: Pools) -> str:
    sharpe, total = pools.sharpe, len(pools.evidence)
    difference, z = decimal(sharpe.difference), decimal(sharpe.z)
    if total == 1:
        return (
            "Its Sharpe ratio less that of the best baseline, seen in hindsight, is "
            f"{difference} (z {z})."
        )
    return (
        "Its Sharpe ratio less that of each table’s best baseline, seen in hindsight, is "
        f"{difference} on average (Stouffer’s z {z}); it is higher on {sharpe.positive} of "
        f"{amount(total, 'table')}."
    )


def looks_sentence(result: Result) -> str:
    """How many looks were taken, which z luck alone is expected to reach, and what counts twice."""
    tables = len(next(iter(result.variants[0].agents.values())).evidence)
    earlier, z = "", "z" if tables == 1 else "pooled z"
    if result.earlier:
        known = f"{amount(result.earlier, 'earlier look')} at its {plural('table', tables)}"
        earlier = f"; {known} {'is' if result.earlier == 1 else 'are'} known"
    sentence = f"This study took {amount(result.looks, 'look')}{earlier}."
    if result.trials > 1:
        sentence += (
            f" The best of {result.trials:,} configurations without skill is expected to reach a "
            f"{z} of {decimal(result.threshold)}; a lower z is no evidence."
        )
    return " ".join([sentence, *result.twins])


def growth_text(value: float | None) -> str:
    """A growth with its sign; two decimals if it is small."""
    if value is None:
        return "undefined"
    digits = 1 if abs(value) >= 0.0995 else 2
    return figure(value, f"+.{digits}%")


def decimal(value: float | None) -> str:
    return "undefined" if value is None else figure(value, "+.2f")
