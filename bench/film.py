"""The moving pictures in docs/images: a first session in a terminal, and the board as seeds learn.

The commands run as shown; the time is shortened, and long lines are broken between words. Needs
Chromium and a system with terminals.
"""

import codecs
import os
import subprocess
import sys
import tempfile
import termios
import textwrap
import threading
from base64 import b64decode
from io import BytesIO
from pathlib import Path
from time import monotonic, sleep

import pyte
from matplotlib import get_data_path
from PIL import Image, ImageDraw, ImageFont

from qfolio.report.board.server import Board
from qfolio.report.printing import find_browser

ROOT = Path(__file__).parents[1]
sys.path.append(str(ROOT / "tests"))
from browser import Browser  # noqa: E402

IMAGES = ROOT / "docs" / "images"
QFOLIO = [sys.executable, "-m", "qfolio"]
FONT = ImageFont.truetype(f"{get_data_path()}/fonts/ttf/DejaVuSansMono.ttf", 13)
AHEAD = "#454b52"  # the part of a progress bar that is not reached yet
COLUMNS, ROWS, LINE, MARGIN = 112, 36, 17, 14
SESSION = (
    "backtest --test 4y --seeds 2 --out runs/first",
    "allocate runs/first --agent tilts --as-of 2022-12-28 --capital 1000000",
)
HALTS = {"to equal-weight, a year": 3000, "Report": 2500, "cash": 3000}
"""How many milliseconds the film halts after lines that begin so."""


class Film:
    """Frames and how long each is shown."""

    def __init__(self) -> None:
        self.frames: list[Image.Image] = []
        self.milliseconds: list[int] = []

    def add(self, frame: Image.Image, milliseconds: int) -> None:
        self.frames.append(frame)
        self.milliseconds.append(milliseconds)

    def save(self, name: str, colors: int) -> None:
        """Write a GIF that repeats, in colors that all frames share."""
        palette = self.frames[-1].quantize(colors, dither=Image.Dither.NONE)
        first, *rest = (
            frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in self.frames
        )
        first.save(
            IMAGES / name,
            save_all=True,
            append_images=rest,
            duration=self.milliseconds,
            loop=0,
            optimize=True,
        )
        size, seconds = (IMAGES / name).stat().st_size / 1e6, sum(self.milliseconds) / 1e3
        print(f"{name}: {len(self.frames)} frames, {seconds:.0f} s, {size:.2f} MB")


class Terminal:
    """A terminal of fixed size that runs commands and films itself."""

    def __init__(self, folder: str) -> None:
        self.folder = folder
        self.film = Film()
        self._screen = pyte.Screen(COLUMNS, ROWS)
        self._stream = pyte.Stream(self._screen)

    def type(self, command: str) -> None:
        self._stream.feed("$ ")
        for start in range(0, len(command), 3):
            self._stream.feed(command[start : start + 3])
            self._shoot(80)
        self._stream.feed("\r\n")

    def run(self, arguments: list[str]) -> None:
        ours, theirs = os.openpty()
        termios.tcsetwinsize(theirs, (ROWS, COLUMNS))
        process = subprocess.Popen(
            [*QFOLIO, *arguments],
            cwd=self.folder,
            env=os.environ | {"TERM": "xterm-256color"},
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
        )
        os.close(theirs)
        shot, printed, rest = 0.0, 0, ""
        decoder = codecs.getincrementaldecoder("utf-8")()
        while output := _read(ours):
            *lines, rest = (rest + decoder.decode(output)).split("\n")
            for line in lines:
                self._print(line.rstrip("\r"))
                printed += 1
                halt = [ms for start, ms in HALTS.items() if line.startswith(start)]
                if halt or printed % 3 == 0:
                    self._shoot(*halt or [240])
            if rest.startswith(("\r", "\x1b")):  # progress, which is drawn over
                self._stream.feed(rest)
                rest = ""
                if monotonic() > shot + 1:  # a second in a tenth
                    self._shoot(100)
                    shot = monotonic()
        os.close(ours)
        self._shoot(240)
        assert process.wait() == 0, self._screen.display

    def _print(self, line: str) -> None:
        prose = len(line) > COLUMNS and "\x1b" not in line
        for part in textwrap.wrap(line, COLUMNS - 1) if prose else [line]:
            self._stream.feed(f"{part}\r\n")

    def _shoot(self, milliseconds: int) -> None:
        size = round(COLUMNS * FONT.getlength("m")) + 2 * MARGIN, ROWS * LINE + 2 * MARGIN
        image = Image.new("RGB", size, "#16191d")
        draw = ImageDraw.Draw(image)
        for row, cells in self._screen.buffer.items():
            command = cells[0].data == "$"
            for column, cell in cells.items():
                bright = "#ffffff" if command or cell.bold else "#a9b1ba"
                place = MARGIN + column * FONT.getlength("m"), MARGIN + row * LINE
                draw.text(
                    place, cell.data, font=FONT, fill=AHEAD if cell.fg == "3a3a3a" else bright
                )
        self.film.add(image, milliseconds)


def _read(terminal: int) -> bytes:
    try:
        return os.read(terminal, 1 << 16)
    except OSError:  # how Linux says that the other end was closed
        return b""


def film_session(folder: str) -> None:
    terminal = Terminal(folder)
    for command in SESSION:
        terminal.type(f"qfolio {command}")
        terminal.run(command.split())
    terminal.film.milliseconds[-1] = 5000
    terminal.film.save("session.gif", 16)


def _photograph(browser: Browser) -> Image.Image:
    picture = browser.call("Page.captureScreenshot", format="png")["data"]
    image = Image.open(BytesIO(b64decode(picture))).convert("RGB")
    return image.resize((800, round(800 * image.height / image.width)), Image.Resampling.LANCZOS)


def film_board(folder: str) -> None:
    chromium = find_browser()
    assert chromium, "The film of the board needs Chromium."
    runs = Path(folder, "board")
    runs.mkdir()
    film = Film()
    with Board(runs, 0) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser = Browser(chromium, Path(folder, "profile"))
        browser.call("Emulation.setScrollbarsHidden", hidden=True)
        train = [*QFOLIO, "train", "pendulum", "--no-compare", "--out", str(runs / "pendulum")]
        learner = subprocess.Popen(train, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while not (runs / "pendulum" / "events.jsonl").exists():
            sleep(0.2)
        browser.show(server.url, 1000)
        while not browser.evaluate("document.body.innerText.includes('Done')"):
            film.add(_photograph(browser), 250)
            sleep(1)
        film.add(_photograph(browser), 4000)
        learner.wait()
        browser.close()
        server.shutdown()
    film.save("board.gif", 64)


FILMS = {"session": film_session, "board": film_board}

if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        for name in sys.argv[1:] or FILMS:
            FILMS[name](place)
