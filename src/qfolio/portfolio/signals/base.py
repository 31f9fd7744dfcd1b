"""A signal, from which the library's and a user's own derive."""

import abc
from typing import Any, ClassVar

import equinox as eqx
import numpy as np

from qfolio.core.arrays import Floats
from qfolio.core.errors import QfolioError
from qfolio.core.fields import static
from qfolio.core.text import amount

ROUNDING = 1e-9
"""Differences between assets that are smaller than this share of the largest number are none."""


class Signal(eqx.Module):
    """A number for each asset and row, which depends on no later row.

    rows: number of rows that it looks back on. skip: number of latest rows that it leaves out.
    """

    shared: ClassVar[bool] = False
    """Whether all assets have the same number, which then has no rank."""
    scale: ClassVar[str | None] = None
    """The one of ``SCALES`` that the signal always uses; None for the portfolio's setting."""

    rows: int = static(21)
    skip: int = static(0)

    def __check_init__(self) -> None:
        if not 0 <= self.skip < self.rows <= 100_000:
            raise QfolioError(
                f"A signal looks back on {amount(self.rows, 'row')} and skips {self.skip}; it must "
                "look back on 1 to 100,000 and skip fewer."
            )

    def __call__(self, prices: Floats) -> Any:  # a user's may be a data frame
        """The signal, shape (row, asset), NaN where it is unknown.

        prices: of the same shape, NaN before an asset's first price.
        """
        return self.measure(before(prices, self.skip), self.rows - self.skip)

    @abc.abstractmethod
    def measure(self, prices: Floats, rows: int) -> Floats:
        """The signal of each row, looking back on ``rows`` rows, with nothing left to skip.

        prices: as known ``skip`` rows before, shape (row, asset), NaN where unknown.
        """


class Column(Signal):
    """A column of the table, as it is known at each row."""

    name: str = static("")
    rows: int = static(1)

    def measure(self, prices: Floats, rows: int) -> Floats:
        raise AssertionError("compute reads columns from the table")


def before(values: Floats, rows: int) -> Floats:
    """The values a given number of rows earlier; NaN in the first rows."""
    return np.concatenate([np.full((min(rows, len(values)), *values.shape[1:]), np.nan),
                           values[: max(0, len(values) - rows)]])  # fmt: skip
