"""Whether one agent gains from the batch of each update being split over both cores.

    taskset -c 0 python bench/split.py 1    # whole batches, one core
    python bench/split.py 1                 # whole batches, the runtime's threads on both cores
    python bench/split.py 2                 # half a batch on each of two devices, gradients summed
    taskset -c 0 python bench/split.py 1 32 # half a batch on one core: the limit of splitting

Prints the time of an update of the preset ``report``: the network 3-256-256-11, a batch of 64 from
50,000 rows, the target network's values, the gradient and Adam. It leaves out acting and the
pendulum, which a split does not change.
"""

import os
import sys
import time
from functools import partial

DEVICES = int(sys.argv[1])
BATCH = int(sys.argv[2]) if len(sys.argv) > 2 else 64
os.environ["XLA_FLAGS"] = f"--xla_force_host_platform_device_count={DEVICES}"

import jax  # noqa: E402  # it reads the flags when it is imported
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from jax import lax  # noqa: E402
from jax.sharding import Mesh, PartitionSpec  # noqa: E402

from qfolio.learning import optimizer  # noqa: E402

UPDATES, ROUNDS, ROWS = 400, 11, 50_000
SIZES = (3, 256, 256, 11)
LEARNING_RATE = 1e-3


def values(layers, rows):
    *hidden, (weights, biases) = layers
    for w, b in hidden:
        rows = jax.nn.relu(rows @ w + b)
    return rows @ weights + biases


def update(replay, state, key):
    layers, target, adam = state
    share = BATCH // DEVICES
    index = jax.random.randint(key, (BATCH,), 0, ROWS - 1)
    index = lax.dynamic_slice(index, (lax.axis_index("device") * share,), (share,))
    now, then = replay[index], replay[index + 1]

    def loss(layers):
        wanted = now[:, 0] + 0.99 * values(target, then).max(-1)
        return ((values(layers, now)[:, 0] - wanted) ** 2).sum() / BATCH

    gradient = jax.grad(loss)(layers)
    if DEVICES > 1:
        gradient = lax.psum(gradient, "device")
    layers, adam = optimizer.descend(layers, gradient, adam, LEARNING_RATE)
    return (layers, target, adam), None


def main():
    first, *rest = jax.random.split(jax.random.key(0), len(SIZES))
    replay = jax.random.normal(first, (ROWS, SIZES[0]))
    layers = [
        (jax.random.normal(key, (a, b)) / a**0.5, jnp.zeros(b))
        for key, a, b in zip(rest, SIZES[:-1], SIZES[1:], strict=True)
    ]
    mesh, whole = Mesh(np.array(jax.devices()), ("device",)), PartitionSpec()

    @jax.jit
    @partial(jax.shard_map, mesh=mesh, in_specs=whole, out_specs=whole, check_vma=False)
    def run(replay, state, keys):
        return lax.scan(partial(update, replay), state, keys)[0]

    state = layers, layers, optimizer.begin(layers)
    keys = jax.random.split(jax.random.key(1), UPDATES)
    seconds = []
    for _ in range(1 + ROUNDS):
        start = time.perf_counter()
        state = jax.block_until_ready(run(replay, state, keys))
        seconds.append((time.perf_counter() - start) / UPDATES)
    print(f"{np.median(seconds[1:]) * 1e6:.0f} µs an update, batch {BATCH}, {DEVICES} device(s)")


if __name__ == "__main__":
    main()
