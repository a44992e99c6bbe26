"""Tables built in a program, converted to the types of a TOML file."""

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

import numpy as np
from pydantic import BaseModel


def plain_table(table: Mapping[str, Any]) -> dict[str, Any]:
    """``table`` in the types of TOML; a value None is a key that is not given.

    Tuples and arrays become lists, numbers of numpy those of Python, paths text, and sections of a case tables.
    """
    return {key: plain(value) for key, value in table.items() if value is not None}


def plain(value: Any) -> Any:
    """``value`` in the types of TOML; a value without such a type stays as it is, and is refused when it is read."""
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
