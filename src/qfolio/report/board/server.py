"""The board's server: read-only, for this machine only, and only for its own page.

It listens on the loopback address and answers only requests that name it as their host, so that
no other site can reach it through a name of its own (DNS rebinding). It sends no CORS headers, so
that no other page can read its answers. Reports run in a sandbox without an origin.
"""

import functools
import os
import re
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

import msgspec

from qfolio.core.errors import QfolioError
from qfolio.report.board.shelf import Shelf
from qfolio.report.rendering import render, source

ADDRESS = "127.0.0.1"

PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
REPORT_POLICY = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data: blob:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)


class Board(ThreadingHTTPServer):
    """Serves the experiments below a folder; port 0 chooses a free port.

    Raises:
        QfolioError: The folder does not exist, or the port is taken.
    """

    daemon_threads = True
    allow_reuse_address = os.name != "nt"  # where it would let two boards share a port
    request_queue_size = 64

    def __init__(self, root: Path, port: int) -> None:
        if not root.is_dir():
            raise QfolioError(f"{root} is not a folder; give the one that holds your runs.")
        self.shelf = Shelf(root)
        try:
            super().__init__((ADDRESS, port), Handler)
        except (OSError, OverflowError) as error:
            raise QfolioError(
                f"The board cannot use port {port} ({error}); choose another one with --port."
            ) from None
        self.hosts = {f"{name}:{self.server_port}" for name in (ADDRESS, "localhost")}

    @property
    def url(self) -> str:
        return f"http://{ADDRESS}:{self.server_port}/"


class Handler(BaseHTTPRequestHandler):
    """Answers GET and HEAD; nothing from a request becomes a path."""

    server: Board
    server_version, sys_version = "qfolio", ""
    protocol_version = "HTTP/1.1"

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        if self.headers.get("Host") not in self.server.hosts:
            self._send(HTTPStatus.FORBIDDEN, "text/plain", b"This board has another address.\n")
            return
        try:
            address = urlsplit(self.path)
        except ValueError:
            address = urlsplit("")
        for pattern, answer in ROUTES:
            if match := re.fullmatch(pattern, unquote(address.path)):
                since = re.fullmatch("since=([0-9]{1,15})", address.query)
                known = int(since[1]) if since else 0
                found = answer(self.server.shelf, known, *match.groups())
                if found is not None:
                    self._send(HTTPStatus.OK, *found)
                    return
        self._send(HTTPStatus.NOT_FOUND, "text/plain", b"There is no such page.\n")

    def _send(
        self, status: HTTPStatus, kind: str, content: bytes, policy: str = PAGE_POLICY
    ) -> None:
        self.send_response(status)
        self.send_header("Content-Type", f"{kind}; charset=utf-8")
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Content-Security-Policy", policy)
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Cross-Origin-Opener-Policy", "same-origin")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("X-Frame-Options", "DENY")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def handle(self) -> None:
        try:
            super().handle()
        except (ConnectionError, TimeoutError):  # the page was closed
            self.close_connection = True

    def log_message(self, format: str, *args: object) -> None:
        """Logs nothing, to keep the terminal quiet."""


@functools.cache
def _text(name: str) -> bytes:
    """The page, its style or its script."""
    text = source(name) if name.endswith(".js") else render(name)
    return text.encode()


def _json(content: object) -> tuple[str, bytes] | None:
    return None if content is None else ("application/json", msgspec.json.encode(content))


def _report(shelf: Shelf, since: int, key: str, name: str) -> tuple[str, bytes, str] | None:
    content = shelf.report(key, name)
    return None if content is None else ("text/html", content, REPORT_POLICY)


ROUTES: list[tuple[str, Callable[..., tuple | None]]] = [
    ("/", lambda shelf, since: ("text/html", _text("board.html"))),
    ("/board.css", lambda shelf, since: ("text/css", _text("board.css"))),
    ("/board.js", lambda shelf, since: ("text/javascript", _text("board.js"))),
    ("/runs", lambda shelf, since: _json(shelf.runs(since))),
    ("/runs/([0-9a-f]{16})", lambda shelf, since, key: _json(shelf.run(key, since))),
    ("/reports/([0-9a-f]{16})/(.{1,500})", _report),
]
