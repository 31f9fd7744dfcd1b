"""What commands print; the modules of this package print the results of one kind of work each."""

import contextlib
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from functools import partial
from textwrap import wrap
from typing import Literal

import rich.progress
from rich.console import Console
from rich.table import Table
from rich.text import Text

from qfolio.core.text import printable

NAME, GAP = 16, 2
"""Characters that the names of a table's rows have at least, if they need them, and those between
two columns."""

console = Console(highlight=False)
if not console.is_terminal:
    console.width = 10_000  # files and pipes have no width: nothing is folded there


def animated() -> bool:
    """Whether lines can be drawn again: in a terminal that is not dumb."""
    return console.is_terminal and not console.is_dumb_terminal


def say(*lines: str) -> None:
    """Prints lines; control characters are escaped, such as a line break in the name of a file."""
    print("\n".join(map(printable, lines)), flush=True)


def tell(sentences: str) -> None:
    """Prints sentences; a terminal breaks them between words."""
    lines = [sentences]
    if console.is_terminal:
        lines = wrap(sentences, console.width, break_long_words=False, break_on_hyphens=False)
    say(*lines)


@contextlib.contextmanager
def working(text: str) -> Iterator[None]:
    """Says what is being done: where lines can move until it is, elsewhere once."""
    if not animated():
        say(f"{text}.")
    with console.status(text):
        yield


@contextlib.contextmanager
def bar(text: str, total: float = 1.0) -> Iterator[Callable[..., None]]:
    """A bar with text beside it, where lines can move, removed at the end.

    Yields the function that moves it: ``update(completed=…)``, with ``description=…`` for new text.
    """
    columns = (
        rich.progress.BarColumn(bar_width=24),
        rich.progress.TextColumn("{task.description}"),
    )
    with rich.progress.Progress(
        *columns, console=console, transient=True, disable=not animated()
    ) as live:
        yield partial(live.update, live.add_task(text, total=total))


def print_table(
    heads: Sequence[str],
    rows: Iterable[Sequence[str]],
    *,
    bold: Container[str] = (),
    width: int = 0,
) -> None:
    """A table; its first column names the rows, and numbers in the others are aligned.

    A narrow terminal folds the names. Where even that is too little, lines are longer than the
    terminal is wide: no name is left out, and no digit cut off.

    Args:
        heads: The columns' names.
        rows: Their cells.
        bold: Names of the rows to emphasize.
        width: Characters that each column has at least.
    """
    table = Table(box=None, header_style="bold", pad_edge=False)
    rows = [*rows]
    lines = [[Text(printable(cell)) for cell in line] for line in (heads, *rows)]
    for i, head in enumerate(lines[0]):
        side: Literal["left", "right"] = "right" if i else "left"
        table.add_column(head, justify=side, no_wrap=i > 0, overflow="fold", min_width=width)
    for row, cells in zip(rows, lines[1:], strict=True):
        table.add_row(*cells, style="bold" if row[0] in bold else None)
    names, *numbers = (max(each.cell_len for each in column) for column in zip(*lines, strict=True))
    needed = min(names, NAME) + sum(max(each, width) + GAP for each in numbers)
    if needed > console.width:
        table.width = needed
    console.print(table, crop=False)
