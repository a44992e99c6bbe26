"""What the schema of the keys excludes is refused, by the key: wrong types, numbers out of bounds, unknown words."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from vipetsc.case import Case, CaseError
from vipetsc.case.keys import json_schema
from vipetsc.case.verb_cases import OF_SECTION

SCHEMA = json_schema()
TYPES = {"string": str, "boolean": bool, "array": list, "object": dict, "null": type(None)}
# What a user may write by mistake where something else is meant.
VALUES = ["no such word", True, -1, 0, 10**13, -0.5, 1.5, 1e300, [], ["no such word"], [-1.0], {"no_such_key": 1}]
# Sections whose keys a user chooses: their values are checked by what they name.
FREE = ("sweep", "petsc")


def accepts(schema: dict[str, Any], value: Any) -> bool:
    """Return whether a ``value`` has the type, the bounds and the words of a JSON ``schema``."""
    if "$ref" in schema:
        return accepts(SCHEMA["$defs"][schema["$ref"].split("/")[-1]], value)
    if "anyOf" in schema or "oneOf" in schema:
        return any(accepts(choice, value) for choice in schema.get("anyOf", schema.get("oneOf")))
    if "const" in schema:
        return value == schema["const"]
    if "enum" in schema and not (isinstance(value, str | int) and value in schema["enum"]):
        return False
    kind = schema.get("type")
    if kind in ("integer", "number"):
        return is_number(value, whole=kind == "integer") and within(schema, value)
    if kind in TYPES and not isinstance(value, TYPES[kind]):
        return False
    if kind == "array":
        enough = schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", len(value))
        return enough and all(accepts(schema.get("items", {}), item) for item in value)
    if kind == "object":
        return schema.get("additionalProperties") is not False or value.keys() <= schema.get("properties", {}).keys()
    return True


def is_number(value: Any, whole: bool) -> bool:
    """Return whether a ``value`` is a number, ``whole`` if that is asked."""
    return isinstance(value, int | float) and not isinstance(value, bool) and (not whole or value == int(value))


def within(schema: dict[str, Any], value: float) -> bool:
    """Return whether a number keeps the bounds of a ``schema``."""
    return (
        schema.get("minimum", value) <= value <= schema.get("maximum", value)
        and value > schema.get("exclusiveMinimum", -float("inf"))
        and value < schema.get("exclusiveMaximum", float("inf"))
    )


def keys(schema: dict[str, Any], path: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], dict[str, Any]]]:
    """Yield the paths and schemas of all keys of a section, those of its tables and of lists of tables behind it."""
    if "$ref" in schema:
        schema = SCHEMA["$defs"][schema["$ref"].split("/")[-1]]
    for name, item in schema.get("properties", {}).items():
        yield (*path, name), item
        for choice in item.get("anyOf", [item]):
            if "$ref" in choice:
                yield from keys(choice, (*path, name))
            elif "$ref" in choice.get("items", {}):
                yield from keys(choice["items"], (*path, f"{name}[1]"))


KEYS = [
    pytest.param(path, schema, id=".".join(path))
    for section in SCHEMA["properties"]
    if section not in FREE and section != "name"
    for path, schema in keys(SCHEMA["properties"][section], (section,))
]


@pytest.mark.parametrize(("path", "schema"), KEYS)
def test_a_value_that_the_schema_excludes_is_refused_by_its_key(path, schema):
    """The message names the key, or the table that the key makes impossible."""
    case_type = OF_SECTION.get(path[0], Case)
    excluded = [value for value in VALUES if not accepts(schema, value)]
    for value in excluded:
        with pytest.raises(CaseError) as caught:
            case_type.from_table(nested(path, value))
        named = [problem.key for problem in caught.value.problems]
        assert any(key.startswith(".".join(path)) for key in named), (value, named)


def test_most_keys_exclude_some_values():
    """Else the test above would test nothing."""
    count = [sum(not accepts(parameter.values[1], value) for value in VALUES) for parameter in KEYS]
    assert len(count) > 200
    assert sum(number > 0 for number in count) > 0.9 * len(count)


def nested(path: tuple[str, ...], value: Any) -> dict[str, Any]:
    """Return the table of a case in which the key with that ``path`` has a ``value``."""
    for name in reversed(path):
        if name.endswith("[1]"):
            value = {name.removesuffix("[1]"): [value]}
        else:
            value = {name: value}
    return value
