"""The text of a value that `--set` gives."""

import tomllib
from typing import Any


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
