"""Files that are never half-written and never executed: atomic writes, safetensors, locks."""

import contextlib
import datetime
import hashlib
import json
import os
import platform
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import platformdirs
from filelock import FileLock, Timeout
from safetensors import SafetensorError
from safetensors.numpy import load, save

from qfolio.core.errors import QfolioError, require_type
from qfolio.core.text import csv_cell, quote, shell

_JSON = msgspec.json.Encoder()
_NUMBERS, _LARGE = (float, int), 2.0**63  # msgspec takes no larger integers
_SPECIAL = re.compile('[,"\r\n]')

UNFINISHED = ".part"
"""Suffix of temporary files; a killed process may leave some."""


def cache_directory() -> Path:
    """The folder of compiled programs and solved optima; safe to delete at any time.

    ``QFOLIO_CACHE`` names it (default: the user's cache folder).
    """
    if path := os.environ.get("QFOLIO_CACHE"):
        return Path(path)
    try:
        return platformdirs.user_cache_path("qfolio", appauthor=False)
    except RuntimeError:  # no home; other users might write to a folder for temporary files
        return Path(os.devnull) / "qfolio"  # where nothing can be written


def can_write(folder: Path) -> bool:
    """Whether a folder, or else the nearest one above it that exists, lets files be made in it."""
    there = _nearest(folder)
    return there.is_dir() and os.access(there, os.W_OK | os.X_OK)


def _nearest(folder: Path) -> Path:
    """The folder itself, or the nearest one above it that exists."""
    return next((place for place in (folder, *folder.parents) if os.path.exists(place)), Path())


def path_of(name: str, value: Path | str) -> Path:
    """The path that an argument is; raises QfolioError for anything else."""
    require_type(name, value, (str, os.PathLike), 'a path, such as "runs/mine"')
    require_utf8(value)
    return Path(value)


def require_utf8(name: Path | str) -> None:
    """Raises QfolioError for a name that no page and no table of results could hold."""
    try:
        str(name).encode()
    except UnicodeEncodeError:
        raise QfolioError(
            f"{quote(name, 300)} is not UTF-8; rename the file or the folder."
        ) from None


def target_of(path: Path) -> Path:
    """The file that writing to ``path`` replaces: a link stays, and what it leads to is replaced.

    Raises QfolioError if it is a folder or, like a pipe or a device, no regular file, or if the
    place that a link leads to is not there.
    """
    target = Path(os.path.realpath(path))
    if target.is_dir():
        raise QfolioError(f"{path} is a folder; name a file.")
    if (path.exists() or target.is_symlink()) and not path.is_file():  # a link in a loop, too
        raise QfolioError(f"{path} is no regular file; name another.")
    if path.is_symlink() and not target.parent.is_dir():  # such as a disk that is not mounted
        raise QfolioError(f"{path} leads to {target.parent}, which is not there; make it first.")
    return target


def write_bytes(path: Path, content: bytes) -> None:
    """Writes to a temporary name beside ``path``, then renames: a reader sees all or nothing.

    Raises QfolioError for what ``target_of`` refuses.
    """
    target = target_of(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = target.with_name(f".{target.name}.{os.getpid()}{UNFINISHED}")
    try:
        with naming(path):
            with temporary.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(target)
    except BaseException:
        with contextlib.suppress(OSError):  # on a disk that has become read-only
            temporary.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def naming(path: Path) -> Iterator[None]:
    """Adds the name of a file to the errors of writing it: a full disk names none by itself."""
    try:
        yield
    except OSError as error:
        error.filename = str(path)
        raise


def require_new(folder: Path, option: str | None = "--resume") -> None:
    """Raises QfolioError unless ``folder`` can be made: it is new, or empty and can be replaced.

    option: continues the work in it, if it is work.
    """
    if folder.exists() and not folder.is_dir():
        raise QfolioError(f"{folder} is a file; name a new folder.")
    if folder.exists() and any(folder.iterdir()):
        more = f", or continue with {option} {shell(folder)}" if option else ""
        raise QfolioError(f"{folder} is not empty; name a new folder{more}.")
    if folder.resolve() == Path.cwd():  # which no other folder can replace
        raise QfolioError("The results cannot lie in the current folder itself; name a new one.")
    if folder.is_symlink() or os.path.ismount(folder):
        raise QfolioError(
            f"{folder} is a link or a mount point, which no folder can replace; name a new folder."
        )
    if not can_write(folder.parent):
        there, how = _nearest(folder.parent).resolve(), " with --out" if option else ""
        raise QfolioError(f"Nothing can be written to {there}; name a folder elsewhere{how}.")


def require_there(folder: Path) -> None:
    """Raises QfolioError if a folder was deleted or moved: a new one would lack what is in it."""
    if not folder.exists():
        raise QfolioError(
            f"{folder} is gone; if it was moved, resume it there: what was finished is kept."
        )


@contextlib.contextmanager
def new_folder(folder: Path, option: str | None = "--resume") -> Iterator[Path]:
    """A temporary folder that is renamed to ``folder`` at the end: it is complete or absent.

    option: as for ``require_new``, which raises QfolioError if ``folder`` is not empty.
    """
    require_new(folder, option)
    folder.parent.mkdir(parents=True, exist_ok=True)
    with naming(folder):
        temporary = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    try:
        yield temporary
        mask = os.umask(0)
        os.umask(mask)
        temporary.chmod(0o777 & ~mask)  # mkdtemp ignores the user's umask
        if folder.exists():
            folder.rmdir()
        temporary.rename(folder)
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)
        if isinstance(error, OSError):
            error.filename = str(error.filename or folder).replace(str(temporary), str(folder))
        raise


def tidy(folder: Path) -> None:
    """Removes the temporary files of a killed process from a folder and those in it.

    Only for who holds the folder's lock: another process may be writing one.
    """
    for path in folder.rglob(f".*{UNFINISHED}"):
        path.unlink(missing_ok=True)


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Locks a folder against other processes until the block or this process ends.

    Raises QfolioError, which names the other process, if the folder is already locked.
    """
    holder = folder / ".holder"
    lock = FileLock(folder / ".lock", timeout=0)
    try:
        with naming(folder):
            lock.acquire()
    except Timeout:
        raise QfolioError(
            f"{folder} is in use by {_holder(holder)}; wait until it has finished, or stop it."
        ) from None
    try:
        since = datetime.datetime.now().astimezone().isoformat(" ", "seconds")
        write_json(holder, {"pid": os.getpid(), "host": platform.node(), "since": since})
        yield
    finally:
        with contextlib.suppress(OSError):  # read-only by now, or Windows: no open file is deleted
            holder.unlink(missing_ok=True)
            (folder / ".lock").unlink(missing_ok=True)
        lock.release()


def _holder(path: Path) -> str:
    try:
        held = read_json(path)
        return f"process {held['pid']} on {held['host']} since {held['since']}"
    except (QfolioError, KeyError):  # locked, but not signed yet
        return "another process"


def write_text(path: Path, text: str) -> None:
    """Writes text in UTF-8, its line ends as they are: a page holds hashes of its scripts."""
    write_bytes(path, text.encode())


def write_json(path: Path, content: Any) -> None:
    """Writes JSON; raises ValueError for NaN and infinity."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def write_csv(path: Path, header: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """Writes a header and rows as CSV that is safe to open in a spreadsheet (``csv_cell``)."""
    write_bytes(path, csv_lines([header]) + csv_lines(rows))


def csv_lines(rows: Iterable[Iterable[Any]]) -> bytes:
    """Rows as lines of CSV that are safe to open in a spreadsheet."""

    def cell(value: Any) -> msgspec.Raw:
        text = "" if value is None else str(csv_cell(value))
        quoted = '"' + text.replace('"', '""') + '"'
        return msgspec.Raw((quoted if _SPECIAL.search(text) else text).encode())

    def line(row: Iterable[Any]) -> bytes:
        # JSON spells finite numbers as CSV does, in a third of the csv module's time.
        cells = [x if type(x) in _NUMBERS and -_LARGE < x < _LARGE else cell(x) for x in row]
        return _JSON.encode(cells)[1:-1]

    return b"".join([line(row) + b"\n" for row in rows])


def read_json(path: Path) -> dict[str, Any]:
    """Reads a JSON object; raises QfolioError if the file is missing or holds anything else."""
    try:
        content = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise QfolioError(f"{path} cannot be read: {error.strerror or error}.") from None
    except (ValueError, RecursionError) as error:
        raise QfolioError(
            f"{path} is damaged: it holds no valid JSON ({error}); restore it."
        ) from None
    if not isinstance(content, dict):
        raise QfolioError(f"{path} is damaged: it holds no JSON object; restore it.")
    return content


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes named arrays as safetensors, which cannot carry code.

    A digest is stored with them, so that reading detects flipped bits.
    """
    ordered = {name: np.asarray(a, order="C") for name, a in arrays.items()}
    write_bytes(path, save(ordered, metadata={"sha256": _digest(ordered)}))


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Reads named arrays.

    Raises QfolioError if the file is missing, truncated, changed or not safetensors.
    """
    try:
        content = path.read_bytes()
        arrays = load(content)
        header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
        digest = header.get("__metadata__", {}).get("sha256")
    except OSError as error:
        raise QfolioError(f"{path} cannot be read: {error.strerror or error}.") from None
    except (SafetensorError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise QfolioError(
            f"{path} is damaged or not a safetensors file ({error}); restore it or train again."
        ) from None
    if digest != _digest(arrays):
        raise QfolioError(
            f"{path} is damaged: its numbers do not match its digest; restore it or train again."
        )
    return arrays


def _digest(arrays: Mapping[str, np.ndarray]) -> str:
    """SHA-256 of the arrays' names, types, shapes and bytes."""
    sha = hashlib.sha256()
    for name in sorted(arrays):
        array = arrays[name]
        sha.update(json.dumps([name, array.dtype.name, array.shape]).encode())
        sha.update(array.reshape(-1).view(np.uint8).data)
    return sha.hexdigest()


def write_tree(path: Path, tree: Any) -> None:
    """Writes the arrays of a pytree, named by their paths in it."""
    write_arrays(path, _named(tree))


def read_tree(path: Path, template: Any) -> Any:
    """``template`` with its arrays read from a file.

    Raises QfolioError if the file cannot be read, or names, shapes or types differ.
    """
    import jax

    arrays, wanted = read_arrays(path), _named(template)
    fits = wanted.keys() == arrays.keys() and all(
        arrays[name].shape == leaf.shape and arrays[name].dtype == leaf.dtype
        for name, leaf in wanted.items()
    )
    if not fits:
        raise QfolioError(
            f"{path} does not belong to the settings beside it, or is of another version of "
            "qfolio; restore the two together, or train again."
        )
    return jax.tree.unflatten(jax.tree.structure(template), [arrays[name] for name in wanted])


def _named(tree: Any) -> dict[str, Any]:
    import jax

    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}
