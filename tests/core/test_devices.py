"""Devices: each core is one, and they do not wait for each other for ever."""

import os
import subprocess
import sys

PROGRAM = """
from qfolio.core import devices
devices.configure()
import jax, jax.numpy as jnp
many = jax.random.normal(jax.random.key(0), (200, 36, 36))
many = many @ jnp.swapaxes(many, 1, 2)
values = jax.jit(lambda x: jnp.linalg.eigh(x)[0])
each = [jax.device_put(many, device) for device in jax.devices()]
for _ in range(100):
    jax.block_until_ready([values(x) for x in each])
"""


def test_batches_of_eigendecompositions_end_on_all_devices_at_once():
    environment = {k: v for k, v in os.environ.items() if k not in ("NPROC", "XLA_FLAGS")}
    subprocess.run([sys.executable, "-c", PROGRAM], env=environment, timeout=120, check=True)
