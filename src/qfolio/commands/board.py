"""The command that shows training runs in a browser."""

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg


def board(
    runs: Annotated[Positional[Path], arg(metavar="RUNS")] = Path("runs"),
    *,
    port: int = 8642,
    open: bool = True,
) -> None:
    """Show all runs below a folder in the browser, live; Ctrl-C ends it.

    The page is served to this machine only and is read-only.

    Examples:
        qfolio board
        qfolio board results --no-open

    Args:
        runs: Folder of runs.
        port: Port on 127.0.0.1; 0 chooses a free one.
        open: Open the page in a browser.
    """
    import threading
    import webbrowser

    from qfolio.commands.console import say
    from qfolio.report.board.server import Board

    with Board(runs, port) as server:
        say(f"The board of {runs} is at {server.url}")
        if open:  # some browsers return only when they are closed
            threading.Thread(target=webbrowser.open, args=(server.url,), daemon=True).start()
        server.serve_forever()
