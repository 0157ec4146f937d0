"""Responses and material laws that tests and pages declare are withdrawn after them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from dolfinopt.fem import laws
from dolfinopt.responses import response
from dolfinopt.scene.tables.arms import Arm, declare_law
from dolfinopt.scene.tables.material import LAWS, Material
from dolfinopt.scene.tables.objective import Constraints, declare
from dolfinopt.scene.tables.responses import DECLARED


@contextmanager
def withdrawn() -> Iterator[None]:
    """Leave the scenes of other tests without the words that the block declares."""
    before, kinds, keys = set(DECLARED), set(LAWS), set(Material.model_fields)
    yield
    for kind in set(LAWS) - kinds:
        del LAWS[kind], laws._known[kind]
    for key in set(Material.model_fields) - keys:
        del Material.model_fields[key], Arm.model_fields[key]
    declare_law(LAWS["isotropic"], {})
    for name in set(DECLARED) - before:
        Constraints.model_fields.pop(DECLARED.pop(name).key, None)
        response._known.pop(name, None)
    declare(DECLARED["mass"])
