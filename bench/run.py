"""Measures qfolio against its peers and its own limits: `make bench`.

Prints tables and writes results.json and results.md; docs/results/benchmarks.md, which takes the
tables over, says what each figure means. Nothing fails because of a figure.
"""

import json
import math
import os
import platform
import re
import statistics
import subprocess
import sys
import tempfile
import venv
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from textwrap import fill
from time import perf_counter, sleep
from typing import Annotated, Any, NamedTuple

ENVIRONMENT = dict(os.environ)
"""For other processes: without the flags that `configure` sets for this one."""

from qfolio.core import devices  # noqa: E402

devices.configure()

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import tyro  # noqa: E402
from jax import lax  # noqa: E402

import assets  # noqa: E402
import replay  # noqa: E402
from qfolio.core.host import HostPopulation  # noqa: E402
from qfolio.core.population import Population  # noqa: E402
from qfolio.core.training import CHUNK  # noqa: E402
from qfolio.experiments.presets import preset  # noqa: E402
from qfolio.tasks.gymnasium import GymnasiumTask  # noqa: E402
from qfolio.tasks.pendulum import Pendulum  # noqa: E402
from race import Contestant, Rates, Ratio, process, race, ratio, timed  # noqa: E402
from workload import EPISODES, families, hosted, layers, products, report  # noqa: E402

HERE = Path(__file__).parent
ROOT = HERE.parent
PEERS = ROOT / ".venv-bench"
PAGE = ROOT / "docs" / "results" / "benchmarks.md"
QFOLIO = Path(sys.executable).with_name("qfolio")
THREADS = (1, 2)


@dataclass(frozen=True)
class Figure:
    """One row of the table; ``low`` and ``high`` are its extremes over the rounds."""

    what: str
    value: float
    form: str  # how the value is written
    low: float | None = None
    high: float | None = None
    target: float | None = None
    at_least: bool = True  # or else at most

    @property
    def reached(self) -> bool | None:
        if self.target is None:
            return None
        return self.value >= self.target if self.at_least else self.value <= self.target

    def row(self) -> list[str]:
        write = self.form.format
        extremes = "" if self.low is None else f"{write(self.low)} to {write(self.high)}"
        target = "" if self.target is None else f"{'≥' if self.at_least else '≤'} "
        target += "" if self.target is None else write(self.target)
        reached = {None: "", True: "yes", False: "no"}[self.reached]
        return [self.what, write(self.value), extremes, target, reached]


@dataclass(frozen=True)
class Effort:
    """How long to measure."""

    quick: bool

    @property
    def rounds(self) -> int:
        return 2 if self.quick else 5

    @property
    def seconds(self) -> float:
        return 0.5 if self.quick else 2.0


Outcome = tuple[list[Figure], Rates]


LIBRARIES = {"stable_baselines3": "stable-baselines3", "sbx": "sbx-rl", "rejax": "rejax"}


def against_peers(effort: Effort) -> Outcome:
    """One agent with the report's settings, here and in other libraries."""
    targets = {"stable_baselines3": 5.0, "sbx": 4.0, "rejax": 1.8}
    return against("dqn", "one agent", agents(1), targets, effort)


def against(
    algorithm: str,
    who: str,
    own: Contestant,
    targets: dict[str, float],
    effort: Effort,
) -> Outcome:
    """An algorithm here and, with one thread and with two, in other libraries."""
    install_peers()
    name = lambda library, threads: spelled(LIBRARIES[library], threads)  # noqa: E731
    with ExitStack() as stack:
        contestants: dict[str, Contestant] = {"qfolio": own}
        for library in targets:
            for threads in THREADS:
                command = [python(PEERS), "-W", "ignore", str(HERE / "peers.py"), library]
                command += ["--algorithm", algorithm, "--threads", str(threads)]
                peer = process(command, ENVIRONMENT)
                contestants[name(library, threads)] = stack.enter_context(peer)
        rates = race(contestants, effort.rounds, effort.seconds)
    figures = []
    for library, target in targets.items():
        best = max(
            (name(library, threads) for threads in THREADS),
            key=lambda name: statistics.median(rates[name]),
        )
        figures.append(times(f"Speed of {who} ÷ {best}", ratio(rates, "qfolio", best), target))
    return figures, rates


def of_families(effort: Effort) -> Outcome:
    """Policy gradients and actor–critics, here and in other libraries, which must be slower."""
    outcomes = {}
    for algorithm, agent in families().items():
        # rejax has no DDPG, and its TD3 stands for both.
        without = {"ddpg": "rejax"}.get(algorithm)
        targets = {library: 1.0 for library in LIBRARIES if library != without}
        own = trained(Population(Pendulum(torques=0), agent, [0]))
        name = algorithm.upper()
        outcomes[name] = against(algorithm, name, own, targets, effort)
    return joined(outcomes)


def of_host_loop(effort: Effort) -> Outcome:
    """Agents in an environment of Gymnasium, here and in stable-baselines3."""
    outcomes = {}
    for contest, agent in hosted().items():
        algorithm, _, environment = contest.partition("-")
        own = trained(HostPopulation(GymnasiumTask(environment), agent, [0]))
        name = f"{algorithm.upper()} on {environment}"
        targets = {"stable_baselines3": 2.0}
        outcomes[name] = against(contest, name, own, targets, effort)
    return joined(outcomes)


def joined(outcomes: dict[str, Outcome]) -> Outcome:
    """Outcomes of several algorithms as one, their rates under the algorithm's name."""
    figures = [figure for found, _ in outcomes.values() for figure in found]
    rates = {
        f"{name}: {who}": speed
        for name, (_, speeds) in outcomes.items()
        for who, speed in speeds.items()
    }
    return figures, rates


def against_products(effort: Effort) -> Outcome:
    """One agent against nothing but the matrix products of its updates."""
    name = "matrix products only"
    rates = race({"qfolio": agents(1), name: matrix_products()}, effort.rounds, effort.seconds)
    share = ratio(rates, "qfolio", name)
    figure = Figure(
        f"Speed of one agent ÷ {name}", share.median, "{:.0%}", share.low, share.high, target=0.7
    )
    return [figure], rates


def on_all_cores(effort: Effort) -> Outcome:
    """Eight agents on all cores against one agent."""
    contestants: dict[str, Contestant] = {"one agent": agents(1), "eight agents": agents(8)}
    eight = f"Speed of eight agents on {os.cpu_count()} cores"
    with ExitStack() as stack:
        if hasattr(os, "sched_setaffinity"):
            one = stack.enter_context(
                process([sys.executable, str(HERE / "pinned.py")], ENVIRONMENT)
            )
            contestants["one agent on one core"] = one
        rates = race(contestants, effort.rounds, effort.seconds)
    return [
        times(f"{eight} ÷ {name}", ratio(rates, "eight agents", name), 1.8)
        for name in ("one agent on one core", "one agent")
        if name in rates
    ], rates


def of_one_run(effort: Effort) -> Outcome:
    """Memory of the report's run, and how soon training begins."""
    episodes = EPISODES // 20 if effort.quick else EPISODES
    with tempfile.TemporaryDirectory() as folder:
        environment = ENVIRONMENT | {"QFOLIO_CACHE": f"{folder}/cache"}
        train = partial(command, "report", seeds=1)
        first, second = (
            first_chunk(train(episodes=3, out=Path(folder, name)), Path(folder, name), environment)
            for name in ("first", "second")
        )
        run = train(episodes=episodes, out=Path(folder, "run"))
        memory = watched(run, environment).megabytes
    most = partial(Figure, at_least=False)
    return [
        most(f"Peak memory of the report's {episodes} episodes", memory, "{:.0f} MB", target=1000),
        most("From typing the command to the first chunk trained", second, "{:.1f} s", target=3.0),
        most("The same, the first time ever (it compiles)", first, "{:.1f} s"),
    ], {}


def of_preset(name: str, effort: Effort) -> Outcome:
    """Seconds and regrets of a preset, over two runs of eight seeds."""
    target = {"fast": (10.0, 0.05)}.get(name, (None, None))
    episodes = preset(name).episodes // (16 if effort.quick else 1)
    summaries = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in (0, 8):
            out = Path(folder, str(seed))
            run = command(name, seeds=8, episodes=episodes, out=out)
            subprocess.run(
                [*run, "--seed", str(seed)], check=True, env=ENVIRONMENT, stdout=subprocess.DEVNULL
            )
            summaries.append(json.loads((out / "summary.json").read_text()))
    seconds = [summary["seconds_train"] for summary in summaries]
    regrets = [regret for summary in summaries for regret in summary["regret_per_seed"]]
    most = partial(Figure, at_least=False)
    return [
        most(
            f"Preset {name}: training eight agents, the slower of two runs",
            max(seconds),
            "{:.1f} s",
            target=target[0],
        ),
        most(
            f"Preset {name}: regret of the worst of 16 agents",
            max(regrets),
            "{:.2%}",
            target=target[1],
        ),
        most(f"Preset {name}: mean regret of 16 agents", statistics.mean(regrets), "{:.2%}"),
    ], {}


def of_replays(effort: Effort) -> Outcome:
    """The backtest's engine, beside those of other libraries."""
    install_peers()
    rates = replay.measure(rounds=effort.rounds, seconds=effort.seconds)
    figures = []
    for name in (n for n in rates if n.startswith("qfolio")):
        ordered = sorted(rate / 1e6 for rate in rates[name])
        what = f"Replay, million asset-days a second: {name.removeprefix('qfolio, ')}"
        middle = statistics.median(ordered)
        figures.append(Figure(what, middle, "{:.0f}", ordered[0], ordered[-1], target=10.0))
    return figures, rates


def of_many_assets(effort: Effort) -> Outcome:
    """Tables of many assets against tables of few: training, a backtest, and reading."""
    few, many = 20, 100 if effort.quick else 1000
    figures: list[Figure] = []
    rates: Rates = {}
    for name in assets.AGENTS:
        of_few, of_many = (f"{name}, {size:,} assets" for size in (few, many))
        contestants = {
            of_few: assets.decisions(trained(assets.population(name, few)), few),
            of_many: assets.decisions(trained(assets.population(name, many)), many),
        }
        speeds = race(contestants, effort.rounds, effort.seconds)
        what = f"Decisions on an asset a second, {name}: {many:,} assets ÷ {few}"
        figures.append(times(what, ratio(speeds, of_many, of_few), 1.0))
        rates |= speeds
    train = ("--train", "7y", "--agents", "dqn", "--seeds", "2")
    small, large = (needs(assets.backtest(size, 2520, *train)).seconds for size in (few, 100))
    read = needs(assets.prices(1000, 500 if effort.quick else 5040)).seconds
    most = partial(Figure, at_least=False)
    return [
        *figures,
        most("Time of a backtest, dqn: 100 assets ÷ 20", large / small, "{:.2f} ×", target=3.0),
        most("qfolio prices, 1,000 assets × 20 years", read, "{:.1f} s", target=5.0),
    ], rates


def of_backtest(
    what: str,
    assets_and_rows: tuple[int, int],
    options: str,
    effort: Effort,
    *,
    daily: bool = True,
    longest: float | None = None,
    largest: float | None = None,
) -> Outcome:
    """A whole backtest of a large table; at most so many minutes and gigabytes are the targets."""
    count, rows = assets_and_rows
    size = max(count // 25, 5) if effort.quick else count
    found = needs(assets.backtest(size, rows, *options.split(), daily=daily))
    minutes, memory = found.seconds / 60, found.megabytes / 1e3
    most = partial(Figure, at_least=False)
    return [
        most(f"Backtest of {what}", minutes, "{:.1f} min", target=longest),
        most("… its memory", memory, "{:.1f} GB", target=largest),
        most("… its report", found.report, "{:.1f} MB", target=10.0),
    ], {}


def spelled(library: str, threads: int) -> str:
    return f"{library}, {threads} thread{'s' * (threads > 1)}"


@cache
def agents(count: int) -> Contestant:
    """That many agents with the report's settings, past all compiling."""
    return trained(Population(*report(), range(count)))


def trained(population: Population) -> Contestant:
    """A population that goes on training, past all compiling."""

    def advance() -> int:
        before = population.steps
        population.advance(CHUNK)
        steps = population.steps - before
        return steps * population.agent.num_envs * len(population.seeds)

    while population.steps <= population.agent.warm_up():
        advance()
    advance()
    return timed(advance)


@cache
def matrix_products() -> Contestant:
    """The products of an update in a loop that does nothing else.

    Each iteration turns the batch's rows on by one, so that no product stays the same, and hands
    the gradients on, so that none is in vain; adding them up would cost passes over memory.
    """
    task, agent = report()
    shapes = layers(task, agent)
    keys = jax.random.split(jax.random.key(0), 2 * len(shapes) + 2)
    online, target = (
        [jax.random.normal(k, s) * s[0] ** -0.5 for k, s in zip(some, shapes, strict=True)]
        for some in (keys[: len(shapes)], keys[len(shapes) : -2])
    )
    now, following = (jax.random.normal(k, (agent.batch_size, shapes[0][0])) for k in keys[-2:])

    def body(_: Any, carry: tuple) -> tuple:
        now, following, _ = carry
        inputs, q_next = [now], following
        for weight in online:
            inputs.append(inputs[-1] @ weight)
        for weight in target:
            q_next = q_next @ weight
        error = inputs.pop() - q_next
        gradients = [inputs[-1].T @ error]
        for weight, x in zip(reversed(online[1:]), reversed(inputs[:-1]), strict=True):
            error = error @ weight.T
            gradients.append(x.T @ error)
        return jnp.roll(now, 1, 0), jnp.roll(following, 1, 0), gradients

    def loop(carry: tuple, steps: jax.Array) -> tuple:
        return lax.fori_loop(0, steps, body, carry)

    carry = (now, following, [jnp.zeros(shape) for shape in reversed(shapes)])
    program = jax.jit(loop).lower(carry, jnp.int32(CHUNK)).compile()
    everywhere, in_loop = count_products(program.as_text() or "")
    assert everywhere == in_loop == products(task, agent), (
        f"The compiler left {in_loop} products inside the loop and {everywhere - in_loop} outside "
        f"of {products(task, agent)}: what this measures is not what an update multiplies."
    )

    def advance() -> int:
        nonlocal carry
        carry = jax.block_until_ready(program(carry, jnp.int32(CHUNK)))
        return CHUNK

    advance()
    return timed(advance)


def count_products(hlo: str) -> tuple[int, int]:
    """Matrix products in a compiled program, and how many of them its loop's body contains."""
    blocks = re.findall(r"^(?:ENTRY )?%([\w.-]+) \(.*?\{\n(.*?)^\}", hlo, re.DOTALL | re.MULTILINE)
    bodies = dict(blocks)

    def count(name: str) -> int:
        text = bodies[name]
        called = re.findall(r"(?:calls|to_apply|body)=%([\w.-]+)", text)
        return len(re.findall(r" dot\(|matmul", text)) + sum(map(count, called))

    (loop,) = re.findall(r"body=%([\w.-]+)", hlo)
    (entry,) = re.findall(r"^ENTRY %([\w.-]+)", hlo, re.MULTILINE)
    return count(entry), count(loop)


def install_peers() -> None:
    """Makes .venv-bench, unless peers.txt has not changed since; with the jax that qfolio uses."""
    done = PEERS / "installed"
    wanted = HERE / "peers.txt"
    if done.exists() and done.stat().st_mtime >= wanted.stat().st_mtime:
        return
    print("Installing the peers into .venv-bench (once).", flush=True)
    venv.create(PEERS, with_pip=True, clear=True)
    # torch comes first and on its own: whichever build of it pip finds then stays.
    torch, *others = wanted.read_text().split()
    for packages in ([torch], [f"jax=={version('jax')}", *others]):
        install = [python(PEERS), "-m", "pip", "install", "--quiet", *packages]
        subprocess.run(install, check=True, env=ENVIRONMENT)
    done.touch()


def python(environment: Path) -> str:
    return str(environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python"))


def command(preset: str, *, seeds: int, episodes: int, out: Path) -> list[str]:
    """What a user types to train."""
    return [
        *(str(QFOLIO), "train", "pendulum", "--preset", preset, "--no-compare"),
        *("--seeds", str(seeds), "--episodes", str(episodes), "--out", str(out)),
    ]


def first_chunk(run: list[str], out: Path, environment: dict[str, str]) -> float:
    """Seconds from a command's start until it has reported its first episodes."""
    start = perf_counter()
    with subprocess.Popen(run, env=environment, stdout=subprocess.DEVNULL) as process:
        while not (out / "metrics.csv").exists():
            if process.poll():
                raise RuntimeError("qfolio train failed; its message is above.")
            sleep(0.005)
        return perf_counter() - start


class Needs(NamedTuple):
    """What a command needed, and what it wrote."""

    seconds: float
    megabytes: float  # the most memory that it held
    report: float = 0.0  # megabytes of its page, if it wrote one


def needs(command: assets.Command) -> Needs:
    """Runs a command of qfolio that writes to a folder."""
    with tempfile.TemporaryDirectory() as folder:
        found = watched([str(QFOLIO), *command(Path(folder))], ENVIRONMENT)
        page = Path(folder, "out", "report.html")
        return found._replace(report=page.stat().st_size / 1e6) if page.exists() else found


def watched(run: list[str], environment: dict[str, str]) -> Needs:
    """Runs a command.

    A process inherits the peak of the one that starts it, so a small one starts it here.
    """
    starter = (
        "import resource, subprocess, sys, time;"
        "begun = time.perf_counter();"
        "subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL);"
        "used = resource.getrusage(resource.RUSAGE_CHILDREN);"
        "print(time.perf_counter() - begun, used.ru_maxrss)"
    )
    result = subprocess.run(
        [sys.executable, "-S", "-c", starter, *run],
        check=True, env=environment, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    unit = 1 if sys.platform == "darwin" else 1024  # bytes there, kibibytes elsewhere
    seconds, peak = result.stdout.split()
    return Needs(float(seconds), int(peak) * unit / 1e6)


def times(what: str, measured: Ratio, target: float) -> Figure:
    return Figure(what, measured.median, "{:.2f} ×", measured.low, measured.high, target)


def machine() -> str:
    processor = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").exists():
        found = re.search(r"model name\s*: (.*)", Path("/proc/cpuinfo").read_text())
        processor = found[1] if found else processor
    software = f"Python {platform.python_version()}, jax {version('jax')}"
    return f"{os.cpu_count()} cores of {processor}; {software}"


def load() -> float:
    """Processes that wanted a core over the last minute."""
    return round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else math.nan


def table(head: list[str], rows: list[list[str]]) -> str:
    """Markdown, aligned so that it reads as text, too; all but the first column to the right."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = ["-" * widths[0], *["-" * (width - 1) + ":" for width in widths[1:]]]
    written = [
        [cell.ljust(w) if i == 0 else cell.rjust(w) for i, (cell, w) in enumerate(cells)]
        for cells in (list(zip(row, widths, strict=True)) for row in (head, lines, *rows))
    ]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in written) + "\n"


def tables(results: dict[str, Any]) -> str:
    """The figures, then the steps a second behind them."""
    figures = [Figure(**f).row() for part in results.values() for f in part["figures"]]
    text = table(["figure", "value", "range", "target", "reached"], figures)
    rates = [
        [who, f"{statistics.median(all):,.0f}", f"{min(all):,.0f} to {max(all):,.0f}"]
        for part in results.values()
        for who, all in part["rates"].items()
    ]
    if rates:
        text += "\n" + table(
            [
                "environment steps (replay: asset-days; assets: decisions) a second",
                "median",
                "range",
            ],
            rates,
        )
    loads: dict[str, list[str]] = {}
    for name, part in results.items():
        loads.setdefault(part["machine"], []).append(f"{part['load']} ({name})")
    measured_on = "\n\n".join(
        fill(f"{machine}; load average before each part: {', '.join(parts)}.", 120)
        for machine, parts in loads.items()
    )
    return f"{text}\n{measured_on}\n"


def write(results: dict[str, Any]) -> None:
    """Replaces the parts that were measured, in the files and between the page's marks."""
    path = HERE / "results.json"
    old = json.loads(path.read_text()) if path.exists() else {}
    merged = {part: (old | results)[part] for part in PARTS if part in old | results}
    path.write_text(json.dumps(merged, indent=2) + "\n")
    text = tables(merged)
    (HERE / "results.md").write_text(text)
    begin, end = "<!-- results: bench/run.py writes what is between these marks -->", "<!-- end -->"
    before, _, rest = PAGE.read_text().partition(begin)
    _, _, after = rest.partition(end)
    PAGE.write_text(f"{before}{begin}\n\n{text}\n{end}{after}")


PARTS: dict[str, Callable[[Effort], Outcome]] = {
    "a": against_peers,
    "b": against_products,
    "c": on_all_cores,
    "d": of_one_run,
    "e": partial(of_preset, "fast"),
    "families": of_families,
    "host": of_host_loop,
    "replay": of_replays,
    "assets": of_many_assets,
    "best": partial(of_preset, "best"),
    "universe": partial(
        of_backtest, "500 assets × 20 years, default agents", (500, 5040), "--train 7y",
        longest=20.0, largest=6.0,
    ),
    "market": partial(
        of_backtest, "3,000 assets × 10 years, tilts, 1 seed, 1 fold", (3000, 2520),
        "--train 7y --test 3y --agents tilts --seeds 1",
    ),
    "minutes": partial(
        of_backtest, "10 assets × 200,000 minutes, default agents", (10, 200_000),
        "--train 120000d --test 40000d", daily=False,
    ),
}  # fmt: skip

LONG = ("best", "universe", "market", "minutes")
USUAL = tuple(name for name in PARTS if name not in LONG)


def main(
    only: Annotated[tuple[str, ...], tyro.conf.arg(metavar="PART …")] = USUAL,
    long: bool = False,
    quick: bool = False,
) -> None:
    """Measure qfolio against its peers and its own limits.

    Args:
        only: Parts to run: a (peers), b (matrix products), c (cores), d (memory and start),
            e (preset fast), families (PPO, SAC, TD3 and DDPG), host (environments of Gymnasium),
            replay (the backtest's engine), assets (many against few).
        long: Run best (preset best) and backtests of large tables (universe, market, minutes), too.
        quick: Short rounds and short runs, to see that all works; leaves the files as they are.
    """
    chosen = [part for part in PARTS if part in only or (long and part in LONG)]
    results: dict[str, Any] = {}
    for part in chosen:
        busy = load()
        figures, rates = PARTS[part](Effort(quick))
        results[part] = {
            "machine": machine(),
            "load": busy,
            "figures": [asdict(figure) for figure in figures],
            "rates": rates,
        }
        print(tables({part: results[part]}), flush=True)
        if not quick:
            write(results)


if __name__ == "__main__":
    tyro.cli(main)
