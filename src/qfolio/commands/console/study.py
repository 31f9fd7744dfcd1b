"""What a study prints: its extent before it starts, and the pooled evidence."""

from typing import TYPE_CHECKING

from qfolio.commands.console import print_table, say, tell
from qfolio.core.text import amount, figure

if TYPE_CHECKING:
    from qfolio.portfolio.study.evidence import Active
    from qfolio.portfolio.study.folder import Result, Variant
    from qfolio.portfolio.study.pooling import Pooled
    from qfolio.portfolio.study.run import Study


def describe_study(study: "Study") -> list[str]:
    """Tables, variants and agents of a study, why tables are left out, and which are alike."""
    config = study.config
    variants = amount(len(config.variants), "variant")
    tables = amount(len(config.tables), "table")
    left_out = (f"{name} is left out: {why}" for name, why in config.left_out.items())
    about = f"{tables} · {variants} · {' and '.join(config.agents)} · {config.device}"
    return [about, *left_out, *config.twins]


def print_study(result: "Result") -> None:
    """A row for each table and each variant pooled, by agent, and the verdicts.

    Of a table alone nothing is pooled: it has a row in each variant.
    """
    from qfolio.portfolio.study.verdict import decimal, looks_sentence

    main, *_ = result.variants
    several = len(next(iter(main.agents.values())).evidence) > 1
    for agent in main.agents:
        rows: list[tuple[str, ...]] = []
        for entry in [main] if several else result.variants:
            for name, known in entry.agents[agent].evidence.items():
                active = known.to_reference
                ratios = (active.information_ratio, active.t, known.to_rebalanced.t, known.sharpe)
                label = name if entry is main else f"{name}, {entry.variant.text}"
                rows.append((label, *_growth(active), *map(decimal, ratios)))
        for entry in result.variants if several else []:
            found = entry.agents[agent]
            numbers = (found.to_reference.z, found.to_rebalanced.z, found.sharpe.difference)
            cells = (*_growth(found.to_reference), "", *map(decimal, numbers))
            rows.append((_pooled(entry.variant), *cells))
        heads = (agent, "a year", "95% interval", "IR", "t", "rebal.", "Sharpe")
        print_table(heads, rows, bold=[_pooled(main.variant)])
    pooled, or_z = (" (pooled: Stouffer's z)", " (or z)") if several else ("", "")
    say(
        f"“a year” is growth less the benchmark's, and t tests it{pooled}; “rebal.” is the t{or_z} "
        "against its best rebalancing; Sharpe is the ratio less the highest of a baseline."
    )
    for sentences in result.verdicts.values():
        for sentence in sentences:
            tell(sentence)
    tell(looks_sentence(result))


def _pooled(variant: "Variant") -> str:
    return f"pooled, {variant.text}"


def _growth(entry: "Active | Pooled") -> tuple[str, str]:
    """An active growth and its interval."""
    growth, low, high = (figure(x, "+.1%") for x in (entry.growth, entry.low, entry.high))
    return growth, f"{low.removesuffix('%')} … {high}"
