"""The trials of a hyperparameter search on disk, in Optuna's journal.

journal.log is Optuna's own record: lines of JSON, appended, and never unpickled. Any number of
processes may work on one journal. Each keeps a file under processes/ locked while it lives, so that
the others can detect its death and retry its trials.

Proposals depend on the finished trials alone, not on how often a process was stopped: a search that
was killed and resumed proposes the same as an uninterrupted one.
"""

import contextlib
import math
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import optuna
from filelock import FileLock, Timeout
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
from optuna.trial import TrialState

from qfolio.core.errors import QfolioError
from qfolio.experiments.tuning.search import Dimension, Value

optuna.logging.set_verbosity(optuna.logging.WARNING)  # otherwise it logs every trial

_KNOWN = (TrialState.COMPLETE, TrialState.PRUNED)
_HELD = (*_KNOWN, TrialState.RUNNING)


class Trial(NamedTuple):
    """A configuration that has been trained."""

    number: int
    values: dict[str, Value]  # of the searched settings
    returns: tuple[float | None, ...]  # greedy return of each seed; None if the loss was not finite
    is_preset: bool
    at_random: bool  # drawn from the whole space, not chosen by the sampler
    seconds: float  # its share of its batch's time, compiling included

    @property
    def value(self) -> float:
        """The mean return over seeds; NaN if one of them diverged."""
        return float(np.array(self.returns, float).mean())


class Asked(NamedTuple):
    """A configuration to train."""

    values: dict[str, Value]
    trial: optuna.Trial


class Journal:
    """The trials of a search in its folder."""

    def __init__(self, folder: Path, space: Sequence[Dimension], *, at_random: int) -> None:
        """Opens the journal, or creates one.

        at_random: trials drawn at random before the sampler chooses.
        """
        self.folder, self.space, self._at_random = folder, space, at_random
        self._process = uuid.uuid4().hex
        path = folder / "journal.log"
        lock = JournalFileOpenLock(str(path))
        try:
            _drop_cut_line(path, lock)
            self._study = optuna.create_study(
                storage=JournalStorage(JournalFileBackend(str(path), lock)),
                study_name="qfolio",
                direction="maximize",
                load_if_exists=True,
            )
            self.trials()
        except (ValueError, LookupError, TypeError, AttributeError, AssertionError) as error:
            raise QfolioError(f"{path} is damaged ({error}); restore it, or start over.") from None

    def trials(self) -> list[Trial]:
        """The finished trials of all processes, in order of their proposal."""
        found = []
        for trial in self._study.get_trials(states=_KNOWN):
            noted = trial.user_attrs
            values = self._values(trial.params)
            returns, is_preset = tuple(noted["returns"]), noted.get("preset", False)
            at_random = noted.get("at random", False) and not is_preset
            found.append(
                Trial(trial.number, values, returns, is_preset, at_random, noted["seconds"])
            )
        return found

    def in_hand(self) -> int:
        """Number of trials in training, over all processes."""
        return len(self._study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)))

    @contextlib.contextmanager
    def at_work(self) -> Iterator[None]:
        """Shows other processes that this one is alive, by a lock on its file."""
        place = self.folder / "processes" / self._process
        place.parent.mkdir(exist_ok=True)
        try:
            with FileLock(place):
                yield
        finally:
            place.unlink(missing_ok=True)

    def ask(self, count: int, total: int, preset: Mapping[str, Value]) -> list[Asked]:
        """Proposes ``count`` trials, or as many as are left of ``total``.

        preset: a configuration to propose first, if it lies within the space.
        """
        with FileLock(self.folder / "asking.lock"):
            self._fail_dead_trials()
            self._enqueue(preset)
            states = [trial.state for trial in self._study.get_trials(deepcopy=False)]
            held = sum(state in _HELD for state in states)
            known = sum(state in _KNOWN for state in states)
            distributions = {dim.key: dim.distribution() for dim in self.space}
            asked = []
            for _ in range(min(count, total - held)):
                self._study.sampler = self._sampler(known, self.in_hand())
                trial = self._study.ask(distributions)
                trial.set_user_attr("process", self._process)
                trial.set_user_attr("at random", known < self._at_random)
                asked.append(Asked(self._values(trial.params), trial))
            return asked

    def tell(self, asked: Asked, returns: Sequence[float], seconds: float) -> None:
        """Records the returns of a trial by seed; a trial with a NaN ranks below all others."""
        trial = asked.trial
        trial.set_user_attr("returns", [x if math.isfinite(x) else None for x in returns])
        trial.set_user_attr("seconds", round(seconds, 3))
        value = float(np.mean(returns))
        if math.isfinite(value):
            self._study.tell(trial, value)
        else:
            self._study.tell(trial, state=TrialState.PRUNED)

    def give_up(self, asked: Asked) -> None:
        """Records that a trial was not finished, so that it is proposed again."""
        self._study.tell(asked.trial, state=TrialState.FAIL)

    def _sampler(self, known: int, in_hand: int) -> optuna.samplers.TPESampler:
        """A sampler for one trial, seeded by the numbers of finished and running trials.

        A reused sampler would have a random state that a resumed search lacks.
        """
        return optuna.samplers.TPESampler(
            seed=int(np.random.SeedSequence((known, in_hand)).generate_state(1)[0]),
            constant_liar=True,  # spreads the trials of a batch
            n_startup_trials=self._at_random,
        )

    def _values(self, params: Mapping[str, Value]) -> dict[str, Value]:
        return {dim.name: dim.value(params[dim.key]) for dim in self.space}

    def _enqueue(self, preset: Mapping[str, Value]) -> None:
        noted = (
            trial.user_attrs.get("preset", False)
            for trial in self._study.get_trials(deepcopy=False)
            if trial.state != TrialState.FAIL
        )
        if all(dim.covers(preset[dim.name]) for dim in self.space) and not any(noted):
            stored = {dim.key: dim.stored(preset[dim.name]) for dim in self.space}
            self._study.enqueue_trial(stored, user_attrs={"preset": True})

    def _fail_dead_trials(self) -> None:
        for trial in self._study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            process = trial.user_attrs.get("process")
            place = self.folder / "processes" / str(process)
            if process is not None and place.exists():
                try:
                    FileLock(place, timeout=0).acquire().lock.release()
                except Timeout:
                    continue
                place.unlink(missing_ok=True)
            self._study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)


def best_of(trials: Sequence[Trial]) -> Trial | None:
    """The trial with the highest mean return; None if every trial diverged."""
    finite = [trial for trial in trials if math.isfinite(trial.value)]
    return max(finite, key=lambda trial: trial.value, default=None)


def preset_of(trials: Sequence[Trial]) -> Trial | None:
    """The trial of the preset's own settings; None if it has not finished or is not searched."""
    return next((trial for trial in trials if trial.is_preset), None)


def _drop_cut_line(journal: Path, lock: JournalFileOpenLock) -> None:
    """Removes a last line that a crash has cut short; Optuna could not read past it."""
    if not journal.exists():
        return
    lock.acquire()
    try:
        content = journal.read_bytes()
        if not content.endswith(b"\n"):
            with journal.open("r+b") as file:
                file.truncate(content.rfind(b"\n") + 1)
    finally:
        lock.release()
