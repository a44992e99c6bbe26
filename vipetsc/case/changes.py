"""Keys of a table by their paths: their values, changes of them, and the changes that `--set` gives as text."""

import copy
import re
import tomllib
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from vipetsc.case.section import Problem

ITEM = re.compile(r"(.+)\[([1-9]\d*)\]")  # an entry of a list, as in masses[2]


def has_more_keys(text: str) -> bool:
    """Whether further lines of a value's ``text`` are keys or sections of TOML."""
    try:
        return len(tomllib.loads(f"value = {text}")) > 1
    except (ValueError, RecursionError):
        return False


def value_of(text: str) -> Any:
    """Value written in ``text``: TOML, a number such as .5, or a bare word; None if ``text`` is empty."""
    try:
        # TOML first, which distinguishes lists, tables, booleans and quoted text.
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        pass
    try:
        # TOML allows neither .5 nor 5. as a number.
        return float(text)
    except ValueError:
        return text or None


def with_overrides(table: dict[str, Any], overrides: Iterable[str]) -> tuple[dict[str, Any], list[Problem]]:
    """A copy of ``table`` with each ``section.key=value`` set (TOML value or bare word), and the problems.

    ``section.key=`` removes the key.
    """
    # The table may be the built-in one, which later cases read too.
    table = copy.deepcopy(table)
    problems: list[Problem] = []
    for override in overrides:
        path, equals, text = (part.strip() for part in override.partition("="))
        keys = path.split(".")
        value = value_of(text)

        if not equals or not all(keys):
            problems.append(Problem("--set", override, "write section.key=value"))
        elif has_more_keys(text):
            problems.append(
                Problem("--set", override, "gives a single key; give the keys in further lines with a --set each")
            )
        else:
            problems += [replace(p, key=f"--set {p.key}") for p in put(table, path, value)]
    return table, problems


def put(table: dict[str, Any], path: str, value: Any) -> list[Problem]:
    """Set the key ``path`` of ``table`` in place, or remove it (None); returns the problem if this fails.

    A path is "a.b.c", or "a.b[2].c" with an entry of a list, counted from 1. A key of the table may have dots itself.
    """
    place: Any = table
    key, rest = _divided(place, path)
    while rest:
        place = _below(place, key, put_missing=True)
        key, rest = _divided(place, rest)

    item = ITEM.fullmatch(key)
    if item and isinstance(place, dict) and isinstance(place.get(item[1]), list):
        return _put_item(place[item[1]], int(item[2]) - 1, path, value)
    if not isinstance(place, dict):
        reason = "is a value, not a section"
        if place is None:
            reason = "does not exist"
        return [Problem(path, value, f"{path.removesuffix(f'.{key}')} {reason}")]
    if value is None and key not in place:
        return [Problem(path, None, "is not in the case, so that it cannot be removed")]

    if value is None:
        del place[key]
    else:
        place[key] = value
    return []


def value_at(table: dict[str, Any], path: str) -> Any:
    """The value that ``table`` has at ``path``, as ``put`` takes it; None if it has none."""
    place: Any = table
    rest = path
    while rest:
        if not isinstance(place, dict):
            return None
        key, rest = _divided(place, rest)
        place = _below(place, key)
    return place


def _divided(place: Any, path: str) -> tuple[str, str]:
    """The first key of a ``path`` into ``place``, and the rest of the path; a key of a table may have dots itself."""
    dotted: list[str] = []
    if isinstance(place, dict):
        dotted = [key for key in place if "." in key and f"{path}.".startswith(f"{key}.")]
    # The longest: of the keys "a" and "a.b" in one table, the path "a.b.c" begins with the second.
    key = max(dotted, key=len, default=path.partition(".")[0])
    return key, path[len(key) + 1 :]


def _below(place: Any, key: str, put_missing: bool = False) -> Any:
    """The value of ``place`` at ``key``, which may name an entry of a list as in "masses[2]".

    Without a value it is None, or an empty table that is put there (``put_missing``). If ``place`` is no table, it is
    ``place`` itself: ``put`` then reports a value where a section should be.
    """
    if not isinstance(place, dict):
        return place
    item = ITEM.fullmatch(key)
    if item and isinstance(place.get(item[1]), list):
        entries = place[item[1]]
        number = int(item[2])
        if number > len(entries):
            return None
        return entries[number - 1]
    if put_missing:
        return place.setdefault(key, {})
    return place.get(key)


def _put_item(entries: list[Any], index: int, path: str, value: Any) -> list[Problem]:
    """Set the entry ``index`` (from 0) of a list; returns the problem if there is none."""
    if index >= len(entries) or value is None:
        return [
            Problem(path, value, f"the list has the entries 1 to {len(entries)}, which can be changed, not removed")
        ]
    entries[index] = value
    return []
