"""The benchmark of the field: case files, verdicts, and the published results."""

from dataclasses import replace

import numpy as np
import pytest
from runs import TWO_ARM, refused, run

from dolfinopt.bench import field
from dolfinopt.bench import field_machines as ur10e
from dolfinopt.errors import ConvergenceError, InputError
from dolfinopt.exchange.urdf.file import read_robot
from dolfinopt.exchange.urdf.scene import INERTIA
from dolfinopt.multibody.inverse_dynamics import inverse_dynamics
from dolfinopt.multibody.machine import rigid_spatial_body
from dolfinopt.multibody.motion import RigidMotion

pytestmark = pytest.mark.serial  # a case runs on one rank

CASES = {case.name: case for case in field.read_cases()}


@pytest.mark.parametrize("name", [case.name for case in field.chosen_cases([], False)])
def test_published_results_are_those_of_today(name):
    """Ours to a hundredth of the limit, or to 1e-4 where the limit is that of the problem."""
    for one in field.check(CASES[name]):
        assert one.met, one.of.what
        found = one.difference if one.of.table else one.value
        room = 0.01 * one.of.limit * abs(one.reference) if one.of.limit else 0.0
        assert found == pytest.approx(one.of.ours, rel=1e-4, abs=room), one.of.what


def test_two_arm_is_the_demo():
    assert CASES["two-arm"].scene.read_bytes() == TWO_ARM.read_bytes()


@pytest.mark.parametrize(
    ("way", "difference", "met"),
    [
        ("near", 0.009, True),
        ("near", -0.011, False),
        ("most", -0.5, True),
        ("most", 0.011, False),
        ("least", 0.5, True),
        ("least", -0.011, False),
        ("near", float("nan"), False),
    ],
)
def test_verdict(way, difference, met):
    case = CASES["quanser"]
    value = replace(case.values[0], way=way, limit=0.01)
    assert field.Checked(case, value, 1.0, 1.0, difference).met is met


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (("title =", "tittle ="), "tittle"),
        (("origin =", "#origin ="), "origin is missing"),
        (("scene =", "#scene ="), "scene or program"),
        (("unit =", 'way = "about"\nunit ='), "about"),
        (("loaded frequency", "colour"), "colour"),
    ],
)
def test_wrong_case_files(tmp_path, change, told):
    text = (field.benchmark_folder() / "quanser" / "case.toml").read_text().replace(*change, 1)
    file = tmp_path / "case.toml"
    file.write_text(text)
    with pytest.raises(InputError, match=told) as caught:
        field.read_case(file)
    assert str(file) in str(caught.value)


def test_command(tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    run("bench", "field", "--case", "quanser", "--out", out)
    assert "1 values within their limits" in capsys.readouterr().out
    assert "met" in (out / "field.csv").read_text()
    missed = replace(CASES["quanser"].values[0], reference=1.0)
    cases = (replace(CASES["quanser"], values=(missed,)),)
    monkeypatch.setattr(field, "read_cases", lambda: cases)
    with refused("quanser", missed.what, error=ConvergenceError):
        run("bench", "field")
    assert "MISSED" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("field", "--case", "sling"), ("--case", "sling", "rod")),
        (("field", "--case", "rod", "--all"), ("--case", "--all")),
        (("field", "time"), ("field", "time")),
        (("field", "--quick"), ("field", "--quick")),
        (("field", "--case", "ur10e"), ("--records", "dynamic_calibration")),
        (("field", "--case", "ur10e", "--records", "nowhere"), ("nowhere", "ur10e.urdf")),
        (("time", "--all"), ("--all", "field")),
    ],
)
def test_wrong_words(words, told):
    with refused(*told):
        run("bench", *words)


def write_robot(folder):
    """Write six links on joints that turn about x, y and z, and records of their rigid motion."""
    masses = [3.0, 2.5, 2.0, 1.0, 0.8, 0.5]
    links, joints = ['<link name="link0"/>'], []
    for k, mass in enumerate(masses, start=1):
        inertia = f'ixx="{0.02 * mass}" iyy="{0.03 * mass}" izz="{0.015 * mass}"'
        links.append(
            f'<link name="link{k}"><inertial><origin xyz="0.05 0.02 {0.1 * k}"/><mass '
            f'value="{mass}"/><inertia {inertia} ixy="0.001" ixz="0" iyz="0"/></inertial></link>'
        )
        axis = ("0 0 1", "0 1 0", "1 0 0")[k % 3]
        joints.append(
            f'<joint name="joint{k}" type="continuous"><parent link="link{k - 1}"/>'
            f'<child link="link{k}"/><origin xyz="0.1 0 0.3" rpy="0 0.2 0"/><axis xyz="{axis}"/>'
            "</joint>"
        )
    for file in (ur10e.UR10E, ur10e.LEARNT[0], ur10e.PREDICTED[0]):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
    robot = f'<robot name="six">{"".join(links + joints)}</robot>'
    (folder / ur10e.UR10E).write_text(robot)
    machine = ur10e.machine(folder / ur10e.UR10E)
    own = read_robot(folder / ur10e.UR10E).links
    bodies = [own[f"link{k}"].own for k in range(1, 7)]
    rigid = [
        rigid_spatial_body(b.mass, b.centre, [b.tensor[place] for place in INERTIA]) for b in bodies
    ]
    machine = replace(machine, bodies=tuple(rigid))
    for number, (file, _, last) in enumerate((ur10e.LEARNT, ur10e.PREDICTED)):
        t = 0.01 * np.arange(last + 50)
        rate = np.array([0.7, 1.1, 0.9, 1.3, 1.7, 1.9]) + 0.1 * number
        phase = np.outer(t, rate)
        q, qd, qdd = np.sin(phase), rate * np.cos(phase), -(rate**2) * np.sin(phase)
        none = np.zeros((len(t), 0))
        torque = inverse_dynamics(machine, RigidMotion(q, qd, qdd), none, none, none)[1]
        torque += 0.3 * qdd + 2.0 * qd - 0.5  # rotor and friction
        np.savetxt(folder / file, np.column_stack([t, q, qd, torque / ur10e.GAINS]), delimiter=",")


def test_torques_of_a_known_robot_are_predicted(tmp_path):
    """What is left are the ends of the records, where the method has no accelerations."""
    write_robot(tmp_path)
    assert max(ur10e.ur10e_values(tmp_path).values()) < 0.015
    (tmp_path / ur10e.LEARNT[0]).write_text("1,2\n" * 700)
    with pytest.raises(InputError, match="12harm"):
        ur10e.ur10e_values(tmp_path)
