"""Types of numpy arrays, as annotations name them; docstrings give their shapes."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
AnyFloats = NDArray[np.floating[Any]]
"""Of double precision or less, as learned values are."""
