"""Data of small scenes, and what is refused of them."""

import copy

from runs import STATED, refusal

from dolfinopt.scene.load import scene_from_dict

MATERIAL = {"young_modulus": 70e9, "poisson_ratio": 0.33, "density": 2700.0}  # Pa, -, kg/m3
ARM = {"name": "arm1", "length": 1.0, "height": 0.06, "thickness": 0.01}  # m
FILE = "some/where.toml"


def minimal(n_arms=2, **tables):
    """Return the data of a scene with the required keys only, and `tables`."""
    arms = [dict(ARM), *({"name": f"arm{i}"} for i in range(2, n_arms + 1))]
    required = {"material": dict(MATERIAL), "arms": arms, **copy.deepcopy(STATED)} | tables
    for key in STATED:  # a table that is given has its required key, too
        if isinstance(required[key], dict):
            required[key] = STATED[key] | required[key]
    return required


def put(data, path, value):
    """Set `value` at the dotted `path`, unless something other than a table is on the way."""
    node = data
    *above, last = [int(part) if part.isdigit() else part for part in path.split(".")]
    for part in above:
        if isinstance(node, dict):
            node = node.setdefault(part, {})
        elif isinstance(node, list) and isinstance(part, int) and part < len(node):
            node = node[part]
    if isinstance(node, dict) or (isinstance(node, list) and last in range(len(node))):
        node[last] = value


def put_at(data, path, value):
    """Set a value at a path of keys and numbers, tables made where there are none; None: away."""
    node = data
    for key in path[:-1]:
        node = node.setdefault(key, {}) if isinstance(node, dict) else node[key]
    if value is None:
        del node[path[-1]]
    else:
        node[path[-1]] = value


def changed(*pairs, n_arms=2):
    """Return the minimal data with values at dotted paths: path, value, path, value ..."""
    data = minimal(n_arms)
    for path, value in zip(pairs[::2], pairs[1::2]):
        put(data, path, value)
    return data


def refused(data, *words, overrides=(), source=FILE):
    """Check that `data` is refused with `words`; return the message."""
    return refusal(lambda: scene_from_dict(data, source, overrides), str(source), *words)
