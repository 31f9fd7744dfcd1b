"""Listeners for tests."""

import signal

from qfolio.experiments.fit import Listener


class Tell(Listener):
    """Calls a function with the training and the rows of each chunk."""

    def __init__(self, function):
        self.function = function

    def on_chunk(self, training, rows):
        self.function(training, rows)


class Interrupt(Listener):
    """Presses Ctrl-C once a condition on the training holds."""

    def __init__(self, when=lambda training: True):
        self.when = when

    def on_chunk(self, training, rows):
        if self.when(training):
            signal.raise_signal(signal.SIGINT)
