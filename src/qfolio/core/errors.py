"""The one exception that is meant for the person at the keyboard."""


class QfolioError(Exception):
    """Something the user can put right: one sentence that says what, where and what to do.

    The command line prints it without a traceback and exits with code 2.
    """
