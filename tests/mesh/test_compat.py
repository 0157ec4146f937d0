"""What the rest of the package counts on, whatever the version of DOLFINx."""

import subprocess
import sys

import pytest


@pytest.mark.serial
def test_import_keeps_compilers_quiet():
    """The first record of a library must not set up logging to the terminal behind our back."""
    script = (
        "import logging, dolfinopt.mesh.compat; "
        "logging.info('compiled'); logging.getLogger('FFCx').warning('compiled')"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert (run.stdout, run.stderr) == ("", "")
