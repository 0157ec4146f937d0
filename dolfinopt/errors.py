"""Exceptions a caller can act on: what is wrong with the input, and what did not converge."""


class InputError(ValueError):
    """The user's input cannot be used; the message names file, key, value and remedy in one line.

    The command line prints the message and ends with status 2.
    """


class ConvergenceError(RuntimeError):
    """An iteration did not reach its tolerance; the message says what to try next.

    The command line prints the message and ends with status 1.
    """


class OutputError(RuntimeError):
    """A file cannot be written: the message names file, reason and remedy in one line.

    The disk is full, for instance. The command line prints the message and ends with status 1.
    """


class MissingLibrary(RuntimeError):
    """A library that does not come with pip is not installed."""


def line_of(error: BaseException | None) -> str:
    """Return the line that tells of what the user can mend; "" of what needs a traceback."""
    if isinstance(error, KeyboardInterrupt):
        return ": ".join(["dolfinopt", "interrupted", *map(str, error.args)])
    if isinstance(error, InputError | ConvergenceError | OutputError | MissingLibrary):
        return f"dolfinopt: {error}"
    missing = missing_package(error)
    return f"dolfinopt: {missing}" if missing else ""


def missing_package(error: BaseException | None) -> str:
    """Return what to say of a package that is not installed; "" if that is not the reason."""
    name = getattr(error, "name", None) if isinstance(error, ModuleNotFoundError) else None
    if not name or name.partition(".")[0] == "dolfinopt":
        return ""
    return (
        f"the Python package {name} is not installed; on Debian run ./dolfinopt.sh, elsewhere: "
        "pip install --force-reinstall dolfinopt, which brings what it needs"
    )


class OthersFailed(RuntimeError):
    """Work given up because another rank failed.

    In `parallel.together` that rank's exception goes first.
    """
