"""What checks the types of arguments in tests.

As for mypy, an int is a float where one is asked for, and a comparison of numpy's is a bool. A
tuple is an ``ArrayLike``, which numpy's protocols deny at run time.
"""

import numpy as np
from beartype import BeartypeConf, FrozenDict, beartype
from numpy.typing import ArrayLike

check = beartype(
    conf=BeartypeConf(
        is_pep484_tower=True,
        hint_overrides=FrozenDict({bool: bool | np.bool_, ArrayLike: object}),
    )
)
