"""Files are whole or absent, damage is noticed, and one process at a time holds a folder."""

import csv
import errno
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import platformdirs
import pytest
from filelock import FileLock

from qfolio.core.errors import QfolioError
from qfolio.core.files import (
    cache_directory,
    can_write,
    csv_lines,
    locked,
    naming,
    new_folder,
    path_of,
    read_arrays,
    require_new,
    write_arrays,
    write_bytes,
    write_json,
)

ARRAYS = {"weights": np.arange(6, dtype=np.float32).reshape(2, 3), "steps": np.array(7)}


def test_a_full_disk_names_the_file(tmp_path):
    with pytest.raises(OSError, match="No space") as raised, naming(tmp_path / "log"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert raised.value.filename == str(tmp_path / "log")


def test_arrays_come_back(tmp_path):
    write_arrays(tmp_path / "a", ARRAYS | {"none": np.zeros((0, 3)), "flag": np.array(True)})
    again = read_arrays(tmp_path / "a")
    assert again["none"].shape == (0, 3)
    assert again["flag"]
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(again[name], array, strict=True)


def test_a_spreadsheet_reads_what_was_written():
    texts = ["A", "a,b", 'say "no"', "two\nlines", "null", "nan", "],[", "Société", "a;b", ""]
    numbers = [0.1, -0.0, 1e-7, 1e300, 5e-324, 1 / 3, 1e16, math.nan, math.inf, -math.inf]
    counts = [0, -1, 10**20, *range(7)]
    rows = list(zip(texts, numbers, counts, strict=True))
    lines = csv_lines([*rows, ("=1+1", None, True)]).decode()
    *again, last = csv.reader(lines.splitlines(keepends=True))
    assert again == [[text, again[i][1], str(rows[i][2])] for i, (text, *_) in enumerate(rows)]
    assert [repr(float(row[1])) for row in again] == list(map(repr, numbers)), "to the last bit"
    assert last == ["'=1+1", "", "True"]
    assert csv_lines([]) == b""


@pytest.mark.parametrize("place", [-1, -9, -17])
def test_one_flipped_bit_is_noticed(place, tmp_path):
    path = tmp_path / "policy.safetensors"
    write_arrays(path, ARRAYS)
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)
    with pytest.raises(QfolioError, match=r"policy\.safetensors is damaged: .* digest"):
        read_arrays(path)


def test_another_shape_of_the_same_numbers_is_noticed(tmp_path):
    path = tmp_path / "policy.safetensors"
    write_arrays(path, {"x": np.arange(6.0).reshape(2, 3)})
    content = path.read_bytes()
    assert content.count(b"[2,3]") == 1
    path.write_bytes(content.replace(b"[2,3]", b"[3,2]"))
    with pytest.raises(QfolioError, match="digest"):
        read_arrays(path)


def test_another_name_of_the_same_numbers_is_noticed(tmp_path):
    path = tmp_path / "policy.safetensors"
    write_arrays(path, {"mean": np.arange(6.0)})
    path.write_bytes(path.read_bytes().replace(b'"mean"', b'"rate"'))
    with pytest.raises(QfolioError, match="digest"):
        read_arrays(path)


def test_arrays_without_a_digest_are_refused(tmp_path):
    from safetensors.numpy import save_file

    save_file(ARRAYS, tmp_path / "a")
    with pytest.raises(QfolioError, match="do not match its digest"):
        read_arrays(tmp_path / "a")


def test_a_folder_that_cannot_be_made_leaves_nothing(tmp_path):
    def fail(folder):
        write_bytes(folder / "config.json", b"{}")
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError), new_folder(tmp_path / "run") as folder:
        fail(folder)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such rights")
def test_a_folder_has_the_rights_that_the_user_gives(tmp_path):
    before = os.umask(0o027)
    try:
        with new_folder(tmp_path / "run"):
            pass
    finally:
        os.umask(before)
    assert (tmp_path / "run").stat().st_mode & 0o777 == 0o750


def test_json_holds_finite_numbers_only(tmp_path):
    for number in (math.nan, math.inf):
        with pytest.raises(ValueError, match="JSON"):
            write_json(tmp_path / "summary.json", {"x": [number]})
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such limits")
def test_a_file_that_cannot_be_written_is_named(tmp_path):
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))
    try:
        with (
            pytest.raises(OSError, match="File too large") as error,
            new_folder(tmp_path / "run") as folder,
        ):
            write_bytes(folder / "policy", bytes(2000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert error.value.errno == errno.EFBIG
    assert error.value.filename == str(tmp_path / "run" / "policy")
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights there")
def test_what_a_link_leads_to_is_replaced_and_the_link_stays(tmp_path):
    target, link = tmp_path / "sent" / "orders.csv", tmp_path / "orders.csv"
    link.symlink_to(target)
    with pytest.raises(QfolioError, match=r"leads to .*sent, which is not there; make it first"):
        write_bytes(link, b"none")  # as of a disk that is not mounted
    target.parent.mkdir()
    for content in (b"first", b"second"):  # of a file that is not there yet, and of one that is
        write_bytes(link, content)
        assert (link.is_symlink(), target.read_bytes()) == (True, content)
    assert [path.name for path in target.parent.iterdir()] == ["orders.csv"]


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such files")
def test_nothing_but_a_regular_file_is_replaced(tmp_path):
    pipe, link, loop = tmp_path / "pipe", tmp_path / "link", tmp_path / "loop"
    os.mkfifo(pipe)
    link.symlink_to(pipe)
    loop.symlink_to(loop)
    for path in (pipe, link, loop):
        with pytest.raises(QfolioError) as raised:
            write_bytes(path, b"")
        assert str(raised.value) == f"{path} is no regular file; name another."
    assert pipe.is_fifo()
    reading, writing = os.pipe()
    try:
        with pytest.raises(QfolioError, match="is no regular file"):  # as /dev/stdout before a "|"
            write_bytes(Path(f"/dev/fd/{writing}"), b"")
    finally:
        os.close(reading)
        os.close(writing)
    assert {path.name for path in tmp_path.iterdir()} == {"pipe", "link", "loop"}


def test_a_name_that_no_page_could_hold_is_refused_before_any_work():
    with pytest.raises(QfolioError) as raised:
        path_of("out", os.fsdecode(b"pr\xe9.csv"))
    assert str(raised.value) == r"'pr\udce9.csv' is not UTF-8; rename the file or the folder."
    assert path_of("out", "prix-été").name == "prix-été"


def test_a_folder_for_results_is_new_or_empty(tmp_path, monkeypatch):
    used, file, empty = tmp_path / "used", tmp_path / "prices.csv", tmp_path / "empty"
    empty.mkdir()
    with new_folder(empty):
        pass
    write_bytes(used / "results", b"")
    write_bytes(file, b"")
    monkeypatch.chdir(empty)
    for here in (Path(), empty):
        with pytest.raises(QfolioError, match="current folder itself"), new_folder(here):
            pass
    with pytest.raises(QfolioError, match="is not empty; name a new folder"), new_folder(used):
        pass
    with pytest.raises(QfolioError, match="is a file; name a new folder"), new_folder(file):
        pass


def test_a_folder_that_cannot_be_replaced_is_refused_before_any_work(tmp_path, monkeypatch):
    empty, link, mounted = tmp_path / "empty", tmp_path / "link", tmp_path / "mounted"
    empty.mkdir()
    mounted.mkdir()
    link.symlink_to(empty)
    monkeypatch.setattr(os.path, "ismount", lambda path: path == mounted)
    for folder in (link, mounted):
        with pytest.raises(QfolioError, match=f"{folder.name} is a link or a mount point"):
            new_folder(folder).__enter__()
    empty.rmdir()  # the link leads nowhere now
    with pytest.raises(QfolioError, match="link is a link or a mount point"):
        new_folder(link).__enter__()
    with new_folder(mounted / "run"):
        pass


def test_a_folder_where_nothing_can_be_written_is_refused_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda place, mode: place != tmp_path)
    for folder in (tmp_path / "run", tmp_path / "not" / "there"):
        with pytest.raises(QfolioError) as raised:
            require_new(folder)
        assert str(raised.value) == (
            f"Nothing can be written to {tmp_path}; name a folder elsewhere with --out."
        )
    with pytest.raises(QfolioError, match=r"name a folder elsewhere\.$"):
        new_folder(tmp_path / "policy", None).__enter__()
    (tmp_path / "there").mkdir()
    require_new(tmp_path / "there" / "run")


def test_a_full_disk_is_named_where_only_the_folder_is_known(tmp_path):
    with pytest.raises(OSError, match="No space left") as error, new_folder(tmp_path / "run"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert error.value.filename == str(tmp_path / "run")


def test_a_read_only_disk_names_what_was_to_be_written(tmp_path, monkeypatch):
    """And not a temporary file, or one that is never there, such as the lock."""

    def refused(path, *_, **__):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(path))

    def error_of(write):
        with pytest.raises(OSError, match="Read-only") as error:
            write()
        return error.value.filename

    monkeypatch.setattr(tempfile, "mkdtemp", lambda *, prefix, dir: refused(dir / prefix))
    monkeypatch.setattr(FileLock, "acquire", lambda lock: refused(lock.lock_file))
    monkeypatch.setattr(Path, "open", refused)
    monkeypatch.setattr(Path, "unlink", refused)
    assert error_of(lambda: write_bytes(tmp_path / "policy", b"")) == str(tmp_path / "policy")
    assert error_of(new_folder(tmp_path / "run").__enter__) == str(tmp_path / "run")
    assert error_of(locked(tmp_path).__enter__) == str(tmp_path)


def test_a_lock_says_who_holds_it(tmp_path):
    hold = "import sys; from pathlib import Path; from qfolio.core.files import locked\n"
    hold += "with locked(Path(sys.argv[1])): print('held', flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", hold, str(tmp_path)]
    other = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        host = json.loads((tmp_path / ".holder").read_text())["host"]
        says = rf"is in use by process {other.pid} on {host} since \d{{4}}-.*; wait until"
        with pytest.raises(QfolioError, match=says), locked(tmp_path):
            pass
    finally:
        other.kill()
        other.communicate()
    with locked(tmp_path):  # a lock ends with its process, however that ends
        pass
    assert [path.name for path in tmp_path.iterdir()] == []


def test_two_processes_never_hold_a_folder_at_once(tmp_path, monkeypatch):
    """Not even if one begins while another deletes the lock's file, and lets go."""
    fcntl = pytest.importorskip("fcntl")
    flock, release, place = fcntl.flock, FileLock.release, tmp_path / ".lock"

    def deleted_before(*args):
        monkeypatch.setattr(fcntl, "flock", flock)
        place.unlink()
        return flock(*args)

    lock = FileLock(place)
    monkeypatch.setattr(fcntl, "flock", deleted_before)
    with lock, pytest.raises(QfolioError, match="is in use"), locked(tmp_path):
        pass

    def released_after(other, **options):
        monkeypatch.setattr(FileLock, "release", release)
        lock.acquire(timeout=0)
        other.release(**options)

    with locked(tmp_path):
        monkeypatch.setattr(FileLock, "release", released_after)
    with lock, pytest.raises(QfolioError, match="is in use"), locked(tmp_path):
        pass


def test_the_cache_lies_where_the_system_keeps_caches(monkeypatch):
    monkeypatch.setenv("QFOLIO_CACHE", "/somewhere")
    assert cache_directory() == Path("/somewhere")
    monkeypatch.delenv("QFOLIO_CACHE")
    assert cache_directory() == Path(platformdirs.user_cache_dir("qfolio", appauthor=False))


def test_a_user_without_a_home_has_no_cache(monkeypatch):
    def homeless(*_, **__):
        raise RuntimeError("could not determine the home directory")

    monkeypatch.delenv("QFOLIO_CACHE", raising=False)
    monkeypatch.setattr(platformdirs, "user_cache_path", homeless)
    place = cache_directory()
    assert not can_write(place)
    with pytest.raises(OSError, match=r".*"):
        write_bytes(place / "optimum", b"")
    with pytest.raises(QfolioError, match="cannot be read"):
        read_arrays(place / "optimum")
