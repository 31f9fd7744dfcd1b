import pytest

from qfolio.commands.window import Window
from qfolio.core.errors import QfolioError


def test_a_window_that_cannot_be_opened_advises_what_every_command_takes(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "nonsense")
    why = r"here \(nonsense not available\); correct DISPLAY .* with qfolio watch DIR\.$"
    with pytest.raises(QfolioError, match=why):
        Window()
