"""Imported robots."""

import pytest
from robots import DEMO, DEMO_MOTION, run_import, write_uneven

UNEVEN_MOTION = "t,yaw,lift,bend,roll,rail\n0,0,0,0,0,0\n1,0.5,-1,0.7,0.2,0.1\n"


@pytest.fixture(scope="session", params=["six axes", "uneven"])
def imported(request, tmp_path_factory):
    """A robot's file, the scene it was imported to, and the links that are solids."""
    folder = tmp_path_factory.mktemp("robot")
    if request.param == "six axes":
        file, motion, links = DEMO, DEMO_MOTION, "upper_arm,forearm"
    else:
        file, motion, links = write_uneven(folder), folder / "motion.csv", "upper,lower"
        motion.write_text(UNEVEN_MOTION)
    run_import(file, links, motion, folder / "scene")
    return file, folder / "scene" / f"{file.stem}.toml", tuple(links.split(","))
