"""Jobs as bytes: what travels with them."""

import numpy as np
import pytest

from qfolio.core import registry
from qfolio.core.errors import QfolioError
from qfolio.core.population import LARGE
from qfolio.experiments.machines.parcels import Packer, Unpacker

import jobs
from jobs import Add


def test_only_modules_that_a_job_names_travel_with_it(monkeypatch):
    monkeypatch.setattr(registry, "_trusted", {"math", "elsewhere"})
    packer = Packer()
    assert packer.pack({"reward": "math:Mine"}).modules == ("math",)
    assert packer.pack({"reward": "log"}).modules == ()
    assert packer.pack({"math_of": "mathematics"}).modules == ()
    assert packer.pack(("math", 1)).modules == ("math",)


def test_a_large_array_travels_beside_its_jobs_once():
    packer, large = Packer(), np.arange(LARGE)
    first, second = packer.pack((1, large)), packer.pack((2, large))
    assert first.arrays == second.arrays == tuple(packer.arrays)
    unpacker = Unpacker()
    assert unpacker.lacks(first) == list(first.arrays)
    unpacker.keep(packer.arrays)
    (one, mine), (two, same) = unpacker.unpack(first), unpacker.unpack(second)
    assert (one, two) == (1, 2)
    assert mine is same
    np.testing.assert_array_equal(mine, large)


def test_an_array_in_the_place_of_one_that_is_gone_is_another():
    """Python gives a new object the number of one that was freed."""
    packer, one = Packer(), np.arange(LARGE)
    (digest,) = packer.pack(one).arrays
    other = one + 1
    packer._known[id(other)] = packer._known.pop(id(one))
    del one
    assert packer.pack(other).arrays != (digest,)


def test_a_class_that_a_worker_does_not_have(monkeypatch):
    parcel = Packer().pack(Add("a", 1.0))
    monkeypatch.delattr(jobs, "Add")
    with pytest.raises(QfolioError, match=r"cannot make what it is to train \(.*'Add'.*\); define"):
        Unpacker().unpack(parcel)
