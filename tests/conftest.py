"""Types are checked in every test.

Compiling takes most of a test's time, so programs are hardly optimized here. The tests marked
``optimized`` learn for long, or compare what whole programs compute to the bit: ``make test-all``
runs them with programs as users have them (QFOLIO_TEST_OPTIMIZED=1).
"""

import ctypes
import gc
import importlib.metadata
import os
import sys
from pathlib import Path

import pytest

import typechecker

gc.disable()  # until all tests are collected, which otherwise takes a third longer

os.environ.setdefault("QFOLIO_CACHE", str(Path(__file__).parents[1] / ".cache"))
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # no window on anybody's screen
if "QFOLIO_TEST_OPTIMIZED" not in os.environ:
    flags = [
        "--xla_backend_optimization_level=0",
        "--xla_llvm_disable_expensive_passes=true",
    ]
    if importlib.metadata.version("jax") < "0.11":  # later versions end the process over this flag
        flags.append("--xla_cpu_use_fusion_emitters=false")
    os.environ["XLA_FLAGS"] = " ".join([os.environ.get("XLA_FLAGS", ""), *flags]).strip()

# Not the adapters: scikit-learn's habit is to take any setting and to check it when fitting.
WINGS = "core solvers learning agents tasks experiments portfolio report commands"
typechecker.install([f"qfolio.{wing}" for wing in WINGS.split()])

import jax  # noqa: E402

from qfolio.agents.dqn import DQN  # noqa: E402
from qfolio.core import devices, registry  # noqa: E402
from qfolio.core.population import programs_of  # noqa: E402
from qfolio.tasks.pendulum import Pendulum  # noqa: E402

devices.configure()

ENOUGH = 1.5 * 2**30  # bytes, of each of two processes


def pytest_collection_finish():
    """Python searches for garbage rarely, and not in what has been imported.

    Tracing makes many objects; with Python's own thresholds, tests take about a tenth longer.
    """
    gc.freeze()
    gc.set_threshold(50_000, 20, 100)
    gc.enable()


@pytest.fixture(autouse=True, scope="module")
def check_types_again():
    typechecker.check_again()


@pytest.fixture(autouse=True, scope="module")
def forget_programs():
    """Programs of earlier files are forgotten before they fill the memory.

    Until then the small ones among them need not be traced and compiled again.
    """
    yield
    programs_of.cache_clear()
    if _memory() > ENOUGH:
        jax.clear_caches()
        gc.collect()
        if sys.platform == "linux":  # glibc keeps what was freed, gigabytes of it
            ctypes.CDLL(None).malloc_trim(0)


def _memory() -> float:
    """Bytes of this process in memory; without limit where the system does not say."""
    if sys.platform != "linux":
        return float("inf")
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.fixture(autouse=True, scope="module")
def forget_modules():
    """What one file has written, imported and so trusted is not there in the next ones."""
    before = set(registry._trusted)
    yield
    registry._trusted.clear()
    registry._trusted.update(before)


@pytest.fixture
def task() -> Pendulum:
    return Pendulum(horizon=25)


@pytest.fixture
def agent() -> DQN:
    """Small enough that compiling it is most of its cost."""
    return DQN(
        hidden=(16,), num_envs=2, batch_size=8, replay_capacity=200, learning_starts=20,
        episode_steps=0, learning_rate_steps=200.0,
    )  # fmt: skip
