"""Trusses in place of parts, and parts without a strut."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from parts import folder_with, frame

from dolfinopt.cli.shared import scene_of
from dolfinopt.part.part import make_parts
from dolfinopt.part.plane.curves import MIRROR
from dolfinopt.part.plane.free_outline import free_outline
from dolfinopt.part.plane.layouts import struts_of, trusses_of, without

pytestmark = pytest.mark.serial


@pytest.fixture(scope="module", params=[False, True], ids=["free", "symmetric"])
def truss(request, tmp_path_factory):
    """A frame's part, and a truss in its place."""
    text = f"arms.0.symmetric={str(request.param).lower()}"
    path = tmp_path_factory.mktemp("layouts") / "run"
    folder = folder_with(path, frame, "arms.cells=[100,6]", "arms.0.passive=0", text)
    parts = make_parts(scene_of(folder), folder)
    return parts[0], trusses_of(parts, 0)[0]


def test_truss_has_interfaces_and_area_of_the_part(truss):
    part, made = truss
    # `make_shape` moves the curves until the area is that of the densities.
    assert made.shape.area == pytest.approx(part.domain.volume, rel=1e-6)
    ends, others = (
        sorted((p.label, *p.curve.start, *p.curve.end) for p in one.shape.pieces if p.label)
        for one in (part, made)
    )
    assert len(ends) == 2
    np.testing.assert_allclose([e[1:] for e in others], [e[1:] for e in ends], atol=1e-9)
    assert len(made.shape.loops) > 5 and made.shape.is_simple(1e-5)


def test_number_of_a_truss_is_another_length_of_bays(truss):
    part, made = truss
    holes = [len(trusses_of({0: part}, k)[0].shape.loops) for k in range(3)]
    assert len(set(holes)) == 3 and holes[0] == len(made.shape.loops)


def test_part_without_a_strut_has_a_hole_less(truss):
    """Of a frame with three between holes whose curves are all free, on the mirror's axis."""
    outline = free_outline(truss[0])
    wide = replace(outline, least=(0.03, 0.0))  # m: so that its struts count as thin
    struts = struts_of(wide)
    assert len(struts) == 3
    first = struts[0]
    others = [one for one in struts[1:] if one.beside.isdisjoint(first.beside)]
    for gone in ([first], [first, *others[:1]]):
        left = without(outline, gone)
        assert len(left.shape.loops) == len(outline.shape.loops) - len(gone)
        assert left.is_valid and left.shape.area < outline.shape.area - 1e-4 * len(gone)  # m2
        if outline.partner is not None:
            points = np.vstack([one.points for one in left.runs])
            apart = np.linalg.norm(points[:, None] - points * MIRROR, axis=2).min(axis=1)
            assert apart.max() < 1e-9


def test_truss_of_thick_members_is_heavier_than_a_part_of_thin_ones(truss):
    """Flanges and struts are as thick as they must be, whatever the part's area is."""
    part, made = truss
    least = 0.016  # m: two flanges alone are half of the arm's height
    heavy = trusses_of({0: replace(part, domain=replace(part.domain, minimum_member=least))}, 0)[0]
    assert heavy.shape.area > 1.05 * made.shape.area
    assert heavy.thinnest is None or heavy.thinnest > 0.9 * least
