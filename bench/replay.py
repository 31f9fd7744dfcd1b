"""Measures how many asset-days a second the backtest replays, beside skfolio and vectorbt.

    .venv/bin/python bench/replay.py

Each contestant turns the same daily decisions on skfolio's 20 stocks since 1990 into a wealth
curve after costs. They do not all do the same work: vectorbt also keeps a record of every order,
and its target percentages do not solve for what the wealth affords after costs; skfolio subtracts
turnover times cost from the return, for which each day has to be a portfolio of its own.

vectorbt runs in .venv-bench, where this file is started again and answers as peers.py does. It is
left out where it is not installed.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from race import Contestant, Rates, process, race, serve, timed

ROOT = Path(__file__).resolve().parents[1]
PEERS = ROOT / ".venv-bench"
COST = 0.001
GOAL = 10e6
"""Asset-days a second."""

ONE, MANY, VECTORBT_MANY = 1, 64, 16
"""Strategies that are replayed at once; vectorbt's rate hardly depends on it, its memory does."""

SKFOLIO_DAYS = 500


def table() -> np.ndarray:
    from skfolio.datasets import load_sp500_dataset

    return load_sp500_dataset().to_numpy()


def orders(strategies: int, values: np.ndarray) -> np.ndarray:
    """New random weights each day, cash first: nothing is easier to replay than anything else."""
    rows, assets = values.shape
    generator = np.random.default_rng(0)
    return generator.dirichlet(np.ones(assets + 1), (strategies, rows - 2))


def qfolio(values: np.ndarray, strategies: int) -> Contestant:
    from qfolio.portfolio.backtest.simulation import simulate

    decisions = orders(strategies, values)

    def advance() -> int:
        _ = simulate(values, decisions, first=0, cost=COST).wealth
        return decisions[..., 1:].size

    return timed(advance)


def skfolio(values: np.ndarray) -> Contestant:
    import pandas as pd
    from skfolio import MultiPeriodPortfolio, Portfolio

    returns = pd.DataFrame(values).pct_change().iloc[2 : SKFOLIO_DAYS + 2]
    weights = orders(ONE, values)[0, :SKFOLIO_DAYS, 1:]

    def advance() -> int:
        days = [
            Portfolio(
                X=returns.iloc[day : day + 1],
                weights=weights[day],
                previous_weights=weights[day - 1] if day else None,
                transaction_costs=COST,
            )
            for day in range(SKFOLIO_DAYS)
        ]
        _ = MultiPeriodPortfolio(portfolios=days).cumulative_returns
        return weights.size

    return timed(advance)


def vectorbt(values: np.ndarray, strategies: int) -> Callable[[], int]:
    import vectorbt

    rows, assets = values.shape
    close = np.tile(values[1:-1], (1, strategies))  # a decision is traded a row later
    size = orders(strategies, values)[..., 1:].transpose(1, 0, 2).reshape(rows - 2, -1)
    groups = np.repeat(np.arange(strategies), assets)

    def advance() -> int:
        portfolio = vectorbt.Portfolio.from_orders(
            close,
            size,
            size_type="targetpercent",
            group_by=groups,
            cash_sharing=True,
            call_seq="auto",  # sells before it buys
            fees=COST,
            init_cash=1.0,
            freq="1D",
        )
        portfolio.value()
        return size.size

    return advance


def answer(path: str, strategies: int) -> None:
    """What runs in the peers' environment."""
    answers, sys.stdout = sys.stdout, sys.stderr  # a library may print, too
    advance = vectorbt(np.load(path), strategies)
    advance()  # compiles
    serve(timed(advance), answers)


def elsewhere(interpreter: Path, path: str, strategies: int) -> list[str]:
    """The command that runs vectorbt."""
    return [
        *(str(interpreter), "-W", "ignore", __file__),
        *("--serve", path, "--strategies", str(strategies)),
    ]


def interpreter(environment: Path) -> Path | None:
    """The Python of an environment that has vectorbt."""
    found = environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    find = "import importlib.util, sys; sys.exit(importlib.util.find_spec('vectorbt') is None)"
    has_it = found.exists() and not subprocess.run([str(found), "-c", find]).returncode
    return found if has_it else None


def measure(*, rounds: int = 5, seconds: float = 1.5, peers: Path = PEERS) -> Rates:
    """Asset-days a second of each contestant, round by round."""
    values = table()
    with ExitStack() as stack:
        contestants = {
            "qfolio, one strategy": qfolio(values, ONE),
            f"qfolio, {MANY} strategies at once": qfolio(values, MANY),
            "skfolio, a Portfolio a day": skfolio(values),
        }
        if python := interpreter(peers):
            folder = stack.enter_context(tempfile.TemporaryDirectory())
            path = f"{folder}/values.npy"
            np.save(path, values)
            for name, strategies in (
                ("vectorbt, one strategy", ONE),
                (f"vectorbt, {VECTORBT_MANY} strategies at once", VECTORBT_MANY),
            ):
                contestants[name] = stack.enter_context(
                    process(elsewhere(python, path, strategies))
                )
        for run in contestants.values():
            run(0.1)
        return race(contestants, rounds, seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--peers", type=Path, default=PEERS, help="environment with vectorbt")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--serve", help=argparse.SUPPRESS)
    parser.add_argument("--strategies", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.serve:
        answer(arguments.serve, arguments.strategies)
        return
    rates = measure(rounds=arguments.rounds, peers=arguments.peers)
    print(f"{'million asset-days a second':34}{'median':>9}{'low':>9}{'high':>9}")
    for name, all_rates in rates.items():
        figures = (statistics.median(all_rates), min(all_rates), max(all_rates))
        print(f"{name:34}" + "".join(f"{figure / 1e6:9.2f}" for figure in figures))
    slower = min(statistics.median(rates[name]) for name in rates if name.startswith("qfolio"))
    print(f"Goal of {GOAL / 1e6:.0f} million: {'reached' if slower >= GOAL else 'missed'}.")


if __name__ == "__main__":
    main()
