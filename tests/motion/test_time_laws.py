"""Time laws against closed forms, differences and their limits; tables with stops."""

import numpy as np
import pytest
from bodies import assert_close
from runs import TWO_ARM, refusal

from dolfinopt.dynamics.build import check_motion
from dolfinopt.errors import InputError
from dolfinopt.motion.build import breakpoints, desired_path, rigid_motion
from dolfinopt.motion.paths import curve_by_chord, curve_in_time
from dolfinopt.scene.csv_table import Table, read_table
from dolfinopt.scene.laws import Limits, law_for, shaped
from dolfinopt.scene.load import read_scene, scene_from_dict

pytestmark = pytest.mark.serial  # one rank shows all there is

LAWS = ["quintic", "septic", "trapezoidal", "s-curve"]
EVERY = pytest.mark.parametrize("name", LAWS)


def law_of(name, share=0.25, length=1.0, **limits):
    """Return the law on a path of that length, m."""
    return law_for(name, length, Limits(**limits), share)


def pieces(law, duration):
    """Return the ends of the law's smooth pieces, s."""
    return np.array([0.0, *(law.knots * duration), duration])


def peaks(law, duration, length):
    """Return the largest speed, acceleration and jerk, the latter from cubics through samples."""
    largest = np.zeros(3)
    for a, b in np.stack([pieces(law, duration)[:-1], pieces(law, duration)[1:]], axis=1):
        if b - a < 1e-6 * duration:
            continue
        t = a + (b - a) * (0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 41)))[1:-1]
        sdd = law(t, duration)[2]
        fit = np.polynomial.Polynomial.fit(t, sdd, 5)
        dense = np.linspace(a, b, 2001)
        values = law(dense[1:-1], duration)[1], fit(dense), fit.deriv()(dense)
        largest = np.maximum(largest, [np.abs(x).max() for x in values])
    return length * largest


def test_shaped_law_rests_at_both_ends_and_its_rates_are_its_derivatives():
    """(4 u (1 - u))^3 leaves place, speed and acceleration at the ends; by Gauss' rule."""
    base, duration = law_of("quintic"), 0.7
    law = shaped(base, (0.1, -0.2, 0.15))
    ends = law(np.array([0.0, duration]), duration)
    assert_close(ends[0], [0.0, 1.0], 1e-14)
    assert_close(np.array(ends[1:]), np.zeros((2, 2)), 1e-12)
    nodes, weights = np.polynomial.legendre.leggauss(8)
    t = 0.5 * 0.5 * (1.0 + nodes)  # up to 0.5 s
    there = law(np.array([0.5]), duration)
    assert_close(
        law.integral(np.array([0.5]), duration), [0.25 * weights @ law(t, duration)[0]], 1e-13
    )
    for order in (0, 1):
        assert_close(there[order], [0.25 * weights @ law(t, duration)[order + 1]], 1e-13, 1.0)
    assert abs(law(np.array([0.2]), duration)[0] - base(np.array([0.2]), duration)[0]) > 0.01


def test_peaks_in_closed_form():
    """Largest speed and acceleration of a move of 1 m in 1 s."""
    for name, speed, acceleration in (
        ("quintic", 15 / 8, 10 / np.sqrt(3)), ("septic", 35 / 16, 84 * np.sqrt(5) / 25),
        ("trapezoidal", 4 / 3, 16 / 3), ("s-curve", 4 / 3, 64 / 9),
    ):  # fmt: skip
        assert_close(peaks(law_of(name), 1.0, 1.0)[:2], [speed, acceleration], 1e-5)
    assert_close(peaks(law_of("s-curve"), 2.0, 1.0)[2], 64 / 9 * 16 / 8, 1e-9)
    assert_close(law_of("trapezoidal").knots, [0.25, 0.75], 1e-15)
    assert_close(law_of("s-curve").knots, np.array([1, 3, 4, 12, 13, 15]) / 16, 1e-15)


@EVERY
def test_limits_are_met_exactly(name):
    """At the least duration one of them is reached and none exceeded, whichever binds."""
    rng = np.random.default_rng(5)
    binding = set()
    for _ in range(60):
        length = 10.0 ** rng.uniform(-2.0, 1.0)
        chosen = rng.permutation(3)[: rng.integers(1, 4)]
        names = np.array(["speed", "acceleration", "jerk"])[chosen]
        limits = {
            str(key): 10.0 ** rng.uniform(-1.0, 2.0)
            for key in names
            if (name, key) != ("trapezoidal", "jerk")
        }
        if not limits:
            continue
        law = law_of(name, 0.25, length, **limits)
        found = dict(
            zip(("speed", "acceleration", "jerk"), peaks(law, law.least, length), strict=True)
        )
        shares = {key: found[key] / limit for key, limit in limits.items()}
        assert_close(max(shares.values()), 1.0, 1e-6)
        binding.add(max(shares, key=lambda key: shares[key]))
    assert len(binding) == (2 if name == "trapezoidal" else 3)


def posed(**motion):
    """Return the example with another motion."""
    data = read_scene(TWO_ARM, ("arms.cells=[20,2]",)).to_dict()
    return scene_from_dict(data | {"motion": {"path": "arc"} | motion}, "test.toml")


def test_duration_follows_from_the_limits():
    """Unless stated; values that follow stay free in changes, and a short one is refused."""
    limits = {"law": "trapezoidal", "max_speed": 2.0, "max_acceleration": 5.0}
    of = posed(**limits)
    assert_close(of.motion.duration, np.pi / 2.0 + 2.0 / 5.0, 1e-14)
    half = scene_from_dict(of.to_tree(), "test.toml", ["motion.radius=0.9"])
    assert_close(half.motion.duration, 0.9 * np.pi / 2.0 + 2.0 / 5.0, 1e-14)
    assert scene_from_dict(of.to_dict()).motion == of.motion
    slow = posed(**limits, duration=2.5)
    speed = np.linalg.norm(desired_path(np.linspace(0.0, 2.5, 5001), slow)[1], axis=1)
    assert_close(speed.max(), 2.0 * of.motion.duration / 2.5, 1e-12)

    # A long one takes the horizon with it.
    assert posed(law="septic", max_speed=0.5).motion.horizon > 13.0


@pytest.mark.parametrize(
    ("motion", "words"),
    [
        ({"law": "trapezoidal", "max_jerk": 9.0},
         ["motion.max_jerk = 9.0", 'none with law = "trapezoidal"']),
        ({"law": "s-curve", "max_jerk": 9.0, "acceleration_share": 0.3},
         ["motion.acceleration_share = 0.3", "0.25, the default", "motion.max_jerk"]),
        ({"duration": 2.5, "horizon": 2.0}, ["motion.horizon = 2.0", "motion.duration"]),
        ({"law": "trapezoidal", "max_speed": 2.0, "max_acceleration": 5.0, "duration": 1.9},
         ["motion.duration = 1.9", "at least"]),
        ({"path": "joints", "file": str(TWO_ARM), "max_speed": 1.0},
         ["max_speed", 'none with path = "joints"']),
    ],
)  # fmt: skip
def test_values_that_do_not_go_together(motion, words):
    refusal(lambda: posed(**motion), "test.toml", *words)


DWELL = "t,x,y\n0,-0.4,0.1\n0.18,0.3,0.2\n0.22,0.3,0.2\n0.4,0.5,0.6\n"


@EVERY
def test_equal_rows_are_a_stop(tmp_path, name):
    """At the point to rounding, without speed and acceleration; rest to rest on both sides."""
    file = tmp_path / "pick.csv"
    file.write_text(DWELL)
    of = posed(path="points", file=str(file), law=name)
    assert of.motion.duration == 0.4
    t = np.linspace(0.1801, 0.2199, 200)
    place, speed, acceleration = desired_path(t, of)
    assert_close(place, np.tile([0.3, 0.2], (200, 1)), 1e-15)
    assert not speed.any()
    assert not acceleration.any()
    rigid = rigid_motion(t, of)
    assert not rigid.qd.any()
    assert not rigid.qdd.any()
    assert {0.18, 0.22, 0.4} <= {round(one, 12) for one in breakpoints(of)}
    # Between stops each move is straight and follows the law.
    law, tau = law_of(name), np.linspace(0.0, 0.18, 50)
    s, sd, _ = law(tau, 0.18)
    found = desired_path(tau, of)
    assert_close(found[0], np.array([-0.4, 0.1]) + np.outer(s, [0.7, 0.1]), 1e-12)
    assert_close(found[1], np.outer(sd, [0.7, 0.1]), 1e-11)
    later = desired_path(0.22 + tau, of)
    assert_close(later[0], np.array([0.3, 0.2]) + np.outer(s, [0.2, 0.4]), 1e-11)
    check_motion(of)


def test_limits_in_a_table_with_stops(tmp_path):
    """Each move has the time that the table gives it: too little is named by file and line."""
    file = tmp_path / "pick.csv"
    file.write_text(DWELL)
    fast, slow = (
        posed(path="points", file=str(file), law="s-curve", max_speed=v) for v in (6.0, 4.0)
    )
    check_motion(fast)
    refusal(lambda: check_motion(slow), "pick.csv: line 3, column t = 0.18")


# -- tables: what is refused, and the curves through their rows against SciPy's conditions  -------


ROWS = np.array([[0.0, 0.0], [0.3, 0.4], [1.1, 0.3], [1.0, -0.2], [1.6, -0.3]])
TIMES = np.array([0.0, 0.3, 0.8, 1.1, 1.9])  # s


def written(folder, text):
    """Return the path of a table with this content."""
    path = folder / "table.csv"
    path.write_text(text, encoding="utf-8")
    return str(path)


def table(t=None, rows=ROWS):
    """Return a table that was not read from a file."""
    return Table("table.csv", tuple(range(2, 2 + len(rows))), t, rows)


def test_columns_in_any_order_comments_blank_lines_and_spreadsheets(tmp_path):
    """Values are those of the columns asked for; lines are those of the file."""
    text = '\ufeff# a path\n\n"y", t ,x\r\n  # from here\n2, 0, 1\n\n-4e-1,.5,3\n'
    found = read_table(written(tmp_path, text), ("x", "y"))
    assert found.rows.tolist() == [[1.0, 2.0], [3.0, -0.4]]
    assert found.t is not None
    assert found.t.tolist() == [0.0, 0.5]
    assert found.lines == (5, 7)
    assert read_table(written(tmp_path, "x,y\n1,2\n1,2\n"), ("x", "y")).t is None


@pytest.mark.parametrize("separator", [";", "\t", " ; "])
def test_decimal_commas(tmp_path, separator):
    """As spreadsheets write tables where numbers have commas; points are read, too."""
    text = "t|x|y\n0|1,5|2\n0,5|-4.25|1e-1\n".replace("|", separator)
    found = read_table(written(tmp_path, text), ("x", "y"))
    assert found.rows.tolist() == [[1.5, 2.0], [-4.25, 0.1]]
    assert found.t is not None and found.t.tolist() == [0.0, 0.5]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", ["no rows", "x,y or t,x,y"]),
        ("# x,y\n\n", ["no rows", "x,y or t,x,y"]),
        ("1,2\n3,4\n5,6\n", ["line 1", "column '1'", "x,y or t,x,y"]),
        ("\nx|y\n0|1\n1|1\n", ["line 2", "column 'x|y'", "x,y or t,x,y"]),
        ("x;y\n0;1\n1,5;1,,5\n", ["line 3, column y = '1..5'", "a finite number"]),
        ("t,x,y,z\n0,0,0,0\n", ["line 1", "column 'z'", "x,y or t,x,y"]),
        ("x,y,x\n0,0,0\n", ["line 1", "repeated column 'x'", "x,y or t,x,y"]),
        ("t,x\n0,0\n1,1\n", ["line 1", "column 'y'", "x,y or t,x,y"]),
        ("x,y\n", ["0 row(s)", "at least 2"]),
        ("x,y\n0,0\n", ["1 row(s)", "at least 2"]),
        ("x,y\n0,0\n1\n", ["line 3", "1 value(s)", "2", "x,y"]),
        ("x,y\n0,0\n1,2,3\n", ["line 3", "3 value(s)", "2", "x,y"]),
        ("x,y\n0,0\n1,a1\n", ["line 3, column y = 'a1'", "a finite number"]),
        ("x,y\n0,0\n# 1\n1,\n", ["line 4, column y = ''", "a finite number"]),
        ("x,y\n0,0\n1,nan\n", ["line 3, column y = 'nan'", "a finite number"]),
        ("x,y\n-inf,0\n1,0\n", ["line 2, column x = '-inf'", "a finite number"]),
        ("t,x,y\n1,0,0\n2,1,0\n", ["line 2, column t = 1", "0 [s]"]),
        ("t,x,y\n0,0,0\n2,1,0\n2,1,1\n", ["line 4, column t = 2", "more than 2 [s]"]),
        (b"x,y\n# L\xe4nge\n", ["line 2", "UTF-8"]),
    ],
)
def test_bad_table(tmp_path, text, words):
    """One line that names the file, the line, the column and the value."""
    file = tmp_path / "table.csv"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    refusal(lambda: read_table(str(file), ("x", "y")), f"{file}: ", *words)


def test_file_that_cannot_be_read(tmp_path):
    for file, reason in (
        (str(tmp_path), "Is a directory"),
        (str(tmp_path / "absent.csv"), "No such file"),
    ):
        refusal(lambda: read_table(file, ("x", "y")), reason, "a table (CSV)")  # noqa: B023
    with pytest.raises(InputError, match="not a file name"):
        read_table("a\0b", ("x", "y"))


@pytest.mark.parametrize("same", [1, 4])
def test_repeated_rows_have_no_chord(same):
    """Without times only: with them the end-effector waits."""
    rows = ROWS.copy()
    rows[same] = rows[same - 1]
    refusal(lambda: curve_by_chord(table(rows=rows)), f"table.csv: line {2 + same}", "same values")
    assert_close(curve_in_time(table(TIMES, rows))(TIMES)[0][same], rows[same], 1e-13, 1.0)


def test_two_rows_in_time_are_the_quintic_law():
    """Degree 5 with rest at both ends is 10 u^3 - 15 u^4 + 6 u^5."""
    curve = curve_in_time(table(np.array([0.0, 2.0]), np.array([[1.0], [4.0]])))
    u = np.linspace(0.0, 1.0, 11)
    expected = 1.0 + 3.0 * (10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5)
    assert_close(curve(2.0 * u)[0][:, 0], expected, 1e-13)
