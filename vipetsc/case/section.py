"""Base class of the sections of a case file, a strict table, and the problems that are found in one.

A key may have values of several shapes: a number, a text, a list, a table (``BY_SHAPE``). A value is read as the type
of its own shape, so that a mistake within it is one problem and not one for every type that the key may have.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, GetJsonSchemaHandler, model_validator
from pydantic.fields import FieldInfo
from pydantic_core import core_schema

from vipetsc.case.units import in_unit
from vipetsc.wording import counted

LONGEST_VALUE = 200  # characters of a value that a message shows
# A mark at the beginning of the names of shapes, which stand in the paths of pydantic's errors: no key begins with it.
MARK = "~"
SHAPES = {
    "flag": "true or false",
    "whole": "a whole number",
    "number": "a number",
    "text": "text",
    "list": "a list",
    "table": "a table",
}


@dataclass(frozen=True)
class Problem:
    """Problem of a case: the path of the key, its value, and the remedy."""

    key: str
    value: Any
    remedy: str

    def __str__(self) -> str:
        if self.value is None:
            return f"{self.key}: {self.remedy}"
        text = repr(self.value)
        if len(text) > LONGEST_VALUE:
            text = f"{text[:LONGEST_VALUE]} ..."
        return f"{self.key} = {text}: {self.remedy}"


class CaseError(ValueError):
    """An invalid case; ``problems`` contains all reasons."""

    def __init__(self, problems: Iterable[Problem], source: str = "case") -> None:
        self.problems = list(problems)
        self.source = source
        super().__init__(self.problems, source)  # the arguments of unpickling on other ranks

    def __str__(self) -> str:
        return "\n  ".join([f"{self.source}: {counted(len(self.problems), 'problem')}", *map(str, self.problems)])


def is_within(key: str, paths: Iterable[str]) -> bool:
    """Return whether ``key`` is one of the ``paths``, or a key or an entry of a list inside one of them."""
    return any(key == path or key.startswith((f"{path}.", f"{path}[")) for path in paths)


class Section(BaseModel):
    """A table of a case file: strict types, no unknown keys, immutable; a number may be a text with a unit."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, defer_build=True)

    @classmethod
    def unit_of(cls, key: str, table: Mapping[str, Any]) -> str:
        """Return the unit of the ``key`` of a ``table``, on whose other keys it may depend; empty for none."""
        about = field_of(cls, key)
        if about and isinstance(about.json_schema_extra, dict):
            return str(about.json_schema_extra.get("unit", ""))
        return ""

    @model_validator(mode="before")
    @classmethod
    def _in_units(cls, table: Any) -> Any:
        """Replace texts such as "150 Hz" by numbers in the units of their keys."""
        if not isinstance(table, dict):
            return table
        return {key: in_unit(value, cls.unit_of(key, table)) for key, value in table.items()}


def field_of(table: type[BaseModel], key: str) -> FieldInfo | None:
    """Return the field of a ``table`` that a case file writes as ``key``; None for a key that it does not have."""
    for name, about in table.model_fields.items():
        if key == (about.alias or name):
            return about
    return None


def described(text: str, default: Any = ..., *, unit: str = "", **bounds: Any) -> Any:
    """Return the field of a key: a ``text`` that says what it means, its ``default``, its ``unit``, and its ``bounds``.

    The schema for editors, the manual's chapter of all keys and the axes of pictures take text and unit from here.
    Without a default the key is required; ``bounds`` are other arguments of pydantic's ``Field``.
    """
    return Field(default, description=text, json_schema_extra={"unit": unit}, **bounds)


def table_of(table: type[BaseModel], key: str) -> type[Section] | None:
    """Return the class of the table that ``key`` of a ``table`` is, or a list of such tables; None where it is not."""
    about = field_of(table, key)
    if not about:
        return None
    # The types within a type, as in ``list[X] | None``, are appended while the loop runs.
    choices = [about.annotation]
    for choice in choices:
        choices += get_args(choice)
        if isinstance(choice, type) and issubclass(choice, Section):
            return choice
    return None


def unit_at(sections: Mapping[str, type[Section]], path: str, case: Mapping[str, Any]) -> str:
    """Return the unit of the key with that ``path``, as "lattice.cell.masses[2]", in the table of a ``case``.

    It is empty for keys without one, for keys that are not there, and where a text says on what the unit depends.
    """
    section, *keys = path.split(".")
    kind = sections.get(section)
    place: Any = case.get(section)
    for key in keys[:-1]:
        name, _, number = key.rstrip("]").partition("[")
        kind = table_of(kind, name) if kind else None
        place = place.get(name) if isinstance(place, dict) else None
        if number and isinstance(place, list):
            place = place[int(number) - 1] if int(number) <= len(place) else None
    if kind is None or not keys:
        return ""
    unit = kind.unit_of(keys[-1].partition("[")[0], place if isinstance(place, dict) else {})
    if " of " in unit or " or " in unit:
        return ""
    return unit


class ByShape:
    """Mark of a union, as in ``Annotated[float | list[float], BY_SHAPE]``: a value is of the type of its shape.

    Of several tables it is the one that has most of the value's keys.
    """

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        """Return the schema that pydantic reads the union by."""
        types: dict[str, Any] = {}
        tables: dict[str, type[BaseModel]] = {}
        texts: list[Any] = []
        names = []
        for kind in get_args(source):
            bare = get_args(kind)[0] if get_origin(kind) is Annotated else kind
            shape, name = _shape_of_type(bare)
            if isinstance(bare, type) and issubclass(bare, BaseModel):
                shape = bare.__name__
                tables[shape] = bare
            if get_origin(bare) is Literal:
                texts += get_args(bare)
            types[MARK + shape] = handler.generate_schema(kind)
            names.append(name)

        def shape_of(value: Any) -> str:
            # A section that has been read is asked for when it is written.
            if isinstance(value, BaseModel):
                return MARK + type(value).__name__
            shape = _shape_of_value(value)
            # Another text is of no type, rather than a wrong word: the message then names all types.
            if texts and shape == "text" and value not in texts:
                return f"{MARK}another"
            if shape == "table" and tables:
                shape = max(tables, key=lambda table: len(value.keys() & tables[table].model_fields.keys()))
            return MARK + shape

        expected = list(dict.fromkeys(names))
        listed = " or ".join(filter(None, [", ".join(expected[:-1]), expected[-1]]))
        return core_schema.tagged_union_schema(
            types,
            shape_of,
            custom_error_type="shape",
            custom_error_message=f"Input should be {listed}",
            custom_error_context={"expected": ", ".join(map(repr, texts))},
        )

    def __get_pydantic_json_schema__(self, schema: Any, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """Return the JSON schema: that of any union."""
        return handler(core_schema.union_schema(list(schema["choices"].values())))


BY_SHAPE = ByShape()


def _shape_of_type(kind: Any) -> tuple[str, str]:
    """Return the shape of the values of a type, and what a message calls them."""
    origin = get_origin(kind) or kind
    if origin is Literal:
        return "text", " or ".join(map(repr, get_args(kind)))
    if origin in (int, float):
        return "number", SHAPES["whole" if origin is int else "number"]
    if origin is str:
        return "text", SHAPES["text"]
    if origin is bool:
        return "flag", SHAPES["flag"]
    if origin is list:
        return "list", SHAPES["list"]
    return "table", SHAPES["table"]


def _shape_of_value(value: Any) -> str:
    """Return the shape of a ``value``."""
    # A boolean is an ``int`` for Python.
    if isinstance(value, bool):
        return "flag"
    if isinstance(value, int | float):
        return "number"
    if isinstance(value, str):
        return "text"
    if isinstance(value, list):
        return "list"
    if isinstance(value, dict):
        return "table"
    return "another"
