"""Parts from Python."""

import numpy as np
import pytest
from runs import TWO_ARM

from dolfinopt import Model
from dolfinopt.errors import InputError

pytestmark = pytest.mark.serial
SMALL = ("arms.cells=[20, 4]", "optimizer.max_iterations=2", "simulation.sample=0.01")


def test_result_and_files_hold_what_was_projected(tmp_path):
    """Its projection is monotone: denser cells were denser before."""
    model = Model(TWO_ARM, *SMALL, "design.projection=robust")
    result = model.optimize()
    assert result.filtered.keys() == result.design.keys()
    for name, x_phys in result.design.items():
        order = np.argsort(result.filtered[name])
        assert (np.diff(x_phys[order]) >= -1e-12).all()
        assert np.ptp(x_phys) > 0.1
    model._design_file(result, tmp_path / "design.npz")
    with np.load(tmp_path / "design.npz") as data:
        np.testing.assert_array_equal(data["arm2/filtered"], result.filtered["arm2"])


def test_parts_of_a_design(tmp_path):
    model = Model(TWO_ARM, *SMALL)
    design = {}
    for name, points in model.centroids.items():
        x, y = points.T
        design[name] = 1.0 * ((np.abs(y) > 0.015) | (np.abs(x - 0.5) < 0.06))
    parts = model.make_parts(design, tmp_path / "parts", tolerance=1e-3)
    for part in parts.values():
        assert part.shape.area == pytest.approx(part.domain.volume, rel=1e-6)
        assert len(part.shape.loops) == 3
    assert (tmp_path / "parts" / "arm2.step").exists()
    with pytest.raises(InputError, match="holds results already"):
        model.make_parts(design, tmp_path / "parts")
