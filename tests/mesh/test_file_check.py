"""Geometry files of strangers: nothing in them runs a program, or reads or writes another file."""

from __future__ import annotations

import re

import pytest
from mpi4py import MPI

from dolfinopt.data import mesh_folder
from dolfinopt.errors import InputError
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
    return arm_mesh(
        MPI.COMM_SELF,
        Arm(name="a", mesh=str(path), length=0.5, height=0.06, thickness=0.01),
    )


def refusal(path, text):
    """Return why a file is refused; nothing new lies beside it."""
    path.write_bytes(text.replace("HIT", str(path.parent / "hit")).encode())
    with pytest.raises(InputError) as caught:
        mesh_of(path)
    assert [one.name for one in path.parent.iterdir()] == [path.name]
    line = str(caught.value)
    assert line.startswith(f"{path}: mesh of arm 'a': ") and len(line.splitlines()) == 1
    return line


@pytest.mark.parametrize(
    ("text", "line", "what"),
    [
        (TOUCH, 1, "SystemCall runs programs"),
        ('\n/* a\n*/ NonBlockingSystemCall "touch HIT";', 3, "NonBlockingSystemCall runs"),
        ('System Str("touch ", "HIT");', 1, "System runs"),
        ('x = 1; SystemCall // why\r\n"touch HIT";', 1, "SystemCall runs"),
        ("\ufeff" + TOUCH, 1, "SystemCall runs"),
        ('S2N["SystemCall"] "touch HIT";', 1, "S2N makes names"),
        ("Macro m\n" + TOUCH + "\nReturn\nCall m;", 2, "SystemCall runs"),
        ('OnelabRun("a", "touch HIT");', 1, "OnelabRun runs"),
        ('Save "HIT";', 1, "Save writes"),
        ('Print "HIT";', 1, "Print writes"),
        ('CreateDir "HIT";', 1, "CreateDir writes"),
        ('Printf("%g", 1) > "HIT";', 1, "Printf(...) > writes"),
        ('f = "HIT"; Printf("a") >> f;', 1, "Printf(...) >> writes"),
        ('Merge "HIT";', 1, "Merge reads"),
        ('Include "HIT";', 1, "Include reads"),
        ('x() = ListFromFile("HIT");', 1, "ListFromFile reads"),
        ('v() = ShapeFromFile("HIT");', 1, "ShapeFromFile reads"),
        ('Field[1] = ExternalProcess; Field[1].CommandLine = "touch HIT";', 1, "ExternalProcess"),
        ('Field[1] = Structured; Field[1].FileName = "HIT";', 1, "Field Structured"),
        ('Field[1] = Box; Field[1].FileName = "HIT";', 1, "FileName names"),
        ("Plugin(MathEval).Run;", 1, "Plugin may"),
        ('View "a" { SP(0, 0, 0){1}; }; Save View[0] "HIT";', 1, "View may"),
        ('Solver[0].Executable = "touch HIT";', 1, "Solver runs"),
        ('General.ErrorFileName = "HIT";', 1, "General.ErrorFileName"),
        ("General.SaveSession = 1;", 1, "General.SaveSession"),
        ('Geometry.DoubleClickedPointCommand = "HIT";', 1, "DoubleClickedPointCommand"),
        ('Mesh[0].Algorithm = "HIT";', 1, "[...].Algorithm"),
        ("Exit;", 1, "Exit ends"),
        ('x = GetValue("how long?", 1);', 1, "GetValue asks"),
        ('x = GetEnv("HOME");', 1, "GetEnv looks"),
        ('NewCommand "HIT";', 1, "NewCommand is no statement"),
        ('NewCommand("HIT");', 1, "NewCommand is no statement"),
        ("NewCommand;", 1, "NewCommand is no statement"),
        ('Printf("%s", 1);', 1, "format of other kinds"),
        ('Printf("%900g", 1);', 1, "format of other kinds"),
        # Where Gmsh would find a statement in what looks like something else.
        ("If (0)\nEndIf1; " + TOUCH + "\nEndIf", 2, "EndIf1 holds"),
        ('If (0)\nx = "EndIf SystemCall c";\nEndIf', 2, "holds a word that ends"),
        (f'x = "{"a" * 1022} "; y = "; SystemCall c;";', 1, "is too long"),
        ('x = "a\nb";', 1, "goes over several lines"),
        ("x = 1;\0" + TOUCH, 1, "does not belong"),
        ("@include x", 1, "does not belong"),
    ],
)
def test_statements_that_are_refused(tmp_path, text, line, what):
    found = refusal(tmp_path / "arm.geo", text + PLATE)
    assert f"line {line}: " in found and what in found and "give the .msh file" in found


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


@pytest.mark.parametrize("name", ["arm.msh", "arm.MSH", "arm.step", "arm.Step", "arm.STP"], ids=str)
def test_files_that_are_not_what_their_name_says(tmp_path, name):
    assert "it is not a" in refusal(tmp_path / name, TOUCH + PLATE)


def test_step_header_before_statements(tmp_path):
    """Gmsh knows .step and .STEP; any other ending it would read as its own language."""
    refusal(tmp_path / "arm.Step", "ISO-10303-21;\n" + TOUCH)


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
