"""Trackers for ``--track``: TensorBoard, Weights & Biases, Trackio.

They follow the log of an experiment (``experiments/log.py``). A tracker of your own is a class that
inherits from ``qfolio.Tracker``, named ``module:Name``.
"""

import os
from collections.abc import Iterable, Mapping
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from qfolio.core import registry
from qfolio.core.errors import QfolioError, needs, one_line
from qfolio.experiments.log import Tracker

PROJECT = "qfolio"


class TensorBoard(Tracker):
    """Files for TensorBoard, in ``tensorboard/`` of the experiment's folder."""

    def __init__(self) -> None:
        self._module = _module("tensorboardX", "qfolio[track]")

    def start(self, folder: Path | None, about: Mapping[str, Any]) -> None:
        if folder is None:
            raise QfolioError(
                "TensorBoard's files are written to the experiment's folder; set one with out."
            )
        self._writer = self._module.SummaryWriter(str(folder / "tensorboard"))

    def log(self, values: Mapping[str, float], step: int) -> None:
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def event(self, event: Mapping[str, Any]) -> None:
        if event["event"] in ("done", "stopped", "failed"):  # Ctrl-C may end what follows
            self._writer.flush()

    def finish(self) -> None:
        self._writer.close()


class WeightsAndBiases(Tracker):
    """Weights & Biases, offline unless ``WANDB_MODE`` is set.

    API keys stay where wandb keeps them; the log of an experiment holds none.
    """

    name = "wandb"

    def __init__(self) -> None:
        os.environ.setdefault("WANDB_MODE", "offline")
        self._module = _module(self.name, self.name)

    def start(self, folder: Path | None, about: Mapping[str, Any]) -> None:
        name = folder.name if folder else None
        self._module.init(project=PROJECT, name=name, config=dict(about))

    def log(self, values: Mapping[str, float], step: int) -> None:
        self._module.log({**values, "steps": step})  # jobs side by side have steps of their own

    def finish(self) -> None:
        self._module.finish()


class Trackio(WeightsAndBiases):
    """Trackio, which has the same functions as wandb and keeps its data on this machine."""

    name = "trackio"


def trackers(names: Iterable[str]) -> list[Tracker]:
    """The trackers of these names, each once; imports the modules of a user's own.

    Raises:
        QfolioError: There is none of this name, its package is missing, or it cannot be made.
    """
    return [_made(name) for name in dict.fromkeys(names)]


def _made(name: str) -> Tracker:
    try:
        return registry.find("tracker", name)()
    except QfolioError:
        raise
    except Exception as error:
        raise QfolioError(
            f"the tracker {name} cannot be made without arguments: {one_line(error)}."
        ) from None


def _module(name: str, package: str) -> ModuleType:
    with needs(name, otherwise=f'This tracker needs {name}: pip install "{package}".'):
        return import_module(name)
