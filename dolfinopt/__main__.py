"""`python -m dolfinopt` is the command `dolfinopt`."""

from dolfinopt.interrupt import end_at_once


def main() -> None:
    """Run the command line; Ctrl-C ends it in one line from here on."""
    end_at_once()
    from dolfinopt.cli import main as run

    run()


if __name__ == "__main__":
    main()
