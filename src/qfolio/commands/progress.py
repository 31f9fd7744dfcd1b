"""Listeners that print the progress of training on the terminal."""

import datetime
import math
from collections.abc import Callable
from time import perf_counter
from typing import TYPE_CHECKING, NoReturn

from qfolio.commands.console import animated, say
from qfolio.core.text import four_digits
from qfolio.core.training import episode_steps
from qfolio.experiments.fit import Listener, Training
from qfolio.experiments.interrupts import EXIT_CODE
from qfolio.experiments.records import Records

if TYPE_CHECKING:
    from qfolio.experiments.executor import Job
    from qfolio.experiments.run import Run
    from qfolio.experiments.tuning.run import Progress


class RunProgress(Listener):
    """A line for each point of a run's learning curve; moves a bar of ``console.bar`` between them.

    optimum: the optimal mean return on the curve's start states; None if it is unknown. show:
    called with the run at each point of the curve.
    """

    def __init__(
        self,
        run: "Run",
        optimum: float | None,
        update: Callable[..., None],
        show: Callable[["Run"], None] | None = None,
    ) -> None:
        self.run, self.optimum, self.update, self.show = run, optimum, update, show

    def on_start(self, training: Training) -> None:
        run, budget = self.run, training.budget
        steps = episode_steps(run.task, run.agent)
        value = "return" if steps == run.task.horizon else f"return/{steps}"  # of shorter episodes
        columns = (budget.unit, value, "greedy", "optimum", "epsilon", "steps/s", "left")
        say("".join(f"{name:>11}" for name in columns))
        self.points = len(run.evaluations)
        self.update(completed=run.done(budget.unit))

    def on_chunk(self, training: Training, rows: Records) -> None:
        run, budget = self.run, training.budget
        done = run.done(budget.unit)
        value = four_digits(float(rows.column("return").mean()) if rows else math.nan)
        rate = f"{training.steps_per_second:,.0f}"
        epsilon = rows[-1].get("epsilon", math.nan) if rows else math.nan
        explored = "–" if math.isnan(epsilon) else f"{epsilon:.2f}"
        left = time_left(training.seconds_left)
        status = (
            f"{done:,} {budget.unit}  return {value}  ε {explored}  {rate} steps/s  {left} left"
        )
        self.update(completed=min(done, budget.amount), description=status)
        if len(run.evaluations) > self.points:
            now = run.evaluations[self.points :][-len(run.population.seeds) :]
            self.points = len(run.evaluations)
            greedy = four_digits(sum(row["return"] for row in now) / len(now))
            cells = (f"{done:,}", value, greedy, four_digits(self.optimum), explored, rate, left)
            say("".join(f"{cell:>11}" for cell in cells))
            if self.show is not None:
                self.show(run)


class BarProgress(Listener):
    """Moves a bar of ``console.bar``; name: the name of the training."""

    def __init__(self, update: Callable[..., None], name: str) -> None:
        self.update, self.name = update, name

    def on_start(self, training: Training) -> None:
        self.update(completed=training.share, description=f"{self.name}  compiling")

    def on_chunk(self, training: Training, rows: Records) -> None:
        speed = f"{training.steps_per_second:,.0f} steps/s"
        status = f"{self.name}  {speed}  {time_left(training.seconds_left)} left"
        self.update(completed=training.share, description=status)


class JobsProgress:
    """A bar over all jobs of an experiment; where no line can move, a line for each tenth.

    Called before each job, it returns the listener of that job's training. Jobs may run side by
    side. What was done before an experiment was resumed counts, but not for the time left.
    """

    def __init__(self, update: Callable[..., None]) -> None:
        self.update, self.begun, self.said = update, perf_counter(), ""
        self.parts: dict[str, float] = {}  # share of all work that each job has done
        self.before: dict[str, float] = {}  # the same, when it was resumed
        self.known = False  # whether a job has begun to learn, so that its speed predicts the rest

    def __call__(self, job: "Job", done: float, share: float) -> list[Listener]:
        """done, share: of the whole experiment, what is finished and what this job is."""
        if not self.parts:
            self.parts[""] = self.before[""] = done  # by jobs that ran before it was resumed
        return [_JobProgress(self, job.name, share)]

    def note(self, job: str, part: float, learning: bool) -> None:
        """Notes the share of all work that a job has done (``part``) and updates the bar.

        learning: whether the job has begun to learn.
        """
        self.parts[job] = part
        self.before.setdefault(job, part)
        self.known |= learning
        agent, done = job.partition("/")[0], sum(self.parts.values())
        here = done - sum(self.before.values())
        spent = perf_counter() - self.begun
        left = time_left(spent * (1 - done) / here if self.known and here > 0 else math.nan)
        description = f"{agent}  {left} left"
        self.update(completed=done, description=description)
        if not animated() and f"{done:.1f}" != self.said:
            self.said = f"{done:.1f}"
            say(f"{done:4.0%}  {description}")


class _JobProgress(Listener):
    def __init__(self, whole: JobsProgress, job: str, share: float) -> None:
        self.whole, self.job, self.share = whole, job, share

    def on_start(self, training: Training) -> None:
        self.whole.note(self.job, self.share * training.share_since(), learning=False)

    def on_chunk(self, training: Training, rows: Records) -> None:
        learning = not math.isnan(training.seconds_left)
        self.whole.note(self.job, self.share * training.share_since(), learning)


def print_batch(now: "Progress | None" = None) -> None:
    """Prints a line for a batch of a search, or the heads of the columns before the first."""
    cells: tuple[str, ...] = ("trials", "diverged", "best", "preset", "an hour")
    if now is not None:
        best, preset = (four_digits(trial and trial.value) for trial in (now.best, now.preset))
        rate = f"{3600 * now.trials / now.seconds:,.0f}"
        cells = (f"{now.done}/{now.total}", str(now.diverged), best, preset, rate)
    say("".join(f"{cell:>11}" for cell in cells))


def time_left(seconds: float) -> str:
    """The time as hours, minutes and seconds; a dash if it is unknown."""
    return "–" if math.isnan(seconds) else str(datetime.timedelta(seconds=round(seconds)))


def stop(command: str) -> NoReturn:
    """Prints how to resume after Ctrl-C, and exits with ``EXIT_CODE``."""
    say(f"Stopped. Resume with: {command}")
    raise SystemExit(EXIT_CODE)
