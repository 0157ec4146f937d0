"""Geometry files of strangers: nothing in them runs a program, or reads or writes another file."""

import re

import pytest
from mpi4py import MPI
from runs import refusal

from dolfinopt.data import mesh_folder
from dolfinopt.mesh.arm_mesh import arm_mesh
from dolfinopt.mesh.file_check import checked_geo
from dolfinopt.mesh.gmsh_session import gmsh_on_root
from dolfinopt.scene.load import Arm

pytestmark = pytest.mark.serial  # Gmsh runs on one rank

PLATE = """
Point(1) = {0, -0.03, 0, 0.02}; Point(2) = {0.5, -0.03, 0, 0.02};
Point(3) = {0.5, 0.03, 0, 0.02}; Point(4) = {0, 0.03, 0, 0.02};
Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1, 2, 3, 4}; Plane Surface(1) = {1};
Physical Curve("inboard") = {4}; Physical Curve("outboard") = {2};
"""
TOUCH = 'SystemCall "touch HIT";'


def mesh_of(path):
    arm = Arm(name="a", mesh=str(path), length=0.5, height=0.06, thickness=0.01)
    return arm_mesh(MPI.COMM_SELF, arm)


def refused(path, text, *words):
    """Check that a file is refused in one line; nothing new lies beside it."""
    path.write_bytes(text.replace("HIT", str(path.parent / "hit")).encode())
    refusal(lambda: mesh_of(path), str(path), "arm 'a'", *words)
    assert [one.name for one in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("what", "texts"),
    [
        ("SystemCall runs", [TOUCH, 'x = 1; SystemCall // why\r\n"touch HIT";', "\ufeff" + TOUCH]),
        ("System runs", ['System Str("touch ", "HIT");']),
        ("S2N", ['S2N["SystemCall"] "touch HIT";']),
        ("OnelabRun runs", ['OnelabRun("a", "touch HIT");']),
        ("Save writes", ['Save "HIT";']),
        ("Print writes", ['Print "HIT";']),
        ("CreateDir writes", ['CreateDir "HIT";']),
        ("Printf(...) >", ['Printf("%g", 1) > "HIT";', 'f = "HIT"; Printf("a") >> f;']),
        ("Merge reads", ['Merge "HIT";']),
        ("Include reads", ['Include "HIT";']),
        ("ListFromFile reads", ['x() = ListFromFile("HIT");']),
        ("ShapeFromFile reads", ['v() = ShapeFromFile("HIT");']),
        ("ExternalProcess",
         ['Field[1] = ExternalProcess; Field[1].CommandLine = "touch HIT";']),
        ("Field Structured", ['Field[1] = Structured; Field[1].FileName = "HIT";']),
        ("FileName", ['Field[1] = Box; Field[1].FileName = "HIT";']),
        ("Plugin", ["Plugin(MathEval).Run;"]),
        ("View", ['View "a" { SP(0, 0, 0){1}; }; Save View[0] "HIT";']),
        ("Solver runs", ['Solver[0].Executable = "touch HIT";']),
        ("General.ErrorFileName", ['General.ErrorFileName = "HIT";']),
        ("General.SaveSession", ["General.SaveSession = 1;"]),
        ("DoubleClickedPointCommand", ['Geometry.DoubleClickedPointCommand = "HIT";']),
        ("[...].Algorithm", ['Mesh[0].Algorithm = "HIT";']),
        ("Exit ends", ["Exit;"]),
        ("GetValue asks", ['x = GetValue("how long?", 1);']),
        ("GetEnv looks", ['x = GetEnv("HOME");']),
        ("NewCommand", ['NewCommand "HIT";', 'NewCommand("HIT");', "NewCommand;"]),
        ("format", ['Printf("%s", 1);', 'Printf("%900g", 1);']),
        # Where Gmsh would find a statement in what looks like something else.
        ("too long", [f'x = "{"a" * 1022} "; y = "; SystemCall c;";']),
        ("several lines", ['x = "a\nb";']),
        ("does not belong", ["x = 1;\0" + TOUCH, "@include x"]),
    ],
)  # fmt: skip
def test_statements_that_are_refused(tmp_path, what, texts):
    for text in texts:
        refused(tmp_path / "arm.geo", text + PLATE, "line 1: ", what, "give the .msh file")


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        ('\n/* a\n*/ NonBlockingSystemCall "touch HIT";', 3, "NonBlockingSystemCall"),
        ("Macro m\n" + TOUCH + "\nReturn\nCall m;", 2, "SystemCall"),
        ("If (0)\nEndIf1; " + TOUCH + "\nEndIf", 2, "EndIf1"),
        ('If (0)\nx = "EndIf SystemCall c";\nEndIf', 2, "holds a word that ends"),
    ],
)
def test_the_line_is_named(tmp_path, text, line, what):
    refused(tmp_path / "arm.geo", text + PLATE, f"line {line}: ", what)


@pytest.mark.parametrize(
    "text",
    [
        "/* " + TOUCH + " */",
        "// " + TOUCH,
        # All of these ran the command: Gmsh looks into comments where it skips text.
        "If (0)\nF = 1; E/* EndIf " + TOUCH + " */ = 2;\nEndIf",
        "For i In {0 : -1}\nF/* EndFor " + TOUCH + " */ = 1;\nEndFor",
        "For i In {0 : 1} /*\n" + TOUCH + "\nEndFor */\nEndFor",
    ],
)
def test_comments_do_nothing(tmp_path, text):
    path = tmp_path / "arm.geo"
    path.write_text(text.replace("HIT", str(tmp_path / "hit")) + "\n" + PLATE)
    assert mesh_of(path).num_cells > 50
    assert [one.name for one in tmp_path.iterdir()] == ["arm.geo"]


@pytest.mark.parametrize("name", ["arm.msh", "arm.MSH", "arm.step", "arm.Step", "arm.STP"])
def test_files_that_are_not_what_their_name_says(tmp_path, name):
    refused(tmp_path / name, TOUCH + PLATE, "it is not a")
    if name == "arm.Step":  # Gmsh knows .step and .STEP; any other it would read as its language
        refused(tmp_path / name, "ISO-10303-21;\n" + TOUCH)


@pytest.mark.parametrize("ending", [".geo", ".msh", ".step"])
def test_options_beside_a_file_are_not_read(tmp_path, ending):
    """Gmsh merges arm.msh.opt, which may hold any statement, after arm.msh."""
    path = tmp_path / f"arm{ending}"
    with gmsh_on_root(MPI.COMM_SELF) as gmsh:
        gmsh.model.occ.addRectangle(0.0, -0.03, 0.0, 0.5, 0.06)
        gmsh.model.occ.synchronize()
        if ending == ".msh":
            for tag, name in ((4, "inboard"), (2, "outboard"), (1, "design")):
                dim = 2 if name == "design" else 1
                gmsh.model.setPhysicalName(dim, gmsh.model.addPhysicalGroup(dim, [tag]), name)
            gmsh.model.mesh.generate(2)
            gmsh.option.setNumber("Mesh.Binary", 1)
        gmsh.option.setString("Geometry.OCCTargetUnit", "M")
        if ending != ".geo":
            gmsh.write(str(path))
    if ending == ".geo":
        path.write_text(PLATE)
    options = tmp_path / f"{path.name}.opt"
    options.write_text(TOUCH.replace("HIT", str(tmp_path / "hit")))
    assert mesh_of(path).num_cells > 10
    assert not (tmp_path / "hit").exists()


@pytest.mark.parametrize(
    "text",
    [
        'DefineConstant[ a = {1, Min 0, Max 2, Step 0.1, Name "Parameters/a (%)", Visible 0} ];',
        'DefineConstant[ q = {0, Choices{0 = "no", 1 = "yes"}, Name "q", Help "one"} b = 3 ];',
        'SetFactory("OpenCASCADE"); Rectangle(1) = {0, 0, 0, 1, 1}; Disk(2) = {0.5, 0.5, 0, 0.1};',
        "BooleanDifference(3) = { Surface{1}; Delete; }{ Surface{2}; Delete; };",
        "x() = BooleanUnion{ Surface{1}; Delete; }{ Surface{2, 3}; Delete; };",
        "out[] = Extrude {0, 0, 1} { Surface{1}; Layers{ {2, 3}, {0.5, 1} }; Recombine; };",
        "Field[1] = Distance; Field[1].CurvesList = {1}; Field[2] = Threshold;\n"
        "Field[2].InField = 1; Field[2].SizeMin = 0.1; Background Field = 2;",
        'Field[1] = MathEval; Field[1].F = "0.1 + x^2"; Delete Field [1];',
        "Mesh.Algorithm = 8; Mesh.MeshSizeMax = 0.1 * a; Mesh.Color.Points = Red; Mesh 2;",
        'Geometry.ExtrudeReturnLateralEntities = 0; Geometry.OCCTargetUnit = "MM";',
        'General.Terminal = 1; General.ExpertMode = 1; OptimizeMesh "Netgen"; SetOrder 1;',
        "Transfinite Curve {1, -2} = n + 1 Using Progression 1.2; "
        "Transfinite Surface {1} = {1, 2, 3, 4} AlternateLeft;",
        "Transfinite Line {3} = count Using Bump bias; Recombine Surface {1};",
        "Function f\n x = r ? Pi : newp; x += 1; x++; l[0] = 2; p~{i} = 3;\nReturn\nCall f;",
        'If (Exists(a) && !b) Printf("a = %g, %5.2f %%", a, b); ElseIf (a >> 1) EndIf',
        'Physical Curve(StrCat("in", "board"), 1) += Boundary{ Surface{1}; };',
        'Physical Curve(Sprintf("c%g", 1)) = Curve In BoundingBox {0, 0, 0, 1, 1, 1};',
        'Color Red{ Surface{1}; } Hide "*"; Show { Surface{:}; } Coherence Mesh; Delete Model;',
        "Periodic Curve {1} = {-2} Translate {1, 0, 0}; Curve{1} In Surface{2}; MeshSize{:} = 1;",
        "Rotate {{0, 0, 1}, {0, 0, 0}, Pi / 2} { Duplicata { Surface{1}; } }\nk = 1e-3;",
        "Circle(1) = {1, 2, 3}; Spline(2) = {1 : 5}; Ellipse(3) = {1, 2, 3, 4}; Wire(4) = {1};",
    ],
)
def test_statements_of_geometry_and_mesh_pass(text):
    """They reach Gmsh as they are, but for space and comments."""
    found = checked_geo(f"// first\n{text}")
    assert "".join(found.split()) == "".join(text.split())
    assert found.count("\n") == text.count("\n") + 2


@pytest.mark.parametrize("path", sorted(mesh_folder().glob("*.geo")), ids=lambda one: one.name)
def test_meshes_of_the_package_pass(path):
    text = path.read_text()
    lines = checked_geo(text).split("\n")
    for number, line in enumerate(text.split("\n")):
        code = re.sub("//.*", "", line)
        assert "".join(lines[number].split()) == "".join(code.split())


def test_long_lines_are_wrapped():
    """Gmsh reads blocks of 8 kB, and returns to their ends in loops: never amid a word."""
    found = checked_geo("x() = {" + ", ".join(map(str, range(9000))) + "};")
    assert max(map(len, found.split("\n"))) <= 1001
    assert "".join(found.split()).endswith("8998,8999};")
