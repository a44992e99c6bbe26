"""Tables built in a program: in the types of a TOML file, with names as keys, and not too deep."""

from collections.abc import Iterator, Mapping
from pathlib import PurePath
from typing import Any

import numpy as np
from pydantic import BaseModel

from vipetsc.case.section import Problem

# Python's copy and pickle fail from 480 to 980 levels on; the keys of a case have fewer than ten.
DEEPEST = 50
TOO_DEEP = f"tables and lists are nested more than {DEEPEST} levels deep; no key of a case needs this"


def is_deeper(value: Any, levels: int = DEEPEST) -> bool:
    """Return whether tables and lists, or what becomes one, stand more than so many ``levels`` deep in ``value``."""
    if isinstance(value, Mapping):
        value = value.values()
    elif not isinstance(value, list | tuple):
        return False
    return levels == 0 or any(is_deeper(item, levels - 1) for item in value)


def wrong_keys(value: Any, path: str = "") -> Iterator[Problem]:
    """Yield the problems of keys anywhere in ``value`` that are not text."""
    if isinstance(value, dict):
        for key, item in value.items():
            if not isinstance(key, str):
                yield Problem(path or "case", key, "is not a key: keys are text")
            yield from wrong_keys(item, f"{path}.{key}".lstrip("."))
    elif isinstance(value, list):
        for i, item in enumerate(value, 1):
            yield from wrong_keys(item, f"{path}[{i}]")


def plain_table(table: Mapping[Any, Any]) -> dict[Any, Any]:
    """Return ``table``, which is not too deep, in the types of TOML; a value None is a key that is not given.

    Tuples and arrays become lists, numbers of numpy those of Python, paths text, and sections of a case tables.
    """
    return {key: plain(value) for key, value in table.items() if value is not None}


def plain(value: Any) -> Any:
    """Return ``value`` in the types of TOML; one without such a type stays as it is, and is refused when it is read."""
    if isinstance(value, BaseModel):
        return value.model_dump(by_alias=True, exclude_none=True)
    if isinstance(value, Mapping):
        return plain_table(value)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple | range):
        return [plain(item) for item in value]
    if isinstance(value, PurePath):
        return str(value)
    return value
