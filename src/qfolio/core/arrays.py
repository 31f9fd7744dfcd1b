"""Types of numpy arrays, as annotations name them, and arrays from a user's code.

Docstrings give their shapes.
"""

import reprlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qfolio.core.errors import QfolioError

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
AnyFloats = NDArray[np.floating[Any]]
"""Of double precision or less, as learned values are."""


def numbers(name: str, value: Any) -> Floats:
    """What a user's function returned, as an array; raises QfolioError unless it is of numbers."""
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise QfolioError(
            f"{name} returns {reprlib.repr(value)}; it must return an array of numbers."
        ) from None
