"""What checks the types of arguments in tests.

As for mypy, an int is a float where one is asked for. Some types are wider than they say at run
time: a comparison of numpy's is a bool, a sum over all axes is an array, a tuple is an
``ArrayLike``, days are ``datetime64``, and a buffer is an ``IO``.
"""

import io
from typing import IO

import numpy as np
from beartype import BeartypeConf, FrozenDict, beartype
from numpy.typing import ArrayLike, NDArray

check = beartype(
    conf=BeartypeConf(
        is_pep484_tower=True,
        hint_overrides=FrozenDict(
            {
                bool: bool | np.bool_,
                ArrayLike: object,
                NDArray[np.float64]: NDArray[np.float64] | np.float64,
                NDArray[np.datetime64]: np.ndarray,
                IO[bytes]: io.IOBase,
                IO[str]: io.IOBase,
            }
        ),
    )
)
