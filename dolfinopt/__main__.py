"""`python -m dolfinopt` is the command `dolfinopt`."""

import sys

from dolfinopt.cli import main

if __name__ == "__main__":
    sys.exit(main())
