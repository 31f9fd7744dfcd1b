"""What a backtest has to say of its strategies besides their figures, in sentences."""

from collections.abc import Container, Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from qfolio.core.text import amount, plural
from qfolio.portfolio import signals
from qfolio.portfolio.backtest.folder import AgentConfig
from qfolio.portfolio.backtest.folds import fewest
from qfolio.portfolio.backtest.replay import Entry, Replay
from qfolio.portfolio.backtest.statistics.verdict import lost_everything
from qfolio.portfolio.mandate import checks
from qfolio.portfolio.prices.findings import first_of, listing
from qfolio.portfolio.task import Portfolio

BARELY = 1e-3
"""Risk that exceeds a limit by a smaller share of it is a rounding error."""


GENEROUS = 0.15
"""A rate of cash a year, over a whole test, that few currencies have had."""


def beforehand(agents: Mapping[str, AgentConfig], replay: Replay) -> list[str]:
    """What is known of a backtest's settings before it is run."""
    return [
        *shortened(agents, replay),
        *unknown(agents, replay),
        *mandated(replay),
        *unread(replay),
        *generous(replay),
    ]


def shortened(agents: Mapping[str, AgentConfig], replay: Replay) -> list[str]:
    """A note on each agent whose episodes are shorter than its preset's."""
    rows = fewest(replay.folds, replay.prices)
    return [
        f"{name} learns from episodes of {agent.task['horizon']} rows instead of "
        f"{agent.shortened}, because a fold trains on {rows} rows only."
        for name, agent in agents.items()
        if agent.shortened
    ]


def unknown(agents: Mapping[str, AgentConfig], replay: Replay) -> list[str]:
    """A note on each signal that is unknown in all rows that a fold trains on."""
    folds, year = replay.folds, replay.prices.periods_per_year
    found = {
        label: count
        for agent in agents.values()
        for label, signal in zip(
            signals.labels(agent.task.get("signals", "")),
            signals.parse(agent.task.get("signals", ""), year),
            strict=True,
        )
        if (count := sum(signal.rows >= fold.train.stop for fold in folds))
    }
    return [
        f"{label} looks back on more rows than {count} of {amount(len(folds), 'fold')} "
        f"{'has' if count == 1 else 'have'} for training; there it is unknown and counts as 0."
        for label, count in found.items()
    ]


def unread(replay: Replay) -> list[str]:
    """A note on the columns of the market that the costs do not read, so that they do nothing."""
    names = [name for name in replay.prices.market_names if name not in replay.task.costs.columns]
    if not names:
        return []
    which = "it" if len(names) == 1 else names[0]
    return [
        f"No cost reads the {plural('column', len(names))} {listing(names)}; if {which} is the "
        f'rate that cash earns, add --cost-model "itemized(cash_rate=column:{names[0]})".'
    ]


def generous(replay: Replay) -> list[str]:
    """A note on cash that earns so much that its rate may be in percent."""
    rates = np.log(replay.growth[:, 0])
    rate = float(rates.mean() * replay.prices.periods_per_year)
    if rate <= GENEROUS:
        return []
    return [
        f"Cash earns {100 * rate:.0f}% a year over the test; if cash_rate is in percent, divide it "
        "by 100 (0.03 is 3% a year)."
    ]


def brief(replay: Replay) -> list[str]:
    """A note on a test of less than a year, of which figures a year say little."""
    days, year = len(replay.rows), replay.prices.periods_per_year
    if days >= 0.95 * year:  # a year of a calendar has a few more or fewer
        return []
    return [
        f"The test has {amount(days, 'row')}, where a year has about {year:.0f}: figures a year "
        "are extrapolated, and turnover and cost a year repeat the first purchase."
    ]


def left_out(replay: Replay) -> list[str]:
    """A note on each fold that leaves out assets, or one on all that are delisted."""
    listed, assets = replay.prices.listed, replay.prices.assets
    if replay.prices.tradable is not None:
        last = np.ones(len(assets), bool) if listed is None else listed[-1]
        names = [assets[j] for j in np.flatnonzero(~last)]
        return [f"Delisted: {listing(names)}."] if names else []
    folds = ((fold.name, fold.tradable(replay.prices.values)) for fold in replay.folds)
    return [
        f"Fold {name} leaves out {listing(late)}, which started too late."
        for name, tradable in folds
        if (late := [assets[j] for j in np.flatnonzero(~tradable)])
    ]


def mandated(replay: Replay) -> list[str]:
    """Notes on what is unusual about caps and the mandate, and on what a fold cannot meet."""
    every = np.ones(len(replay.prices.assets), bool)
    notes = checks.unusual(replay.task.mandate, every, replay.cap)
    if not replay.task.mandate:
        return notes
    band, turnover = replay.task.terms.band, replay.task.written.trading.turnover
    if band and turnover is not None and turnover <= 2 * band:
        notes.append(
            f"Orders with a turnover of at most {100 * turnover:.3g}% that exchange assets change "
            f"no weight by more than the calendar's band of {100 * band:.3g}%, within which "
            "nothing is ordered; raise trading.turnover, or narrow the band."
        )
    if replay.patterns is not None and (yields := replay.patterns[1]):
        said = ", ".join(yields)
        notes.append(f"The mandate is relaxed to fit the assets that can be traded: {said}.")
    return notes + [
        f"In fold {fold.name} the mandate is relaxed to fit the assets that can be traded: {said}."
        for fold, (_, lowered) in zip(replay.folds, replay.relaxed, strict=True)
        for said in lowered
    ]


def too_risky(replay: Replay, entries: Mapping[str, Entry]) -> list[str]:
    """A note on each limit of risk that trades exceed, with the strategies and how often."""
    allowed = replay.task.allowed
    if allowed is None or not allowed.limits_risk:
        return []
    limits = {"volatility": allowed.volatility, "tracking error": allowed.tracking_error}
    over: dict[str, list[str]] = {said: [] for said in limits}
    for name, entry in entries.items():
        if not entry.weighted:
            continue
        traded = ~np.isnan(entry.decisions[..., 0])
        rows = replay.folds[0].decisions.start + np.nonzero(traded)[1]
        found = _risks(replay.task, jnp.asarray(rows), jnp.asarray(entry.decisions[traded, 1:]))
        for (said, most), risk in zip(limits.items(), np.asarray(found), strict=True):
            if count := int((risk > most * (1 + BARELY)).sum()):
                most_of_all = f"{count:,} of {len(rows):,}, up to {risk.max():.3g}"
                over[said].append(f"{name} ({most_of_all})")
    return [
        f"Trades that leave a {said} above {limits[said]:.4g}: {first_of(names)}."
        for said, names in over.items()
        if names
    ]


def called(replay: Replay, entries: Mapping[str, Entry], own: Container[str]) -> list[str]:
    """A note on margin calls: who traded at rows where the calendar had no decision.

    own: names of strategies of the user's own, which have no margin calls.
    """
    terms, first = replay.terms, replay.folds[0].decisions.start
    if terms.called == np.inf or not len(terms.decides):
        return []
    planned = np.convolve(terms.decides, np.ones(terms.fill))[first:] > 0
    said = []
    for name, entry in entries.items():
        traded = ~np.isnan(entry.decisions[..., 0]) & (entry.simulation.wealth[:, :-1] > 0)
        count = int((traded & ~planned[: traded.shape[1]]).sum())
        if count and name not in own:
            said.append(f"{name} ({count:,})")
    return [f"Trades that margin calls forced: {first_of(said)}."] if said else []


def wiped_out(entries: Mapping[str, Entry]) -> list[str]:
    """A note on each strategy that lost everything."""
    ruined = {name: entry.simulation.ruined for name, entry in entries.items()}
    return [
        f"{lost_everything(name, int(lost.sum()), lost.size)}."
        for name, lost in ruined.items()
        if lost.any()
    ]


@eqx.filter_jit
def _risks(
    task: Portfolio, rows: Int[Array, " trade"], weights: Float[Array, "trade asset"]
) -> tuple[Float[Array, " trade"], Float[Array, " trade"]]:
    """Annual volatility and tracking error of weights, as known at their rows."""

    def each(row: Array, held: Array) -> tuple[Array, Array]:
        risk = task.risk_at(row)
        return risk.of(held), risk.of(held - risk.benchmark)

    found: tuple[Array, Array] = lax.map(lambda given: each(*given), (rows, weights))
    return found
