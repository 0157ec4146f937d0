"""What a geometry file may hold: Gmsh's own language runs programs, reads and writes files.

`open_file` takes the place of `gmsh.open` for every file that may come from others.
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from dolfinopt.errors import InputError
from dolfinopt.mesh.gmsh_session import telling
from dolfinopt.mesh.measured import LINE_CHARACTERS_LIMIT, WORD_CHARACTERS_LIMIT

# What each kind of file begins with; Gmsh takes a file that does not for a text in its language.
FIRST = {
    ".msh": (b"$MeshFormat", 'a mesh of Gmsh (first line "$MeshFormat")'),
    ".step": (b"ISO-10303-21", "a STEP file (ISO 10303-21)"),
}
FIRST[".stp"] = FIRST[".step"]

# Words of Gmsh's language (src/parser/Gmsh.l and Gmsh.y of Gmsh 4.8 to 4.15) that only describe
# geometry and mesh. Every other word is the name of a variable, or refused.
HARMLESS = frozenset(
    """
    Abort Abs Acos Affine ArcCos ArcSin ArcTan ArcTan2 Asin Atan Atan2 BSpline Bezier Block
    BooleanCoherence BooleanCommon BooleanCut BooleanDifference BooleanFragments BooleanFuse
    BooleanIntersection BooleanSection BooleanUnion BoundingBox Box Call Catenary CatmullRom Ceil
    CenterOfMass Chamfer Characteristic Circle ClassifySurfaces Closest Coherence Color Compound
    Cone Coordinates Cos Cosh CreateGeometry CreateMeshEdges CreateMeshFaces CreateTopology
    Curvature Curve Cylinder DefineConstant DefineNumber DefineString Degenerated Delete Dilate
    Disk Ellipse Ellipsis Ellipsoid Elliptic Else ElseIf EndFor EndIf Error Euclidean Euclidian
    Exists Exp Extrude Fabs Field Fillet Find Floor Fmod For Function GMSH_MAJOR_VERSION
    GMSH_MINOR_VERSION GMSH_PATCH_VERSION GeoEntity HealShapes Hide Hole Hypot If In Intersect Knots
    Layers Length Line LinSpace List Log Log10 LogSpace LowerCase MPI_Rank MPI_Size Macro Mass
    MatrixOfInertia Max MeshAlgorithm MeshSize MeshSizeFromBoundary Min Modulo Normal Nurbs Order
    Parametric Parent Periodic Physical Pi Plane Point PolarSphere Printf QuadTriAddVerts
    QuadTriNoNewVerts Quadric Rand RecombLaterals Recombine RecombineMesh Rectangle Recursive
    RefineMesh RelocateMesh RenumberMeshElements RenumberMeshNodes ReorientMesh Return Reverse
    ReverseMesh Rotate Round Ruled ScaleLastLayer SetFactory SetMaxTag SetTag Sewing Show Sin Sinh
    Smoother Sphere Spline Split Sprintf Sqrt Step Str StrCat StrChoice StrCmp StrFind StrLen
    Surface Symmetry SyncModel Tan Tanh TestLevel ThickSolid ThruSections Torus TransfQuadTri
    Transfinite TransformMesh Translate UndefineConstant Unique UpperCase Using Volume Warning Wedge
    Wire
    """.split()
)
_REFUSED = {
    "runs programs": "SystemCall NonBlockingSystemCall System OnelabRun OnelabAction Solver "
    "ExternalProcess SendToServer",
    "reads other files": "Include Merge MergeWithBoundingBox ShapeFromFile ListFromFile FileExists "
    "Structured AutomaticMeshSizeField",
    "writes files": "Save Print CreateDir",
    "may run programs or read and write files": "Plugin PostProcessing View Alias AliasWithOptions "
    "CopyOptions Combine Slide Homology Cohomology Betti Levelset AdaptMesh",
    "asks at the keyboard": "GetValue GetStringValue",
    "ends this program": "Exit",
    "looks beyond this file": "GetEnv GetString GetNumber GetForced GetForcedStr SetString "
    "SetNumber AbsolutePath CurrentDir CurrentDirectory CurrentFileName DirName FixRelativePath "
    "GmshExecutableName CodeName",
    "makes names out of text": "S2N StringToName N2S NameToString StrReplace StrSub StrPrefix "
    "StrRelative LowerCaseIn",
    "describes no arm": "Append ColorTable Cpu DimNameSpace Draw INTERPOLATION_SCHEME Memory "
    "NameStruct NewModel SetChanged SetPartition Sleep Struct T2 T3 TIME TextAttributes Today "
    "TotalMemory UnsplitWindow PartitionMesh CreateOverlaps SetCurrentWindow Remesh "
    "SplitCurrentWindowHorizontal SplitCurrentWindowVertical PostView",
}
REFUSED = {word: why for why, words in _REFUSED.items() for word in words.split()}
FIELDS = frozenset(
    """
    Attractor AttractorAnisoCurve Ball BoundaryLayer Box Constant Curvature Cylinder Distance Extend
    Frustum Gradient IntersectAniso Laplacian LonLat MathEval MathEvalAniso Max MaxEigenHessian Mean
    Min MinAniso Octree Param Restrict Threshold
    """.split()
)
# Names that are no keywords: what they may stand before. `Name "Parameters/length"` and its like
# describe the parameters of DefineConstant.
BEFORE_TEXT = frozenset("Name Label Help Highlight Units Kind OptimizeMesh".split())
BEFORE_NUMBER = frozenset(
    "Range Loop Visible ReadOnly ReadOnlyRange NeverChanged Closed AutoCheck Mesh SetOrder "
    "Power Progression Progression_HWall Bump Bump_HWall Beta Beta_HWall".split()
)
BEFORE_LIST = frozenset(
    "Choices Range Duplicata Boundary CombinedBoundary OrientedBoundary PointsOf Embedded".split()
)
BEFORE_WORD = frozenset({("Background", "Field"), ("BoundaryLayer", "Field")})
ALONE = frozenset("Left Right Alternate AlternateLeft AlternateRight".split())
GENERAL = frozenset(
    {"AbortOnError", "ExpertMode", "NoPopup", "NumThreads", "Terminal", "Verbosity"}
)
# Where Gmsh goes on after it has skipped text.
ENDS = re.compile("(?:EndIf|EndFor|Else|ElseIf|Return)(?![A-Za-z_])")
FORMAT = re.compile(r"(?:[^%]|%%|%[-+ 0#]?\d{0,2}(?:\.\d{0,2})?[eEfFgG])*")
ASSIGNMENTS = frozenset({"=", "+=", "-=", "*=", "/=", "++", "--"})
CLOSING = {"(": ")", "[": "]", "{": "}"}

# As the scanner of Gmsh has them, Gmsh.l.
_TOKEN = re.compile(
    r"""(?P<space>[ \t\f\n]+|//[^\n]*)
    |(?P<comment>/\*.*?\*/)
    |(?P<text>"[^"]*"|'[^']*')
    |(?P<number>\d+\.\d*(?:[Ee][-+]?\d+)?|\d*\.\d+(?:[Ee][-+]?\d+)?|\d+[Ee][-+]?\d+|\d+)
    |(?P<word>[A-Za-z_][A-Za-z_0-9]*)
    |(?P<sign>\.\.\.|::|\|\||&&|\+\+|--|[-+*/=!<>]=|>>|<<|[-;=:+*/<>()\[\]{}.,\#~?!%^|&])""",
    re.VERBOSE | re.DOTALL,
)


def open_file(gmsh: Any, path: str | Path) -> None:
    """Have Gmsh open a .geo, .msh or .step file that runs no programs and touches no other files.

    Gmsh sees a .geo file without its comments, and every file under another name in a folder of
    its own: beside `arm.msh` it would also read `arm.msh.opt`.

    Raises:
        InputError: the file is not what its name says, or a line of a .geo holds a statement that
            is not known to be harmless.
    """
    path = Path(path)
    ending = path.suffix.lower()
    with tempfile.TemporaryDirectory() as folder:
        seen = Path(folder) / f"arm{ending}"
        if ending == ".geo":
            seen.write_bytes(checked_geo(path.read_bytes().decode("latin-1")).encode("latin-1"))
        else:
            check_start(path)
            seen.symlink_to(path.absolute())
        with telling(lambda text: Exception(text.replace(str(seen), path.name))):
            gmsh.open(str(seen))


def check_start(path: Path) -> None:
    """Raise InputError unless a file begins as its ending says."""
    expected, kind = FIRST[path.suffix.lower()]
    with path.open("rb") as stream:
        start = stream.read(256)
    if expected == b"ISO-10303-21":
        start = start.lstrip()
    if not start.startswith(expected):
        raise InputError(f"it is not {kind}; export it again, or give the file its own ending")


@lru_cache(maxsize=4)  # a file with parameters is opened twice
def checked_geo(text: str) -> str:
    """Return a .geo text for Gmsh: the same statements on the same lines, without comments.

    Comments go because Gmsh looks into them where it skips the branch of an If or returns to the
    begin of a loop: what is code to Gmsh would not be what has been checked.

    Args:
        text: decoded as Latin-1, so that every byte is one character.

    Raises:
        InputError: a statement that is not known to be harmless, with its line.
    """
    tokens = _tokens(text.removeprefix("\xef\xbb\xbf").replace("\r\n", "\n"))
    _Checker(tokens).check()
    lines: list[list[str]] = []
    for token in tokens:
        while len(lines) < token.line:
            lines.append([])
        lines[token.line - 1].append(token.text)
    return "".join("\n".join(_wrapped(line)) + "\n" for line in lines)


def _wrapped(words: list[str]) -> list[str]:
    rows, size = [""], 0
    for word in words:
        if size + len(word) >= LINE_CHARACTERS_LIMIT:
            rows.append("")
            size = 0
        rows[-1] += word + " "
        size += len(word) + 1
    return rows


@dataclass(frozen=True)
class _Token:
    kind: str  # "text", "number", "word", "sign"
    text: str
    line: int


NOTHING = _Token("none", "", 0)


def _refused(line: int, what: str, why: str) -> InputError:
    return InputError(
        f"line {line}: {what} {why}; only statements of geometry and mesh are read: remove it, or "
        "save the mesh in Gmsh and give the .msh file"
    )


def _tokens(text: str) -> list[_Token]:
    result, place, line = [], 0, 1
    while place < len(text):
        match = _TOKEN.match(text, place)
        if match is None:
            raise _refused(line, repr(text[place]), "does not belong to Gmsh's language")
        kind, piece = str(match.lastgroup), match.group()
        if kind in ("comment", "space"):
            if "\0" in piece:
                raise _refused(line, "a character 0", "does not belong to Gmsh's language")
        else:
            if len(piece) > WORD_CHARACTERS_LIMIT or any(c < " " for c in piece):
                raise _refused(line, f"{piece[:20]!r}...", "is too long or goes over several lines")
            if ENDS.search(piece) and piece not in HARMLESS:
                raise _refused(line, piece, "holds a word that ends a block")
            result.append(_Token(kind, piece, line))
        line += piece.count("\n")
        place = match.end()
    return result


class _Checker:
    """Rules for a token and its neighbours."""

    # They look at no more than one statement, and Gmsh's parser jumps only between statements: a
    # file that keeps them does so from wherever the parser goes on after a jump or an error.

    def __init__(self, tokens: list[_Token]) -> None:
        self.tokens = tokens

    def at(self, k: int) -> _Token:
        return self.tokens[k] if 0 <= k < len(self.tokens) else NOTHING

    def check(self) -> None:
        for k, token in enumerate(self.tokens):
            if token.kind == "word":
                self._word(k)
            elif token.kind == "text":
                self._text(k)
            elif token.text == ".":
                self._dot(k)
            elif token.text == "::":
                raise _refused(token.line, '"::"', REFUSED["Struct"])

    def _word(self, k: int) -> None:
        token, after = self.at(k), self.at(k + 1)
        word = token.text
        if word in REFUSED:
            raise _refused(token.line, word, REFUSED[word])
        if self.at(k - 1).text == "." and (
            self.at(k - 2).kind == "word" or self.at(k - 2).text == "]"
        ):
            return  # the name of an option, see _dot
        if word == "Field":
            self._field(k)
        elif word in ("Printf", "Error", "Warning", "Sprintf"):
            self._print(k)
        elif word not in HARMLESS:
            self._name(k, token, after)

    def _name(self, k: int, token: _Token, after: _Token) -> None:
        """Check a word that is no keyword: a variable, or a command of this or a later Gmsh."""
        word, before = token.text, self.at(k - 1)
        stranger = _refused(token.line, word, "is no statement that this program knows")
        if after.kind == "text" and word in BEFORE_TEXT:
            return
        if after.text == "{" and word in BEFORE_LIST:
            return
        if word in BEFORE_NUMBER and (after.kind in ("number", "word") or after.text in "-+("):
            return
        if (word, after.text) in BEFORE_WORD or (word in ALONE and after.text == ";"):
            return
        named = before.text in ("Macro", "Function")
        if named or after.text in ("In", "Using") or before.text == "Color":
            return
        if after.kind in ("text", "number", "word") or after.text == "{":
            raise stranger
        if after.text in ("(", "[") and self.at(k + 2).kind == "text":
            raise stranger
        begins = before is NOTHING or before.text in (
            *(";", "}", ")"),
            *("Else", "EndIf", "EndFor", "Return"),
        )
        if begins or self.at(k - 2).text in ("Macro", "Function"):
            self._assignment(k, stranger)

    def _assignment(self, k: int, stranger: InputError) -> None:
        """Check that a name at the begin of a statement is given a value."""
        k += 1
        if self.at(k).text == "~":
            k = self._closed(k + 1) + 1
        if self.at(k).text in ("(", "["):
            k = self._closed(k) + 1
        if self.at(k).text not in (*ASSIGNMENTS, "."):
            raise stranger

    def _closed(self, k: int) -> int:
        """Return the place of the bracket that closes the one at k, in the same statement."""
        opened: list[str] = []
        for j in range(k, len(self.tokens)):
            sign = self.at(j).text
            if sign in CLOSING:
                opened.append(CLOSING[sign])
            elif opened and sign == opened[-1]:
                opened.pop()
            elif sign in (")", "]", "}", ";") or not opened or ENDS.fullmatch(sign):
                break
            if not opened:
                return j
        raise _refused(self.at(k - 1).line, self.at(k - 1).text, "has brackets that do not close")

    def _text(self, k: int) -> None:
        token, before = self.at(k), self.at(k - 1)
        words = BEFORE_TEXT | {"Call", "Macro", "Function"}
        signs = ("(", "[", "{", ",", "=", "+=", "?", ":", "==", "!=")
        if before.text in HARMLESS and token.text == '"*"':  # all entities
            return
        if before.text not in signs and not (before.kind == "word" and before.text in words):
            raise _refused(token.line, f"{before.text} {token.text}", "is not known to be harmless")

    def _print(self, k: int) -> None:
        """Check that text goes to no file, and that its format takes numbers alone."""
        token = self.at(k)
        if self.at(k + 1).text not in ("(", "[") or self.at(k + 2).kind != "text":
            raise _refused(token.line, token.text, 'needs a format, such as ("height %g", h)')
        if not FORMAT.fullmatch(self.at(k + 2).text[1:-1]) or self.at(k + 3).text not in ",)]":
            raise _refused(token.line, token.text, "has a format of other kinds than %g, %f, %e")
        end = self._closed(k + 1)
        if token.text != "Sprintf" and self.at(end + 1).text != ";":
            raise _refused(token.line, f"{token.text}(...) {self.at(end + 1).text}", "writes files")

    def _field(self, k: int) -> None:
        """Check a field of cell sizes: some kinds run programs or read files."""
        token = self.at(k)
        if self.at(k - 1).text in ("Background", "BoundaryLayer"):
            return
        end = self._closed(k + 1)
        first, second, third = (self.at(end + j) for j in (1, 2, 3))
        if first.text == "=" and second.text in FIELDS and third.text == ";":
            return
        if first.text == "." and third.text == "=":
            if re.search("File|Command|Path", second.text):
                raise _refused(second.line, second.text, "names a file or program")
            return
        if first.text == ";" and self.at(k - 1).text == "Delete":
            return
        raise _refused(token.line, f"Field {second.text}", "is of no kind that is known harmless")

    def _dot(self, k: int) -> None:
        """Check options: numbers of mesh and geometry name no file and no program."""
        owner, name, sign, value = (self.at(k + j) for j in (-1, 1, 2, 3))
        line = self.at(k).line
        if owner.text == "]" or (owner.text == "Color" and self.at(k - 2).text == "."):
            if owner.text == "]" and not self._of_field(k - 1):
                raise _refused(line, f"[...].{name.text}", "is no option that is known harmless")
            return
        option = f"{owner.text}.{name.text}"
        known = owner.text in ("Mesh", "Geometry") or (
            owner.text == "General" and name.text in GENERAL
        )
        if not known or name.kind != "word" or name.text.endswith("Command"):
            raise _refused(line, option, "is no option that is known harmless")
        number = value.kind in ("number", "word") or value.text in ("-", "+", "(", "!")
        texts = ("Str", "StrCat", "StrChoice", "Sprintf", "UpperCase", "LowerCase", "DefineString")
        if sign.text == "=" and (not number or value.text in texts):
            if option != "Geometry.OCCTargetUnit" or value.kind != "text":
                raise _refused(line, option, "may take a number only")

    def _of_field(self, k: int) -> bool:
        """Say whether the bracket that closes at k belongs to Field[...]."""
        depth = 0
        for j in range(k, -1, -1):
            depth += (self.at(j).text == "]") - (self.at(j).text == "[")
            if depth == 0:
                return self.at(j - 1).text == "Field"
        return False
