"""Files that are complete or absent: written under a temporary name, and renamed when complete."""

import io
import os
import platform
import re
import secrets
import shutil
import sys
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vipetsc.io.errors import UnwrittenError
from vipetsc.wording import system_number, system_reason

Arrays = Mapping[str, np.ndarray]


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
        # One that cannot be removed is left to the next claim: its error would hide the first one.
        with suppress(OSError):
            aside.unlink()


class _WholeFile(io.RawIOBase):
    """A new file at ``path`` for HDF5 that keeps the first ``error`` in writing instead of raising it.

    HDF5 does not free a file that it failed to write, and crashes later. It is told that all was written, and what
    comes after the error is dropped.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("w+b", buffering=0)
        self.error: OSError | None = None

    def seek(self, offset: int, whence: int = 0) -> int:
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        return self._file.tell()

    def readinto(self, buffer: Any) -> int | None:
        return self._file.readinto(buffer)

    def write(self, data: Any) -> int:
        rest = memoryview(data).cast("B")
        size = len(rest)
        # A disk that is nearly full takes a part.
        while len(rest) and self.error is None:
            try:
                rest = rest[self._file.write(rest) :]
            except OSError as error:
                self.error = error
        return size

    def truncate(self, size: int | None = None) -> int:
        if self.error is None:
            try:
                return self._file.truncate(size)
            except OSError as error:
                self.error = error
        return size or 0

    def close(self) -> None:
        if not self.closed:
            try:
                self._file.close()
            except OSError as error:
                self.error = self.error or error
        super().close()


@contextmanager
def hdf5_file(path: Path) -> Iterator[h5py.File]:
    """Create the HDF5 file ``path`` and fill it within the block; raises OSError if it could not be written."""
    file = _WholeFile(path)
    try:
        with h5py.File(file, "w") as opened:
            yield opened
    except Exception as error:
        # HDF5 may stumble over what was dropped: the first error is the cause.
        raise file.error or error from None
    finally:
        file.close()
    if file.error:
        raise file.error


def remove_abandoned(folder: Path) -> None:
    """Remove temporary files of ``atomic_write`` from ``folder`` whose processes on this host have ended.

    It is for commands that hold no lock on the folder: other commands may be writing there at the same time.
    """
    # The pattern covers the whole name: that of another host may begin with that of this one, a dash and a number.
    of_this_host = re.compile(rf"\..*\.{re.escape(platform.node())}-(\d+)-[0-9a-f]+\.part", re.DOTALL)
    for path in folder.glob(".*.part"):
        named = of_this_host.fullmatch(path.name)
        if named and not _is_running(int(named[1])):
            with suppress(OSError):
                path.unlink()


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


def unwritten(path: Path, error: Exception) -> UnwrittenError:
    """An error with the number of ``error``, from Python or from HDF5, that names the file that was not written."""
    remedy = "after the cause is removed, the same command continues"
    return UnwrittenError(system_number(error), f"{path} could not be written: {system_reason(error)}; {remedy}")


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
    """Write ``arrays`` to ``path`` as datasets of an HDF5 file; raises OSError as ``atomic_write``."""
    with atomic_write(path) as aside, hdf5_file(aside) as file:
        for name, values in arrays.items():
            file[name] = values


def read_arrays(path: Path, wanted: Collection[str]) -> dict[str, np.ndarray]:
    """Read the arrays ``wanted`` of a file that ``save_arrays`` wrote; raises OSError as ``StoredArrays``."""
    with _opened(path) as file:
        return {name: np.asarray(file[name][()]) for name in wanted}


@contextmanager
def _opened(path: Path) -> Iterator[h5py.File]:
    """Open the file to be read; an error of HDF5, or of an array that is missing, becomes an OSError with the path."""
    try:
        with h5py.File(path) as file:
            yield file
    except (OSError, RuntimeError, KeyError) as error:
        raise OSError(f"{path} cannot be read: {system_reason(error)}") from error


class StoredArrays(Mapping[str, np.ndarray]):
    """The arrays in a file that ``save_arrays`` wrote, each read when it is asked for.

    Raises an OSError that names the file if it cannot be read, or lacks an array.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._names: list[str] = []
        with _opened(path) as file:
            file.visititems(self._note)

    def _note(self, name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset):
            self._names.append(name)

    def __getitem__(self, name: str) -> np.ndarray:
        return read_arrays(self.path, [name])[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)
