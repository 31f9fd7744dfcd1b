"""What checks the types of arguments in tests.

As for mypy, an int is a float where one is asked for. numpy's own types are wider than what they
say at run time: a comparison is a bool, a tuple is an ``ArrayLike``, days are ``datetime64``.
"""

import numpy as np
from beartype import BeartypeConf, FrozenDict, beartype
from numpy.typing import ArrayLike, NDArray

check = beartype(
    conf=BeartypeConf(
        is_pep484_tower=True,
        hint_overrides=FrozenDict(
            {bool: bool | np.bool_, ArrayLike: object, NDArray[np.datetime64]: np.ndarray}
        ),
    )
)
