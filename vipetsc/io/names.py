"""Names of files between the system, which has bytes, and cases and files of results, which have text in UTF-8.

Python decodes names in the encoding of the locale, and keeps bytes that are none of it as lone surrogates. UTF-8 has no
such characters, and a locale (C, Latin-1) has not all characters of UTF-8.
"""

import os
from pathlib import Path


def readable(name: str | Path) -> str:
    """A ``name`` as Python has it from the system, as text; bytes that are no UTF-8 become replacement characters."""
    return str(name).encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def path_named(text: str) -> Path:
    """The path that ``text`` names: in the encoding of the system, or in UTF-8 where that lacks a character."""
    try:
        os.fsencode(text)
    except UnicodeEncodeError:
        return Path(os.fsdecode(text.encode("utf-8")))
    return Path(text)
