"""Workers that are actors of Ray, on a cluster of several nodes on this machine."""

import importlib.util
import os
import pickle
import random
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import jax
import numpy as np
import pytest

from qfolio.core.errors import QfolioError, WorkerError
from qfolio.experiments.budget import Budget
from qfolio.experiments.executor import Executor, Job
from qfolio.experiments.machines import dispatch, rays
from qfolio.experiments.machines.choice import on
from qfolio.experiments.machines.messages import Lost, Ready
from qfolio.experiments.machines.rays import Ray
from qfolio.experiments.machines.schedule import ATTEMPTS
from qfolio.experiments.run import Run

import jobs
from jobs import LIMIT, Add, Die, Fail, Meet, Sleep, alive, silent, wait_until

pytestmark = [
    pytest.mark.filterwarnings("default"),  # Ray's own
]
needs_ray = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("ray") is None, reason='needs pip install "ray[client]"'
    ),
]


def test_without_ray(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(QfolioError, match=r'^Ray is not installed; .*pip install "qfolio\[ray\]"'):
        on("ray")


@pytest.mark.parametrize("address", [None, "127.0.0.1:1"])
def test_a_cluster_that_does_not_answer(address, monkeypatch):
    fake = Mock(is_initialized=lambda: False)
    monkeypatch.setitem(sys.modules, "ray", fake)
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    with pytest.raises(QfolioError, match=r"cluster 127.0.0.1:1 cannot be reached .*=token"):
        rays._connected(address)
    assert not fake.init.called


SLOW = [ConnectionAbortedError("late"), RuntimeError("Starting Ray client server failed. See x")]


@pytest.mark.parametrize(
    ("errors", "calls", "why"),
    [
        (SLOW, 3, None),
        ([*SLOW, SLOW[0]], 3, "late"),
        ([RuntimeError("Python versions differ")], 1, "Python versions differ"),
    ],
)
def test_a_head_that_is_slow_is_asked_again(errors, calls, why, monkeypatch):
    init = Mock(side_effect=[*errors, None])
    fake = Mock(init=init, is_initialized=lambda: False)
    monkeypatch.setitem(sys.modules, "ray", fake)
    if why is None:
        assert rays._connected("ray://x:1") is fake
    else:
        with pytest.raises(QfolioError, match=rf"ray://x:1 cannot be reached \({why}\)"):
            rays._connected("ray://x:1")
    assert init.call_count == calls


@pytest.mark.parametrize("begun", [False, True])
def test_it_is_known_whether_a_lost_worker_may_have_begun_its_job(begun, monkeypatch):
    """One that died idle is noticed only when it is sent a job."""
    nothing, dead = pickle.dumps([]), ConnectionError("its node has died")
    answers = [nothing, pickle.dumps([Ready("x", {})]), *[nothing] * begun, dead]
    fake = Mock(wait=lambda awaited, **_: (awaited, []), get=Mock(side_effect=answers))
    fake.exceptions.RayError = ConnectionError
    monkeypatch.setitem(sys.modules, "ray", fake)
    actors = rays._Actors(Mock(spec=Ray, workers=1, waits=True, devices=1, cpus=1, lockstep=False))
    actors.start(0)
    heard = [said for _ in range(2) for _, said in actors.receive(0.0)]
    actors.send(0, Add("a", 1.0))
    heard += [said for _ in range(1 + begun) for _, said in actors.receive(0.0)]
    assert heard == [Ready("x", {}), Lost("its node has died", begun)]


class Nodes:
    """A cluster of nodes with one core each, and a driver without any."""

    def __init__(self, count):
        import ray
        from ray.cluster_utils import Cluster

        self.ray = ray
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        head = {"num_cpus": 0, "ray_client_server_port": self.port, "include_dashboard": False}
        self.cluster = Cluster(initialize_head=True, head_node_args=head)
        self.nodes = [self.cluster.add_node(num_cpus=1) for _ in range(count)]
        ray.init(address=self.cluster.address, log_to_driver=False)

    def close(self):
        self.ray.shutdown()
        self.cluster.shutdown()


@pytest.fixture(scope="module")
def nodes():
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setenv("PYTHONPATH", str(Path(jobs.__file__).parent), prepend=os.pathsep)
        monkeypatch.setenv("RAY_worker_niceness", "0")  # else they wait for whatever else runs
        started = Nodes(3)
    yield started
    started.close()


class TestRay:
    pytestmark = needs_ray

    @pytest.fixture(autouse=True)
    def patience(self, monkeypatch):
        """A worker gets its place when its process runs, which takes a busy machine long."""
        monkeypatch.setattr(rays, "PLACE", LIMIT)

    def test_large_arrays_reach_each_worker_once(self, nodes, tmp_path):
        executor = on("ray")
        assert isinstance(executor, Executor)
        assert isinstance(executor, Ray)
        assert (executor.workers, executor.devices, executor.lockstep) == (3, 1, False)
        table = np.arange(4000.0)
        work = [Meet(str(i), i, table, tmp_path) for i in range(60)]
        results = {job.name: result for job, result in executor.map(work, silent)}
        for i in range(60):
            np.testing.assert_array_equal(results[str(i)]["sum"], table + i)
        stored = {(result["place"], result["table"]) for result in results.values()}
        places = {place for place, _ in stored}
        assert len(stored) == len(places) > 1
        wait_until(lambda: not any(map(alive, places)))

    @pytest.mark.skipif(
        importlib.util.find_spec("grpc") is None, reason='needs pip install "ray[client]"'
    )
    def test_a_cluster_elsewhere(self, nodes):
        code = (
            "import numpy as np\n"
            "from qfolio.experiments.machines import rays\n"
            "from qfolio.experiments.machines.choice import on\n"
            "from jobs import Add\n"
            f"rays.PLACE = {LIMIT}\n"
            f"executor = on('ray://127.0.0.1:{nodes.port}')\n"
            "work = [Add(str(i), i, np.arange(4000.0)) for i in range(9)]\n"
            "done = {job.name: result for job, result in executor.map(work, lambda job: ())}\n"
            "print(executor.workers, sum(result['sum'][1] for result in done.values()))\n"
        )
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
        done = subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True, text=True, timeout=LIMIT, env=environment, check=False,
        )  # fmt: skip
        assert done.stdout == "3 45.0\n", done.stderr

    def test_a_cluster_that_is_not_there(self):
        done = subprocess.run(
            [sys.executable, "-m", "qfolio", "backtest", "--on", "ray://127.0.0.1:1"],
            capture_output=True, text=True, timeout=LIMIT, check=False,
            env=os.environ | {"RAY_CLIENT_INITIAL_CONNECTION_TIMEOUT_S": "1"},
        )  # fmt: skip
        assert done.returncode == 2
        assert done.stderr.startswith("qfolio: The Ray cluster ray://127.0.0.1:1 cannot be reached")
        assert len(done.stderr.splitlines()) == 1

    def test_a_job_that_kills_every_worker(self, nodes, tmp_path):
        with pytest.raises(QfolioError, match=r"^a was given up, because 3 workers ended"):
            list(on("ray").map([Die("a", tmp_path / "count", 9)], silent))

    def test_workers_killed_twenty_times(self, nodes, tmp_path):
        """At random; each job runs again as often as it lost its worker, and no other does."""
        draw, times = random.Random(0), [0] * 30
        while sum(times) < 20:
            chosen = draw.randrange(30)
            times[chosen] = min(times[chosen] + 1, ATTEMPTS - 1)
        work = [Die(str(i), tmp_path / str(i), often) for i, often in enumerate(times)]
        done = [(job.name, result) for job, result in on("ray").map(work, silent)]
        assert sorted(done) == sorted((job.name, "alive") for job in work)
        ran = [len((tmp_path / job.name).read_text()) for job in work]
        assert ran == [often + 1 for often in times]

    def test_no_place_for_a_worker(self, nodes, monkeypatch):
        with pytest.raises(QfolioError, match="has no node with 2 cores, so no worker can start"):
            Ray(cpus=2)
        monkeypatch.setattr(rays, "PLACE", 3.0)

        class Busy:
            def ready(self):
                return True

        busy: Any = nodes.ray.remote(num_cpus=1)(Busy)
        others = [busy.remote() for _ in nodes.nodes]
        assert all(nodes.ray.get([other.ready.remote() for other in others]))
        message = "No worker got a place within 3 seconds: each asks for 1 core, and of the Ray "
        with pytest.raises(QfolioError, match=f"{message}cluster's 3 cores 0 are free; end"):
            list(on("ray").map([Add("a", 1.0)], silent))
        for other in others:
            nodes.ray.kill(other)

    def test_a_driver_that_is_killed(self, nodes, tmp_path, task, agent, monkeypatch):
        """What it has is kept; resumed, the run equals that of one process to the bit."""
        folder, budget = tmp_path / "run", Budget(400)
        Run.create(task, agent, budget=budget, seeds=4, out=folder)
        code = (
            "import sys\n"
            "from qfolio.experiments.machines import rays\n"
            "from qfolio.experiments.machines.choice import on\n"
            "from qfolio.experiments.run import Run\n"
            f"rays.PLACE, begun = {LIMIT}, []\n"
            "def listen(job, done, share):\n"
            "    begun.append(job)\n"
            "    if len(begun) == 4: sys.stdin.read()\n"  # so that it does not finish them all
            "    return []\n"
            "Run.open(sys.argv[1]).train(executor=on('ray'), listen=listen)\n"
        )
        environment = os.environ | {"RAY_ADDRESS": nodes.cluster.address}
        command = [sys.executable, "-c", code, str(folder)]
        driver = subprocess.Popen(command, stdin=subprocess.PIPE, env=environment)
        try:
            wait_until(lambda: driver.poll() is not None or any((folder / "seeds").glob("[0-9]")))
        finally:
            driver.kill()
            driver.communicate()
        kept = {path.name for path in (folder / "seeds").glob("[0-9]")}
        resumed, asked = Run.open(folder), set[str]()

        def listen(job, done, share):
            asked.add(job.name)
            return []

        resumed.train(executor=on("ray"), listen=listen)
        assert 0 < len(kept) < 4
        assert asked == {f"dqn/{seed}" for seed in range(4)} - {f"dqn/{seed}" for seed in kept}
        alone = Run.create(task, agent, budget=budget, seeds=4)
        alone.train()
        jax.tree.map(
            np.testing.assert_array_equal, alone.population.fetch(), resumed.population.fetch()
        )
        assert (alone.metrics, alone.evaluations) == (resumed.metrics, resumed.evaluations)

    def test_the_error_of_a_job(self, nodes):
        with pytest.raises(QfolioError, match="the loss is not finite"):
            list(on("ray").map([Fail("a")], silent))
        with pytest.raises(WorkerError, match=r"SystemExit: no license"):
            list(on("ray").map([Fail("a", SystemExit("no license"))], silent))

    def test_ctrl_c(self, nodes, tmp_path):
        """With two workers, so that the last job begins when the first is done."""
        names = ("a", "b")

        def press():
            wait_until(lambda: all((tmp_path / name).exists() for name in names))
            os.kill(os.getpid(), signal.SIGINT)

        threading.Thread(target=press).start()
        work: list[Job] = [Add("done", 1.0), *(Sleep(name, tmp_path) for name in names)]
        assert [job.name for job, _ in Ray(workers=2).map(work, silent)] == ["done"]
        places = [int((tmp_path / name).read_text()) for name in names]
        wait_until(lambda: not any(map(alive, places)))

    def test_other_versions_are_refused(self, nodes, monkeypatch):
        monkeypatch.setattr(dispatch, "versions", lambda: {"qfolio": "99"})
        with pytest.raises(QfolioError, match=r"^The worker process \d+ on .* this machine 99;"):
            list(on("ray").map([Add("a", 1.0)], silent))

    def test_a_node_without_qfolio(self, nodes, tmp_path):
        """The other nodes cannot do all that there is to do."""
        (tmp_path / "qfolio").mkdir()
        (tmp_path / "qfolio" / "__init__.py").write_text(
            "raise ModuleNotFoundError(\"No module named 'qfolio'\")"
        )
        bare = nodes.cluster.add_node(
            num_cpus=1, env_vars={"PYTHONPATH": str(tmp_path)}, resources={"bare": 1}
        )
        try:
            with pytest.raises(QfolioError, match=r"has no qfolio; install qfolio .* on all"):
                list(on("ray").map([Sleep(str(i), tmp_path) for i in range(4)], silent))
        finally:
            nodes.cluster.remove_node(bare)

    def test_a_node_that_goes_away(self, nodes, tmp_path):
        """Last, because it stays away: its job runs again on the others."""
        names = [str(i) for i in range(3)]

        def remove():
            wait_until(lambda: all((tmp_path / name).exists() for name in names))
            places = [int((tmp_path / name).read_text()) for name in names]
            nodes.cluster.remove_node(nodes.nodes[0], allow_graceful=False)
            wait_until(lambda: not all(map(alive, places)))
            (tmp_path / "wake").touch()

        threading.Thread(target=remove).start()
        work = [Sleep(name, tmp_path) for name in names]
        results = {job.name: result for job, result in on("ray").map(work, silent)}
        assert sorted(results.values()) == ["begun before", "rested", "rested"]
