"""Folders in the user's cache for compiled kernels, named by all that their machine code follows from.

Numba's own cache checks only the file of a kernel: a kernel that calls a changed kernel of another file, or uses a
constant of it, would keep the old code. Here the name of the folder contains a hash of the kernel's file, of the
modules from which it uses kernels or constants, and of the tables of numbers, because compiled code contains constants.
Equal sources have their kernels in common, wherever they lie: those of a second checkout, or of a version of the
package that has changed elsewhere, are compiled already. Numba itself tells processors and versions of Python apart.
"""

import hashlib
import logging
import os
import re
import shutil
import tempfile
import time
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba.core.caching import UserProvidedCacheLocator

from vipetsc.process import cache_folder, launched_rank

logger = logging.getLogger(__name__)

# Bytes of all folders together; the folders used longest ago are removed first. The kernels of a version take 20 MB, so
# that some 25 versions have room.
LARGEST = 2**29
DAY = 86400  # s: how exactly it is known when a folder was used
HAS_KERNELS = re.compile(rb"^(from|import) (vipetsc\.compiled|numba)\b", re.MULTILINE)
IMPORTS = re.compile(r"^[ \t]*from ([\w.]+) import (\([^)]*\)|.*)$", re.MULTILINE)
NAME = re.compile(r"\w+")


class ByContent(UserProvidedCacheLocator):
    """Locator that has numba look for code in ``NUMBA_CACHE_DIR`` itself, a folder that is named by its sources.

    Numba's own locators add the path of the source file, and those of older versions the time at which it was written.
    Equal files differ in both.
    """

    def __init__(self, function: object, file: str) -> None:
        super().__init__(function, file)
        config: Any = numba.config
        self._cache_path = config.CACHE_DIR

    def get_source_stamp(self) -> str:
        """An empty stamp: the name of the folder alone says of which sources stored code is."""
        return ""


@cache
def kernel_cache(package: Path, file: Path, chosen: str = "") -> Path:
    """The folder for the compiled kernels of a ``file`` of ``package``, named by the hash of ``kernel_sources``.

    It is in ``chosen``, else in the user's cache; where that cannot be written, on nodes without a home for instance,
    it is in ``package``, if files can be written there.
    """
    digest = hashlib.sha256(f"{numba.__version__} {llvmlite.__version__}".encode())
    for path in sorted(kernel_sources(package, file)):
        digest.update(str(path.relative_to(package)).encode() + b"\0" + path.read_bytes())

    parent = cache_folder()
    if chosen:
        parent = Path(chosen)
    elif obstacle(parent) and os.access(package, os.W_OK):
        parent = package / "__pycache__"
    folder = parent / f"kernels-{digest.hexdigest()[:16]}"
    note_use(folder)
    return folder


@cache
def obstacle(folder: Path) -> str:
    """Why no files can be written to a ``folder``, which is made if it is absent; nothing if they can."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        return error.strerror or str(error)
    return ""


def note_use(folder: Path) -> None:
    """Note that a ``folder`` of kernels is used, if it exists and this was not noted within a day."""
    # The folder may be absent, of another user, or on a device that can only be read.
    with suppress(OSError):
        if time.time() - folder.stat().st_mtime > DAY:
            os.utime(folder)


@cache
def remove_oldest(parent: Path) -> None:
    """Remove the folders of kernels used longest ago until the others take ``LARGEST`` bytes at most; once a process.

    A process that has loaded kernels of a removed folder keeps them; it compiles those that it has yet to load.
    """
    # Another process may remove the same folders.
    with suppress(OSError):
        folders = [(folder.stat().st_mtime, folder) for folder in parent.glob("kernels-*")]
        total = 0
        for _, folder in sorted(folders, reverse=True):
            total += sum(file.stat().st_size for file in folder.iterdir())
            if total > LARGEST:
                shutil.rmtree(folder, ignore_errors=True)


@cache
def can_keep(parent: Path) -> bool:
    """Whether kernels can be written below ``parent``; prints a message if they cannot."""
    reason = obstacle(parent)
    # Every command then compiles for up to 20 s, which is said once, on one rank.
    if reason and not launched_rank():
        logger.warning("vipetsc: compiling kernels at every start; the cache %s cannot be written: %s", parent, reason)
    return not reason


def kernel_sources(package: Path, file: Path) -> set[Path]:
    """Files that the kernels of ``file`` depend on: itself, the files that it imports, and the tables of ``package``.

    Where one of those has kernels too, the files that it imports are among them, and so on.
    """
    sources = set(_tables(package))
    waiting = [file]
    while waiting:
        path = waiting.pop()
        if path not in sources:
            sources.add(path)
            waiting += _imports(package, path)
    return sources


@cache
def _tables(package: Path) -> frozenset[Path]:
    """The tables of numbers in ``package``, which stand next to its modules; other folders hold what users read."""
    return frozenset(table for table in package.rglob("*.csv") if (table.parent / "__init__.py").exists())


@cache
def _imports(package: Path, path: Path) -> list[Path]:
    """The files of ``package`` that the file ``path`` imports; none if it has no kernels."""
    text = path.read_bytes()
    if not HAS_KERNELS.search(text):
        return []

    names = []
    # Not by Python's parser, which takes longer for all files with kernels than a short run does.
    for module, imported in IMPORTS.findall(text.decode("utf-8")):
        if module.split(".")[0] == package.name:
            # What is imported may be a module, or a name in one.
            names += [module, *(f"{module}.{name}" for name in NAME.findall(imported))]
    files = [package.parent.joinpath(*name.split(".")).with_suffix(".py") for name in names]
    return [file for file in files if file.exists()]
