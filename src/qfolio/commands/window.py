"""The pendulum in a window, drawn by Gymnasium's own renderer."""

import os
import sys
from typing import Any

import numpy as np

from qfolio.core.errors import QfolioError, needs


def has_display() -> bool:
    """Whether a window can be opened here."""
    if os.environ.get("SDL_VIDEODRIVER") == "dummy":
        return True  # an invisible window, requested explicitly
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _not_opened(where: str) -> QfolioError:
    return QfolioError(
        f"No window can be opened {where}; correct DISPLAY or WAYLAND_DISPLAY, or unset them and "
        "write a GIF with qfolio watch DIR."
    )


class Window:
    """Shows pendulum episodes in real time; closing it does not stop the training.

    Raises QfolioError if Gymnasium or pygame is not installed or no window can be opened.
    """

    def __init__(self, caption: str = "qfolio") -> None:
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        missing = 'The window needs Gymnasium and pygame: pip install "qfolio[watch]".'
        with needs("gymnasium", "pygame", otherwise=missing):
            import gymnasium
            import pygame
        self._pygame: Any = pygame
        self._env: Any = gymnasium.make("Pendulum-v1", render_mode="human")
        self._open = True
        try:
            self._env.reset(seed=0)
        except pygame.error as error:
            raise _not_opened(f"here ({error})") from None
        driver = pygame.display.get_driver()
        if driver in ("dummy", "offscreen") and os.environ.get("SDL_VIDEODRIVER") != driver:
            # SDL falls back to these if the display does not answer.
            display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
            raise _not_opened(f"on display {display}")
        self.caption(caption)

    def caption(self, text: str) -> None:
        if self._open:
            self._pygame.display.set_caption(text)

    def show(self, states: np.ndarray, torques: np.ndarray) -> bool:
        """Shows an episode in real time; returns whether the window is still open.

        states: angle and velocity, of shape (time + 1, 2). torques: of shape (time,).
        """
        pendulum = self._env.unwrapped
        for state, torque in zip(states[1:], torques, strict=True):
            if not self._open:
                return False
            pendulum.state, pendulum.last_u = np.asarray(state, float), float(torque)
            pendulum.render()  # limited to the task's 20 frames a second
            self._open = not self._pygame.event.peek(self._pygame.QUIT)
        return self._open

    def close(self) -> None:
        self._env.close()
