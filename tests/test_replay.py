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
    np.testing.assert_array_equal(filled(6, 5).rows, [6, 7, 8, 9, 4, 5])


def test_rounds_the_capacity_up_to_whole_writes():
    assert filled(5, 0).capacity == 6


def test_samples_only_what_was_written():
    sample = filled(1000, 3).sample(jax.random.key(0), 500)
    assert set(sample.tolist()) == {0, 1, 2, 3, 4, 5}


def test_samples_a_full_buffer_uniformly():
    sample = np.asarray(filled(8, 9).sample(jax.random.key(1), 8000))
    counts = np.bincount(sample, minlength=18)
    assert counts[:10].sum() == 0
    # Eight cells of 1,000 expected draws each: chi-square with 7 degrees of freedom, p = 0.001.
    assert ((counts[10:] - 1000) ** 2 / 1000).sum() < 24.3
