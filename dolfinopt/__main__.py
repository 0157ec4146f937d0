"""`python -m dolfinopt` is the command `dolfinopt`."""

from dolfinopt.cli import main

if __name__ == "__main__":
    main()
