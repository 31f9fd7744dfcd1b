"""What is asked of jax before it computes."""

import ast
import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from platform import python_version
from types import SimpleNamespace

import jax
import pytest

from qfolio.core import devices
from qfolio.core.errors import QfolioError
from qfolio.experiments.machines import worker


def test_double_precision_is_refused():
    with jax.enable_x64(True), pytest.raises(QfolioError, match=r"JAX_ENABLE_X64 .* is set; unset"):
        devices.configure()


@pytest.mark.parametrize("error", [AssertionError(), RuntimeError("Unable to initialize backend")])
def test_a_platform_without_a_device_is_named(monkeypatch, error):
    def none():
        raise error

    monkeypatch.setattr(jax, "devices", none)
    monkeypatch.setenv("JAX_PLATFORMS", "banana")
    with pytest.raises(QfolioError, match="no device of JAX_PLATFORMS=banana; unset it"):
        devices.describe()


def test_a_worker_has_its_own_number_of_cores(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_a=1")
    assert worker.environment(2) == {"XLA_FLAGS": "--xla_a=1", "NPROC": "2"}


def test_nproc_bounds_the_places(monkeypatch):
    monkeypatch.setattr(devices, "cores", lambda: [3, 5, 8])
    for limit, count in {"": 3, "1": 1, "2": 2, "0": 1, "64": 3, "many": 3}.items():
        monkeypatch.setenv("NPROC", limit)
        assert len(devices.places()) == count


@pytest.mark.parametrize(
    "first",
    [
        "from qfolio.portfolio.synthetic.merton import Merton; Merton()",
        "from qfolio import Portfolio; Portfolio.blank(3, 0)",
        "from qfolio import DQN, Backtest; DQN()",
    ],
)
def test_jax_is_set_up_before_the_first_array_of_a_task(first, tmp_path):
    """Whatever is made first, as jax takes no settings of devices after its first array."""
    code = (
        f"{first}\n"
        "import jax; from qfolio.core import devices\n"
        "assert len(devices.places()) == len(devices.cores())\n"
        "print(jax.config.jax_default_matmul_precision, jax.config.jax_compilation_cache_dir)\n"
    )
    unset = {"NPROC", "XLA_FLAGS", "JAX_COMPILATION_CACHE_DIR"}
    plain = {key: value for key, value in os.environ.items() if key not in unset}
    done = subprocess.run(
        [sys.executable, "-c", code], env=plain | {"QFOLIO_CACHE": str(tmp_path)},
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.stdout.strip() == f"highest {tmp_path / 'programs'}", done.stderr


def test_what_the_user_has_set_for_jax_is_kept(tmp_path):
    own = {
        "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=true",
        "JAX_DEFAULT_MATMUL_PRECISION": "bfloat16",
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "mine"),
    }
    code = (
        "import os, jax; from qfolio.core import devices; devices.configure()\n"
        "print(jax.config.jax_default_matmul_precision, jax.config.jax_compilation_cache_dir)\n"
        "print(os.environ['XLA_FLAGS'])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | own, capture_output=True, text=True
    )
    config, flags = done.stdout.splitlines()
    assert config == f"bfloat16 {tmp_path / 'mine'}"
    assert flags.count("--xla_cpu_multi_thread_eigen") == 1
    assert "--xla_cpu_multi_thread_eigen=true" in flags


@pytest.mark.parametrize(
    ("once", "flags", "options"),
    [
        (True, "", {"xla_backend_optimization_level": "1"}), (False, "", {}),
        (True, "--xla_backend_optimization_level=2", {}),
    ],
)  # fmt: skip
def test_what_runs_once_is_compiled_with_less_effort(monkeypatch, once, flags, options):
    monkeypatch.setenv("XLA_FLAGS", flags)
    assert devices.effort(once=once) == options


def test_a_compiler_without_an_option_compiles_without_it():
    made = jax.jit(lambda x: x).lower(1.0).compile()

    class Lowered(jax.stages.Lowered):
        def __init__(self, message):
            self.message = message

        def compile(self, compiler_options=None, **more):
            if compiler_options:
                raise jax.errors.JaxRuntimeError(self.message)
            return made

    assert devices.compiled(Lowered("INVALID_ARGUMENT: No such compile option")) is made
    with pytest.raises(jax.errors.JaxRuntimeError, match="RESOURCE_EXHAUSTED"):
        devices.compiled(Lowered("RESOURCE_EXHAUSTED: Out of memory"))


def test_a_run_says_which_versions_it_had():
    told = devices.circumstances("python", "jax")
    assert told["versions"] == {"python": python_version(), "jax": jax.__version__}
    assert "versions" not in devices.circumstances()


def test_without_a_cache_that_can_be_written_nothing_is_said():
    code = "import qfolio, jax; qfolio.DQN(); print(jax.config.jax_compilation_cache_dir)"
    plain = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", f"{code}; jax.numpy.ones(3).sum()"],
        env=plain | {"QFOLIO_CACHE": f"{os.devnull}/none"}, capture_output=True, text=True,
    )  # fmt: skip
    assert (done.stdout, done.stderr) == ("None\n", "")


def test_memory_counts_every_slot(monkeypatch):
    """On a CPU a place has two at least."""
    members = devices.Members(1)
    assert members.slots == 2
    state = jax.ShapeDtypeStruct((2**18,), "float32")  # 1 MiB
    monkeypatch.setattr(devices, "host_memory", lambda: 2**20 * members.slots)
    devices.require_memory(state, members.slots)
    monkeypatch.setattr(devices, "host_memory", lambda: 2**20)
    with pytest.raises(QfolioError, match=r"need 0\.0 GiB"):
        devices.require_memory(state, members.slots)


def test_memory_is_that_of_the_devices_that_have_a_member(monkeypatch):
    """Of two with 1 MiB each."""
    gpu = SimpleNamespace(memory_stats=lambda: {"bytes_limit": 2**20})
    monkeypatch.setattr(jax, "devices", lambda: [gpu, gpu])
    half, whole, double = (jax.ShapeDtypeStruct((n * 2**17,), "float32") for n in (1, 2, 4))
    for state, count, fits in (
        (half, 4, True), (half, 5, False), (whole, 2, True), (double, 1, False),
    ):  # fmt: skip
        with contextlib.nullcontext() if fits else pytest.raises(QfolioError, match="of memory"):
            devices.require_memory(state, count)


@pytest.mark.parametrize(("count", "room"), [(1, 5), (5, 1), (5, 0)])
def test_there_is_a_slot_for_every_member_and_for_those_to_come(count, room):
    assert devices.Members(count, room).slots >= 5


def test_gpus_divide_members_among_them():
    """Two devices of the CPU stand for two GPUs."""
    code = (
        "import jax; from qfolio.core import devices; devices.LOCKSTEP = {'cpu'}\n"
        "from qfolio import DQN; from qfolio.core.population import Population\n"
        "from qfolio.tasks.pendulum import Pendulum\n"
        "agent = DQN(hidden=(8,), batch_size=8, replay_capacity=99, learning_starts=9)\n"
        "population = Population(Pendulum(horizon=9), agent, range(3))\n"
        "population.advance(9); population.advance(9)\n"
        "print([{x.device.id for x in jax.tree.leaves(s)} for s in population._states])\n"
        "print([len(s.steps) for s in population._states])\n"
        "print(population.fetch().agent.online.mlp.weights[0].sum((1, 2)).tolist())\n"
    )
    told = []
    for count in (1, 2):
        flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={count}"
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True,
            env=os.environ | {"XLA_FLAGS": flags},
        )  # fmt: skip
        told.append([ast.literal_eval(line) for line in done.stdout.splitlines()])
    alone, two = told
    assert alone[:2] == [[{0}], [3]]
    assert two[:2] == [[{0}, {1}], [2, 2]]
    assert two[2] == pytest.approx(alone[2], abs=1e-5)


def test_all_places_end_before_ctrl_c_does():
    """And before an exception of one of them: their threads would be inside jax."""
    ended = list[int]()

    def call(place):
        time.sleep(0.2 * place)
        ended.append(place)
        if place == 1:
            raise ValueError("one")

    with pytest.raises(ValueError, match="one"):
        devices.side_by_side(call, 3)
    assert ended == [0, 1, 2]

    def wait(place):
        time.sleep(0.5 * place)
        ended.append(place)

    ended.clear()
    main = threading.main_thread().ident
    assert main is not None
    threading.Timer(0.1, signal.pthread_kill, (main, signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        devices.side_by_side(wait, 3)
    assert ended == [0, 1, 2]
    assert devices.side_by_side(lambda place: place, 1) == [0]
