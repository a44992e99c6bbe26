"""HDF5 files: written so that an error of the disk is Python's, and files of named arrays."""

import io
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vipetsc.io.atomic import atomic_write
from vipetsc.wording import system_reason

Arrays = Mapping[str, np.ndarray]


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
