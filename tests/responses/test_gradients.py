"""The gradient contract: of every response, in every setting, remainders are of second order."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from machines import demo_machine
from remainders import hold_instants, taylor, wave
from runs import by_root

import dolfinopt as do
from dolfinopt.fem.elements import ELEMENTS
from dolfinopt.scene.tables.objective import EXACT_ONLY, FORCES, NEEDS, POLES, ObjectiveKind

ROUGHLY = ("simulation.tolerance=1e-4", "simulation.sample=0.01", "objective.gradient=exact")
SHORT = ("arms.passive=0", "design.filter_radius=0", "motion.horizon=2.2", *ROUGHLY)
LOOP = ("motion.speed=60", "motion.duration=0.05", "motion.horizon=0.1", "design.initial=0.5")
# Scene, what makes it small, and its kinds of machine.
BASES = {
    "two_arm": ("two_arm", ("arms.cells=[20,3]", *SHORT)),
    "one_arm": ("two_arm", ("arms.cells=[20,3]", "motion.radius=0.4", *SHORT)),
    "three_arm": ("three_arm", ("arms.cells=[20,3]", *SHORT)),
    "controlled": ("controlled_two_arm", ("arms.cells=[20,3]", *SHORT)),
    "slider": (
        "slider_crank",
        ("arms.rod.cells=[24,3]", "arms.rod.height=0.008", "arms.rod.passive=0", *LOOP, *ROUGHLY),
    ),
    "pin": (
        "four_bar",
        ("arms.coupler.cells=[24,3]", "arms.rocker.cells=[24,3]", "arms.coupler.passive=0",
         "arms.rocker.passive=0", *LOOP, *ROUGHLY),
    ),
    "space": (
        "spatial_arm",
        ("arms.link1.cells=[8,2,2]", "arms.link2.cells=[8,2,2]", "arms.passive=0.06",
         "simulation.stiffening=false", "objective.load_cases=6", *ROUGHLY),
    ),
    "fork": ("", ROUGHLY[2:]),
}  # fmt: skip
FILES = {
    "drives.csv": "t,cart,arm1,arm2\n0,0,0,0\n0.7,20,5,-3\n1.4,-20,0,2\n2.2,0,0,0\n",
    "push.csv": "t,fx,fy,mz\n0,0,20,1\n0.7,40,-20,5\n1.4,-60,0,-2\n2.0,10,30,0\n",
    "twist.csv": "t,fx,fy,fz,mx,my,mz\n"
                 "0,0,1,2,0,0.5,1\n0.1,10,-5,2,1,0,0\n0.2,0,5,0,-1,1,0.2\n",
    # Strokes with a stop between them.
    "strokes.csv": "t,cart,arm1,arm2\n"
                   "0,0,2,-1.5\n0.6,0.1,1.5,-1\n0.9,0.1,1.5,-1\n1.9,0,1,-0.8\n",
    "spatial.csv": "t,yaw,shoulder,elbow\n"
                   "0,0,0.4,-1.9\n0.2,0.4,0.7,-1.5\n0.3,0.4,0.7,-1.5\n0.5,1,1,-1\n",
    "skew.geo": """Point(1) = {0, -0.03, 0}; Point(2) = {1, -0.03, 0}; Point(3) = {1, 0.03, 0};
Point(4) = {0, 0.03, 0}; Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4}; Plane Surface(1) = {1};
Transfinite Curve {1} = 25 Using Progression 1.05; Transfinite Curve {3} = 25;
Transfinite Curve {2, 4} = 4; Transfinite Surface {1};
Physical Curve("inboard") = {4}; Physical Curve("outboard") = {2};
""",
}  # fmt: skip


def scene_of(base: str, changes: tuple[str, ...], folder: Path) -> do.Scene:
    """Return a scene of `BASES` with keys changed, FOLDER standing for the files' one."""
    by_root(lambda: [(folder / file).write_text(text) for file, text in FILES.items()])
    name, quick = BASES[base]
    return demo_machine(name, (*quick, *changes), folder, one_arm=base == "one_arm")


def case(base: str, *changes: str, slow: bool = False, ranks: bool = False):
    marks = [*[pytest.mark.slow] * slow, *[pytest.mark.serial] * (not ranks)]
    told = [one.removeprefix("objective.") for one in changes]
    return pytest.param(base, changes, marks=marks, id=" ".join((base, *told)))


BENT = "simulation.stiffening=true"
LINEAR = "simulation.stiffening=false"
GRAVITY, SKEWED = "motion.gravity=[0.0,-9.81]", "motion.gravity=[0.5,-9.81]"
LOADED = (SKEWED, "payload.inertia=0.05")
KEPT = "constraints.compliance=1e6"  # N m; far away
COMPLIANCE, DEVIATION, STRESS = (
    f"objective.kind={kind}" for kind in ("compliance", "deviation", "stress")
)
EFFORT, PEAK = (("objective.kind=effort", KEPT), ("objective.kind=peak_force", KEPT))
SETTLING, ORIENTATION = "objective.kind=settling", "objective.kind=orientation"
BUCKLING = "objective.kind=buckling"
DAMPING, PERIOD = "objective.kind=damping_ratio", "objective.kind=pole_frequency"
IN_STROKES = ("motion.path=joints", "motion.file='FOLDER/strokes.csv'")
STATIC, FREQUENCY = "objective.kind=static", "objective.kind=eigenfrequency"
MODAL = "reduction.method=modal"
JOINT = ("arms.arm2.joint_mass=0.5", "arms.arm2.joint_inertia=0.01")
SOFT = ("arms.arm2.joint_stiffness=2e4", "arms.arm2.joint_damping=50.0")
GEARS = ("arms.gear_stiffness=3e4", "arms.gear_damping=30.0", "arms.rotor_inertia=2e-5",
         "arms.gear_ratio=100.0")  # fmt: skip
BEARINGS = "arms.bearing_stiffness=[1e6,2e6,0,0,0,5e4]"
WOUND = "control.feed_forward=elastic"
STIFF = "joints.bearing_stiffness=[1e7,2e7,3e7,1e5,2e5,0]"
IN_SPACE = ("joints.gear_stiffness=3e4", "joints.gear_damping=30.0", "joints.rotor_inertia=2e-5",
            "joints.gear_ratio=100.0", STIFF, "joints.friction=[5.0,3.0]",
            "joints.bearing_damping=[100,100,100,20,20,0]")  # fmt: skip
CRANK = "control={stiffness=[2e3], damping=[20.0]}"
MATERIAL = '"material.density=3100.0", "material.young_modulus=50e9"'
TWO = (
    f'scenarios=[{{changes=[{MATERIAL}, "damping.stiffness_proportional=1e-3"]}}, '
    '{changes=["motion.flattening=0.5", "motion.horizon=2.5", "payload.mass=8"], weight=0.3}]'
)
TWO_IN_SPACE = (
    'scenarios=[{changes=["payload.mass=2"]}, '
    '{changes=["material.young_modulus=60e9", "material.density=2500.0"], weight=2.0}]'
)
HELD = "control={stiffness=[2e4,2e4,2e4], damping=[600.0,600.0,600.0]}"
# A force of the world over time between the arms, one of the arm's frame at the end.
PUSHED = (
    'forces=[{arm="arm1", force=[30.0,-50.0], table="FOLDER/push.csv"}, '
    '{arm="arm2", force=[5.0,40.0], moment=-3.0, frame="arm"}]',
)
UNFORESEEN = (PUSHED[0].replace("-3.0,", "-3.0, feed_forward=false,"),)
TRUST = (PUSHED[0].replace("arm1", "rod").replace("arm2", "rod"),)
PUSHED_FORK = (
    'forces=[{arm="link", interface="side", force=[3.0,-20.0,30.0], moment=[0.5,1.0,-2.0]}, '
    '{arm="hand", force=[5.0,10.0,-4.0], frame="arm"}, '
    '{arm="link", moment=[0.5,1.0,2.0], table="FOLDER/twist.csv", frame="arm"}]',
)
REPEATED = (
    "arms.cells=[40,4]", "arms.passive=0.05", "arms.arm2.pattern=arm1", "arms.arm2.length=0.8",
    "arms.arm2.height=0.045", "arms.arm2.thickness=0.012", "arms.symmetric=true",
    'arms.arm1.regions=[{kind="void", circle=[0.5, 0.0, 0.016]}, '
    '{kind="solid", box=[0.2, -0.03, 0.3, -0.01]}]',
)  # fmt: skip
CASES = [
    # Prescribed motions in the plane.
    case("two_arm", "reduction.coordinates=3"),
    case("two_arm", COMPLIANCE, "reduction.coordinates=4", ranks=True),
    case("two_arm", "reduction.coordinates=6", *LOADED),
    case("two_arm", MODAL, "reduction.coordinates=1"),
    case("two_arm", MODAL, "reduction.coordinates=4", *LOADED),
    case("two_arm", "damping.stiffness_proportional=0.0"),
    case("two_arm", DEVIATION, *LOADED),
    case("two_arm", COMPLIANCE, "payload.mass=0.2", "arms.passive=0.05", *LOADED),
    case("two_arm", *EFFORT, "payload.mass=0.5"),
    case("two_arm", *EFFORT, MODAL, BENT, *LOADED),
    case("two_arm", *EFFORT, BENT, GRAVITY),
    case("two_arm", DEVIATION, BENT),
    case("two_arm", "arms.mesh='FOLDER/skew.geo'", "design.filter_radius=0.02", COMPLIANCE, BENT),
    *(case("two_arm", COMPLIANCE, f"arms.element={name}", bent, "arms.cells=[12,2]")
      for name in ELEMENTS for bent in (LINEAR, BENT)),
    *(case("two_arm", COMPLIANCE, "reduction.method=krylov", f"reduction.coordinates={q}",
           f"reduction.shifts={shifts}", "payload.mass=1", slow=q > 4)
      for q, shifts in ((3, [0.0]), (4, [0.0]), (8, [0.0]), (13, [0.0]), (8, [0.0, 30.0]))),
    # Nothing moves: neither basis nor integrator matters.
    case("two_arm", STATIC, ranks=True),
    case("two_arm", STATIC, "reduction.method=balanced", "objective.gradient=esl", ranks=True),
    case("two_arm", STATIC, "arms.arm2.length=0.7", "arms.height=0.1",
         "objective.loads=[[0.0,1.0,0.0],[30.0,1.0,-2.0],[0.0,0.0,1.0]]", ranks=True),
    case("two_arm", STATIC, "arms.passive=0.1", "interpolation.law=simp", ranks=True),
    case("two_arm", STATIC, "arms.arm2.design=arm1", ranks=True),
    case("two_arm", STATIC, "arms.mesh='FOLDER/skew.geo'", "design.filter_radius=0.02", ranks=True),
    case("two_arm", FREQUENCY, ranks=True),
    case("two_arm", FREQUENCY, "simulation.integrator=generalized-alpha",
         "objective.gradient=esl", ranks=True),
    case("two_arm", FREQUENCY, "objective.elbow_angle=2.1", "payload.inertia=0.4"),
    case("two_arm", FREQUENCY, "objective.follow=true"),
    case("two_arm", FREQUENCY, "objective.attached=point-mass"),
    case("two_arm", FREQUENCY, "objective.attached=none", "arms.passive=0.1"),
    case("two_arm", FREQUENCY, "arms.arm2.design=arm1", "objective.exponent=3.0"),
    case("two_arm", FREQUENCY, "arms.arm2.design=arm1", "objective.attached=point-mass"),
    case("two_arm", FREQUENCY, "arms.joint_mass=2.0", "arms.joint_inertia=0.1"),
    case("two_arm", FREQUENCY, "arms.arm1.rigid=true", ranks=True),
    case("two_arm", FREQUENCY, "arms.arm2.rigid=true"),
    case("two_arm", FREQUENCY, "arms.arm2.density=8000.0", "arms.arm2.young_modulus=2e11",
         "interpolation.law=simp"),
    # Stress.
    case("two_arm", STRESS, LINEAR, slow=True),
    case("two_arm", STRESS, BENT, "damping.stiffness_proportional=1e-3", slow=True),
    case("two_arm", STRESS, BENT, MODAL, slow=True),
    case("two_arm", STRESS, "reduction.method=krylov", slow=True),
    case("two_arm", STRESS, "arms.element=linear", "objective.stress_margin=0.1", slow=True),
    case("two_arm", STRESS, TWO, slow=True),
    case("controlled", STRESS),
    case("slider", STRESS),
    # Scenarios.
    *(case("two_arm", f"objective.scenarios={combined}", "objective.load_cases=6", TWO, *more,
           slow=True)
      for combined in ("sum", "worst")
      for more in ((), (DEVIATION, "reduction.coordinates=3"),
                   ("arms.arm2.design=arm1", MODAL), ("arms.arm1.rigid=true",))),
    # Two arms of one design, by the densities of one; of the same size, or scaled.
    *(case("two_arm", *REPEATED, kind, ranks=kind == STATIC)
      for kind in ("objective.kind=esl", STATIC, FREQUENCY, DEVIATION)),
    case("two_arm", *REPEATED, STATIC, "interpolation.law=simp"),
    # Other numbers of arms.
    case("one_arm", COMPLIANCE, "motion.law=trapezoidal"),
    case("three_arm", "motion.law=s-curve", "objective.load_cases=5", slow=True),
    # Machines: control, hardware at the joints, closed loops.
    case("controlled"),
    case("controlled", BENT, GRAVITY, slow=True),
    case("controlled", COMPLIANCE, GRAVITY, "control.feed_forward=none"),
    case("controlled", COMPLIANCE, "control.feed_forward=none",
         "control.forces='FOLDER/drives.csv'"),
    case("controlled", COMPLIANCE, *JOINT, "motion.cart_mass=2.0", "arms.arm2.rotor_inertia=1e-4",
         "arms.arm2.gear_ratio=30.0", slow=True),
    case("controlled", GRAVITY, "arms.joint_stiffness=3e4", "arms.joint_damping=30.0",
         "arms.rotor_inertia=2e-5", "arms.gear_ratio=100.0"),
    case("two_arm", DEVIATION, *JOINT, *SOFT),
    case("two_arm", COMPLIANCE, BENT, GRAVITY, BEARINGS, ranks=True),
    case("two_arm", COMPLIANCE, TWO, BEARINGS, slow=True),
    case("controlled", DEVIATION, GRAVITY, *GEARS, BEARINGS, WOUND, "arms.friction=[5.0,3.0]"),
    case("controlled", *EFFORT, GRAVITY, *GEARS, WOUND, "arms.friction=[5.0,3.0]"),
    case("two_arm", *EFFORT, GRAVITY, BEARINGS, *SOFT, "arms.friction=[5.0,3.0]", slow=True),
    case("controlled", *EFFORT, GRAVITY),
    case("controlled", *EFFORT, GRAVITY, "control.limits=[150.0,200.0,150.0]",
         "control.forces='FOLDER/drives.csv'", *SOFT),
    case("two_arm", *EFFORT, *JOINT, *SOFT),
    case("controlled", *PEAK, BENT),
    case("slider"),
    case("slider", DEVIATION, GRAVITY),
    case("slider", CRANK, GRAVITY),
    case("slider", CRANK, "control.limits=[36.0]", GRAVITY, slow=True),  # of 43 N m asked for
    case("slider", CRANK, "control.stiffness=[0.0]", GRAVITY),
    case("slider", *EFFORT, GRAVITY),
    case("slider", *EFFORT, CRANK),
    case("slider", *EFFORT, CRANK, WOUND, "arms.crank.gear_stiffness=3e3",
         "arms.rod.gear_stiffness=0", "arms.friction=[0.1,0.5]"),
    case("slider", *EFFORT, CRANK, "control.limits=[40.0]"),
    case("slider", *PEAK, GRAVITY),
    case("pin", slow=True),
    case("pin", *EFFORT, slow=True),
    # Space.
    case("space", DEVIATION, TWO_IN_SPACE, slow=True),
    case("space", "objective.kind=effort", "constraints.deviation=0.1", HELD, slow=True),
    case("space", STRESS, BENT, slow=True),
    case("space", "objective.kind=tip_deflection", slow=True),
    case("space", FREQUENCY, slow=True),
    case("fork", DEVIATION),
    case("fork", DEVIATION, BENT, STIFF, *(f"joints.{name}.{key}" for name in ("swing", "slide")
         for key in ("gear_stiffness=3e4", "gear_damping=30.0", "friction=[5.0,3.0]"))),
    case("space", DEVIATION, *IN_SPACE, HELD, slow=True),
    case("space", *EFFORT, *IN_SPACE, HELD.replace("{", "{feed_forward='elastic',"), slow=True),
    case("space", STRESS, *IN_SPACE, TWO_IN_SPACE, slow=True),
    case("fork", FREQUENCY),
    case("fork", FREQUENCY, STIFF),
    # Settling in every rest.
    case("two_arm", SETTLING, *IN_STROKES, "constraints.settling_after=0.05"),
    case("two_arm", SETTLING, "motion.dwells=[[0.5,0.7],[1.0,1.2]]"),
    case("controlled", SETTLING, *IN_STROKES, GRAVITY),
    case("space", SETTLING, "motion.path=joints", "motion.file='FOLDER/spatial.csv'",
         "motion.duration=0.5", "motion.horizon=0.6", slow=True),
    case("space", SETTLING, "motion.dwells=[[0.1,0.2]]", "constraints.settling_after=0.02",
         "motion.horizon=0.7", HELD, slow=True),
    # Orientation of the end-effector.
    case("two_arm", ORIENTATION, BENT, *LOADED),
    case("controlled", ORIENTATION, GRAVITY),
    case("slider", ORIENTATION, GRAVITY),
    case("pin", ORIENTATION, slow=True),
    case("fork", ORIENTATION),
    case("space", ORIENTATION, TWO_IN_SPACE, HELD, slow=True),
    # Buckling: of the chain of derivatives all parts.
    case("two_arm", BUCKLING, BENT, *LOADED, ranks=True),
    case("one_arm", BUCKLING, LINEAR, MODAL, ranks=True),
    case("two_arm", BUCKLING, "interpolation.law=simp", "arms.arm2.design=arm1"),
    case("two_arm", BUCKLING, TWO, slow=True),
    case("controlled", BUCKLING),
    case("slider", BUCKLING, GRAVITY, "motion.speed=30"),
    case("fork", BUCKLING),
    case("space", BUCKLING, slow=True),
    # Forces on interfaces.
    case("two_arm", DEVIATION, BENT, *LOADED, *PUSHED, ranks=True),
    case("two_arm", *EFFORT, *PUSHED, slow=True),
    case("two_arm", STRESS, BENT, *PUSHED, slow=True),
    case("two_arm", BUCKLING, BENT, *PUSHED, slow=True),
    case("two_arm", DEVIATION, TWO, *PUSHED, slow=True),
    case("controlled", DEVIATION, GRAVITY, *UNFORESEEN, slow=True),
    case("controlled", *EFFORT, GRAVITY, *PUSHED, slow=True),
    case("slider", COMPLIANCE, CRANK, *TRUST),
    case("pin", BENT, TRUST[0].replace("rod", "coupler"), slow=True),
    case("fork", DEVIATION, *PUSHED_FORK),
    case("fork", *EFFORT, *PUSHED_FORK, slow=True),
    # Poles of the closed loop: of the residual's second derivatives all parts.
    case("controlled", DAMPING, BENT, GRAVITY, "constraints.poles_at=[0.0,0.7,1.9]"),
    case("controlled", PERIOD, *UNFORESEEN, slow=True),
    case("controlled", DAMPING, GRAVITY, "control.limits=[150.0,200.0,150.0]",
         "arms.joint_stiffness=3e4", "arms.joint_damping=3.0", "arms.rotor_inertia=2e-5",
         "arms.gear_ratio=100.0", "constraints.damping_below=60.0", slow=True),
    case("space", DAMPING, HELD, BENT, slow=True),
    # Every word that a scene knows, through a filter: new ones are tested by their word alone.
    *(case("two_arm", f"objective.kind={kind}", "design.filter_radius=0.05", *limit, slow=True)
      for kind in get_args(ObjectiveKind) if kind not in POLES
      for limit in [[KEPT] * (kind in ("mass", *EXACT_ONLY))]),
]  # fmt: skip


@pytest.mark.parametrize(("base", "changes"), CASES)
def test_remainders_are_of_second_order(base, changes, shared_tmp_path, monkeypatch) -> None:
    """Along a random and a smooth direction; the gradient by ESL points the same way."""
    # Instants that come and go beneath the cut would make small steps of the p-mean.
    monkeypatch.setattr("dolfinopt.responses.stress.NEGLIGIBLE_POWER_SHARE", 0.0)
    hold_instants(monkeypatch)
    scene = scene_of(base, changes, shared_tmp_path)
    # Forces are made of accelerations, which leave more rounding.
    steps = (1e-3, 2.5e-4) if scene.objective.kind in FORCES else (4e-4, 1e-4)
    test = taylor(scene, wave, steps, ("random", "smooth"))
    rates = [row.rate for row in test.rows]
    kind = scene.objective.kind
    if kind == "mass":  # linear in the densities of this law
        assert rates == [np.inf, np.inf]
    else:
        assert rates == pytest.approx([2.0, 2.0], abs=0.1)
        assert all(row.slope != 0.0 for row in test.rows)
    assert np.isfinite(test.angle) == ("motion" in NEEDS[kind] and kind not in EXACT_ONLY)
    # Frozen loads tell the sign, no more; of three fast arms not even that.
    assert base == "three_arm" or not test.angle > 45.0  # deg
