"""Responses that tests and pages declare are withdrawn after them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from dolfinopt.responses import response
from dolfinopt.scene.tables.objective import Constraints, declare
from dolfinopt.scene.tables.responses import DECLARED


@contextmanager
def withdrawn() -> Iterator[None]:
    """Leave the scenes of other tests without the words that the block declares."""
    before = set(DECLARED)
    yield
    for name in set(DECLARED) - before:
        Constraints.model_fields.pop(DECLARED.pop(name).key, None)
        response._known.pop(name, None)
    declare(DECLARED["mass"])
