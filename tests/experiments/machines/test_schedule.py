"""The scheduler, without processes; in the simulation, with a clock that jumps."""

import contextlib
import heapq
import random
import threading
import time
from dataclasses import dataclass, field

import pytest

from qfolio.core.errors import QfolioError
from qfolio.experiments.machines.dispatch import dispatch, drive
from qfolio.experiments.machines.messages import Done, Failed, Lost, Ready, versions
from qfolio.experiments.machines.schedule import ATTEMPTS, Schedule


@dataclass(frozen=True)
class Job:
    name: str
    seconds: float = 1.0

    def run(self, listeners):
        raise AssertionError("nobody runs it here")


def given(schedule, worker):
    job = schedule.give(worker)
    return None if job is None else job.name


def test_jobs_go_out_in_order_and_a_lost_one_first():
    schedule = Schedule(Job(name) for name in "abc")
    assert [given(schedule, worker) for worker in (0, 1)] == ["a", "b"]
    assert schedule.lose(0, "x")
    assert [given(schedule, worker) for worker in (2, 3, 4)] == ["a", "c", None]
    assert [schedule.finish(worker).name for worker in (1, 3)] == ["b", "c"]
    assert not schedule.finished
    assert schedule.finish(2).name == "a"
    assert schedule.finished


def test_jobs_that_are_not_known_yet():
    come = iter([Job("a"), None, None, Job("b")])
    schedule = Schedule(come)
    assert [given(schedule, worker) for worker in (0, 1, 1)] == ["a", None, None]
    schedule.finish(0)
    assert not schedule.finished
    assert [given(schedule, worker) for worker in (1, 0)] == ["b", None]
    schedule.finish(1)
    assert schedule.finished


def test_a_job_that_ends_every_worker_is_given_up():
    schedule = Schedule([Job("dqn/2001"), Job("other")])
    for attempt in range(ATTEMPTS - 1):
        assert given(schedule, attempt) == "dqn/2001"
        assert schedule.lose(attempt, "SIGKILL")
    schedule.give(9)
    with pytest.raises(QfolioError, match=r"^dqn/2001 was given up, because 3 workers.*SIGKILL"):
        schedule.lose(9, "SIGKILL")


def test_a_job_is_not_to_blame_for_workers_that_had_not_begun_it():
    schedule = Schedule([Job("a")])
    for worker in range(2 * ATTEMPTS):
        assert given(schedule, worker) == "a"
        assert schedule.lose(worker, "its node has died", begun=False)
    assert given(schedule, 9) == "a"


def test_a_place_where_no_worker_starts_is_left():
    schedule = Schedule([Job("a")])
    assert [schedule.lose(0, "") for _ in range(ATTEMPTS)] == [True, True, False]
    assert schedule.lose(1, "")
    schedule.start(1)  # which counts anew
    assert schedule.lose(1, "")


@dataclass
class Simulated:
    """Workers on a clock of their own; some are lost in the middle of a job.

    lost: the share of jobs that end their worker. start: seconds of a start. broken: places where
    none starts.
    """

    count: int
    lost: float = 0.0
    start_seconds: float = 20.0
    broken: frozenset[int] = frozenset()
    versions: dict[str, str] = field(default_factory=versions)
    now: float = 0.0
    worked: float = 0.0

    def __post_init__(self):
        self.random, self.events, self.starts = random.Random(0), [], 0
        self.runs: dict[str, int] = {}

    def after(self, seconds, worker, message):
        heapq.heappush(self.events, (self.now + seconds, len(self.events), worker, message))

    def start(self, worker):
        self.starts += 1
        if worker in self.broken:
            self.after(self.start_seconds, worker, Lost("no such node"))
        else:
            self.after(self.start_seconds, worker, Ready(f"worker {worker}", self.versions))

    def send(self, worker, job):
        self.runs[job.name] = self.runs.get(job.name, 0) + 1
        if self.random.random() < self.lost:
            self.after(self.random.random() * job.seconds, worker, Lost("its node went away"))
        else:
            self.worked += job.seconds
            self.after(job.seconds, worker, Done(f"result of {job.name}"))

    def receive(self, seconds):
        self.now, _, worker, message = heapq.heappop(self.events)
        return [(worker, message)]


def simulate(workers, jobs):
    """The results by name, and the seconds that the driver computed."""
    begun = time.process_time()
    run = dispatch(lambda: contextlib.nullcontext(workers), jobs, lambda job: ())
    results = [(job.name, result) for job, result in run]
    assert len(results) == len(dict(results))
    return dict(results), time.process_time() - begun


def test_ten_thousand_jobs_on_two_hundred_workers_that_fail():
    draw = random.Random(1)
    jobs = [Job(f"agent/{i}", draw.expovariate(1 / 60)) for i in range(10_000)]
    workers = Simulated(200, lost=0.02, broken=frozenset({7, 8}))
    results, seconds = simulate(workers, jobs)
    assert results == {job.name: f"result of {job.name}" for job in jobs}
    again = sum(workers.runs.values()) - len(jobs)
    assert 100 < again < 400  # those of lost workers only
    assert workers.starts == 200 + again + 2 * (ATTEMPTS - 1)
    # All but the two broken places are busy, except for starts, losses and the last jobs.
    assert workers.worked / (workers.now * 198) > 0.85
    assert seconds / len(jobs) < 2e-3  # of the driver; about 0.01 ms on one core


def test_a_longer_list_costs_no_more_for_each_job():
    """Nothing that the driver does for a job depends on how many there are."""

    def cost(count):
        jobs = [Job(str(i)) for i in range(count)]
        return min(simulate(Simulated(50), jobs)[1] for _ in range(3)) / count

    few, many = cost(2000), cost(16_000)
    assert many < 4 * few


def test_no_more_workers_than_jobs():
    workers = Simulated(200)
    simulate(workers, [Job("a"), Job("b")])
    assert workers.starts == 2
    workers = Simulated(3)
    assert simulate(workers, [])[0] == {}
    assert workers.starts == 0


def test_a_place_is_used_as_soon_as_there_is_a_job_for_it():
    """In a later batch, too, if the first was smaller; one that waits for jobs comes first."""
    batches = [[Job("first")], [Job("alone")], [Job(f"later/{i}") for i in range(8)]]

    def jobs():
        given = 0
        for batch in batches:
            yield from batch
            given += len(batch)
            while len(finished) < given:
                yield None

    class Noting(Simulated):
        def send(self, worker, job):
            ran[job.name] = worker
            super().send(worker, job)

        def receive(self, seconds):
            return super().receive(seconds) if self.events else []

    finished, ran, workers = list[str](), dict[str, int](), Noting(4, start_seconds=0.5)
    run = dispatch(lambda: contextlib.nullcontext(workers), jobs(), lambda job: ())
    for job, _ in run:
        finished.append(job.name)
    assert (ran["first"], ran["alone"]) == (0, 0)
    assert [name for name in ran if name.startswith("later")] == [f"later/{i}" for i in range(8)]
    assert set(ran.values()) == {0, 1, 2, 3}
    assert workers.starts == 4


def test_places_where_none_starts_are_left_while_more_jobs_wait_than_places():
    """Two jobs wait for the one place that is left, and one runs."""

    class Together(Simulated):
        """Says at once what happens at the same time."""

        def receive(self, seconds):
            heard = super().receive(seconds)
            while self.events and self.events[0][0] == self.now:
                heard += super().receive(seconds)
            return heard

    def jobs():
        yield Job("long", 1000.0)
        yield None
        yield from (Job("b"), Job("c"))

    workers = Together(4, broken=frozenset({1, 2}))
    assert simulate(workers, jobs())[0].keys() == {"long", "b", "c"}
    assert workers.starts == 2 + 2 * ATTEMPTS


def test_a_good_place_is_tried_after_a_broken_one():
    """The first batch needs one place only."""
    workers = Simulated(4, broken=frozenset({0}))
    assert simulate(workers, [Job("a")])[0] == {"a": "result of a"}
    assert workers.starts == ATTEMPTS + 1
    with pytest.raises(QfolioError, match="No worker stays alive"):
        simulate(Simulated(3, broken=frozenset({0, 1, 2})), [Job("a")])


def test_jobs_are_taken_when_a_worker_is_free():
    taken = []

    def jobs():
        for i in range(10):
            taken.append(i)
            yield Job(str(i))

    workers = Held(2)
    run = dispatch(lambda: contextlib.nullcontext(workers), jobs(), lambda job: ())
    next(run)
    assert len(taken) <= 3
    workers.go.set()
    assert len(list(run)) == 9


class Held(Simulated):
    """They say no more after their first result until they may."""

    def __post_init__(self):
        super().__post_init__()
        self.go, self.done = threading.Event(), False

    def receive(self, seconds):
        if self.done:
            self.go.wait(60)
        heard = super().receive(seconds)
        self.done = any(isinstance(said, Done) for _, said in heard)
        return heard


def test_a_worker_with_another_version_is_refused():
    other = {**versions(), "qfolio": "0.0.9"}
    message = r"^The worker worker 0 has qfolio 0\.0\.9, and this machine .*; install the same"
    with pytest.raises(QfolioError, match=message):
        simulate(Simulated(1, versions=other), [Job("a")])


def test_no_worker_that_stays_alive():
    with pytest.raises(QfolioError, match="No worker stays alive; the last one: no such node"):
        simulate(Simulated(2, broken=frozenset({0, 1})), [Job("a"), Job("b")])


def test_the_error_of_a_job_ends_the_run_behind_what_is_done():
    class Failing(Simulated):
        def send(self, worker, job):
            if job.name == "bad":
                self.after(job.seconds, worker, Failed("the loss is not finite.", plain=True))
            else:
                super().send(worker, job)

    run = dispatch(
        lambda: contextlib.nullcontext(Failing(2)),
        [Job("good"), Job("bad", 5.0), Job("long", 50.0)],
        lambda job: (),
    )
    assert next(run)[0].name == "good"
    with pytest.raises(QfolioError, match=r"^the loss is not finite\.$"):
        next(run)


def test_stopping_gives_out_no_more_jobs():
    stop, told = threading.Event(), []

    def tell(job, said):
        told.append(job.name)
        stop.set()

    drive(Simulated(1), [Job("a"), Job("b")], tell, stop)
    assert told == ["a"]
