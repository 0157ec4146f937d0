"""Exceptions a caller can act on: what is wrong with the input, and what did not converge."""


class InputError(ValueError):
    """The user's input cannot be used; the message names file, key, value and remedy in one line.

    The command line prints the message and ends with status 2.
    """


class ConvergenceError(RuntimeError):
    """An iteration did not reach its tolerance; the message says what to try next.

    The command line prints the message and ends with status 1.
    """
