"""Base class of the sections of a case file, a strict table, and the problems that are found in one."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel, ConfigDict, Field

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
    """A table of a case file: strict types, no unknown keys, immutable."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


def described(text: str, default: Any = ..., *, unit: str = "", **bounds: Any) -> Any:
    """Return the field of a key: a ``text`` that says what it means, its ``default``, its ``unit``, and its ``bounds``.

    The schema for editors, the manual's chapter of all keys and the axes of pictures take text and unit from here.
    Without a default the key is required; ``bounds`` are other arguments of pydantic's ``Field``.
    """
    return Field(default, description=text, json_schema_extra={"unit": unit}, **bounds)
