"""Names of files between the system, which has bytes, and cases and files of results, which have text in UTF-8.

Python decodes names in the encoding of the locale, and turns bytes that are invalid there into lone surrogates (PEP
383). These cannot be written as UTF-8; and some locales (C, Latin-1) lack characters that UTF-8 has.
"""

import errno
import os
from pathlib import Path


def readable(name: str | Path) -> str:
    """The ``name`` of a file, from the system, as text for a file; invalid bytes become replacement characters."""
    return str(name).encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def path_named(text: str) -> Path:
    """The path that ``text`` names: in the encoding of the system, or in UTF-8 where that lacks a character."""
    try:
        os.fsencode(text)
    except UnicodeEncodeError:
        return Path(os.fsdecode(text.encode("utf-8")))
    return Path(text)


def resolved_path(text: str) -> Path:
    """The path that ``text`` names, absolute and without links; raises OSError for one that can lead to no file."""
    try:
        return path_named(text).resolve()
    # Python up to 3.12 raises RuntimeError for links that lead to each other; a NUL in the name is a ValueError.
    except (RuntimeError, ValueError) as error:
        raise OSError(errno.EINVAL, str(error)) from None
