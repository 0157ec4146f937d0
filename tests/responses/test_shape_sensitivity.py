"""Gradients by the places of nodes: remainders of second order, a closed form, on any ranks.

The reference is the whole program on meshes whose nodes are moved.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from machines import demo_machine
from moved_nodes import built_with, node_test, noise
from remainders import hold_instants, rates, wave
from runs import by_root, minimising

import dolfinopt as do
from dolfinopt.arms.arm import Arm
from dolfinopt.arms.design_state import DesignState
from dolfinopt.fem.geometric_stiffness import static_response
from dolfinopt.fem.shape_derivative import ShapeDerivative
from dolfinopt.responses.evaluation import gradient
from dolfinopt.responses.products import Products, by_nodes
from dolfinopt.responses.sensitivity import esl_gradient

ROUGHLY = ("simulation.tolerance=1e-4", "simulation.sample=0.01", "objective.gradient=exact")
TRIANGLES = ("arms.mesh='FOLDER/bar.geo'", "arms.cell_shape=triangle")
QUADRILATERALS = ("arms.cells=[12,2]",)
SHORT = ("arms.passive=0", "design.filter_radius=0", "motion.horizon=2.2", *ROUGHLY)
LINK = ("arms.link1.cells=[5,1,1]", "arms.link2.cells=[5,1,1]", "arms.passive=0.06",
        "objective.load_cases=6", "design.filter_radius=0", *ROUGHLY)  # fmt: skip
ROD = ("arms.rod.height=0.008", "arms.rod.passive=0", "motion.speed=60", "motion.duration=0.05",
       "motion.horizon=0.1", *ROUGHLY)  # fmt: skip
# Quadratic unless a case says otherwise; the outlines of tests/responses/test_gradients.py's bars.
BAR = """Point(1) = {0, -0.03, 0}; Point(2) = {1, -0.03, 0}; Point(3) = {1, 0.03, 0};
Point(4) = {0, 0.03, 0}; Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4}; Plane Surface(1) = {1};
Transfinite Curve {1, 3} = 13; Transfinite Curve {2, 4} = 3; Transfinite Surface {1};
Physical Curve("inboard") = {4}; Physical Curve("outboard") = {2};
"""
BASES = {  # scene, what makes it small, size of a move (m), whether boxes are cut into tetrahedra
    "triangles": ("two_arm", (*SHORT, *TRIANGLES), 0.015, False),
    "one arm": ("two_arm", (*SHORT, *QUADRILATERALS, "motion.radius=0.4"), 0.015, False),
    # Of unknown cells before it is meshed: on two ranks one looks on.
    "lone file": ("two_arm", (*SHORT, *TRIANGLES, "motion.radius=0.4"), 0.015, False),
    "controlled": ("controlled_two_arm", (*SHORT, *TRIANGLES), 0.015, False),
    "quadrilaterals": ("two_arm", (*SHORT, *QUADRILATERALS), 0.015, False),
    "tetrahedra": ("spatial_arm", LINK, 0.01, True),
    "hexahedra": ("spatial_arm", LINK, 0.01, False),
    "fork": ("", ("simulation.sample=0.01", *ROUGHLY[2:]), 0.005, False),
    "slider": ("slider_crank", ("arms.rod.cells=[12,2]", *ROD), 0.001, False),
}
BENT, LINEAR = "simulation.stiffening=true", "simulation.stiffening=false"
GRAVITY = "motion.gravity=[0.5,-9.81]"
KEPT = "constraints.compliance=1e6"  # N m; far away
MODAL, KRYLOV = "reduction.method=modal", ("reduction.method=krylov", "reduction.coordinates=8")
MATERIAL = '"material.density=3100.0", "material.young_modulus=50e9"'
TWO = f'scenarios=[{{changes=[{MATERIAL}]}}, {{changes=["payload.mass=8"], weight=0.3}}]'
CONTROL = "control={stiffness=[2e4,2e4,2e4], damping=[600.0,600.0,600.0]}"


def case(base: str, kind: str, *changes: str, ranks: bool = False, slow: bool = False):
    marks = [*[pytest.mark.slow] * slow, *[pytest.mark.serial] * (not ranks)]
    told = (f"objective.kind={kind}", *changes)
    return pytest.param(base, told, marks=marks, id=" ".join((base, kind, *changes)))


CASES = [
    case("triangles", "mass", KEPT, ranks=True),
    case("triangles", "static", ranks=True),
    case("triangles", "tip_deflection"),
    case("triangles", "eigenfrequency", "payload.inertia=0.4", ranks=True),
    case("triangles", "esl", LINEAR),
    case("triangles", "compliance", LINEAR, GRAVITY, "payload.inertia=0.05", ranks=True),
    case("triangles", "compliance", BENT, GRAVITY, ranks=True),
    case("triangles", "compliance", LINEAR, "arms.arm2.design=arm1"),
    case("triangles", "compliance", BENT, *KRYLOV),
    case("triangles", "compliance", LINEAR, TWO),
    case("triangles", "deviation", LINEAR, GRAVITY),
    case("triangles", "deviation", BENT, "reduction.coordinates=6"),
    case("triangles", "settling", LINEAR),
    case("triangles", "effort", KEPT, LINEAR),
    case("triangles", "peak_force", KEPT, BENT),
    case("triangles", "stress", LINEAR, "objective.stress_margin=0.1"),
    case("triangles", "stress", BENT, MODAL, GRAVITY),
    case("one arm", "stress", BENT, GRAVITY, ranks=True),
    case("one arm", "deviation", LINEAR, MODAL, ranks=True),
    case("lone file", "stress", BENT, GRAVITY, ranks=True),
    case("triangles", "buckling", BENT, GRAVITY, "payload.inertia=0.05", ranks=True),
    case("triangles", "buckling", LINEAR, MODAL),
    case("one arm", "buckling", BENT, GRAVITY, ranks=True),
    case("controlled", "esl", LINEAR),
    case("controlled", "deviation", BENT),
    case("controlled", "settling", BENT, slow=True),
    case("controlled", "effort", KEPT, BENT),
    case("controlled", "stress", BENT, slow=True),
    *(case("quadrilaterals", "compliance", f"arms.element={name}", BENT)
      for name in ("incompatible", "linear", "quadratic")),
    case("quadrilaterals", "mass", KEPT, LINEAR),
    case("quadrilaterals", "stress", BENT),
    case("quadrilaterals", "buckling", BENT),
    case("tetrahedra", "mass", KEPT),
    case("tetrahedra", "static"),
    case("tetrahedra", "eigenfrequency"),
    case("tetrahedra", "compliance", LINEAR),
    case("tetrahedra", "deviation", BENT, slow=True),
    case("tetrahedra", "settling", LINEAR, "motion.dwells=[[0.1,0.2]]", slow=True),
    case("tetrahedra", "effort", "constraints.deviation=0.1", CONTROL, BENT, slow=True),
    case("tetrahedra", "stress", BENT, slow=True),
    case("tetrahedra", "buckling", LINEAR, slow=True),
    case("hexahedra", "mass", KEPT),
    case("hexahedra", "static"),
    case("hexahedra", "compliance", LINEAR),
    case("hexahedra", "deviation", BENT, slow=True),
    case("hexahedra", "effort", "constraints.deviation=0.1", CONTROL, BENT, slow=True),
    case("hexahedra", "stress", BENT, slow=True),
    case("hexahedra", "buckling", LINEAR, slow=True),
    # Two outboard interfaces; a closed loop.
    case("fork", "deviation", BENT),
    case("fork", "eigenfrequency"),
    case("fork", "buckling", BENT),
    case("slider", "deviation", GRAVITY),
    case("slider", "stress", BENT, slow=True),
]  # fmt: skip


def scene_of(base: str, changes: tuple[str, ...], folder: Path) -> do.Scene:
    """Return a scene of `BASES` with keys changed, FOLDER standing for the files' one."""
    by_root(lambda: (folder / "bar.geo").write_text(BAR))
    name, quick, _, _ = BASES[base]
    alone = base in ("one arm", "lone file")
    return demo_machine(name, (*quick, *changes), folder, one_arm=alone)


@pytest.mark.parametrize(("base", "changes"), CASES)
def test_remainders_are_of_second_order(base, changes, shared_tmp_path, monkeypatch) -> None:
    """Along random moves of all nodes of uneven meshes, those of interfaces included."""
    # Instants that come and go beneath the cut would make small steps of the p-mean.
    monkeypatch.setattr("dolfinopt.responses.stress.NEGLIGIBLE_POWER_SHARE", 0.0)
    hold_instants(monkeypatch)
    monkeypatch.setattr("dolfinopt.parallel.SPLIT_CELLS", 1)  # one arm on two ranks is cut in two
    scene = scene_of(base, changes, shared_tmp_path)
    _, _, size, cut = BASES[base]
    # The margin of cells near the interfaces moves with the nodes: none may come or go.
    found = node_test(scene, wave, size, cut=cut)
    assert found.slope != 0.0
    assert found.rate == pytest.approx(2.0, abs=0.1)


@pytest.mark.serial
@pytest.mark.parametrize(
    ("kind", "part"),
    [("effort", "places"), ("compliance", "interfaces"), ("stress", "volumes"),
     ("stress", "stress"), ("compliance", "geometric_stiffness"), ("buckling", "prestress")],
)  # fmt: skip
def test_what_is_left_out_is_found(kind, part, shared_tmp_path, monkeypatch) -> None:
    """Each part of the chain alone: remainders become of first order."""
    monkeypatch.setattr("dolfinopt.responses.stress.NEGLIGIBLE_POWER_SHARE", 0.0)
    hold_instants(monkeypatch)
    if part == "geometric_stiffness":

        def none(shape: ShapeDerivative, *_: object) -> np.ndarray:
            return np.zeros_like(shape.corners)

        monkeypatch.setattr(ShapeDerivative, part, none)
    else:

        def without(state: DesignState, products: Products) -> np.ndarray:
            return by_nodes(state, replace(products, **{part: None}))

        monkeypatch.setattr("moved_nodes.by_nodes", without)
    told = f"objective.kind={kind}", "payload.mass=0.1", KEPT, BENT, GRAVITY
    scene = scene_of("triangles", told, shared_tmp_path)
    assert node_test(scene, wave, 0.015).rate < 1.7


@pytest.mark.serial
def test_height_of_a_bar_bent_by_a_moment(shared_tmp_path) -> None:
    """Compliance M^2 L / (E t h^3 / 12) and mass: exact in quadratic triangles without nu."""
    moment, told = 3.0, ("objective.kind=static", "material.poisson_ratio=0.0", KEPT)  # N m
    scene = scene_of("triangles", (*told, f"objective.loads=[[0,0,{moment}]]"), shared_tmp_path)
    built = built_with(scene, lambda arm, x: np.zeros_like(x))
    built.evaluate(built.uniform(1.0))
    compliance, mass = (_along_height(one, built) for one in (scene, minimising(scene, "mass")))
    arm, material = scene.arms[0], scene.material
    bent = moment**2 * arm.length / (material.young_modulus * arm.thickness * arm.height**3 / 12.0)
    assert compliance == pytest.approx([-3.0 * bent] * 2, rel=1e-8)  # a step of h / h
    one = material.density * arm.length * arm.height * arm.thickness
    assert mass == pytest.approx([one] * 2, rel=1e-12)


def _along_height(scene: do.Scene, built) -> list[float]:
    """Return the objective's derivative by the relative height of every arm."""
    found = gradient(scene, built.partition, built.arms, None, built.profile, by=by_nodes)
    places = {k: arm.mesh.mesh.geometry.x[:, 1] for k, arm in built.arms.items()}
    return [float(found[k][:, 1] @ y) for k, y in places.items()]


@pytest.mark.serial
@pytest.mark.parametrize("base", ["triangles", "tetrahedra"])
def test_frozen_loads(base, shared_tmp_path) -> None:
    """The gradient by equivalent static loads is that of the compliance under held loads."""
    _, _, size, cut = BASES[base]
    scene = scene_of(base, (LINEAR,), shared_tmp_path)
    loads: list[np.ndarray] = []

    def compliance(h: float) -> tuple[Arm, float]:
        def places(arm: str, x: np.ndarray) -> np.ndarray:
            return size * (0.2 * noise(arm, x, 7) + h * noise(arm, x))

        arm = next(iter(built_with(scene, places, cut).arms.values()))
        arm.set_design(np.ones(arm.mesh.num_cells))
        elastic = arm.current.elastic
        nodes = elastic.interior_nodes  # in an order that moves may change
        if not loads:
            interior, outboard = elastic.restrict(elastic.stiffness_times(arm.current.basis.V))
            nodal = np.zeros(arm.current.basis.V.shape)
            nodal[nodes] = interior.reshape(len(nodes), *nodal.shape[1:])
            loads.extend((nodal, outboard))
        interior = loads[0][nodes].reshape(-1, loads[0].shape[2])
        u = static_response(elastic, interior, loads[1])
        return arm, float(np.trace(elastic.energy_matrix(u)))

    arm, _ = compliance(0.0)
    found = esl_gradient(arm.current, np.eye(loads[0].shape[2]), by_nodes)
    even: dict[str, np.ndarray] = {}
    built_with(scene, lambda name, x: np.zeros_like(x), cut, even)
    slope = size * float(np.sum(found * noise(arm.mesh.name, even[arm.mesh.name])))
    assert rates(lambda h: compliance(h)[1], slope) == pytest.approx(2.0, abs=0.05)
