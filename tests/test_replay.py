import jax
import jax.numpy as jnp
import numpy as np

from qfolio.replay import Replay


def filled(capacity, writes, width=2):
    replay = Replay.empty(jnp.array(0), capacity, width)
    for i in range(writes):
        replay = replay.add(jnp.arange(i * width, (i + 1) * width))
    return replay


def test_keeps_the_latest_rows():
    np.testing.assert_array_equal(filled(6, 5).rows[:, 0], [6, 7, 8, 9, 4, 5])


def test_rounds_the_capacity_up_to_whole_writes():
    assert len(filled(5, 0).rows) == 6


def test_samples_only_what_was_written():
    sample = filled(1000, 3).sample(jax.random.key(0), 500)
    assert set(sample.tolist()) == {0, 1, 2, 3, 4, 5}


def test_samples_a_full_buffer_uniformly():
    sample = np.asarray(filled(8, 9).sample(jax.random.key(1), 8000))
    counts = np.bincount(sample, minlength=18)
    assert counts[:10].sum() == 0
    # Eight cells of 1,000 expected draws each: chi-square with 7 degrees of freedom, p = 0.001.
    assert ((counts[10:] - 1000) ** 2 / 1000).sum() < 24.3


def test_rows_come_back_as_they_were():
    row = {"flag": jnp.array(True), "matrix": jnp.zeros((2, 3)), "number": jnp.array(0)}
    rows = {
        "flag": jnp.array([True, False]),
        "matrix": jnp.arange(12.0).reshape(2, 2, 3) / 7,
        "number": jnp.array([2**24, -3]),
    }
    replay = Replay.empty(row, 4, 2).add(rows)
    again = replay.unpack(replay.rows[:2])
    for name, array in rows.items():
        np.testing.assert_array_equal(again[name], array)
        assert again[name].dtype == array.dtype
