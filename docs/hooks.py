"""What mkdocs makes anew with every build: references from the code, pictures, formulas.

The scene reference comes from the keys' own descriptions, the command reference from the commands'
own help, so that neither can differ from the program.
"""

from __future__ import annotations

import ast
import html
import re
from pathlib import Path
from typing import Any

import click
from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

import dolfinopt
from dolfinopt.bench.field import Value, read_cases
from dolfinopt.cli import commands
from dolfinopt.scene.messages import describe_keys
from dolfinopt.scene.old_words import OLD_WORDS

ROOT = Path(__file__).parents[1]
ARRAYS = ("arms", "arms.regions", "arms.interfaces", "joints", "closures", "scenarios")
TABLES = {
    "": "Top level",
    "material": 'Material of all arms that state none of their own. `material = "NAME"` at the top '
    "of the scene takes a material of the catalogue; `dolfinopt keys material` lists them.",
    "interpolation": "How stiffness and mass follow from the density x of a cell.",
    "arms": "An array of tables, one `[[arms]]` an arm, from the base outwards. "
    "A key that an arm leaves out has the value of the arm before it.",
    "arms.regions": "An array of tables below an arm's, one `[[arms.regions]]` a part of the arm "
    "that stays solid or void.",
    "arms.interfaces": "An array of tables below an arm's, one `[[arms.interfaces]]` a further "
    "place where a joint or the payload sits; machines in space.",
    "joints": "An array of tables, one `[[joints]]` a joint of a machine in space.",
    "motion": "What the machine does.",
    "control": "Drives with feed-forward and feedback; without this table joints are prescribed.",
    "closures": "An array of tables, one `[[closures]]` a joint that closes a loop.",
    "payload": "What the end-effector carries.",
    "damping": "Damping of the arms.",
    "reduction": "The reduced model of every arm.",
    "simulation": "Integration in time.",
    "objective": "What is minimised.",
    "constraints": "Limits besides that of the volume.",
    "design": "The design variables, their filter and projection.",
    "optimizer": "The optimiser and when it ends.",
    "part": "What `dolfinopt part` makes of the result; options of the command go over it.",
    "scenarios": "An array of tables, one `[[scenarios]]` a use of the machine that the design "
    "must serve besides the others.",
}


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages and the pictures of demos/pictures."""
    for path, text in {
        "reference/scene.md": scene_reference(),
        "reference/commands.md": command_reference(),
        "reference/python.md": python_reference(),
        "develop/modules.md": module_list(),
        "validation/field.md": field_page(),
    }.items():
        files.append(File.generated(config, path, content=text))
    for picture in sorted((ROOT / "demos" / "pictures").iterdir()):
        source = str(picture)
        files.append(File.generated(config, f"pictures/{picture.name}", abs_src_path=source))
    return files


def on_page_content(page_html: str, **_: Any) -> str:
    """Turn the formulas that arithmatex has marked into MathML."""
    pattern = r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>'
    return re.sub(pattern, _formula, page_html, flags=re.DOTALL)


def _formula(match: re.Match[str]) -> str:
    display = "inline" if match[2] == "(" else "block"
    # The converter wants braces around what a font applies to.
    pattern = r"\\(math[a-z]+|boldsymbol)(?:\s+|(?=\\))(\\[a-zA-Z]+|\w)"
    tex = re.sub(pattern, r"\\\1{\2}", html.unescape(match[3]))
    return convert(tex, display=display)


def scene_reference() -> str:
    """Return the page of all keys, table by table."""
    lines = [
        "# Scene reference\n",
        "A scene is a TOML file. This page is made from how the program describes its keys;",
        "`dolfinopt keys` prints the same in a terminal. A key without default is required.",
        "Whatever is not listed here, or out of range, is refused with the name of the key.\n",
        "All quantities are in SI units, angles in radians. Another consistent set of units",
        "(millimetre, tonne, newton, second) gives the same designs.\n",
    ]
    known: set[str] = set()
    for info in describe_keys():
        table, _, key = info.key.rpartition(".")
        if table not in known:
            known.add(table)
            array = table in ARRAYS
            title = f"`[[{table}]]`" if array else f"`[{table}]`" if table else TABLES[""]
            lines += [f"\n## {title} {{#{table or 'top'}}}\n"]
            lines += [f"{TABLES.get(table, '')}\n"] if table else []
            lines += ["| key | meaning | unit | default | allowed |", "|---|---|---|---|---|"]
        meaning, unit = _with_unit(info.description)
        meaning += "".join(f"; also of [[{other}]]" for other in info.also)
        default = f"`{info.default}`" if info.default else "required"
        default = "none" if info.default == "none" else default
        allowed = info.allowed.replace(" | ", " or ")
        lines.append(f"| `{key}` | {_cell(meaning)} | {unit} | {default} | {_cell(allowed)} |")
    lines += ["\n## Older words {#older}\n", OLDER, "| older | now |", "|---|---|"]
    lines += [f"| `{word.old}` | {_cell(word.told)} |" for word in OLD_WORDS.values()]
    return "\n".join(lines) + "\n"


OLDER = """Scenes of earlier versions are read, and so are the folders of their runs. A run tells in
one line what it translated; `dolfinopt keys --upgrade SCENE` rewrites a file, with its comments.
"""


def _with_unit(description: str) -> tuple[str, str]:
    match = re.fullmatch(r"(.*) \[([^\]]*)\]", description, flags=re.DOTALL)
    return (match[1], "" if match[2] == "-" else match[2]) if match else (description, "")


def _cell(text: str) -> str:
    """Return a text that may stand in a table of Markdown."""
    return text.replace("|", "&#124;").replace("<", "&lt;").replace("*", "\\*").replace("_", "\\_")


def command_reference() -> str:
    """Return the page of all commands with their arguments and options."""
    lines = [
        "# Command reference\n",
        "This page is made from the commands' own help: `dolfinopt COMMAND --help`. Where the",
        "program was set up by its launcher, `./dolfinopt.sh COMMAND` is the same, and",
        "`./dolfinopt.sh -n RANKS COMMAND` runs it on several processes; elsewhere",
        "`mpirun -n RANKS dolfinopt COMMAND` does.\n",
        "Exit status: 0, done; 1, failed to converge, a design that does not meet a constraint, or",
        "an internal error; 2, bad input. One line says what and where.\n",
    ]
    for name in commands.list_commands(click.Context(commands)):
        command = commands.commands[name]
        context = click.Context(command, info_name=f"dolfinopt {name}")
        lines += [f"\n## `{name}`\n", "```text", context.get_usage(), "```\n"]
        lines += [_paragraphs(command.help or ""), ""]
        options = [one for one in command.params if isinstance(one, click.Option)]
        if rows := [row for one in options if (row := one.get_help_record(context))]:
            lines += ["| option | meaning |", "|---|---|"]
            lines += [f"| <code>{_cell(a)}</code> | {_cell(b)} |" for a, b in rows]
        for one in options:
            if one.hidden and one.help:
                lines.append(f"| older: <code>{one.opts[0]}</code> | {_cell(one.help)} |")
    return "\n".join(lines) + "\n"


def _paragraphs(text: str) -> str:
    """Return a help text as Markdown: paragraphs flow, \\b blocks stay as they are."""
    parts = re.split(r"\n\s*\n", text.strip())
    done = []
    for part in parts:
        if part.startswith("\b"):
            done.append("```text\n" + part.lstrip("\b\n") + "\n```")
        else:
            done.append(" ".join(part.split()).replace("<", "&lt;"))
    return "\n\n".join(done)


def python_reference() -> str:
    """Return the page of all public names, described by their docstrings."""
    first = ["Model", "load_scene", "scene_from_dict", "optimize", "evaluate", "gradient"]
    names = [name for name in dolfinopt.__all__ if name != "__version__"]
    names.sort(key=lambda name: (first.index(name) if name in first else len(first), name))
    lines = [
        "# Python\n",
        "What `import dolfinopt` offers; everything else may change. Functions marked collective",
        "are called by all MPI processes together. Arrays and their shapes are described with",
        "`n` for a number and `q` for that of elastic coordinates; units are SI.\n",
    ]
    for title, chosen in (
        ("Functions and classes", [name for name in names if not name.endswith("Error")]),
        ("Errors", [name for name in names if name.endswith("Error")]),
    ):
        lines += [f"\n## {title}\n", *(f"::: dolfinopt.{name}\n" for name in chosen)]
    return "\n".join(lines)


def field_page() -> str:
    """Return the page of the benchmark, from its case files."""
    lines = [
        "# Benchmark of the field\n",
        "Published problems of flexible machines in motion, with geometry, motion, design and",
        "numbers together, so that programs can be compared. Statements, reference values and our",
        "results are in the folder `benchmarks` of the source, free for any use (CC0).",
        "`dolfinopt bench field` runs them and compares; `bench field all` includes the long ones,",
        "`bench field NAME` runs one. Of a history, the difference is the largest over time as a",
        "share of the reference's largest value.\n",
        "How the references were made: `benchmarks/reference/README.md`. To take part, see",
        "`benchmarks/README.md`.\n",
    ]
    for case in read_cases():
        lines += [f"\n## {case.title} {{#{case.name}}}\n", f"{_flowing(case.problem)}\n"]
        lines += [f"Source: {_flowing(case.source)}. Case `{case.name}`.\n"]
        lines += ["| value | unit | reference | dolfinopt | difference | limit | from |"]
        lines += ["|---|---|---|---|---|---|---|"]
        lines += [_field_row(one) for one in case.values]
    return "\n".join(lines) + "\n"


def _flowing(text: str) -> str:
    """Return a text on one line, as Markdown; addresses and DOIs as links."""
    text = " ".join(text.split()).replace("<", "&lt;").replace("*", "\\*").replace("_", "\\_")
    return re.sub(r"\bdoi:(10\.\d+/[\w./()-]*\w)", r"[doi:\1](https://doi.org/\1)", text)


def _field_row(one: Value) -> str:
    """Return the row of a value of the benchmark."""
    way = {"near": "", "most": "at most ", "least": "at least "}[one.way]
    if one.table:
        cells = ["history", "history", f"{one.ours:.2g}", f"{one.limit:g}"]
    else:
        change = one.ours / one.reference - 1.0
        limit = f"{way}{one.limit:g}" if one.way == "near" else f"{way}the reference"
        cells = [f"{one.reference:.6g}", f"{one.ours:.6g}", f"{change:.1g}", limit]
    return f"| {' | '.join([_flowing(one.what), one.unit, *cells, _flowing(one.origin)])} |"


def module_list() -> str:
    """Return the page of all subpackages and modules with what each is for."""
    package = ROOT / "dolfinopt"
    rooms = sorted(path.parent for path in package.glob("*/**/__init__.py"))
    lines = ["# Modules\n", "What each module is for, by its own first line.\n"]
    for room in [package, *rooms]:
        modules = sorted(path for path in room.glob("[!_]*.py"))
        rows = [f"| `{path.stem}` | {_cell(_docstring(path)[0])} |" for path in modules]
        name = "Top level" if room == package else f"`{'.'.join(room.relative_to(package).parts)}`"
        lines += [f"\n## {name}\n"]
        lines += (
            [_cell(" ".join(_docstring(room / "__init__.py"))) + "\n"] if name[0] == "`" else []
        )
        lines += ["| module | |", "|---|---|", *rows] if rows else []
    return "\n".join(lines) + "\n"


def _docstring(path: Path) -> list[str]:
    """Return the lines of a module's docstring up to the first blank one."""
    text = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return text.split("\n\n")[0].splitlines() or [""]
