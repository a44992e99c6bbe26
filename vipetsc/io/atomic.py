"""Files that are complete or absent: written under a temporary name, and renamed when complete."""

import glob
import os
import platform
import re
import secrets
import shutil
import sys
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.lib import format as npy

Arrays = Mapping[str, np.ndarray]


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """A temporary path that replaces ``path`` when the block succeeds and vanishes when it fails.

    Raises OSError that names ``path``.
    """
    # Processes of two hosts with a common file system, or of two containers, may have the same number.
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

    For commands that hold no lock on the folder, so that others may write there at the same time.
    """
    here = platform.node()
    for path in folder.glob(f".*.{glob.escape(here)}-*.part"):
        process = path.name.rpartition(f".{here}-")[2].partition("-")[0]
        if process.isdigit() and not _is_running(int(process)):
            path.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    """Whether there is a ``process`` of that number on this host."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass  # another user's
    return True


def unwritten(path: Path, error: Exception) -> OSError:
    """An OSError with the number of ``error``, from Python or from HDF5, that names the file that was not written."""
    number = getattr(error, "errno", None) or 0
    in_text = re.search(r"errno = (\d+)", str(error))
    if not number and in_text:
        # HDF5 says it in its message alone.
        number = int(in_text[1])
    reason = str(error)
    if number:
        reason = os.strerror(number)
    return OSError(
        number, f"{path} could not be written: {reason}; after the cause is removed, the same command continues"
    )


def discard(folder: Path) -> None:
    """Remove ``folder`` if it exists; a kill leaves it whole, or under a name that begins with a dot."""
    aside = folder.with_name(f".{folder.name}.old")
    shutil.rmtree(aside, ignore_errors=True)  # of a call that was killed
    if folder.is_dir():
        os.replace(folder, aside)
        shutil.rmtree(aside, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` whole or not at all."""
    with atomic_write(path) as aside:
        aside.write_text(text, encoding="utf-8")


def save_arrays(path: Path, arrays: Arrays) -> None:
    """Write ``arrays`` as the fields of one record, in numpy's format; a zip file costs three times that."""
    record = np.dtype([(name, values.dtype, values.shape) for name, values in arrays.items()])
    with atomic_write(path) as aside, aside.open("wb") as file:
        # One record of all arrays: numpy has the header, and the values follow without being copied together.
        header = {"descr": npy.dtype_to_descr(record), "fortran_order": False, "shape": ()}
        npy.write_array_header_2_0(file, header)
        file.seek(6)
        file.write(b"\3")  # version 3, in UTF-8: headers of the others numpy takes apart into tokens first
        file.seek(0, 2)
        # Through ``write``, whose error has a number; numpy's own writing to disk gives none.
        for values in arrays.values():
            file.write(np.ascontiguousarray(values).data)


def load_arrays(path: Path, wanted: Collection[str] | None = None, copy: bool = True) -> dict[str, np.ndarray]:
    """Load the arrays ``wanted``, else all, that ``save_arrays`` wrote; without a ``copy`` each is read when used.

    They have the shapes with which they were saved.

    Raises OSError that names the file.
    """
    try:
        record = npy.open_memmap(path, mode="r", max_header_size=2**32)  # type: ignore[call-arg]
        if wanted is None:
            wanted = record.dtype.names or ()
        return {name: np.array(record[name], copy=copy) for name in wanted}
    except (OSError, ValueError) as error:
        raise OSError(f"{path} cannot be read: {error}") from error
