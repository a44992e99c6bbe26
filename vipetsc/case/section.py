"""Base class of the sections of a case file, a strict table, and the problems that are found in one."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, get_args

from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic.fields import FieldInfo

from vipetsc.case.units import in_unit

LONGEST_VALUE = 200  # characters of a value that a message shows


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


def is_within(key: str, paths: Iterable[str]) -> bool:
    """Whether ``key`` is one of the ``paths``, or a key or an entry of a list inside one of them."""
    return any(key == path or key.startswith((f"{path}.", f"{path}[")) for path in paths)


class Section(BaseModel):
    """A table of a case file: strict types, no unknown keys, immutable; a number may be a text with a unit."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)

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
