"""JAX setup, and the placement of a population's members on devices.

A population is a pytree whose leaves have a leading member axis: one member for each seed (or
configuration), spread over the devices. A GPU steps its members in lockstep (vmap). On a CPU each
core is a separate device and runs its members one after another: an agent's weights stay in cache,
its matrix products keep their shape, and its arithmetic does not depend on the number of members,
to the last bit.
"""

import datetime
import os
from collections.abc import Callable
from importlib.metadata import version
from platform import python_version
from threading import Lock
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Array

from qfolio.core.errors import QfolioError
from qfolio.core.files import cache_directory, can_write

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
    """Makes each core a device, compiles for speed, multiplies precisely, keeps programs on disk.

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
        "--xla_force_host_platform_device_count": str(len(cores())),
        "--xla_cpu_multi_thread_eigen": "false",
        "--xla_backend_extra_options": loops,
    }
    new = [f"{flag}={value}" for flag, value in wanted.items() if flag not in flags]
    os.environ["XLA_FLAGS"] = " ".join([flags, *new]).strip()
    if not jax.config.jax_default_matmul_precision:  # type: ignore[attr-defined]
        # GPUs would round the factors to three digits. CPUs compute as before.
        jax.config.update("jax_default_matmul_precision", "highest")
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


def describe() -> str:
    """The number, kind and platform of the devices.

    Raises QfolioError if the platform that the user chose has none.
    """
    try:
        devices = jax.devices()
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


class Members:
    """``count`` members spread over the devices, each in a slot of its device.

    room: number of members to provide slots for, if more than ``count``.
    one_by_one: whether a device runs its members in turn instead of in lockstep.
    form: everything that compiled programs depend on.
    slots: number of slots of all devices.
    taken: number of taken slots of each device, the first argument of compiled programs.

    Outside, leaves have a leading axis of length ``count``; on the devices, an axis of slots.
    ``place`` and ``fetch`` convert between the two.
    """

    def __init__(self, count: int, room: int = 0) -> None:
        self.room = max(count, room)
        self.one_by_one = jax.devices()[0].platform not in LOCKSTEP
        # At least two devices, if there are two, and two slots on each if members take turns: XLA
        # neither divides a program for one device nor keeps an axis of length one, and then rounds
        # differently. An empty slot costs memory, but no time.
        least = 2 if self.one_by_one else 1
        devices = jax.devices()[: max(least, self.room)]
        slots = max(least, -(-self.room // len(devices)))
        self.slots = slots * len(devices)
        self.form = (slots, len(devices), self.one_by_one)
        shares = np.array_split(np.arange(count), len(devices))
        self._slots = np.concatenate([d * slots + np.arange(len(s)) for d, s in enumerate(shares)])
        self._filling = np.concatenate([np.resize(share, slots) for share in shares])
        self._sharding = NamedSharding(
            jax.sharding.Mesh(np.array(devices), ("member",)), PartitionSpec("member")
        )
        taken = np.array([len(share) for share in shares], np.int32)
        self.taken = jax.device_put(taken, self._sharding)

    def place(self, tree: Any) -> Any:
        """Moves leaves with a leading member axis to the devices."""
        slots = jax.tree.map(lambda x: np.asarray(x)[self._filling], tree)
        # Programs return empty arrays undivided, and take them back only like this.
        undivided = NamedSharding(self._sharding.mesh, PartitionSpec())
        return jax.device_put(
            slots, jax.tree.map(lambda x: self._sharding if x.size else undivided, slots)
        )

    def fetch(self, tree: Any) -> Any:
        """Leaves on the devices, as numpy arrays with a leading member axis."""
        return jax.tree.map(lambda x: unkeyed(x)[self._slots], tree)

    def compile(
        self,
        function: Callable[..., Any],
        *example: Any,
        split: int = 1,
        donate: bool = False,
        once: bool = False,
    ) -> Any:
        """Compiles ``function(*members, *shared)`` into a program of ``taken`` and these arguments.

        It serves all populations of the same form, whatever their number of members.

        example: arguments of the shapes to compile for; the first ``split`` of them have an axis of
        slots, the others are the same for all members. donate: reuses the first one's memory.
        once: whether it is to run only once, so that optimizing it would take longer than it saves.
        """

        def on_device(taken: Array, *args: Any) -> Any:
            one = lambda members: function(*members, *args[split:])  # noqa: E731
            members = args[:split]
            return _map(one, members, taken[0]) if self.one_by_one else jax.vmap(one)(members)

        def on_all(taken: Array, *args: Any) -> Any:
            each, same = self._sharding.spec, PartitionSpec()
            return jax.shard_map(
                on_device,
                mesh=self._sharding.mesh,
                in_specs=(each, *[each] * split, *[same] * (len(args) - split)),
                out_specs=each,
                check_vma=False,
            )(taken, *args)

        program = jax.jit(on_all, donate_argnums=1 if donate else ())
        with TRACING:
            lowered = program.lower(self.taken, *example)
        try:
            return lowered.compile(compiler_options=PRODUCTS_ONLY | effort(once=once))
        except jax.errors.JaxRuntimeError as error:
            if "INVALID_ARGUMENT" not in str(error):
                raise
            return lowered.compile()  # this version of XLA has no such option


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
