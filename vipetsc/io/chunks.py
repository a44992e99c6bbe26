"""Samples and checkpoints of a run that goes on: chunks in files or in memory.

Chunk k holds the samples between the checkpoints k - 1 and k. A chunk and a checkpoint are named arrays; a rank writes
its share of each into a file of its own, so nothing is sent while a run goes on.
"""

import os
import shutil
from collections import Counter
from collections.abc import Collection, Mapping
from pathlib import Path

from mpi4py import MPI

import numpy as np
from numpy.lib import format as npy

from vipetsc.io.atomic import atomic_write
from vipetsc.io.folder import FolderError
from vipetsc.parallel import on_every_rank, on_root

Arrays = Mapping[str, np.ndarray]


class ChunkFiles:
    """Chunks, ``count`` of them, and the last two checkpoints in ``folder``, shared by all ranks of ``comm``."""

    def __init__(self, folder: Path, comm: MPI.Comm) -> None:
        self.folder, self.comm, self.count = folder, comm, 0

    def begin(self) -> None:
        """Make ready (rank 0 only)."""
        self.folder.mkdir(exist_ok=True)

    def append(self, chunk: Arrays | None) -> None:
        """Write this rank's share of the next chunk, None for no share; all ranks must call it.

        Raises OSError on all ranks if one cannot write.
        """
        path = self._chunk(self.count, self.comm.rank)
        on_every_rank(self.comm, lambda: None if chunk is None else save_arrays(path, chunk))
        self.count += 1

    def read(self, number: int, rank: int, wanted: Collection[str]) -> Arrays:
        """The arrays ``wanted`` of chunk ``number`` as ``rank`` wrote it."""
        return load_arrays(self._chunk(number, rank), wanted)

    def remove(self) -> None:
        """Drop all of them (rank 0 only)."""
        shutil.rmtree(self.folder)

    def save_state(self, state: Arrays) -> None:
        """Write this rank's checkpoint after the last chunk; see ``append``."""
        number = self.count - 1
        on_every_rank(self.comm, lambda: save_arrays(self._state(number), state))
        self._state(number - 2).unlink(missing_ok=True)

    def last_state(self) -> Arrays | None:
        """Go back to the last checkpoint that all ranks wrote, if there is one: ``count``, and this rank's share.

        All ranks must call it; raises FolderError if it was written by another number of ranks.
        """
        number = on_root(self.comm, self._last_complete)
        self.count = number + 1
        return load_arrays(self._state(number)) if number >= 0 else None

    def _last_complete(self) -> int:
        names = [path.stem.split("-") for path in self.folder.glob("state-*.npy")]
        sizes = {int(size) for *_, size in names}
        if sizes - {self.comm.size}:
            message = f"was begun on {max(sizes)} ranks; resume with mpirun -n {max(sizes)}"
            raise FolderError(f"{self.folder.parent}: {message}")
        counts = Counter(int(number) for _, number, *_ in names)
        return max((number for number, count in counts.items() if count == self.comm.size), default=-1)

    def _chunk(self, number: int, rank: int) -> Path:
        return self.folder / f"part-{number:06d}-{rank}.npy"

    def _state(self, number: int) -> Path:
        return self.folder / f"state-{number:06d}-{self.comm.rank}-{self.comm.size}.npy"


class ChunkList:
    """Chunks kept in memory by the rank that reads them, without checkpoints; as ``ChunkFiles``."""

    def __init__(self) -> None:
        self._chunks: list[Arrays | None] = []

    @property
    def count(self) -> int:
        """Number of chunks."""
        return len(self._chunks)

    def begin(self) -> None:
        """Forget all chunks."""
        self._chunks = []

    remove = begin

    def append(self, chunk: Arrays | None) -> None:
        """Keep the next chunk."""
        self._chunks.append(chunk)

    def read(self, number: int, rank: int, wanted: Collection[str]) -> Arrays:
        """Chunk ``number``, which has what is ``wanted``."""
        return self._chunks[number] or {}

    def save_state(self, state: Arrays) -> None:
        """Nothing: a run in memory cannot be gone on with."""

    def last_state(self) -> None:
        """No checkpoint."""


def save_arrays(path: Path, arrays: Arrays) -> None:
    """Write the names of ``arrays`` and then each of them, one after the other; a zip file costs three times that."""
    try:
        with atomic_write(path) as aside, aside.open("wb") as file:
            np.save(file, np.array(list(arrays)))
            for values in map(np.ascontiguousarray, arrays.values()):
                # Through ``write``, which says what is wrong where numpy's own way of writing to disk does not.
                npy.write_array_header_1_0(file, npy.header_data_from_array_1_0(values))
                file.write(values.data)
    except OSError as error:
        message = f"{path} could not be written; make room and go on with --resume: {error.strerror}"
        raise OSError(error.errno, message) from error


def load_arrays(path: Path, wanted: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """What ``save_arrays`` wrote, or the ``wanted`` arrays of it."""
    arrays = {}
    with path.open("rb") as file:
        for name in np.load(file):
            npy.read_magic(file)
            shape, _, dtype = npy.read_array_header_1_0(file)
            count = int(np.prod(shape))
            if wanted is None or name in wanted:
                arrays[str(name)] = np.fromfile(file, dtype, count).reshape(shape)
            else:
                file.seek(count * dtype.itemsize, os.SEEK_CUR)
    return arrays
