"""Why an agent earned what it earned: all attributions of a backtest.

Each agent is explained by the policy that ``allocate`` follows, the mean of all its seeds.
docs/guides/why.md lists formulas and sources.
"""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from qfolio.core.arrays import Floats
from qfolio.portfolio.backtest.attribution.decomposition import decompose
from qfolio.portfolio.backtest.attribution.diagnosis import diagnose, idle
from qfolio.portfolio.backtest.attribution.distillation import Rule, distil
from qfolio.portfolio.backtest.attribution.factors import exposures, factor_returns
from qfolio.portfolio.backtest.attribution.gradients import integrated_gradients
from qfolio.portfolio.backtest.attribution.importance import importance, of_seeds
from qfolio.portfolio.backtest.attribution.replays import (
    channel_names,
    open_to,
    seen_in_test,
    shared_channels,
)
from qfolio.portfolio.backtest.attribution.slices import slices
from qfolio.portfolio.backtest.attribution.why import AgentWhy, Why
from qfolio.portfolio.backtest.folder import followed
from qfolio.portfolio.backtest.folds import days_of, tested
from qfolio.portfolio.backtest.replay import Entry, Stretch
from qfolio.portfolio.backtest.run import Backtest
from qfolio.portfolio.backtest.statistics.measures import before_costs


def explain(backtest: Backtest, entries: Mapping[str, Entry]) -> Why:
    """Explain every agent of a finished backtest, from the replays of ``Backtest.entries``."""
    prices, config = backtest.prices, backtest.config
    year = prices.periods_per_year
    factors = factor_returns(
        prices.values, backtest.folds, config.lag, year, prices.tradable, backtest.replay.growth
    )
    one = lambda name: _explained(name, backtest, entries, factors)  # noqa: E731
    with ThreadPoolExecutor(backtest.side_by_side) as threads:
        found = list(threads.map(one, backtest.agents))
    traded = (followed(name, entries) for name in backtest.agents)
    agents = {name: why for name, (why, _) in zip(traded, found, strict=True)}
    diagnosis = {name: said for _, of in found for name, said in of.items() if said}
    return Why(config.benchmark, agents, diagnosis)


def _explained(
    name: str, backtest: Backtest, entries: Mapping[str, Entry], factors: dict[str, Floats]
) -> tuple[AgentWhy, dict[str, list[str]]]:
    """An agent's attributions, and the diagnosis of each of its entries."""
    prices, config, agent = backtest.prices, backtest.config, backtest.agents[name]
    names_of = [fold.name for fold in backtest.folds]
    folds = dict(zip(names_of, days_of(backtest.folds), strict=True))
    year = prices.periods_per_year
    benchmark = entries[config.benchmark].simulation
    reference = before_costs(benchmark.returns[0], benchmark.cost[0])
    traded = followed(name, entries)
    entry, stretches = entries[traded], backtest.stretches(name)
    net = entry.simulation.returns[0]
    names = channel_names(backtest.tasks[name], prices.feature_names)
    worth, held = importance(agent, stretches, names, prices.values, year)
    few = of_seeds(stretches, worth.seeds)
    there = ~np.isnan(prices.values) if prices.tradable is None else prices.tradable
    why = AgentWhy(
        decomposition=decompose(
            net,
            entry.simulation.weights[0],
            backtest.replay.growth - 1,
            folds,
            prices.assets,
            year,
            open_to(stretches) & there[backtest.replay.rows],
        ),
        exposures=exposures(net - reference, factors, year),
        importance=worth,
        slices=slices(agent, few, names, prices.assets, held, shared_channels(stretches).tolist()),
        gradients=integrated_gradients(agent, few, names, held),
        rule=_rule(entry.decisions[0], stretches, names),
        menu=bool(stretches[0].task.menu),
    )
    said = {
        each: diagnose(
            each,
            entries[each],
            list(folds.values()),
            prices.assets,
            worth.ignored and each == traded,
            backtest.tasks[name].anchor,
        )
        for each in dict.fromkeys((name, traded))
    }
    said[traded] += idle(traded, entry, config.benchmark, entries[config.benchmark])
    return why, said


def _rule(decisions: np.ndarray, stretches: list[Stretch], names: list[str]) -> Rule:
    """The linear rule of an agent's decisions, fitted on every other fold."""
    task, folds = stretches[0].task, [fold for *_, fold in stretches]
    tradable = open_to(stretches)
    fitted = np.zeros(len(tradable), bool)
    for days in days_of(folds)[::2]:
        fitted[days] = True
    if len(folds) == 1:
        fitted[len(fitted) // 2 :] = False
    anchor = np.asarray(task.anchors)[tested(folds)] if task.anchor else np.zeros_like(tradable)
    seen = seen_in_test(stretches)
    given = ~np.isnan(decisions[:, 0])  # there are no orders between a calendar's decisions
    ordered, anchor, seen = decisions[given, 1:], anchor[given], seen[given]
    return distil(ordered, anchor, seen, names, tradable[given], fitted[given])
