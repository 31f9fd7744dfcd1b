"""Printing of pages as PDF, by headless Chromium or Chrome."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from qfolio.core.errors import QfolioError
from qfolio.core.files import write_bytes
from qfolio.core.text import quote

PROGRAMS = (
    *("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome"),
    *("msedge", "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome"),
)

PATIENCE = 180.0
"""Seconds after which printing is given up."""


def find_browser() -> str | None:
    """The browser named in QFOLIO_CHROMIUM, or the first of Chromium, Chrome and Edge found."""
    chosen = os.environ.get("QFOLIO_CHROMIUM")
    return next(filter(None, map(shutil.which, (chosen,) if chosen else PROGRAMS)), None)


def print_pdf(page: Path, target: Path) -> None:
    """Print a page as PDF with its print style.

    Args:
        page: The HTML file.
        target: The PDF to write.

    Raises:
        QfolioError: There is no browser, or it prints nothing.
    """
    browser = find_browser()
    if browser is None:
        if chosen := os.environ.get("QFOLIO_CHROMIUM"):
            raise QfolioError(f"QFOLIO_CHROMIUM is {quote(chosen)}, which is not a program.")
        raise QfolioError(
            "Printing a PDF needs Chromium or Chrome, and neither was found; install one, or set "
            "QFOLIO_CHROMIUM to its program."
        )
    with tempfile.TemporaryDirectory() as place:
        printed = Path(place) / "report.pdf"
        command = [
            *(browser, "--headless", "--disable-gpu", "--disable-dev-shm-usage", "--no-first-run"),
            *("--disable-background-networking", f"--user-data-dir={place}/profile"),
            *("--no-pdf-header-footer", f"--print-to-pdf={printed}", page.resolve().as_uri()),
        ]
        if getattr(os, "geteuid", lambda: 1)() == 0:  # as in containers, where it refuses to start
            command.insert(1, "--no-sandbox")
        try:
            subprocess.run(command, capture_output=True, timeout=PATIENCE, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise QfolioError(f"{browser} could not print {page} ({error}).") from None
        if not printed.is_file():
            raise QfolioError(
                f"{browser} printed nothing; open {page} in a browser and print it from there."
            )
        write_bytes(target, printed.read_bytes())
