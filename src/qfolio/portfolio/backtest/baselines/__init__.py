"""Baselines: the rules that agents are compared with, a file for each family.

A baseline decides as an agent does: it sees the rows up to a decision and its holding, and returns
target weights. ``backtest/orders.py`` runs it over the folds of a test.
"""

from qfolio.portfolio.backtest.baselines.base import (
    Baseline,
    Fitted,
    History,
    baseline,
    equal_weights,
    with_cash,
)

__all__ = ["Baseline", "Fitted", "History", "baseline", "equal_weights", "with_cash"]
