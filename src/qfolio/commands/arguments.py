"""Arguments that several commands take, and how they look in --help."""

from pathlib import Path
from typing import Annotated

from tyro.conf import arg

INTERRUPTED = 130
"""The exit code that a shell expects after Ctrl-C."""

Name = Annotated[str | None, arg(metavar="NAME", help_behavior_hint="")]
Count = Annotated[int | None, arg(metavar="N", help_behavior_hint="")]
Folder = Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="")]
File = Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="")]
Names = Annotated[tuple[str, ...], arg(metavar="NAME …", help_behavior_hint="")]
Assignments = Annotated[
    tuple[str, ...], arg(name="set", metavar="NAME=VALUE …", help_behavior_hint="")
]
