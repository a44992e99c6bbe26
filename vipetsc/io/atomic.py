"""Files that are complete or absent: written under a temporary name, and renamed when complete."""

import math
import os
import platform
import re
import secrets
import shutil
import sys
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.lib import format as npy

Arrays = Mapping[str, np.ndarray]
LARGEST_RECORD = 2**31 - 1  # bytes, which numpy counts in a C int


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """A temporary path that replaces ``path`` when the block succeeds and vanishes when it fails.

    Raises an OSError that names ``path`` if the temporary file cannot be written or renamed.
    """
    # Processes of two hosts with a common file system, or of two containers, may have the same number: the host's name
    # and a random word tell them apart.
    aside = path.with_name(f".{path.name}.{platform.node()}-{os.getpid()}-{secrets.token_hex(4)}.part")
    sys.audit("vipetsc.write", str(path))
    # Renamed only when it is complete: a kill leaves the earlier file, and the temporary one for the next claim.
    try:
        yield aside
        sys.audit("vipetsc.replace", str(path))
        os.replace(aside, path)
    except OSError as error:
        raise unwritten(path, error) from error
    finally:
        aside.unlink(missing_ok=True)


def remove_abandoned(folder: Path) -> None:
    """Remove temporary files of ``atomic_write`` from ``folder`` whose processes on this host have ended.

    It is for commands that hold no lock on the folder: other commands may be writing there at the same time.
    """
    # The pattern covers the whole name: that of another host may begin with that of this one, a dash and a number.
    of_this_host = re.compile(rf"\..*\.{re.escape(platform.node())}-(\d+)-[0-9a-f]+\.part", re.DOTALL)
    for path in folder.glob(".*.part"):
        named = of_this_host.fullmatch(path.name)
        if named and not _is_running(int(named[1])):
            path.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    """Whether there is a ``process`` of that number on this host."""
    try:
        # The signal 0 is not sent: the system only looks whether it could be.
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        # The process is another user's.
        pass
    return True


def unwritten(path: Path, error: Exception) -> OSError:
    """An OSError with the number of ``error``, from Python or from HDF5, that names the file that was not written."""
    number = getattr(error, "errno", None) or 0
    in_text = re.search(r"errno = (\d+)", str(error))
    if not number and in_text:
        # HDF5 gives the number in its message alone.
        number = int(in_text[1])

    reason = str(error)
    if number:
        reason = os.strerror(number)
    remedy = "after the cause is removed, the same command continues"
    return OSError(number, f"{path} could not be written: {reason}; {remedy}")


def discard(folder: Path) -> None:
    """Remove ``folder`` if it exists; a kill leaves it whole, or under a name that begins with a dot."""
    aside = folder.with_name(f".{folder.name}.old")
    # A call that was killed may have left one, onto which the folder could not be renamed.
    shutil.rmtree(aside, ignore_errors=True)
    if folder.is_dir():
        os.replace(folder, aside)
        shutil.rmtree(aside, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` in UTF-8, whole or not at all; raises OSError as ``atomic_write``."""
    with atomic_write(path) as aside:
        aside.write_text(text, encoding="utf-8")


def save_arrays(path: Path, arrays: Arrays) -> None:
    """Write ``arrays`` to ``path`` in numpy's format (.npy); raises OSError as ``atomic_write``.

    They are the fields of one record or, if they are too large for it, arrays one after another, of which the first
    has the names of the others. numpy's own format for several arrays, a zip file, takes three times as long as a
    record, and cannot be mapped.
    """
    with atomic_write(path) as aside, aside.open("wb") as file:
        if sum(values.nbytes for values in arrays.values()) > LARGEST_RECORD:
            _write_sequence(file, arrays)
        else:
            _write_record(file, arrays)


def _write_record(file: BinaryIO, arrays: Arrays) -> None:
    """Write ``arrays`` as the fields of one record."""
    record = np.dtype([(name, values.dtype, values.shape) for name, values in arrays.items()])
    # The header is numpy's. The values follow it one after another, without a copy of all in one array.
    header = {"descr": npy.dtype_to_descr(record), "fortran_order": False, "shape": ()}
    npy.write_array_header_2_0(file, header)

    # Byte 6 is the version of the format. Version 3 differs from 2 in the header's encoding, UTF-8, and
    # numpy 1.24 takes a header of version 2 apart into tokens, which takes longer than the rest of the reading.
    file.seek(6)
    file.write(b"\3")
    file.seek(0, os.SEEK_END)

    # By ``write``, whose error has a number; numpy's ``tofile`` gives none.
    for values in arrays.values():
        file.write(np.ascontiguousarray(values).data)


def _write_sequence(file: BinaryIO, arrays: Arrays) -> None:
    """Write the names of ``arrays`` as an array, and behind it each of them."""
    for values in (np.array(list(arrays)), *arrays.values()):
        header = {"descr": npy.dtype_to_descr(values.dtype), "fortran_order": False, "shape": values.shape}
        npy.write_array_header_2_0(file, header)
        file.write(np.ascontiguousarray(values).data)


def load_arrays(path: Path, wanted: Collection[str] | None = None, copy: bool = True) -> dict[str, np.ndarray]:
    """Load the arrays ``wanted``, by default all, that ``save_arrays`` wrote, in the shapes that they had.

    Without a ``copy`` they are parts of the file, read when they are used. Raises an OSError that names the file if it
    cannot be read, or lacks an array.
    """
    try:
        # numpy refuses headers of more than 10,000 letters, since a hostile one could stop it; this one is ours.
        record = npy.open_memmap(path, mode="r", max_header_size=2**32)  # type: ignore[call-arg]
        names = record.dtype.names
        arrays: Any = record
        # Without fields it is the array of names of a sequence.
        if names is None:
            arrays = _mapped_sequence(path)
            names = tuple(arrays)
        if wanted is None:
            wanted = names
        return {name: np.array(arrays[name], copy=copy) for name in wanted}
    except (OSError, ValueError, KeyError) as error:
        raise OSError(f"{path} cannot be read: {error}") from error


def _mapped_sequence(path: Path) -> dict[str, np.ndarray]:
    """The arrays that ``_write_sequence`` wrote, as parts of the file."""
    content = np.memmap(path, np.uint8, mode="r")
    mapped: dict[str, np.ndarray] = {}
    with path.open("rb") as file:
        for name in npy.read_array(file).tolist():
            npy.read_magic(file)
            shape, _, dtype = npy.read_array_header_2_0(file)
            start = file.tell()
            stop = start + math.prod(shape) * dtype.itemsize
            mapped[name] = content[start:stop].view(dtype).reshape(shape)
            file.seek(stop)
    return mapped
