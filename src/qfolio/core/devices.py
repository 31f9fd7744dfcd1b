"""JAX setup, and the placement of a population's members on devices.

A population is a pytree whose leaves have a leading member axis: one member for each seed (or
configuration). Its members are divided among places: the GPUs, or the cores of the CPU. A GPU steps
its members in lockstep (vmap). On a CPU each core runs its members one after another: an agent's
weights stay in cache, its matrix products keep their shape, and its arithmetic does not depend on
the number of members, to the last bit. All cores run one program, compiled for one device, so that
it does not depend on the number of cores either; XLA would compile a program for several devices in
another way.
"""

import datetime
import os
from collections.abc import Callable
from concurrent.futures import Future
from importlib.metadata import version
from platform import python_version
from threading import Lock, Thread
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import SingleDeviceSharding
from jax.stages import Compiled, Lowered
from jaxtyping import Array

from qfolio.core import products
from qfolio.core.errors import QfolioError
from qfolio.core.files import cache_directory, can_write

T = TypeVar("T")

LOCKSTEP = {"gpu", "tpu"}
"""Platforms that step their members in lockstep."""

SMALL_LOOP = 20_000_000
"""Most bytes that a loop may touch for XLA to compile it into one CPU function. It launches each
operation of a larger loop separately, and splits those over threads that have a large operand. If a
step reads a few rows of a large table, that takes as long as the operations. With 100 MB, loops
with a mandate's projections would take minutes to compile."""

UNROLLED = 16
"""Most rounds of a loop that LLVM may replace by as many copies of its body. It does so before it
looks for vector instructions, and then finds none: without this limit, an operation on a row of 20
numbers takes longer than on one of 64, and programs take longer to compile."""

TRACING = Lock()
"""Held while a program is traced. Tracing is done in Python, where two threads slow each other. In
turn, the second traces while the first compiles."""

PRODUCTS_ONLY: dict[str, str | bool] = {
    "xla_cpu_experimental_ynn_fusion_type": "LIBRARY_FUSION_TYPE_INDIVIDUAL_DOT"
}
"""Leaves only matrix products to YNNPACK, a library that XLA calls on a CPU. By default sums, and
what is summed, go to it as well; for small arrays its call takes longer than the sum. An option of
the compiler instead of a flag, because a version that does not know a flag ends the process."""


def configure() -> None:
    """Compiles for speed, multiplies precisely, and keeps programs on disk.

    Has an effect only before jax first computes; settings that the user has made are kept. Raises
    QfolioError if one of them is for double precision.
    """
    if jax.config.jax_enable_x64:  # type: ignore[attr-defined]
        raise QfolioError(
            "qfolio computes in single precision, but JAX_ENABLE_X64 (jax_enable_x64) is set; "
            "unset it."
        )
    flags = os.environ.get("XLA_FLAGS", "")
    loops = (
        f"xla_cpu_small_while_loop_byte_threshold={SMALL_LOOP},-unroll-full-max-count={UNROLLED}"
    )
    wanted = {
        "--xla_cpu_multi_thread_eigen": "false",
        "--xla_backend_extra_options": loops,
    }
    new = [f"{flag}={value}" for flag, value in wanted.items() if flag not in flags]
    os.environ["XLA_FLAGS"] = " ".join([flags, *new]).strip()
    if not jax.config.jax_default_matmul_precision:  # type: ignore[attr-defined]
        # GPUs would round the factors to three digits. CPUs compute as before.
        jax.config.update("jax_default_matmul_precision", "highest")
    products.register()
    programs = cache_directory() / "programs"
    # Where nothing can be written, jax would warn in each run.
    if not jax.config.jax_compilation_cache_dir and can_write(programs):  # type: ignore[attr-defined]
        jax.config.update("jax_compilation_cache_dir", str(programs))
        # Small programs, too: compiling a dozen of them takes half a second of a command's start.
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def effort(*, once: bool) -> dict[str, str | bool]:
    """Options of the compiler: half the effort for a program that runs once, with equal results."""
    level = "xla_backend_optimization_level"
    return {level: "1"} if once and level not in os.environ.get("XLA_FLAGS", "") else {}


def cores() -> list[int]:
    """The numbers of the CPU cores that this process may use."""
    known = hasattr(os, "sched_getaffinity")
    return sorted(os.sched_getaffinity(0)) if known else list(range(os.cpu_count() or 1))


def places() -> list[jax.Device]:
    """Where members are trained side by side: each GPU, or the CPU once for each of its cores.

    NPROC, which bounds XLA's own threads, bounds the number of cores, too.
    """
    devices = jax.devices()
    if devices[0].platform in LOCKSTEP:
        return devices
    limit = os.environ.get("NPROC", "")
    count = len(cores())
    return devices[:1] * (min(count, max(1, int(limit))) if limit.isdigit() else count)


def describe() -> str:
    """The number of places, and kind and platform of their devices.

    Raises QfolioError if the platform that the user chose has none.
    """
    try:
        devices = places()
    except (AssertionError, RuntimeError):  # the first without the plugin of a platform
        if not (platforms := os.environ.get("JAX_PLATFORMS")):
            raise
        raise QfolioError(
            f"jax finds no device of JAX_PLATFORMS={platforms}; unset it, or install jax for this "
            "platform."
        ) from None
    return f"{len(devices)} × {devices[0].device_kind} ({devices[0].platform})"


def circumstances(*programs: str) -> dict[str, Any]:
    """Device, versions and start time of a run, for its record on disk.

    programs: names of libraries, or "python", whose versions are included.
    """
    versions = {name: python_version() if name == "python" else version(name) for name in programs}
    return {
        "device": describe(),
        **({"versions": versions} if programs else {}),
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def host_memory() -> int | None:
    """The machine's memory in bytes; None where the system does not say."""
    if not hasattr(os, "sysconf"):
        return None
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def require_memory(tree: Any, count: int) -> None:
    """Raises QfolioError if ``count`` states shaped like ``tree`` exceed the devices' memory."""
    needed = count * sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(tree))
    stats = jax.devices()[0].memory_stats()
    used = min(len(jax.devices()), count)
    there = stats["bytes_limit"] * used if stats else host_memory()
    if there is not None and needed > there:
        raise QfolioError(
            f"These settings need {needed / 2**30:,.1f} GiB of memory, but only "
            f"{there / 2**30:,.1f} are there; lower the number of seeds, or whichever of "
            "hidden and replay_capacity the agent has."
        )


def compiled(lowered: Lowered, *, once: bool = False) -> Compiled:
    """Compiles a program; once: whether it is to run only once."""
    try:
        return lowered.compile(compiler_options=PRODUCTS_ONLY | effort(once=once))
    except jax.errors.JaxRuntimeError as error:
        if "INVALID_ARGUMENT" not in str(error):
            raise
        return lowered.compile()  # this version of XLA has no such option


class Program:
    """A program that is compiled once for each device."""

    def __init__(self, compile: Callable[[jax.Device], Compiled]) -> None:
        self._compile, self._lock = compile, Lock()
        self._on: dict[jax.Device, Compiled] = {}

    def on(self, device: jax.Device) -> Compiled:
        """The program for a device, which is compiled when it is first asked for."""
        with self._lock:
            if device not in self._on:
                self._on[device] = self._compile(device)
            return self._on[device]

    @property
    def shapes(self) -> Any:
        """Shapes and types of what it computes in one place."""
        return next(iter(self._on.values())).out_info


class Members:
    """``count`` members divided among places, each in a slot of its place.

    room: number of members to provide slots for, if more than ``count``.
    one_by_one: whether a place runs its members in turn instead of in lockstep.
    form: everything that compiled programs depend on.
    slots: number of slots of all places.

    Outside, leaves have a leading axis of length ``count``. On the devices there is a tree for each
    place, whose leaves have an axis of slots. ``place`` and ``fetch`` convert between the two.
    """

    def __init__(self, count: int, room: int = 0) -> None:
        room = max(count, room)
        self.one_by_one = jax.devices()[0].platform not in LOCKSTEP
        self._places = places()[:room]
        # At least two slots if members take turns: XLA does not keep an axis of length one, and
        # then rounds differently. An empty slot costs memory, but no time.
        slots = max(2 if self.one_by_one else 1, -(-room // len(self._places)))
        self.slots = slots * len(self._places)
        self.form = (slots, self.one_by_one)
        self._shares = np.array_split(np.arange(count), len(self._places))

    def place(self, tree: Any) -> list[Any]:
        """Moves leaves with a leading member axis to the places; empty slots repeat a member."""
        filling = [np.resize(share, self.form[0]) for share in self._shares]
        return [
            jax.device_put(jax.tree.map(lambda x, at=at: np.asarray(x)[at], tree), device)
            for at, device in zip(filling, self._places, strict=True)
        ]

    def share(self, tree: Any) -> list[Any]:
        """What all members have in common, at each place; places of one device share its memory."""
        there = {device: jax.device_put(tree, device) for device in dict.fromkeys(self._places)}
        return [there[device] for device in self._places]

    def fetch(self, trees: list[Any]) -> Any:
        """What is at the places, as numpy arrays with a leading member axis."""
        taken = [len(share) for share in self._shares]

        def joined(*leaves: Any) -> np.ndarray:
            return np.concatenate([unkeyed(x)[:n] for x, n in zip(leaves, taken, strict=True)])

        return jax.tree.map(joined, *trees)

    def compile(
        self,
        function: Callable[..., Any],
        *example: Any,
        split: int = 1,
        donate: bool = False,
        once: bool = False,
    ) -> Program:
        """Compiles ``function(*members, *shared)`` into a program for ``run``.

        It serves all populations of the same form, whatever their number of members and places.

        example: arguments of one place, of the shapes to compile for; the first ``split`` of them
        have an axis of slots, the others are the same for all members. donate: reuses the first
        one's memory. once: whether it is to run only once, so that optimizing it would take longer
        than it saves.
        """
        shapes = jax.eval_shape(lambda *args: args, *example)

        def in_place(taken: Array, *args: Any) -> Any:
            one = lambda members: function(*members, *args[split:])  # noqa: E731
            members = args[:split]
            return _map(one, members, taken) if self.one_by_one else jax.vmap(one)(members)

        program = jax.jit(in_place, donate_argnums=1 if donate else ())

        def compile(device: jax.Device) -> Compiled:
            sharding = SingleDeviceSharding(device)
            there = jax.tree.map(lambda x: x.update(sharding=sharding), shapes)
            with TRACING:
                lowered = program.lower(np.int32(0), *there)
            return compiled(lowered, once=once)

        made = Program(compile)
        for device in self._places:  # a further GPU takes the program from the cache on disk
            made.on(device)
        return made

    def run(self, program: Program, *args: list[Any]) -> list[Any]:
        """What the program computes at each place, from arguments that have a tree for each.

        The places work side by side, each in a thread: jax runs what one thread starts on the CPU
        one after another.
        """

        def call(place: int) -> Any:
            start = program.on(self._places[place])
            taken = np.int32(len(self._shares[place]))
            return jax.block_until_ready(start(taken, *(arg[place] for arg in args)))

        return side_by_side(call, len(self._places))


def side_by_side(call: Callable[[int], T], count: int) -> list[T]:
    """``call(0)``, ``call(1)``, …, each in a thread of its own.

    All of them end first if one fails, or on Ctrl-C: at its exit, Python would wait for a thread
    that is still inside jax, and a second Ctrl-C would then crash the process.
    """
    found: list[Future[T]] = [Future() for _ in range(count)]

    def complete(i: int) -> None:
        try:
            found[i].set_result(call(i))
        except BaseException as error:
            found[i].set_exception(error)

    # Not a pool of threads, which takes no more work once the main thread has ended.
    threads = [Thread(target=complete, args=(i,)) for i in range(count)]
    for thread in threads:
        thread.start()
    interrupt = None
    while any(thread.is_alive() for thread in threads):
        try:
            for thread in threads:
                thread.join()
        except KeyboardInterrupt as error:
            interrupt = error
    if interrupt is not None:
        raise interrupt
    return [each.result() for each in found]


def unkeyed(leaf: Any) -> np.ndarray:
    """A leaf as an array of numpy, which has no random keys: those become their numbers."""
    return np.asarray(jax.random.key_data(leaf) if _is_key(leaf) else leaf)


def keyed(tree: Any, like: Any) -> Any:
    """A tree whose numbers become random keys again where ``like`` has keys."""
    wrap = jax.random.wrap_key_data
    again = lambda x, old: wrap(x, impl=jax.random.key_impl(old)) if _is_key(old) else x  # noqa: E731
    return jax.tree.map(again, tree, like)


def _is_key(leaf: Any) -> bool:
    return isinstance(leaf, Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def _map(function: Callable[[Any], Any], members: Any, count: Array) -> Any:
    """``lax.map`` over the first ``count`` members only."""
    at = lambda i: jax.tree.map(lambda x: lax.dynamic_index_in_dim(x, i, 0, False), members)  # noqa: E731
    function = jax.jit(function, inline=True)  # traced once, here and below
    shapes = jax.eval_shape(function, at(0))
    length = jax.tree.leaves(members)[0].shape[0]
    results = jax.tree.map(lambda x: jnp.zeros((length, *x.shape), x.dtype), shapes)

    def body(i: Array, results: Any) -> Any:
        put = lambda all, one: lax.dynamic_update_index_in_dim(all, one, i, 0)  # noqa: E731
        return jax.tree.map(put, results, function(at(i)))

    return lax.fori_loop(0, count, body, results)
