"""Errors of pydantic in a value of several possible types, reduced to those of the nearest type."""

import re
from collections.abc import Sequence
from typing import Any

# The types that pydantic tried a value as, in the path of an error: "float", "list[int]", "Span".
BRANCH = re.compile(r"int|float|str|bool|Span|ClearanceSpan|Profile|Defects|\w*\[(?!\d+\]).*|constrained.*")
MISTYPED = 100  # cost of a value of another type, in errors within a value, which has fewer than so many
# What a value of a type is called, by the error of one that is not.
NAMES_OF_TYPES = {
    "float_type": "a number",
    "int_type": "a whole number",
    "string_type": "text",
    "bool_type": "true or false",
    "list_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
}
Location = tuple[int | str, ...]  # the path of an error in a section, as pydantic gives it


def of_nearest_type(errors: Sequence[Any]) -> list[Any]:
    """Pydantic's ``errors`` without those of types that a value is not nearest to.

    A value that may be of several types (a number, a list, a table) is tried as each, and has the errors of all. The
    nearest type is the one with the lowest cost: an error within the value, such as an item of a list, costs 1, a value
    that is not of the type at all ``MISTYPED``. The error of a value that is of no type names all types.
    """
    costs: dict[Location, dict[str, int]] = {}
    expected: dict[Location, dict[str, None]] = {}  # a dictionary, since the order counts
    for error in errors:
        value, tried_type = _tried_type(error["loc"])
        if tried_type:
            is_whole_value = len(error["loc"]) == len(value) + 1
            cost = 1
            if is_whole_value and error["type"].endswith("_type"):
                cost = MISTYPED
            types = costs.setdefault(value, {})
            types[tried_type] = types.get(tried_type, 0) + cost
            name = ""
            if is_whole_value:
                name = _expected_type(error)
            expected.setdefault(value, {})[name] = None

    # This is the one that the section lists first among types of equal cost.
    nearest = {value: min(types, key=lambda name: types[name]) for value, types in costs.items()}
    kept_errors = []
    for error in errors:
        value, tried_type = _tried_type(error["loc"])
        if not tried_type:
            kept_errors.append(error)
        elif tried_type == nearest[value]:
            alternatives = list(expected[value])
            if len(alternatives) > 1 and all(alternatives):
                error = error | {"msg": f"Input should be {', '.join(alternatives[:-1])} or {alternatives[-1]}"}
            kept_errors.append(error)
    return kept_errors


def _expected_type(error: Any) -> str:
    """The type that was expected where an ``error`` is; "" if the type is right and the error lies within the value."""
    if error["type"] == "literal_error":
        return str(error["ctx"]["expected"])
    return NAMES_OF_TYPES.get(error["type"], "")


def _tried_type(location: Location) -> tuple[Location, str]:
    """The path, within an error's ``location``, of the value that may be of several types, and the type that was tried.

    The type is "" if there is no such value.
    """
    for i, part in enumerate(location):
        if BRANCH.fullmatch(str(part)):
            return location[:i], str(part)
    return location, ""
