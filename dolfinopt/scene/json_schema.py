"""The keys of a scene as JSON schema, from which editors complete and check scene files."""

from __future__ import annotations

from typing import Any

from dolfinopt.scene.materials import CATALOGUE
from dolfinopt.scene.schema import Scene

SCHEMA_FILE = "dolfinopt.schema.json"


def scene_schema() -> dict[str, Any]:
    """Return the JSON schema (draft 7, which editors of TOML know) of a scene file.

    It knows keys, types and ranges; what depends on several keys is checked when a scene is read.
    """
    schema = _plain(Scene.model_json_schema())
    schema["definitions"] = schema.pop("$defs")
    schema["required"].remove("name")  # by default the file's
    schema["properties"]["arms"]["minItems"] = 1
    # An arm takes what it leaves out from the one before, and --set may supply what all lack.
    schema["definitions"]["Arm"]["required"] = ["name"]
    for name, table in schema["properties"].items():
        if "$ref" in table:  # tables complete as tables; their defaults stand at their keys
            schema["properties"][name] = {"$ref": table["$ref"]}
    # A name in place of the table, or in it, stands for its values.
    table = schema["definitions"]["Material"]
    table["anyOf"] = [{"required": ["name"]}, {"required": table.pop("required")}]
    schema["properties"]["material"] = {
        "anyOf": [{"type": "string", "enum": list(CATALOGUE)}, schema["properties"]["material"]]
    }
    head = {"$schema": "http://json-schema.org/draft-07/schema#", "title": "scene of dolfinopt"}
    return head | {key: value for key, value in schema.items() if key != "title"}


def _plain(node: Any) -> Any:
    """Return a part of pydantic's schema without null, which TOML lacks, and in draft 7's words."""
    if isinstance(node, list):
        return [_plain(item) for item in node]
    if not isinstance(node, dict):
        return node
    if "anyOf" in node:
        kinds = [kind for kind in node["anyOf"] if kind != {"type": "null"}]
        rest = {key: value for key, value in node.items() if key != "anyOf"}
        node = rest | (kinds[0] if len(kinds) == 1 else {"anyOf": kinds})
    found = {}
    for key, value in node.items():
        if key == "properties":
            found[key] = {name: _plain(item) for name, item in value.items()}
        elif key == "prefixItems":
            found["items"] = _plain(value)
        elif key == "$ref":
            found[key] = value.replace("#/$defs/", "#/definitions/")
        elif key != "title" and (key, value) != ("default", None):
            found[key] = _plain(value)
    return found
