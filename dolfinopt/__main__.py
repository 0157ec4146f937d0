"""`python -m dolfinopt` is the command `dolfinopt`."""

import sys

from dolfinopt.errors import missing_package
from dolfinopt.interrupt import end_at_once


def main() -> None:
    """Run the command line; Ctrl-C ends it in one line from here on."""
    end_at_once()
    try:
        from dolfinopt.cli import main as run
    except ModuleNotFoundError as error:
        missing = missing_package(error)
        if not missing:
            raise
        sys.exit(f"dolfinopt: {missing}")
    run()


if __name__ == "__main__":
    main()
