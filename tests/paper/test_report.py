"""The report: complete in itself, sound as HTML, and read in a real browser where there is one."""

import re
from dataclasses import replace

import numpy as np
import pytest
from browser import browser, open_browser
from mpi4py import MPI
from pages import Reader
from test_paper import tiny_plan

from dolfinopt.output.views import ArmView
from dolfinopt.paper import page as report
from dolfinopt.paper import reproduction as paper
from dolfinopt.paper.statements import check_paper, failed_checks

pytestmark = pytest.mark.serial  # the root writes it

WORLD = MPI.COMM_WORLD
PHONE, DESK = (390, 844), (1280, 900)  # px


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A reproduction with few cells and iterations and its folder, on all ranks."""
    path = WORLD.bcast(tmp_path_factory.mktemp("paper") if WORLD.rank == 0 else None, root=0)
    plan = tiny_plan()
    results, outcomes = paper.reproduce(plan, path, WORLD, shown=False)
    checks = check_paper(results, paper.setting_of(plan.scene))
    if WORLD.rank == 0:
        report.write_reproduction(plan, results, outcomes, checks, path)
    WORLD.barrier()
    return (plan, outcomes, checks), path


@pytest.fixture
def folder(made):
    return made[1]


@pytest.fixture
def page(folder):
    return Reader((folder / "report.html").read_text(encoding="utf-8"))


def test_page_says_where_the_scene_is_not_the_papers(folder):
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert "two flexible arms that move 6 kg along a semicircle." in text
    assert "simulation.sample = 0.01 in place of 0.001" in text
    assert "arms.arm1.cells = [16, 3] in place of [200, 12]" in text
    assert "payload.mass =" not in text and "$" not in text.split("</style>")[1].split("<script")[0]


# -- the files -------------------------------------------------------------------------------


def test_every_figure_is_there(folder):
    """Figures 3 to 15, none of them blank, each with its data."""
    from PIL import Image

    for number in range(3, 16):
        picture = Image.open(folder / f"fig{number:02d}.png").convert("L")
        assert np.asarray(picture).std() > 5.0
        rows = (folder / f"fig{number:02d}.csv").read_text().splitlines()
        assert len(rows) > 2 and len({row.count(",") for row in rows if '"' not in row}) == 1


def test_page_needs_nothing_from_elsewhere(page):
    """Everything it loads is inside; the one address is a link to the paper."""
    loaded = [a.get(key) for _, a in page.tags for key in ("src", "data", "poster", "srcset")]
    assert all(address.startswith("data:") for address in loaded if address is not None)
    assert [a["href"] for a in page.all("link")] == ["data:,"]
    outside = {a["href"] for a in page.all("a") if not a["href"].startswith("#")}
    assert outside == {"https://doi.org/10.1016/j.piutam.2015.01.018"}


def test_style_and_script_load_nothing(folder):
    text = (folder / "report.html").read_text(encoding="utf-8")
    assert not re.search(r"url\(|@import|fetch\(|XMLHttpRequest|import\(", text)


def test_page_is_sound(page):
    """One heading on top, places that links lead to, and words for every picture."""
    assert page.all("html")[0]["lang"] == "en" and len(page.all("h1")) == 1
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    inside = {a["href"][1:] for a in page.all("a") if a["href"].startswith("#")}
    assert inside <= set(ids) and len(inside) == 15
    assert all(len(image["alt"]) > 10 for image in page.all("img"))
    assert len(page.all("article")) == 15
    # 12 figures without that of the designs, which are shown arm by arm: initial design, three
    # objectives, four reductions, two paths.
    assert len(page.all("img")) == 12 + 2 * (4 + 4 + 2)


def test_every_statement_is_told(made, folder):
    """With the paper's figure, ours, and the verdict."""
    from html import unescape

    text = unescape((folder / "report.html").read_text(encoding="utf-8"))
    for check in made[0][-1]:
        for words in (check.statement, check.paper, check.found, check.criterion):
            assert words in text
        assert check.holds or check.reason in text


def test_page_without_some_results(made, tmp_path):
    """Cases that failed are named; nothing that needs them holds, and the rest is told."""
    (plan, outcomes, _), _ = made
    table = plan.table
    lost = {plan.optimum, table.made[table.table == "reductions"].iloc[-1]}
    lost |= {case for case in table.case if case.design in lost}
    nothing = {"failure": "it <diverged>", "compliance": np.nan, "max_deviation": np.nan}
    outcomes = replace(
        outcomes,
        by_case={
            case: replace(outcome, **nothing) if case in lost else outcome
            for case, outcome in outcomes.by_case.items()
        },
    )
    results = paper.add_outcomes(table, outcomes)
    checks = check_paper(results, paper.setting_of(plan.scene))
    report.write_reproduction(plan, results, outcomes, checks, tmp_path)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "it &lt;diverged&gt;" in text and len(Reader(text).all("article")) == 15
    wrong = {line.partition(":")[0] for line in failed_checks(checks)}
    assert wrong >= {"dynamic loads", "coordinates, optimised design", "payload, loss"}
    assert "coordinates, initial design" not in wrong


# -- pictures of designs ---------------------------------------------------------------------


def test_arm_picture_is_to_scale():
    """Two cells, the left one solid: twice as wide as high, dark on the left."""
    import io

    from PIL import Image

    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    corners = 0.5 * np.stack([square, square + np.array([1.0, 0.0])])
    centroid, modes = corners.mean(axis=1), np.zeros((2, 4, 2, 0))
    view = ArmView("arm", corners, centroid, np.array([1.0, 0.0]), modes)
    picture = Image.open(io.BytesIO(report.arm_picture(view, 40))).convert("L")
    assert picture.size == (40, 20)
    values = np.asarray(picture)
    assert values[5:15, 3:17].max() < 80 < 200 < values[5:15, 23:37].min()


def test_animation_follows_the_mechanism():
    """Frames of the SVG end where the trajectory's end-effector is."""
    from dolfinopt.study.simulate import simulate_scenarios

    simulated = next(iter(simulate_scenarios([tiny_plan().scene], None)))
    trajectory = simulated.trajectory
    at = np.array([0, 80, len(trajectory.t) - 1])
    flexible, rigid = (report.centre_lines(trajectory, at, factor) for factor in (1.0, 0.0))
    apart = flexible[:, -1] - rigid[:, -1]
    np.testing.assert_allclose([apart.real, apart.imag], trajectory.deviation[at].T, atol=1e-12)
    numbers = [float(v) for v in re.findall(r"-?\d+\.\d+", report.svg_path(flexible[1]))]
    assert len(numbers) == 2 + 2 * 6  # three points of a cubic curve an arm
    np.testing.assert_allclose(
        numbers[-2:], [flexible[1, -1].real, flexible[1, -1].imag], atol=1e-4
    )
    # Rigid arms are straight: all points of one lie on a line from joint to joint.
    a, b, c, d = rigid[1, :4]
    np.testing.assert_allclose([((p - a) / (d - a)).imag for p in (b, c)], 0.0, atol=1e-12)


# -- in a browser ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def window(tmp_path_factory):
    with open_browser(tmp_path_factory.mktemp("profile")) as opened:
        yield opened


in_browser = pytest.mark.skipif(browser() is None, reason="needs Chromium")


@in_browser
@pytest.mark.parametrize("size", [DESK, PHONE], ids=["desk", "phone"])
def test_page_in_a_browser(folder, window, size):
    """No complaint, no request, all pictures there, and nothing wider than the window."""
    window.open(folder / "report.html", *size)
    assert window.complaints() == []
    sent = [address for address in window.requests() if not address.startswith("data:")]
    assert sent == [(folder / "report.html").resolve().as_uri()]
    count, missing = window.value(
        "[document.images.length,"
        " [...document.images].filter(i => !i.complete || i.naturalWidth === 0).length]"
    )
    assert count == 32 and missing == 0
    assert window.value("document.documentElement.scrollWidth") == size[0]
    wide = window.value(
        "[...document.querySelectorAll('body *')].filter(e => !e.closest('.scroll')"
        " && e.getBoundingClientRect().right > innerWidth + 0.5).map(e => e.outerHTML.slice(0, 80))"
    )
    assert wide == []


@in_browser
def test_tables_scroll_in_their_boxes(folder, window):
    """On a phone figures are wider than their boxes, which scroll; the checks are read down."""
    window.open(folder / "report.html", *PHONE)
    wider, moved, first = window.value(
        "(() => { const boxes = [...document.querySelectorAll('.scroll')];"
        " const wide = boxes.filter(box => box.scrollWidth > box.clientWidth);"
        " for (const box of wide) box.scrollLeft = 1;"
        " return [wide.length, wide.every(b => b.scrollLeft === 1), wide.indexOf(boxes[0])]; })()"
    )
    assert wider > 0 and moved and first == -1


@in_browser
def test_text_is_legible(folder, window):
    """At least 12 px on a phone, and pictures scaled by no more than a third."""
    window.open(folder / "report.html", *PHONE)
    small = window.value(
        "[...document.querySelectorAll('p, td, th, figcaption, dd, dt, h3')]"
        ".map(e => parseFloat(getComputedStyle(e).fontSize)).reduce((a, b) => Math.min(a, b))"
    )
    assert small >= 12.0
    width = window.value("Math.min(...[...document.querySelectorAll('.plots img')]"
                         ".map(i => i.getBoundingClientRect().width))")  # fmt: skip
    assert width >= 340.0


@in_browser
def test_player(folder, window):
    """The slider moves the mechanism; the button plays and pauses."""
    window.open(folder / "report.html", *DESK)
    before = window.value("document.getElementById('before').getAttribute('d')")
    window.value(
        "(() => { const s = document.getElementById('frame'); s.value = 3;"
        " s.dispatchEvent(new Event('input')); })()"
    )
    moved = window.value("document.getElementById('before').getAttribute('d')")
    film = "JSON.parse(document.getElementById('frames').textContent)"
    assert moved != before and moved == window.value(f"{film}.before[3]")
    said = window.value("document.getElementById('said').textContent")
    assert said.startswith(f"{window.value(f'{film}.t[3]'):.2f} s: ")
    words = [
        window.value(
            "(() => { const b = document.getElementById('play'); b.click();"
            " return b.textContent; })()"
        )
        for _ in range(2)
    ]
    assert words == ["Pause", "Play"] and window.complaints() == []
