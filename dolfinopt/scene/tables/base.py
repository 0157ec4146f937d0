"""What all tables of a scene have in common: validation, refusals, ranges of quantities."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from types import UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    NamedTuple,
    TypeVar,
    Union,
    get_args,
    get_origin,
)

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from dolfinopt.data import tables_of
from dolfinopt.errors import InputError

if TYPE_CHECKING:
    from typing_extensions import Self

    from dolfinopt.scene.schema import Scene

# Ranges far beyond what machines need, within which products and quotients of all quantities stay
# within double precision. What is merely improbable is for `plausibility.py` to say.
Length = Annotated[float, Field(ge=1e-6, le=1e4)]  # m
Extent = Annotated[float, Field(ge=0, le=1e4)]  # m; 0: none
Position = Annotated[float, Field(ge=-1e4, le=1e4)]  # m; rad, m of a joint's coordinate
Angle = Annotated[float, Field(ge=-1e3, le=1e3)]  # rad
Duration = Annotated[float, Field(ge=1e-4, le=1e5)]  # s
Instant = Annotated[float, Field(ge=0, le=1e5)]  # s
Frequency = Annotated[float, Field(ge=0, le=1e9)]  # Hz
Inertia = Annotated[float, Field(ge=0, le=1e9)]  # kg m2; kg
Stiffness = Annotated[float, Field(ge=0, le=1e15)]  # N/m, N m/rad; of dampers and gains, too
DriveForce = Annotated[float, Field(ge=1e-9, le=1e15)]  # N, N m; rates alike
Component = Annotated[float, Field(ge=-1e6, le=1e6)]  # of a direction

T = TypeVar("T")
Three = tuple[T, T, T]
Six = tuple[T, T, T, T, T, T]
TwoOrThree = tuple[T, T] | tuple[T, T, T]  # in the plane or in space
MAX_ITERATIONS = 1_000_000
DEEPEST = 100  # of arrays and tables in each other

NAMES_FILE = "names a file"
FileName = Annotated[str, NAMES_FILE]  # path of a file; a scene holds it absolute

Loc = tuple[Any, ...]  # path of a key in the scene's data, e.g. ("arms", 0, "length")


class Refusal(ValueError):
    """Reject a value for a reason that needs more than one key or a sentence of its own.

    `keys` are paths, dotted or as tuples; the first one is reported, all are involved. Validators
    of a table give them from that table, `check_in_scene` from the scene, but for those that begin
    with a dot, which are the table's own.
    """

    def __init__(self, reason: str, *keys: str | Loc):
        super().__init__(reason)
        self.reason = reason
        self.keys = tuple(map(loc_of, keys))

    def below(self, at: Loc) -> Refusal:
        """Return it with all keys from the scene, for a table at `at`."""
        keys = ((*at, *key[1:]) if key and key[0] == "" else key for key in self.keys)
        return Refusal(self.reason, *keys)


def loc_of(path: str | Loc) -> Loc:
    """Return a dotted path as a tuple; numbers are places in arrays."""
    if isinstance(path, tuple):
        return path
    return tuple(int(part) if part.isdigit() else part for part in path.split("."))


def rows(tree: Mapping[str, Any], key: str) -> list[dict[str, Any]]:
    """Return the tables of an array of tables of a scene's data, or the only one."""
    node = tree.get(key)
    return [row for row in (node if isinstance(node, list) else [node]) if isinstance(row, dict)]


MEANINGS = tables_of("scene/keys.toml")  # of every table's keys, with the unit, by its class
USES, DIMENSIONS = MEANINGS.pop("uses"), MEANINGS.pop("dimensions")


class Use(NamedTuple):
    """Keys of a table that have an effect with some values of another one alone.

    Attributes:
        keys: which, separated by spaces.
        choice: the other one.
        values: of that; none: any but none, false and 0.
    """

    keys: str
    choice: str
    values: Sequence[str]

    @property
    def words(self) -> str:
        """Return e.g. 'used only with path = "arc"'."""
        values = " or ".join(map(shown, self.values))
        return f"used only with {self.choice}" + f" = {values}" * bool(values)


class Table(BaseModel):
    """Base of all tables of the scene: frozen, no unknown key, no silent conversion."""

    USES: ClassVar[tuple[Use, ...]] = ()

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Put inherited keys behind a table's own; tell what keys mean and are used with."""
        for key, meaning in MEANINGS.get(cls.__name__, {}).items():
            cls.model_fields[key].description = meaning
        for key in [key for key in cls.model_fields if key not in cls.__annotations__]:
            cls.model_fields[key] = cls.model_fields.pop(key)
        uses = [
            Use(keys, choice, values)
            for keys, (choice, *values) in USES.get(cls.__name__, {}).items()
        ]
        cls.USES = (*cls.USES, *uses)
        for use in uses:
            for key in use.keys.split():
                field = cls.model_fields[key]
                meaning, _, unit = str(field.description).rpartition(" [")
                field.description = f"{meaning}; {use.words} [{unit}"

    # Validators are built at first use, once for the whole scene, not when a table is imported.
    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, defer_build=True
    )

    def unchecked_copy(self, update: Mapping[str, Any]) -> Self:
        """Return a copy with other values, which are known to fit."""
        return super().model_copy(update=update)

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy with other values, checked as those of a file are.

        Raises:
            InputError: the table has no such key, or cannot have the value.
        """
        copy = super().model_copy(deep=deep)
        if not update:
            return copy
        values = {key: getattr(self, key) for key in type(self).model_fields} | {**update}
        try:
            checked = self.model_validate(values)
        except ValidationError as error:
            raise input_error(type(self).__name__.lower(), problem(error)) from None
        object.__setattr__(checked, "__pydantic_private__", copy.__pydantic_private__)
        return checked

    def check_in_scene(self, scene: Scene) -> None:
        """Check what this table and others of `scene` must agree on.

        Raises:
            Refusal: they do not.
        """

    def check_at(self, scene: Scene, at: Loc) -> None:
        """Do so; the refusal's keys are paths from the scene.

        Raises:
            Refusal: they do not agree.
        """
        try:
            self._check_name(scene, at)
            self._check_dimension(scene)
            self.check_in_scene(scene)
        except Refusal as refusal:
            raise refusal.below(at) from None

    def _check_name(self, scene: Scene, at: Loc) -> None:
        """Refuse the name of an earlier entry; some file systems do not tell capitals apart."""
        table, *places = at
        own = getattr(self, "name", None)
        if own is None or not places:
            return
        before = getattr(scene, table)[: places[0]]
        if own.casefold() in [str(entry.name).casefold() for entry in before]:
            raise Refusal(f"expected a name that no other {table[:-1]} has", ".name")

    def _check_dimension(self, scene: Scene) -> None:
        """Refuse keys, and shapes of values, that the machine has no use for."""
        spatial = scene.is_spatial
        said = {key: x.split() for key, x in DIMENSIONS.get(type(self).__name__, {}).items()}
        where = "with [[joints]]: the machine moves in space"
        if not spatial:
            where = "without [[joints]]: the machine moves in the plane"
        for key in said.get("in_plane" if spatial else "in_space", ()):
            self.refuse_stated(f".{key}", where, "joints")
        for key in said.get("numbers", ()):
            if isinstance(getattr(self, key), tuple) and not spatial:
                raise Refusal(f"expected a number {where}", f".{key}")
        numbers = "three numbers" if spatial else "two numbers"
        for key in said.get("vectors", ()):
            value = getattr(self, key)
            if value != type(self).model_fields[key].default and len(value) != scene.dimension:
                raise Refusal(f"expected an array of {numbers} {where}", f".{key}")

    @model_validator(mode="after")
    def _check_uses(self) -> Self:
        for use in self.USES:
            choice = getattr(self, use.choice)
            if choice in use.values if use.values else choice:
                continue
            reason = f"with {use.choice} = {shown(choice)}: it is {use.words}"
            if choice is None:
                reason = f"without {use.choice}"
            for key in use.keys.split():
                self.refuse_stated(key, reason, use.choice)
        self.check_table()
        return self

    def check_table(self) -> None:
        """Check what the values of this table must agree on.

        Raises:
            Refusal: they do not.
        """

    def need(self, key: str, choice: str) -> None:
        """Raise if a key has no value that another one's asks for."""
        if getattr(self, key, None) is None:
            meaning = type(self).model_fields[key].description
            reason = f"expected a value with {choice} = {shown(getattr(self, choice))}"
            raise Refusal(f"{reason}: {meaning}", key, choice)

    def refuse_stated(self, key: str, reason: str, *others: str) -> None:
        """Raise if a key, of any path, has not its default; `reason` goes on after it."""
        name = key.rpartition(".")[2]
        default = type(self).model_fields[name].default
        if getattr(self, name) != default:
            expected = "none" if default is None else f"{shown(default)}, the default,"
            raise Refusal(f"expected {expected} {reason}", key, *others)

    @field_validator("*", mode="before")
    @classmethod
    def _check_type(cls, value: Any, info: ValidationInfo) -> Any:
        """Turn a TOML array into a tuple; keep 1, 1.0 and true apart where choices are listed."""
        annotation = without_none(cls.model_fields[str(info.field_name)].annotation)
        kinds = (annotation, *get_args(annotation))
        if isinstance(value, list) and any(get_origin(kind) is tuple for kind in kinds):
            return tuple(tuple(item) if isinstance(item, list) else item for item in value)
        # Literal compares with ==, for which True, 1 and 1.0 are the same.
        types = map(type, get_args(annotation))
        if get_origin(annotation) is Literal and value is not None and type(value) not in types:
            raise ValueError
        return value


def refuse_count(values: object, names: Sequence[str], at: str | Loc) -> None:
    """Raise Refusal for an array that has not one number for each of the names."""
    if isinstance(values, tuple) and len(values) != len(names):
        number = "1 number" if len(names) == 1 else f"{len(names)} numbers"
        raise Refusal(f"expected {number}, for {', '.join(names)}", at)


def wrench(load: Any, dimension: int) -> tuple[float, ...]:
    """Return force and moment that a table states, N and N m, zeros where it states none.

    Two components and one in the plane, three each in space; another number as it is stated.
    """
    force, moment = load.force or (0.0,) * dimension, load.moment
    if moment is None:
        moment = (0.0,) * (2 * dimension - 3)
    return *force, *(moment if isinstance(moment, tuple) else (moment,))


def problem(error: ValidationError) -> str:
    """Return key and reason of the first problem of a table on its own."""
    first = error.errors(include_url=False)[0]
    refusal = first.get("ctx", {}).get("error")
    keys = refusal.keys[:1] if isinstance(refusal, Refusal) else ()
    key = ".".join(map(str, (*first["loc"], *(part for key in keys for part in key))))
    reason = refusal.reason if isinstance(refusal, Refusal) else first["msg"]
    return f"{key} = {shown(first['input'])}: {reason}" if not keys else f"{key}: {reason}"


def without_none(annotation: Any) -> Any:
    """Return T for an annotation `T | None`, which stands for a key that may be left out."""
    kinds = [kind for kind in get_args(annotation) if kind is not type(None)]
    union = get_origin(annotation) in (Union, UnionType)  # of a Literal it is the former
    return kinds[0] if union and len(kinds) == 1 else annotation


def table_in(annotation: Any) -> type[Table] | None:
    """Return the table that a field holds, itself or as elements of an array; None for a value."""
    annotation = without_none(annotation)
    if get_origin(annotation) is tuple:
        annotation = get_args(annotation)[0]
    return annotation if isinstance(annotation, type) and issubclass(annotation, Table) else None


# -- values, keys and files as one-line messages show them ---------------------------------------


def key_text(part: Any) -> str:
    """Return a part of a path as TOML spells it, in quotes if it needs them."""
    text = cut(str(part))
    return text if re.fullmatch(r"[A-Za-z0-9_-]+", text) else shown(text)


def shown(value: Any) -> str:
    """Return `value` in TOML's spelling, cut to a length that fits a message."""
    return cut(toml_value(value, 3))


def cut(text: str) -> str:
    return text if len(text) <= 80 else f"{text[:77]}..."


def toml_value(value: Any, depth: int = DEEPEST) -> str:
    """Return a value as TOML: numbers, also NumPy's, texts, paths, arrays and tables.

    Entries that are None are left out, and what is nested deeper than `depth`.
    """
    if hasattr(value, "tolist"):  # NumPy's
        value = value.tolist()
    if isinstance(value, (bool, str, os.PathLike)):
        text = os.fspath(value) if isinstance(value, os.PathLike) else value
        return json.dumps(text, ensure_ascii=False)
    if isinstance(value, int) and value.bit_length() > 256:  # Python refuses to print huge ones
        return f"{'-' if value < 0 else ''}2**{value.bit_length() - 1}..."
    if not isinstance(value, (Mapping, list, tuple)):
        return str(value)
    if depth == 0:
        return "..."
    if isinstance(value, Mapping):
        pairs = [
            f"{key_text(key)} = {toml_value(item, depth - 1)}"
            for key, item in value.items()
            if item is not None
        ]
        return f"{{ {', '.join(pairs)} }}"
    return f"[{', '.join(toml_value(item, depth - 1) for item in value if item is not None)}]"


def input_error(where: str, text: str) -> InputError:
    return InputError(one_line(f"{where}: {text}"))


def one_line(text: str) -> str:
    """Escape whatever would break the line or the terminal: line ends, control characters."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
