"""Serialization of jobs.

Large arrays, such as prices, are sent apart from the jobs, so that a worker gets each only once.
"""

import hashlib
import io
import pickle
from collections.abc import Mapping
from typing import Any, NamedTuple
from weakref import ReferenceType, ref

import jax
import numpy as np

from qfolio.core.errors import QfolioError
from qfolio.core.population import LARGE
from qfolio.core.registry import trust, trusted


class Parcel(NamedTuple):
    """A job without its large arrays.

    arrays: the digests of these arrays. modules: the user's own modules that the job names.
    """

    job: bytes
    arrays: tuple[str, ...]
    modules: tuple[str, ...]


class Packer:
    """Packs jobs; ``arrays`` holds the bytes of all their large arrays by digest.

    Only the driver's own workers read these bytes; they are never written to a file.
    """

    def __init__(self) -> None:
        self.arrays: dict[str, bytes] = {}
        self._known: dict[int, tuple[ReferenceType[Any], str]] = {}  # by id, which may be reused

    def pack(self, job: Any) -> Parcel:
        """A job as bytes, in which the digests of large arrays stand for them."""
        file, needs = io.BytesIO(), dict[str, None]()

        class Pickler(pickle.Pickler):
            def persistent_id(_, value: Any) -> str | None:  # noqa: N805
                if not (isinstance(value, jax.Array | np.ndarray) and value.size >= LARGE):
                    return None
                digest = self._digest(value)
                needs[digest] = None
                return digest

        Pickler(file, protocol=5).dump(job)
        content = file.getvalue()
        named = (module for module in trusted() if _names(content, module))
        return Parcel(content, tuple(needs), tuple(named))

    def _digest(self, array: Any) -> str:
        known = self._known.get(id(array))
        if known is None or known[0]() is not array:
            content = pickle.dumps(array, protocol=5)
            digest = hashlib.sha256(content).hexdigest()
            self.arrays[digest] = content
            self._known[id(array)] = known = (ref(array), digest)
        return known[1]


def _names(pickled: bytes, module: str) -> bool:
    """Whether a string in a pickle is the module's name or contains ``module:Name``."""
    name = module.encode()
    whole = pickle.SHORT_BINUNICODE + bytes([len(name) % 256]) + name
    return name + b":" in pickled or whole in pickled


class Unpacker:
    """Unpacks parcels; keeps the arrays, so that jobs share them as in the driver."""

    def __init__(self) -> None:
        self._arrays: dict[str, Any] = {}

    def keep(self, arrays: Mapping[str, bytes]) -> None:
        """Keeps arrays that were sent with a parcel."""
        self._arrays |= {digest: pickle.loads(content) for digest, content in arrays.items()}

    def lacks(self, parcel: Parcel) -> list[str]:
        """The digests of arrays that have not arrived yet."""
        return [digest for digest in parcel.arrays if digest not in self._arrays]

    def unpack(self, parcel: Parcel) -> Any:
        """The job; imports the modules that the driver has imported.

        Raises QfolioError if a class is not found here, such as one of a notebook.
        """
        trust(parcel.modules)
        arrays = self._arrays

        class Unpickler(pickle.Unpickler):
            def persistent_load(_, digest: str) -> Any:  # noqa: N805
                return arrays[digest]

        try:
            return Unpickler(io.BytesIO(parcel.job)).load()
        except (AttributeError, ImportError) as error:
            raise QfolioError(
                f"A worker cannot make what it is to train ({error}); define parts of your own in "
                "a module that every worker can import, not in a notebook or in the script itself."
            ) from None
