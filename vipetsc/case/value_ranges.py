"""Keys that vary in a case file: their values, the axes that they form, and their short names."""

import copy
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from vipetsc.case.contacts import keys_of_other_laws
from vipetsc.case.disorder import SEED
from vipetsc.case.reading import LARGEST, Table, put
from vipetsc.case.section import Problem, Section, unit_at
from vipetsc.case.units import in_unit

# Every rank lists the names of all members: 0.6 s and 70 MB for a million.
MOST_MEMBERS = 1_000_000
# A value of a range is taken for a decimal number of so many digits if it differs from it by so many roundings (2e-16)
# at most; geomspace differs by up to 3.2.
DIGITS = 12
ROUNDINGS = 8
RANGES = {"log", "linear", "whole"}  # the last one only in searches
LAW = "contacts.law"
Values = dict[str, tuple[Any, ...]]  # the values of each key; an axis has those of keys that vary together
Varied = tuple[Values, list[Problem]]


def short_names(keys: Sequence[str]) -> dict[str, str]:
    """Return a short name for each of ``keys``: its last part, or all of it where that is not unique."""
    short = {key: key.removesuffix(".count").rpartition(".")[2] for key in keys}
    common = {name for name in short.values() if list(short.values()).count(name) > 1}
    return {key: key.replace(".", "_") if name in common else name for key, name in short.items()}


def leaves(tree: Table, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield pairs of a key's path, as "a.b.c", and its value in the table ``tree``; a range is one value."""
    for key, value in tree.items():
        # For the seed { count = n } alone is a range too, and no table.
        if isinstance(value, dict) and not value.keys() & RANGES and path + key != SEED:
            yield from leaves(value, f"{path}{key}.")
        else:
            yield path + key, value


def values_in(value: Any) -> tuple[Any, ...]:
    """Return the values of a list or a range, of seeds from 0 for a count alone; raises ValueError with the remedy."""
    if isinstance(value, list) and value:
        return tuple(value)
    if isinstance(value, dict) and value.keys() == {"count"} and type(value["count"]) is int and value["count"] > 0:
        # One more than is allowed, rather than all: the sweep is refused for it, and a count may exceed the memory.
        return tuple(range(min(value["count"], MOST_MEMBERS + 1)))

    remedy = "give a list of values, { log = [first, last], count = n } or { linear = [first, last], count = n }"
    if not isinstance(value, dict) or len(value) != 2 or "count" not in value:
        raise ValueError(remedy)
    # The kind of range, its ends and its count are checked one by one, so that a message is about the first problem.
    (kind,) = value.keys() - {"count"}
    ends = value[kind]
    count = value["count"]
    # "whole" is a range of searches alone: here it would have the values of a linear one, which are no whole numbers.
    if kind not in ("log", "linear"):
        raise ValueError(remedy)
    if not (isinstance(ends, list) and len(ends) == 2 and all(type(end) in (int, float) for end in ends)):
        raise ValueError(remedy)
    if type(count) is not int or not 1 <= count <= MOST_MEMBERS:
        raise ValueError(f"{remedy}, n from 1 to {MOST_MEMBERS}")
    if not all(abs(end) <= LARGEST for end in ends):
        raise ValueError(f"the ends of a range must be numbers up to {LARGEST:g}")
    if kind == "log" and min(ends) <= 0:
        raise ValueError("the ends of a log range must be positive")

    first, last = map(float, ends)
    # A value of a linear range is a sum, with the rounding of its larger end; one of a log range is a product, and
    # never 0.
    values = np.linspace(first, last, count)
    largest = max(abs(first), abs(last))
    if kind == "log":
        values = np.geomspace(first, last, count)
        largest = 0.0
    # The names of members are hashes of their values: 5 and 4.999999999999999 would be two members.
    return tuple(_without_rounding(value, largest) for value in values.tolist())


def _without_rounding(value: float, largest: float) -> float:
    """Return decimal number from which a ``value`` of a range differs by rounding (5 for 4.999999999999999), or itself.

    It is 0 for a value within the rounding of ``largest``, the magnitude of the larger summand.
    """
    rounding = ROUNDINGS * np.finfo(float).eps
    if abs(value) <= rounding * largest:
        return 0.0
    decimal = float(f"{value:.{DIGITS}g}")
    if math.isclose(value, decimal, rel_tol=rounding):
        return decimal
    # All other values keep their bits, of which the names of members are hashes.
    return value


def varied_values(given: Mapping[str, Any], at: str, table: Table, kinds: Mapping[str, type[Section]]) -> Varied:
    """Return values of the keys that are ``given`` with theirs at the path ``at``, in the keys' units, and problems.

    Keys are those of the ``table`` of a case, whose sections are of these ``kinds``.
    """
    values: Values = {}
    problems: list[Problem] = []
    for key, value in given.items():
        try:
            values[key] = values_in(in_unit(value, unit_at(kinds, key, table)))
        except ValueError as error:
            problems.append(Problem(f"{at}.{key}", value, str(error)))
    return values, problems


def table_with(table: Table, chosen: Mapping[str, Any]) -> tuple[Table, list[Problem]]:
    """Return a copy of the ``table`` of a case with ``chosen`` values of keys, and problems of keys without a place.

    Where laws vary, each takes its own of the keys that all cases have: a rigid stop has no stiffness.
    """
    table = copy.deepcopy(table)
    problems: list[Problem] = []
    for key, value in chosen.items():
        # A copy, since cases must not have one list or table in common.
        problems += put(table, key, copy.deepcopy(value))

    contacts = table.get("contacts")
    if LAW in chosen and isinstance(contacts, dict):
        for key in keys_of_other_laws(str(contacts.get("law"))):
            if f"contacts.{key}" not in chosen:
                contacts.pop(key, None)
            each = contacts.get("each")
            if isinstance(each, dict) and f"contacts.each.{key}" not in chosen:
                each.pop(key, None)
    return table, problems


def axes_of(values: Values, groups: list[list[str]]) -> tuple[tuple[Values, ...], list[Problem]]:
    """Return the axes of a sweep, each with the values of a key or of keys that vary together, and problems.

    ``groups`` lists the keys of each group.
    """
    problems: list[Problem] = []
    group_of: dict[str, tuple[str, ...]] = {}
    for group in groups:
        lengths = {key: len(values[key]) for key in group if key in values}
        missing = [key for key in group if key not in values]
        if missing:
            problems.append(Problem("sweep.zip", missing, f"not among the keys that vary: {', '.join(values)}"))
        elif len(set(lengths.values())) > 1:
            problems.append(Problem("sweep.zip", lengths, "keys that vary together need the same number of values"))
        elif group_of.keys() & set(group):
            problems.append(Problem("sweep.zip", group, "a key can be in one group only"))
        group_of |= dict.fromkeys(group, tuple(group))
    if problems:
        return (), problems

    axes = dict.fromkeys(group_of.get(key, (key,)) for key in values)
    return tuple({key: values[key] for key in keys} for keys in axes), []
