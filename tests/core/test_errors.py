"""What is said of errors that a user can fix."""

import errno
from importlib import import_module

import pytest

from qfolio.core.errors import QfolioError, needs, told


def test_only_a_package_that_is_missing_is_said_to_be_missing(monkeypatch, tmp_path):
    """One that is there, but lacks a package of its own, is not to be installed again."""
    (tmp_path / "half_there.py").write_text("import not_there")
    monkeypatch.syspath_prepend(tmp_path)
    hint = "pip install 'qfolio[this]'."
    with pytest.raises(QfolioError) as raised, needs("not_there", otherwise=hint):
        import_module("not_there")
    assert str(raised.value) == hint
    with pytest.raises(QfolioError) as raised, needs("half_there", otherwise=hint):
        import_module("half_there")
    assert str(raised.value).startswith(
        "half_there cannot be imported: ModuleNotFoundError: No mod"
    )


def test_what_is_said_of_files():
    denied = PermissionError(errno.EACCES, "Permission denied", "runs/mine")
    assert told(denied) == (
        "runs/mine: Permission denied; get the right to read and write there, or name another "
        "place."
    )
    full = OSError(errno.ENOSPC, "No space left on device", "runs/mine")
    assert told(full) == "runs/mine: No space left on device."
    assert told(PermissionError("not allowed")) == "not allowed."
