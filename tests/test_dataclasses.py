"""Dataclasses all over the package compare without asking arrays for a truth value."""

import importlib
import inspect
import pkgutil
import typing
from collections.abc import Callable
from dataclasses import fields, is_dataclass

import numpy as np
import pytest

import dolfinopt as do
from dolfinopt.multibody.rigid_motion import RigidMotion

pytestmark = pytest.mark.serial  # one rank shows all there is

OPTIONAL = {"bench"}  # imports programs that a plain installation does not have


def dataclasses():
    """Yield every dataclass that a module of the package defines."""
    for module in pkgutil.walk_packages(do.__path__, "dolfinopt."):
        if module.name.endswith("__main__"):
            continue
        try:
            loaded = importlib.import_module(module.name)
        except ImportError:
            assert OPTIONAL & set(module.name.split("."))
            continue
        for _, found in inspect.getmembers(loaded, inspect.isclass):
            if found.__module__ == module.name and is_dataclass(found):
                yield found


def holds_array(hint):
    """Return whether values of this type, or what they contain, are arrays; not of functions."""
    if isinstance(hint, str):  # a name that only type checkers import
        return "ndarray" in hint and "Callable" not in hint
    if typing.get_origin(hint) is Callable:
        return False
    if hint is np.ndarray or typing.get_origin(hint) is np.ndarray:
        return True
    return any(map(holds_array, typing.get_args(hint)))


def hints(of):
    """Yield the types of a dataclass' fields, or their text where a name is not known here."""
    known = vars(importlib.import_module(of.__module__))
    for field in fields(of):  # type: ignore[arg-type]
        try:
            yield eval(field.type, dict(known)) if isinstance(field.type, str) else field.type
        except NameError:
            yield field.type


def test_dataclasses_with_arrays_compare_by_identity():
    """The generated == raises where a field is an array: it has no single truth value."""
    found = list(dataclasses())
    assert RigidMotion in found
    compared = [one for one in found if one.__eq__ is not object.__eq__]
    wrong = [one for one in compared if any(map(holds_array, hints(one)))]
    assert not wrong, "write @dataclass(eq=False)"
