"""Files that a case file names, and the folders in which a relative name is looked up.

A case file and the data that it reads are moved and copied together. A relative name is therefore that of a file in the
folder of the case file, or if there is none, of a file in the current folder. A name that is given by ``--set`` or in
code is looked up in the current folder alone.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# Keys that name a file: `drive.samples.file` and `initial.path`, which sweeps and searches may vary, and the `file` of
# `identify.records`.
SECTIONS = "drive", "initial", "sweep", "optimise", "identify"
KEYS = "file", "path"
MISSING = "no such file, neither in the folder of the case file nor in the current one"


def with_absolute_names(table: dict[str, Any], folder: Path) -> dict[str, Any]:
    """A copy of the ``table`` of a case file in ``folder``, in which names of files are absolute."""

    def absolute(value: Any, key: str) -> Any:
        if isinstance(value, dict):
            # A sweep may write a key as "initial.path", in quotes.
            return {inner: absolute(item, inner.rpartition(".")[2]) for inner, item in value.items()}
        if isinstance(value, list):
            return [absolute(item, key) for item in value]
        if key in KEYS and isinstance(value, str):
            return _absolute_name(value, folder)
        return value

    return table | {section: absolute(table[section], section) for section in SECTIONS if section in table}


def relative_names(table: dict[str, Any]) -> list[str]:
    """The relative names of files in the ``table`` of a case file, in its order."""

    def names(value: Any, key: str) -> Iterator[str]:
        if isinstance(value, dict):
            for inner, item in value.items():
                yield from names(item, inner.rpartition(".")[2])
        elif isinstance(value, list):
            for item in value:
                yield from names(item, key)
        elif key in KEYS and isinstance(value, str) and not Path(value).is_absolute():
            yield value

    return [name for section in SECTIONS for name in names(table.get(section), section)]


def _absolute_name(name: str, folder: Path) -> str:
    """The ``name`` of a file of ``folder``, or of the current folder; as it is where neither has the file."""
    path = Path(name)
    # The folder of the case file first: a case that is moved with its data must not find other data of the same name.
    for place in (folder, Path()):
        # ``Path.is_file`` would raise for a name that is too long for the system.
        if os.path.isfile(place / path):
            return str((place / path).absolute())
    return name
