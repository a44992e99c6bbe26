"""Changes of keys in a table: the text of a value that `--set` gives, and the place of a key."""

import re
import tomllib
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
        # TOML first: only TOML distinguishes lists, tables, booleans and quoted text.
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        pass
    try:
        # TOML allows neither .5 nor 5. as a number.
        return float(text)
    except ValueError:
        return text or None


def put(table: dict[str, Any], path: str, value: Any) -> list[Problem]:
    """Set the key ``path`` of ``table`` in place, or remove it (None); returns the problem if this fails.

    A path is "a.b.c", or "a.b[2].c" with an entry of a list, counted from 1.
    """
    *parents, key = path.split(".")
    place: Any = table
    for parent in parents:
        place = _below(place, parent)
    item = ITEM.fullmatch(key)
    if item and isinstance(place, dict) and isinstance(place.get(item[1]), list):
        return _put_item(place[item[1]], int(item[2]) - 1, path, value)
    if not isinstance(place, dict):
        kind = "does not exist" if place is None else "is a value, not a section"
        return [Problem(path, value, f"{'.'.join(parents)} {kind}")]
    if value is None and key not in place:
        return [Problem(path, None, "is not in the case, so that it cannot be removed")]

    if value is None:
        del place[key]
    else:
        place[key] = value
    return []


def _below(place: Any, key: str) -> Any:
    """What the table ``place`` has at ``key``, perhaps an entry of a list; an empty table is put where nothing is."""
    if not isinstance(place, dict):
        return place
    item = ITEM.fullmatch(key)
    entries = place.get(item[1]) if item else None
    if item and isinstance(entries, list):
        number = int(item[2])
        return entries[number - 1] if number <= len(entries) else None
    return place.setdefault(key, {})


def _put_item(entries: list[Any], index: int, path: str, value: Any) -> list[Problem]:
    """Set the entry ``index`` (from 0) of a list; returns the problem if there is none."""
    if index >= len(entries) or value is None:
        return [
            Problem(path, value, f"the list has the entries 1 to {len(entries)}, which can be changed, not removed")
        ]
    entries[index] = value
    return []
