"""The result of a study: the pooled evidence, corrected for all comparisons and looks."""

from collections.abc import Mapping, Sequence

import msgspec

from qfolio.core.statistics import holm
from qfolio.portfolio.backtest.statistics.bootstrap import LEVEL
from qfolio.portfolio.backtest.statistics.differences import Finding
from qfolio.portfolio.backtest.statistics.sharpe import expected_maximum_sharpe
from qfolio.portfolio.prices.table import trials_on
from qfolio.portfolio.study.evidence import AGAINST, TableReturns
from qfolio.portfolio.study.folder import Result, StudyConfig, VariantResult
from qfolio.portfolio.study.pooling import Pooled, Pools, pool
from qfolio.portfolio.study.verdict import verdicts


def summarize(config: StudyConfig, tested: Sequence[Mapping[str, TableReturns]]) -> Result:
    """Pool the evidence of a study.

    Args:
        config: With the looks that were taken.
        tested: The returns on each table, by variant.
    """
    pooled = [pool(tables, config.agents) for tables in tested]
    rebalanced = any(len(table.rebalancings) > 1 for table in tested[0].values())
    before = [table.trials + trials_on(table.source) for table in config.tables.values()]
    trials = max(before) + len(config.variants) * len(config.agents)
    threshold = expected_maximum_sharpe(trials, 1.0)
    pooled[0] = corrected(pooled[0], rebalanced, threshold)
    return Result(
        variants=[
            VariantResult(variant=variant, agents=agents)
            for variant, agents in zip(config.variants, pooled, strict=True)
        ],
        looks=sum(len(look.agents) for look in config.looks),
        earlier=sum(before),
        trials=trials,
        threshold=threshold,
        verdicts=verdicts(pooled[0], threshold),
        twins=config.twins,
    )


def corrected(
    agents: Mapping[str, Pools], rebalanced: bool, threshold: float = 0.0
) -> dict[str, Pools]:
    """The pooled evidence with findings, by Holm's correction over all agents and references.

    rebalanced: whether the reference has rebalancings; if not, there is one comparison per agent.
    threshold: the z that luck is expected to reach after all looks; nothing below it is better.
    """
    against = AGAINST if rebalanced else AGAINST[:1]
    pooled: list[Pooled] = [getattr(agents[name], key) for name in agents for key in against]
    p_holm = holm([1.0 if each.p is None else each.p for each in pooled]).tolist()
    found = iter([_found(each, p, threshold) for each, p in zip(pooled, p_holm, strict=True)])
    decided = {}
    for name, pools in agents.items():
        first = next(found)
        second = next(found) if rebalanced else first
        decided[name] = msgspec.structs.replace(pools, to_reference=first, to_rebalanced=second)
    return decided


def _found(pooled: Pooled, p: float, threshold: float) -> Pooled:
    finding: Finding = "none"
    if p <= 1 - LEVEL and pooled.z is not None and not 0 < pooled.z < threshold:
        finding = "better" if pooled.z > 0 else "worse"
    return msgspec.structs.replace(pooled, p_holm=p, finding=finding)
