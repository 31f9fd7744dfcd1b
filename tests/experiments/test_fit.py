"""Listeners of a training."""

import pytest

from qfolio.core.errors import QfolioError
from qfolio.experiments.fit import Listener, require_listeners


class Short(Listener):
    def on_chunk(self, training):  # type: ignore[override]
        """Takes no rows."""


@pytest.mark.parametrize(
    ("listeners", "said"),
    [
        ([Short()], "Short.on_chunk must be a method that takes self, training and rows"),
        ([print], "objects whose classes derive from qfolio.Listener"),
    ],
)
def test_listeners_that_could_not_be_called_are_refused(listeners, said):
    with pytest.raises(QfolioError, match=said):
        require_listeners(listeners)
    require_listeners([Listener()])
