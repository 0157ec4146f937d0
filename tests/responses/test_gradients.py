"""The gradient contract: of every response, by densities and by nodes, in every setting.

Remainders are of second order along random directions. The reference is the whole program: of
densities that are changed, and on meshes whose nodes are moved.
"""

import numpy as np
import pytest
from loops import BOOM_TABLE, SOFT, bennett, boom, closed, four_bar
from machines import demo_machine
from moved_nodes import node_test
from remainders import built_of, hold_instants, limit_rates, taylor, wave
from runs import by_root

import dolfinopt as do
from dolfinopt.fem.forms import ELEMENTS
from dolfinopt.responses.response import constraints_of
from dolfinopt.scene.tables.responses import DECLARED, objective_kinds

ROUGHLY = ("simulation.tolerance=1e-3", "simulation.sample=0.01", "objective.gradient=exact")
SHORT = ("arms.cells=[12,2]", "arms.passive=0", "design.filter_radius=0", "motion.horizon=2.2",
         *ROUGHLY)  # fmt: skip
LOOP = ("motion.speed=60", "motion.duration=0.05", "motion.horizon=0.1", "design.initial=0.5",
        *ROUGHLY)  # fmt: skip
LINK = ("arms.link1.cells=[5,1,1]", "arms.link2.cells=[5,1,1]", "arms.passive=0.06",
        "objective.load_cases=6", "design.filter_radius=0", *ROUGHLY)  # fmt: skip
BASES = {  # demo, what makes it small, and the largest move of a node, m
    "two_arm": ("two_arm", SHORT, 0.015),
    "one_arm": ("two_arm", (*SHORT, "motion.radius=0.4"), 0.015),
    "three_arm": ("three_arm", SHORT, 0.015),
    "controlled": ("controlled_two_arm", SHORT, 0.015),
    "slider": ("slider_crank", ("arms.rod.cells=[12,2]", "arms.rod.height=0.008",
                                "arms.rod.passive=0", *LOOP), 0.001),
    "pin": ("four_bar", ("arms.coupler.cells=[12,2]", "arms.rocker.cells=[12,2]",
                         "arms.coupler.passive=0", "arms.rocker.passive=0", *LOOP), 0.001),
    "space": ("spatial_arm", LINK, 0.01),
    "tetrahedra": ("spatial_arm", LINK, 0.01),  # boxes cut into six
    "fork": ("", ("simulation.sample=0.01", *ROUGHLY[2:]), 0.005),
}  # fmt: skip
BAR = """Point(1) = {0, -0.03, 0}; Point(2) = {1, -0.03, 0}; Point(3) = {1, 0.03, 0};
Point(4) = {0, 0.03, 0}; Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4}; Plane Surface(1) = {1}; %s Transfinite Surface {1};
Physical Curve("inboard") = {4}; Physical Curve("outboard") = {2};
"""
WHOLE = "integral_compliance"  # of the whole horizon
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
    "skew.geo": BAR % "Transfinite Curve {1} = 13 Using Progression 1.05; "
                      "Transfinite Curve {3} = 13; Transfinite Curve {2, 4} = 3;",
    "bar.geo": BAR % "Transfinite Curve {1, 3} = 13; Transfinite Curve {2, 4} = 3;",
}  # fmt: skip
# Closed loops in space.
TURNED = SOFT | {"motion": {"horizon": 0.35, "gravity": [0, -9.81, 3.0]}}
CLOSED = {
    "boom": (BOOM_TABLE, boom(), {}),
    "loop": ("t,turn\n0,0.5\n0.3,2.5\n", four_bar(), TURNED),
    "bennett": ("t,j1\n0,0.5\n0.3,1.5\n", bennett(), TURNED | {"simulation": {"tolerance": 1e-4}}),
}


def scene_of(base, changes, folder):
    """Return a scene with keys changed, FOLDER standing for the files' one (collective)."""
    by_root(lambda: [(folder / file).write_text(text) for file, text in FILES.items()])
    if base in CLOSED:
        table, tree, tables = CLOSED[base]
        whole = closed(folder, table, tree, **tables)
        return do.scene_from_dict(whole.to_tree(), whole.source, changes)
    name, quick, _ = BASES[base]
    return demo_machine(name, (*quick, *changes), folder, one_arm=base == "one_arm")


def case(base, kind, *changes, ranks=False, slow=False):
    """Return a case: base, objective ("": the base's own) and keys."""
    lightest = kind in ("mass", "effort", "peak_force")
    kept = ["constraints.compliance=1e6"] * lightest  # N m; far away
    told = [f"objective.kind={kind}"] * (kind != "") + kept
    marks = [*[pytest.mark.slow] * slow, *[pytest.mark.serial] * (not ranks)]
    return pytest.param(base, (*told, *changes), marks=marks, id=" ".join((base, kind, *changes)))


FINER = ("arms.cells=[20,3]",)  # where remainders of 12 cells are not yet of second order
LINKS = ("arms.link1.cells=[8,2,2]", "arms.link2.cells=[8,2,2]")
BENT, LINEAR = "simulation.stiffening=true", "simulation.stiffening=false"
GRAVITY, SKEWED = "motion.gravity=[0.0,-9.81]", "motion.gravity=[0.5,-9.81]"
LOADED = (SKEWED, "payload.inertia=0.05")
SHARED, SIMP = "arms.arm2.design=arm1", "interpolation.law=simp"
MODAL, KRYLOV = "reduction.method=modal", ("reduction.method=krylov", "reduction.coordinates=8")
IN_STROKES = ("motion.path=joints", "motion.file='FOLDER/strokes.csv'")
DRIVES = "control.forces='FOLDER/drives.csv'"
SKEW = ("arms.mesh='FOLDER/skew.geo'", "design.filter_radius=0.02")
TRIANGLES = ("arms.mesh='FOLDER/bar.geo'", "arms.cell_shape=triangle")  # quadratic
JOINT = ("arms.arm2.joint_mass=0.5", "arms.arm2.joint_inertia=0.01")
ROTORS = ("arms.rotor_inertia=2e-5", "arms.gear_ratio=100.0")
SPRINGY = ("arms.joint_stiffness=3e4", "arms.joint_damping=30.0", *ROTORS)
YIELDING = ("arms.arm2.joint_stiffness=2e4", "arms.arm2.joint_damping=50.0")
GEARS = ("arms.gear_stiffness=3e4", "arms.gear_damping=30.0", *ROTORS)
BEARINGS, RUB = "arms.bearing_stiffness=[1e6,2e6,0,0,0,5e4]", "arms.friction=[5.0,3.0]"
WOUND = "control.feed_forward=elastic"
STIFF = "joints.bearing_stiffness=[1e7,2e7,3e7,1e5,2e5,0]"
IN_SPACE = ("joints.gear_stiffness=3e4", "joints.gear_damping=30.0", "joints.rotor_inertia=2e-5",
            "joints.gear_ratio=100.0", STIFF, "joints.friction=[5.0,3.0]",
            "joints.bearing_damping=[100,100,100,20,20,0]")  # fmt: skip
CRANK = "control={stiffness=[2e3], damping=[20.0]}"
HELD = "control={stiffness=[2e4,2e4,2e4], damping=[600.0,600.0,600.0]}"
MATERIAL = '"material.density=3100.0", "material.young_modulus=50e9"'
TWO = (
    f'scenarios=[{{changes=[{MATERIAL}, "damping.stiffness_proportional=1e-3"]}}, '
    '{changes=["motion.flattening=0.5", "motion.horizon=2.5", "payload.mass=8"], weight=0.3}]'
)
TWO_IN_SPACE = (
    'scenarios=[{changes=["payload.mass=2"]}, '
    '{changes=["material.young_modulus=60e9", "material.density=2500.0"], weight=2.0}]'
)
TWO_GAINS = (
    'scenarios=[{changes=["payload.mass=3"]}, '
    '{changes=["control.stiffness_factor=0.1", "control.damping_factor=0.3"]}]'
)
TWO_SPEEDS = 'scenarios=[{changes=["closure.force=-50"]}, {changes=["motion.speed=75"]}]'
FEED = "feed_forward.kind=tip"
PAYLOADS = 'scenarios=[{changes=["payload.mass=5"]}, {changes=["payload.mass=7"]}]'
# A force of the world over time between the arms, one of the arm's frame at the end.
PUSHED = (
    'forces=[{arm="arm1", force=[30.0,-50.0], table="FOLDER/push.csv"}, '
    '{arm="arm2", force=[5.0,40.0], moment=-3.0, frame="arm"}]'
)
UNFORESEEN = PUSHED.replace("-3.0,", "-3.0, feed_forward=false,")
TRUST = PUSHED.replace("arm1", "rod").replace("arm2", "rod")
PUSHED_FORK = (
    'forces=[{arm="link", interface="side", force=[3.0,-20.0,30.0], moment=[0.5,1.0,-2.0]}, '
    '{arm="hand", force=[5.0,10.0,-4.0], frame="arm"}, '
    '{arm="link", moment=[0.5,1.0,2.0], table="FOLDER/twist.csv", frame="arm"}]'
)
REPEATED = (
    "arms.cells=[40,4]", "arms.passive=0.05", "arms.arm2.design=arm1", "arms.arm2.length=0.8",
    "arms.arm2.height=0.045", "arms.arm2.thickness=0.012", "arms.symmetric=true",
    'arms.arm1.regions=[{kind="void", circle=[0.5, 0.0, 0.016]}, '
    '{kind="solid", box=[0.2, -0.03, 0.3, -0.01]}]',
)  # fmt: skip
SPRUNG = ("closures.cylinder.stiffness=1e7", "closures.cylinder.damping=1e4")
BOOM_HELD = "control={stiffness=[1e6, 1e8], damping=[1e4, 1e5]}"
YIELDING_BOOM = (
    "joints.slew.gear_stiffness=1e5", "joints.slew.gear_damping=50", "joints.slew.friction=[1,0.5]",
    "joints.luff.bearing_stiffness=[2e7,2e7,2e7,1e5,1e5,0]",
    "joints.luff.bearing_damping=[2e3,2e3,2e3,10,10,0]",
)  # fmt: skip
CASES = [
    # Prescribed motions in the plane.
    case("two_arm", "", "reduction.coordinates=3"),
    case("two_arm", WHOLE, "reduction.coordinates=4", ranks=True),
    case("two_arm", "", MODAL, "reduction.coordinates=4", *LOADED),
    case("two_arm", "deviation", *LOADED),
    case("two_arm", WHOLE, "payload.mass=0.2", "arms.passive=0.09", *LOADED),
    case("two_arm", "effort", MODAL, BENT, *LOADED),
    case("two_arm", "deviation", BENT),
    case("two_arm", WHOLE, *SKEW, BENT),
    *(case("two_arm", WHOLE, f"arms.element={name}", bent)
      for name in ELEMENTS for bent in (LINEAR, BENT)),
    *(case("two_arm", WHOLE, "reduction.method=krylov", f"reduction.coordinates={q}",
           f"reduction.shifts={shifts}", "payload.mass=1")
      for q, shifts in ((4, [0.0]), (13, [0.0]), (8, [0.0, 30.0]))),
    # Nothing moves: neither basis nor integrator matters.
    case("two_arm", "static", ranks=True),
    case("two_arm", "static", "reduction.method=balanced", "objective.gradient=esl", ranks=True),
    case("two_arm", "static", "arms.arm2.length=0.7", "arms.height=0.1",
         "objective.loads=[[0.0,1.0,0.0],[30.0,1.0,-2.0],[0.0,0.0,1.0]]", ranks=True),
    case("two_arm", "static", SHARED, ranks=True),
    case("two_arm", "eigenfrequency", ranks=True),
    case("two_arm", "eigenfrequency", "objective.gradient=esl", ranks=True),
    case("two_arm", "eigenfrequency", "objective.elbow_angle=2.1", "payload.inertia=0.4"),
    case("two_arm", "eigenfrequency", "objective.follow=true"),
    case("two_arm", "eigenfrequency", "objective.attached=point-mass"),
    case("two_arm", "eigenfrequency", "objective.attached=none", "arms.passive=0.1"),
    case("two_arm", "eigenfrequency", SHARED, "objective.exponent=3.0"),
    case("two_arm", "eigenfrequency", "arms.joint_mass=2.0", "arms.joint_inertia=0.1"),
    case("two_arm", "eigenfrequency", "arms.arm1.rigid=true", ranks=True),
    case("two_arm", "eigenfrequency", "arms.arm2.density=8000.0", "arms.arm2.young_modulus=2e11",
         SIMP),
    # Stress.
    case("two_arm", "stress", LINEAR),
    case("two_arm", "stress", BENT, "damping.stiffness_proportional=1e-3"),
    case("two_arm", "stress", BENT, MODAL),
    case("two_arm", "stress", "arms.element=linear", "objective.stress_margin=0.1"),
    case("two_arm", "stress", TWO),
    case("controlled", "stress"),
    case("slider", "stress"),
    # Scenarios.
    *(case("two_arm", kind, f"objective.scenarios={combined}", "objective.load_cases=6", TWO, *more)
      for combined in ("sum", "worst")
      for kind, *more in (("",), ("deviation", "reduction.coordinates=3"), ("", SHARED, MODAL),
                          ("", "arms.arm1.rigid=true"))),
    case("controlled", "", TWO_GAINS, "reduction.coordinates=3"),
    case("slider", "", TWO_SPEEDS, "reduction.coordinates=3"),
    # Two arms of one design, by the densities of one; of the same size, or scaled.
    *(case("two_arm", kind, *REPEATED, ranks=kind == "static")
      for kind in ("esl", "static", "eigenfrequency", "deviation")),
    # Other numbers of arms.
    case("one_arm", WHOLE, "motion.law=trapezoidal"),
    case("three_arm", "", "motion.law=s-curve", "objective.load_cases=5", slow=True),
    # Machines: control, hardware at the joints, closed loops.
    case("controlled", ""),
    case("controlled", "", BENT, GRAVITY),
    case("controlled", WHOLE, "control.feed_forward=none", DRIVES),
    case("controlled", WHOLE, *JOINT, "motion.cart_mass=2.0", "arms.arm2.rotor_inertia=1e-4",
         "arms.arm2.gear_ratio=30.0", slow=True),
    case("controlled", "", GRAVITY, *SPRINGY),
    case("two_arm", "deviation", *JOINT, *YIELDING),
    case("two_arm", WHOLE, BENT, GRAVITY, BEARINGS, ranks=True),
    case("two_arm", WHOLE, TWO, BEARINGS, slow=True),
    case("controlled", "deviation", GRAVITY, *GEARS, BEARINGS, WOUND, RUB),
    case("controlled", "effort", GRAVITY, *GEARS, WOUND, RUB),
    case("two_arm", "effort", GRAVITY, BEARINGS, *YIELDING, RUB, slow=True),
    case("controlled", "effort", GRAVITY, "control.limits=[150.0,200.0,150.0]", DRIVES, *YIELDING,
         *FINER, slow=True),
    case("two_arm", "effort", *JOINT, *YIELDING),
    case("controlled", "peak_force", BENT),
    case("slider", ""),
    case("slider", "deviation", GRAVITY),
    case("slider", "", CRANK, GRAVITY),
    case("slider", "", CRANK, "control.limits=[36.0]", GRAVITY),  # of 43 N m asked for
    case("slider", "", CRANK, "control.stiffness=[0.0]", GRAVITY),
    case("slider", "effort", GRAVITY),
    case("slider", "effort", CRANK, WOUND, "arms.crank.gear_stiffness=3e3",
         "arms.rod.gear_stiffness=0", "arms.friction=[0.1,0.5]", "arms.rod.cells=[24,3]"),
    case("slider", "effort", CRANK, "control.limits=[40.0]"),
    case("slider", "peak_force", GRAVITY),
    case("pin", ""),
    case("pin", "effort"),
    # Space.
    case("space", "deviation", LINEAR, TWO_IN_SPACE, *LINKS, slow=True),
    case("space", "effort", LINEAR, HELD),
    case("space", "stress", BENT, slow=True),
    case("space", "tip_deflection", LINEAR),
    case("space", "eigenfrequency", LINEAR),
    case("fork", "deviation"),
    case("fork", "deviation", BENT, STIFF, *(f"joints.{name}.{key}" for name in ("swing", "slide")
         for key in ("gear_stiffness=3e4", "gear_damping=30.0", "friction=[5.0,3.0]"))),
    case("space", "deviation", LINEAR, *IN_SPACE, HELD, *LINKS, slow=True),
    case("space", "effort", LINEAR, *IN_SPACE, HELD.replace("{", "{feed_forward='elastic',"),
         slow=True),
    case("space", "stress", LINEAR, *IN_SPACE, TWO_IN_SPACE, slow=True),
    case("fork", "eigenfrequency"),
    # Closed loops in space.
    case("boom", ""),
    case("boom", "effort", BOOM_HELD, slow=True),
    case("boom", "peak_force"),
    case("boom", "stress", slow=True),
    case("boom", "", *SPRUNG, BENT),
    case("boom", "", *YIELDING_BOOM, BOOM_HELD, slow=True),
    case("loop", "", BENT, "control={stiffness=[100.0], damping=[2.0]}"),
    case("bennett", ""),
    # Settling in every rest.
    case("two_arm", "settling", *IN_STROKES, "constraints.settling_after=0.05"),
    case("two_arm", "settling", "motion.dwells=[[0.5,0.7],[1.0,1.2]]"),
    case("controlled", "settling", *IN_STROKES, GRAVITY),
    case("space", "settling", LINEAR, "motion.path=joints", "motion.file='FOLDER/spatial.csv'",
         "motion.duration=0.5", "motion.horizon=0.6", slow=True),
    case("space", "settling", LINEAR, "motion.dwells=[[0.1,0.2]]",
         "constraints.settling_after=0.02", "motion.horizon=0.7", HELD, slow=True),
    # Orientation of the end-effector.
    case("two_arm", "orientation", BENT, *LOADED),
    case("controlled", "orientation", GRAVITY),
    case("slider", "orientation", GRAVITY),
    case("pin", "orientation"),
    case("fork", "orientation"),
    case("space", "orientation", LINEAR, TWO_IN_SPACE, HELD, *LINKS, slow=True),
    # Buckling: of the chain of derivatives all parts.
    case("two_arm", "buckling", BENT, *LOADED, ranks=True),
    case("one_arm", "buckling", LINEAR, MODAL, ranks=True),
    case("two_arm", "buckling", SIMP, SHARED),
    case("controlled", "buckling"),
    case("slider", "buckling", GRAVITY, "motion.speed=30"),
    case("fork", "buckling"),
    case("space", "buckling", LINEAR),
    # Forces on interfaces.
    case("two_arm", "deviation", BENT, *LOADED, PUSHED, ranks=True),
    case("two_arm", "stress", BENT, PUSHED, slow=True),
    case("two_arm", "buckling", BENT, PUSHED, slow=True),
    case("controlled", "deviation", GRAVITY, UNFORESEEN, slow=True),
    case("controlled", "effort", GRAVITY, PUSHED, slow=True),
    case("slider", WHOLE, CRANK, TRUST),
    case("pin", "", BENT, TRUST.replace("rod", "coupler"), slow=True),
    case("fork", "deviation", PUSHED_FORK),
    case("fork", "effort", PUSHED_FORK, slow=True),
    # Poles of the closed loop: of the residual's second derivatives all parts.
    case("controlled", "damping_ratio", BENT, GRAVITY, "constraints.poles_at=[0.0,0.7,1.9]"),
    case("controlled", "pole_frequency", UNFORESEEN, slow=True),
    case("controlled", "damping_ratio", GRAVITY, "control.limits=[150.0,200.0,150.0]", *SPRINGY,
         "arms.joint_damping=3.0", *FINER, slow=True),
    case("space", "damping_ratio", HELD, BENT, "simulation.tolerance=1e-5", slow=True),
    # In closed loops: of the motions that the constraints leave, too, and of their rates.
    case("slider", "pole_frequency", CRANK.replace("2e3", "2e5"), BENT, GRAVITY),
    case("pin", "damping_ratio", CRANK, "constraints.poles_at=[0.03,0.08]"),
    case("boom", "damping_ratio", BOOM_HELD),
    case("loop", "damping_ratio", BENT, "control={stiffness=[100.0], damping=[0.1]}"),
    # Joints that keep the tip on its path follow the design.
    case("two_arm", "deviation", FEED, PAYLOADS, *FINER, ranks=True),
    case("two_arm", "stress", FEED, PAYLOADS, *FINER),
    case("two_arm", "integral_compliance", FEED, GRAVITY, "feed_forward.lead=0.0", *FINER),
    case("two_arm", "effort", FEED, TWO, *FINER, slow=True),
    # Every word that a scene knows, through a filter: new ones are tested by their word alone.
    *(case("two_arm", kind, "design.filter_radius=0.05", *FINER)
      for kind in objective_kinds()
      if kind != "duration" and "poles_at" not in DECLARED[kind].options),
]  # fmt: skip


def contract(base, changes, folder, patch):
    """Return the scene, whose stress and buckling look at what they look at, come what may."""
    # Instants that come and go beneath the cut would make small steps of the p-mean.
    patch.setattr("dolfinopt.responses.stress.NEGLIGIBLE_POWER_SHARE", 0.0)
    hold_instants(patch)
    return scene_of(base, changes, folder)


@pytest.mark.parametrize(("base", "changes"), CASES)
def test_by_densities(base, changes, shared_tmp_path, monkeypatch):
    """Along a random and a smooth direction; the gradient by ESL points the same way."""
    scene = contract(base, changes, shared_tmp_path, monkeypatch)
    kind = scene.objective.kind
    # Forces are made of accelerations, which leave more rounding.
    steps = (1e-3, 2.5e-4) if "effort_weights" in DECLARED[kind].options else (4e-4, 1e-4)
    test = taylor(scene, wave, steps, ("random", "smooth"))
    found = [row.rate for row in test.rows]
    if kind == "mass":  # linear in the densities of this law
        assert found == [np.inf, np.inf]
    else:
        assert found == pytest.approx([2.0, 2.0], abs=0.1)
        assert all(row.slope != 0.0 for row in test.rows)
    assert np.isfinite(test.angle) == (
        "motion" in DECLARED[kind].needs and not DECLARED[kind].exact
    )
    # Frozen loads tell the sign, no more; of three fast arms not even that.
    assert base == "three_arm" or not test.angle > 45.0  # deg


LOADS = "constraints.stiffness=[{arm='arm1', force=[3.0,100.0], moment=-5.0, displacement=1e-4}, "
LOADS += "{arm='arm2', moment=2.0, rotation=2e-3}]"
LOADS_IN_SPACE = (
    "constraints.stiffness=[{arm='link1', force=[0.0,100.0,20.0], moment=[3.0,0.0,0.0], "
    "displacement=1e-4, rotation=2e-3}, {arm='link2', force=[0.0,0.0,1.0], displacement=1.0}]"
)
LIMITS = [
    case("two_arm", "static", "constraints.tip_deflection=1e-6", "arms.height=0.1", ranks=True),
    case("two_arm", "eigenfrequency", "objective.follow=true", "constraints.first_frequency=4.0"),
    case("two_arm", "static", LOADS, ranks=True),
    case("space", "static", LOADS_IN_SPACE, ranks=True),
    case("two_arm", "static", "constraints.deviation=0.01", "motion.horizon=1.9",
         "simulation.tolerance=1e-7"),
]  # fmt: skip


@pytest.mark.parametrize(("base", "changes"), LIMITS)
def test_limits_by_densities(base, changes, shared_tmp_path):
    """Of every value that is limited, over its limit."""
    scene = scene_of(base, changes, shared_tmp_path)
    # Of a motion by steps at which what is left of the time error stays below the remainders.
    steps = (4e-3, 1e-3) if scene.constraints.deviation is None else (4e-2, 1e-2)
    found = limit_rates(built_of(scene), steps)
    assert found == pytest.approx([2.0] * len(found), abs=0.15) and found


NODES = [
    *(case("two_arm", kind, *TRIANGLES, *changes, ranks=ranks) for kind, ranks, *changes in (
        ("mass", True), ("static", True), ("tip_deflection", False),
        ("eigenfrequency", True, "payload.inertia=0.4"), ("esl", False, LINEAR),
        (WHOLE, True, LINEAR, *LOADED), (WHOLE, True, BENT, SKEWED),
        (WHOLE, False, LINEAR, SHARED), (WHOLE, False, BENT, *KRYLOV),
        (WHOLE, False, LINEAR, TWO), ("deviation", False, LINEAR, SKEWED),
        ("deviation", False, BENT, "reduction.coordinates=6"), ("settling", False, LINEAR),
        ("effort", False, LINEAR), ("peak_force", False, BENT),
        ("stress", False, LINEAR, "objective.stress_margin=0.1"),
        ("stress", False, BENT, MODAL, SKEWED), ("buckling", True, BENT, *LOADED),
        ("buckling", False, LINEAR, MODAL), ("static", True, LOADS),
    )),
    case("one_arm", "stress", BENT, SKEWED, ranks=True),
    case("one_arm", "deviation", LINEAR, MODAL, ranks=True),
    case("one_arm", "buckling", BENT, SKEWED, ranks=True),
    # Of unknown cells before it is meshed: on two ranks one looks on.
    case("one_arm", "stress", *TRIANGLES, BENT, SKEWED, ranks=True),
    case("controlled", "deviation", *TRIANGLES, BENT),
    case("controlled", "settling", *TRIANGLES, BENT),
    case("controlled", "effort", *TRIANGLES, BENT),
    case("controlled", "stress", *TRIANGLES, BENT),
    *(case("two_arm", WHOLE, f"arms.element={name}", BENT)
      for name in ("incompatible", "linear", "quadratic")),
    case("two_arm", "stress", BENT),
    case("two_arm", "buckling", BENT),
    *(case(base, kind, *changes) for base in ("tetrahedra", "space")
      for kind, *changes in (("mass",), ("static",), (WHOLE, LINEAR), ("deviation", BENT),
                             ("effort", HELD, BENT), ("stress", BENT), ("buckling", LINEAR))),
    case("tetrahedra", "eigenfrequency"),
    case("tetrahedra", "settling", LINEAR, "motion.dwells=[[0.1,0.2]]"),
    case("space", "static", LOADS_IN_SPACE, ranks=True),
    # Two outboard interfaces; a closed loop.
    case("fork", "deviation", BENT),
    case("fork", "eigenfrequency"),
    case("fork", "buckling", BENT),
    case("slider", "deviation", GRAVITY),
    case("slider", "stress", BENT),
]  # fmt: skip


@pytest.mark.parametrize(("base", "changes"), NODES)
def test_by_nodes(base, changes, shared_tmp_path, monkeypatch):
    """Along random moves of all nodes of uneven meshes, those of interfaces included."""
    monkeypatch.setattr("dolfinopt.parallel.SPLIT_CELLS", 1)  # one arm on two ranks is cut in two
    scene = contract(base, changes, shared_tmp_path, monkeypatch)
    limited = constraints_of(scene)[-1].response if scene.constraints.stiffness else None
    found = node_test(scene, wave, BASES[base][2], cut=base == "tetrahedra", response=limited)
    assert found.slope != 0.0
    assert found.rate == pytest.approx(2.0, abs=0.1)
