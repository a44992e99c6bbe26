"""The largest depth of nested tables and lists in a case file: they are copied and sent recursively."""

from typing import Any

# Python's copy and pickle fail from 480 to 980 levels on; the keys of a case have fewer than ten.
DEEPEST = 50
TOO_DEEP = f"tables and lists are nested more than {DEEPEST} levels deep; no key of a case needs this"


def is_deeper(value: Any, levels: int = DEEPEST) -> bool:
    """Whether tables and lists stand more than so many ``levels`` deep in ``value``."""
    if isinstance(value, dict):
        value = list(value.values())
    if not isinstance(value, list):
        return False
    return levels == 0 or any(is_deeper(item, levels - 1) for item in value)
