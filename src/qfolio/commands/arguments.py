"""Arguments shared by several commands, with their form in --help."""

import datetime
import re
import secrets
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import UseAppendAction, arg

from qfolio.core import registry, settings
from qfolio.core.errors import QfolioError
from qfolio.core.text import shell
from qfolio.experiments.budget import Budget

if TYPE_CHECKING:
    from qfolio.experiments.executor import Executor
    from qfolio.experiments.run_folder import RunConfig
    from qfolio.experiments.tuning.run import SearchConfig

Name = Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")]
Count = Annotated[int | None, arg(metavar="N", help_behavior_hint="")]
Folder = Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")]
File = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")]
Names = Annotated[tuple[str, ...], arg(metavar="NAME …", help_behavior_hint="")]
Limits = Annotated[tuple[str, ...], arg(metavar="KEY=VALUE …", help_behavior_hint="")]
Modules = Annotated[tuple[str, ...], arg(metavar="MODULE …", help_behavior_hint="")]
Trackers = Annotated[
    tuple[str, ...], arg(metavar="tensorboard|wandb|trackio …", help_behavior_hint="")
]
Sources = Annotated[
    tuple[str, ...], arg(metavar="NAME=FILE", help_behavior_hint=""), UseAppendAction
]
Assignments = Annotated[
    tuple[str, ...], arg(name="set", metavar="NAME=VALUE …", help_behavior_hint="")
]


def sources(options: tuple[str, ...]) -> dict[str, str]:
    """The files of ``--strategy NAME=FILE``, by name."""
    found: dict[str, str] = {}
    for option in options:
        name, equals, file = option.partition("=")
        if not (name and equals and file):
            raise QfolioError(f"--strategy is {option!r}; it must be NAME=FILE, as in mine=my.csv.")
        if name in found:
            raise QfolioError(f"--strategy names {name} twice; give each its own name.")
        found[name] = file
    return found


def budget_of(episodes: int | None, steps: int | None) -> Budget | None:
    """The budget of ``--episodes`` or ``--steps``; None if neither is given."""
    if episodes is not None and steps is not None:
        raise QfolioError(
            "--episodes and --steps both set the length of training; give one of them."
        )
    return None if episodes is None and steps is None else Budget(episodes, steps)


def fresh_name(*words: str) -> Path:
    """A folder in runs/ that is named by the words, such as task and agent, and the time.

    Four random digits tell it from that of a command that starts in the same second.
    """
    name = "-".join([re.sub("[/:]", "-", word) for word in words])
    now = f"{datetime.datetime.now():%Y%m%d-%H%M%S}"
    return Path("runs") / f"{name}-{now}-{secrets.token_hex(2)}"


def executor_of(
    on: str, out: Path | None, resumed: Path | None, option: str = "--resume"
) -> "Executor":
    """What ``--on`` names; a folder that cannot be made is refused before a cluster is asked.

    option: gives ``resumed``, the folder of earlier work.
    """
    from qfolio.core.files import require_new
    from qfolio.experiments.machines.choice import on as chosen

    if resumed is None:
        require_new(out or fresh_name("run"), option)
    return chosen(on)


def prepare(trust: Sequence[str]) -> None:
    """Sets jax up and imports the modules that a user trusts, before anything that needs them."""
    from qfolio.core import devices

    devices.configure()
    registry.trust(trust)


def typed() -> str:
    """The command line as it was typed."""
    return shell("qfolio", *sys.argv[1:])


def continues(*more: str) -> bool:
    """Whether only options were typed that keep the settings of what is resumed.

    more: names of the command's own options that do.
    """
    words = (word.partition("=")[0] for word in sys.argv[1:] if word.startswith("--"))
    names = {word[2:].removeprefix("no-").replace("-", "_") for word in words}
    return names <= {"resume", "join", "on", "track", "trust", "json", *more}


def training_command(
    config: "RunConfig | SearchConfig", preset: str, changed: Mapping[str, Any], *more: str
) -> str:
    """The command line that trains the agent of a run or a search.

    preset: its preset. changed: the settings that differ from it. more: further options.
    """
    words = ["qfolio", "train", config.task, "--agent", config.agent, "--preset", preset]
    words += [f"--{config.budget.unit}", str(config.budget.amount), *more]
    words += ["--set"] if changed else []
    return shell(*words, *(f"{k}={settings.written(v)}" for k, v in changed.items()))
