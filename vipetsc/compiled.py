"""Numba's decorators as the package uses them: with its cache, which is cleared when a source of the package changes.

Numba's cache checks only the file of a function: one that calls a changed function of another file would keep the old
code. Each folder of the cache therefore has a note of the sources from which its code was compiled. Where one of these
has changed, the code is removed and compiled anew: nothing old piles up. Numba chooses the folders: beside the sources,
in the user's cache where these cannot be written, or in NUMBA_CACHE_DIR.
"""

import hashlib
import logging
import os
import pickle
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numba

from vipetsc.process import launched_rank, say

logger = logging.getLogger(__name__)
Function = TypeVar("Function", bound=Callable[..., Any])

PACKAGE = Path(__file__).parent
NOTE = "vipetsc-sources.txt"  # in each folder of the cache
# Parts of the package with kernels, from the top down: each uses kernels and constants of those below it.
ROOMS = ("modes", "dynamics", "contact", "spectra", "lattice")
SHARED = ("compiled.py", "records.py", "register.py")


def kernel(function: Any = None, /, **options: Any) -> Any:
    """Compile a function as ``numba.njit`` does, at its first call; a division by zero gives inf or NaN.

    The code is kept between runs where files can be written. Kernels count as untyped: their annotations say which
    named tuple an argument has, and callers pass its ``Record``.
    """
    # No C code calls these functions: the wrapper that it would need is not compiled.
    decorate = _kept(numba.njit, error_model="numpy", no_cfunc_wrapper=True, **options)
    if function is None:
        return decorate
    return decorate(function)


def cfunc(signature: str) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function as ``numba.cfunc`` does: C code calls it at its ``address``. The code is kept between runs."""
    return _kept(numba.cfunc, signature)


def users_function(function: Callable[..., Any]) -> Any:
    """Return a ``function`` of a user's module, compiled where it is called; nothing is kept of it between runs."""
    # A function that the module itself has compiled may raise at a division by zero, which gives inf here.
    return numba.njit(error_model="numpy")(getattr(function, "py_func", function))


def c_address(function: Callable[..., Any], signature: str) -> int:
    """Return the address of a ``function`` as a C function, for the rest of this process; raises NumbaError."""
    callback = numba.cfunc(signature)(function)
    _CALLBACKS.append(callback)
    return int(callback.address or 0)


_CALLBACKS: list[Any] = []  # C functions in use: an address alone does not keep Python from freeing the function


def _kept(decorator: Any, *signature: str, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator of functions by numba's ``decorator``, with its cache where that can be written."""

    def decorate(function: Callable[..., Any]) -> Any:
        # Numba chooses the folder when it decorates a function, and raises RuntimeError where it finds none. A function
        # with a signature is compiled at once, but then the folder must be up to date.
        try:
            lazy = numba.njit(cache=True, **options)(function)
        except RuntimeError:
            _warn()
            return decorator(*signature, **options)(function)
        room = Path(function.__code__.co_filename).relative_to(PACKAGE).parts[0]
        clear_if_changed(Path(lazy.stats.cache_path), room)
        if decorator is numba.njit and not signature:
            return lazy
        return decorator(*signature, cache=True, **options)(function)

    return decorate


@cache
def _warn() -> None:
    """Warn once, on one rank, that nothing is kept."""
    if not launched_rank():
        logger.warning("vipetsc: compiling kernels at every start: no cache can be written; set NUMBA_CACHE_DIR")


@cache
def sources(room: str) -> str:
    """Return a hash of the names, sizes and times of all files from which the kernels of a ``room`` are compiled.

    These are its own and those of the rooms below it, among them tables of numbers: compiled code contains constants.
    """
    digest = hashlib.sha256(numba.__version__.encode())
    folders = [PACKAGE]
    if room in ROOMS:
        folders += [PACKAGE / name for name in ROOMS[ROOMS.index(room) :]]
    for folder in folders:
        for entry in sorted(os.scandir(folder), key=lambda entry: entry.name):
            if entry.is_dir() and folder != PACKAGE and entry.name != "__pycache__":
                folders.append(Path(entry.path))
            elif entry.name in SHARED or (folder != PACKAGE and entry.name.endswith((".py", ".csv"))):
                status = entry.stat()
                digest.update(f"{entry.name} {status.st_size} {status.st_mtime_ns}\n".encode())
    return digest.hexdigest()


@cache
def clear_if_changed(folder: Path, room: str) -> None:
    """Remove the code in a ``folder`` of the cache that was compiled from other sources of a ``room``; once a process.

    So is a file that is cut off, which numba could not read: a machine that lost its power leaves such files.
    """
    note = folder / NOTE
    # Other processes may do the same at the same time, and a folder of another user cannot be written.
    with suppress(OSError):
        is_current = note.exists() and note.read_text() == sources(room)
        for code in folder.glob("*.nb[ci]"):
            if not is_current or not _is_whole(code):
                code.unlink(missing_ok=True)
        if not is_current:
            note.write_text(sources(room))
            _announce()


def _is_whole(code: Path) -> bool:
    """Return whether a file of the cache is whole: numba writes pickles, whose last byte is a full stop."""
    with code.open("rb") as file:
        if not file.seek(0, os.SEEK_END):
            return False
        file.seek(-1, os.SEEK_END)
        return file.read() == pickle.STOP


@cache
def _announce() -> None:
    """Report once, on one rank, why the first run of a version takes longer than the next."""
    if not launched_rank():
        say("vipetsc: compiling kernels (once, about a minute)")


# For short functions that numba puts in place of their calls, with the constants that are passed there.
inlined = kernel(inline="always")
