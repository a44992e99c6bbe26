"""Tables built in a program: in the types of a TOML file, with names as keys."""

from collections.abc import Iterator, Mapping
from pathlib import PurePath
from typing import Any

import numpy as np
from pydantic import BaseModel

from vipetsc.case.section import Problem


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
    """Return ``table`` in the types of TOML; a value None is a key that is not given.

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
