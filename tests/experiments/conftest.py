"""What the tests of several kinds of experiments share."""

import jax
import pytest


@pytest.fixture
def one_core(monkeypatch):
    """Programs that are hardly optimized, as those of the quick tests, round differently on two."""
    monkeypatch.setattr(jax, "devices", lambda every=jax.devices: every()[:1])
