"""Signals: numbers for each asset and row, from prices up to that row.

A portfolio's setting ``signals="momentum:252-21,volatility:1m"`` names signals, each with the
number of rows that it looks back on and, after the hyphen, of latest rows that it skips; either may
be a length of time such as ``1y`` (``LENGTHS``). A user's own signal is ``module:Name``, with or
without rows, and ``feature:NAME`` is a column of the table.
Agents observe signals after the log return and the table's own features. By default each signal is
ranked across assets, from −1 to 1, so that nothing has to be fitted; a number that all assets share
is not scaled. docs/concepts/signals.md lists formulas and sources.
"""

from qfolio.portfolio.signals.base import Signal
from qfolio.portfolio.signals.computing import SCALES, compute
from qfolio.portfolio.signals.reading import COLUMN, labels, lookback, names, parse

__all__ = ["COLUMN", "SCALES", "Signal", "compute", "labels", "lookback", "names", "parse"]
