"""What checks the types of arguments in tests: shapes by jaxtyping, the rest by beartype.

As for mypy, an int is a float where one is asked for. Some types are wider than they say at run
time: a comparison of numpy's is a bool, a sum over all axes is an array, a tuple is an
``ArrayLike``, days are ``datetime64``, and a buffer is an ``IO``.
"""

import functools
import inspect
import io
from collections import Counter
from typing import IO, Any

import jaxtyping
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

CALLS = 50
"""Calls of a function that are checked in a file of tests. Later ones hardly bring other types, and
a check takes longer than many a function: a test that loops in Python took six times as long."""

CLOSURES = 4
"""Closures of one function that are checked in a file of tests. Making a check takes long, too."""

_calls: Counter[int] = Counter()  # by the address of a function's code, which its closures share
_made: Counter[int] = Counter()
_jaxtyped = jaxtyping.jaxtyped


def install(packages: list[str]) -> None:
    """Has the functions of packages checked that are imported from now on."""
    # What the hook applies to each function:
    jaxtyping.jaxtyped = _first_calls  # type: ignore[assignment]
    jaxtyping.install_import_hook(packages, "typechecker.check")


def check_again() -> None:
    """Counts calls and closures anew."""
    _calls.clear()
    _made.clear()


def _first_calls(function: Any = None, *, typechecker: Any) -> Any:
    if function is None:
        return functools.partial(_first_calls, typechecker=typechecker)
    if not inspect.isfunction(function):
        return _jaxtyped(function, typechecker=typechecker)
    code = id(function.__code__)
    _made[code] += 1
    if _made[code] > CLOSURES or _calls[code] >= CALLS:
        return function
    checked = _jaxtyped(function, typechecker=typechecker)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        _calls[code] += 1
        return (checked if _calls[code] <= CALLS else function)(*args, **kwargs)

    return call
