"""Output of a run: a folder, which contains ``run.h5`` and ``summary.json`` at the end, or memory.

During a run its samples are stored as chunks: chunk k holds the samples between the checkpoints k - 1 and k. A chunk
and a checkpoint are arrays by name; each rank writes its part of them into a file of its own, so that ranks send each
other nothing. Every part says which cells and sites it has, so that another number of ranks can go on with the run.

When the run has ended, ``io.chunks`` puts the parts together. Fields (t, cell, dof) and losses (t, site) may be too
large for the memory: they are copied chunk by chunk, by rank 0 alone or by all ranks into a common file. The log of
contacts is sorted by onset, and each rank that writes holds a part of it.
"""

from __future__ import annotations

import json
import math
import os
import sys
import tomllib
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from mpi4py import MPI

import h5py
import numpy as np

from vipetsc.io import chunks
from vipetsc.io.atomic import Arrays, discard, load_arrays, save_arrays, unwritten, write_text
from vipetsc.io.chunks import Recording
from vipetsc.io.lock import FolderError
from vipetsc.io.netcdf import add_variable, put_dataset
from vipetsc.io.read import open_run, with_point_names
from vipetsc.parallel import SortedRows, on_every_rank, on_root, sort_over_ranks

if TYPE_CHECKING:
    import xarray as xr

# Bytes of fields above which all ranks write the file together if output.writer is "auto". Fewer are copied by one rank
# in some seconds, and a file that ranks write together needs a file system that all of them see.
GATHER_LIMIT = 2 * 2**30


class _Contents(NamedTuple):
    """Contents of ``run.h5`` but for fields, losses and forces, which are copied from the chunks.

    ``small`` is the dataset whose values rank 0 writes, ``log`` this rank's part of all episodes in order.
    """

    small: xr.Dataset
    log: SortedRows


class RunFolder:
    """The folder of one run: ``case.toml``, ``parts/`` while it runs, ``run.h5`` and ``summary.json`` after.

    It stores the ``count`` chunks of the run, on all ranks of ``comm``, and puts them together at the end. The caller
    sets ``recording``, which describes their contents, before the first one. A chunk has ``chunk_length`` samples; if
    that is None, as many as are copied and written at once.
    """

    recording: Recording
    saves_states = True
    chunk_length: int | None = None

    def __init__(self, folder: Path, comm: MPI.Comm) -> None:
        self.folder = Path(folder)
        self.comm = comm
        self.count = 0
        self._parts = self.folder / "parts"

    def begin(self, case: str) -> None:
        """Prepare the output of a new or continued run of ``case`` (TOML); all ranks must call it."""
        self.case = case
        on_root(self.comm, lambda: self._parts.mkdir(parents=True, exist_ok=True))

    def ending(self) -> dict[str, Any] | None:
        """The root attributes of ``run.h5``; None if the run has not ended. All ranks must call it.

        A ``summary.json`` that is missing is written again. Raises FolderError on all ranks if ``run.h5`` cannot be
        read.
        """
        return on_root(self.comm, self._read_ending)

    def _read_ending(self) -> dict[str, Any] | None:
        """The attributes, on one rank; see ``ending``."""
        path = self.folder / "run.h5"
        # Chunks next to a run.h5 are those of a run that was begun anew, and has not ended.
        if not path.exists() or any(self._parts.glob("*")):
            return None
        try:
            with open_run(path) as run:
                attributes = {key: np.asarray(value).item() for key, value in run.attrs.items()}
        except (OSError, ValueError) as error:
            raise FolderError(f"{error}; --force repeats the run") from error

        for key in ("statistics", "warnings"):
            if key in attributes:
                attributes[key] = json.loads(attributes[key])
        if not (self.folder / "summary.json").exists():
            self._summarise(attributes | {"case": tomllib.loads(attributes["case"])})
        return attributes

    def _summarise(self, summary: Mapping[str, Any]) -> None:
        """Write ``summary.json``."""
        write_text(self.folder / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")

    def room(self, shape: tuple[int, ...]) -> np.ndarray:
        """Array (field, sample, dof, cell) for this rank's fields of the next chunk, not initialised."""
        return np.empty(shape)

    def append(self, chunk: Arrays | None) -> None:
        """Store this rank's part of the next chunk, None for no part; all ranks must call it.

        Raises OSError on all ranks if one cannot write.
        """
        path = self._chunk(self.count, self.comm.rank)

        def save() -> None:
            if chunk is not None:
                save_arrays(path, chunk)

        on_every_rank(self.comm, save)
        self.count += 1

    def read(self, number: int, rank: int, wanted: Collection[str]) -> Arrays:
        """The arrays ``wanted`` of the part of chunk ``number`` that ``rank`` has stored."""
        return load_arrays(self._chunk(number, rank), wanted)

    def save_state(self, state: Arrays) -> None:
        """Store this rank's checkpoint after the last chunk, and keep the one before; all ranks must call it.

        Raises OSError on all ranks if one cannot write.
        """
        number = self.count - 1
        path = self._state(number, self.comm.rank, self.comm.size)

        def replace_oldest() -> None:
            save_arrays(path, state)
            # Two checkpoints are kept: until all ranks have written this one, the one before it is the last that is
            # complete.
            if self.comm.rank == 0:
                earlier = [path for path in self._parts.glob("state-*") if int(path.stem.split("-")[1]) < number]
                last = max((path.stem.split("-")[1] for path in earlier), default="")
                for old in earlier:
                    if old.stem.split("-")[1] != last:
                        old.unlink()

        on_every_rank(self.comm, replace_oldest)

    def last_state(self) -> Sequence[Arrays] | None:
        """Go back to the last complete checkpoint: return the parts of all ranks that wrote it; None if there is none.

        ``count`` becomes the number of chunks before it. Another number of ranks may have written it. All ranks must
        call it; raises OSError on all if one cannot read.
        """
        number, size = on_root(self.comm, self._last_complete_state)
        self.count = number + 1
        if not size:
            return None
        paths = [self._state(number, rank, size) for rank in range(size)]
        return on_every_rank(self.comm, lambda: [load_arrays(path, copy=False) for path in paths])

    def _last_complete_state(self) -> tuple[int, int]:
        """Number of the last complete checkpoint, and of the ranks that wrote it; (-1, 0) if there is none.

        Files of later chunks and checkpoints are removed.
        """
        names = [path.stem.split("-") for path in self._parts.glob("state-*.npy")]
        counts = Counter((int(number), int(size)) for _, number, _, size in names)
        # A checkpoint is complete when there are as many parts as ranks that wrote it.
        complete = [key for key, count in counts.items() if count == key[1]]
        number, size = max(complete, default=(-1, 0))

        for path in self._parts.glob("*-*-*.npy"):
            # Another number of ranks, which goes on with the run, would not replace all of them.
            if int(path.stem.split("-")[1]) > number:
                path.unlink()
        return number, size

    def _chunk(self, number: int, rank: int) -> Path:
        """The file of a rank's part of chunk ``number``."""
        return self._parts / f"part-{number:06d}-{rank}.npy"

    def _state(self, number: int, rank: int, size: int) -> Path:
        """The file of a rank's part of the checkpoint after chunk ``number``, which ``size`` ranks have written."""
        return self._parts / f"state-{number:06d}-{rank}-{size}.npy"

    def ranks(self, number: int) -> list[int]:
        """The ranks that have stored a part of chunk ``number``."""
        return [int(path.stem.split("-")[2]) for path in self._parts.glob(f"part-{number:06d}-*.npy")]

    def finish(self, attributes: Mapping[str, Any], summary: Mapping[str, Any]) -> None:
        """Put the chunks together to ``run.h5``; all ranks must call it. Raises OSError on all if one cannot write.

        ``attributes``, the same on all ranks, become those of the root, with the case; ``summary.json`` holds them and
        ``summary``. The file has a temporary name until it is complete; the chunks are removed after that.
        """
        target = self.folder / "run.h5"
        aside = self.folder / ".run.h5.part"
        writes = self.recording.together or self.comm.rank == 0

        def read_chunks() -> tuple[xr.Dataset, np.ndarray] | None:
            sys.audit("vipetsc.assemble", str(target))
            if not writes:
                return None
            small = chunks.run_dataset(self, chunks.small_variables(self), attributes)
            return small, chunks.read_log(self)

        def write() -> None:
            try:
                self._write(aside, contents)
            except (OSError, RuntimeError) as error:  # h5py raises either when HDF5 cannot write
                raise unwritten(target, error) from error

        def conclude() -> None:
            sys.audit("vipetsc.conclude", str(self.folder))
            os.replace(aside, target)
            self._summarise({**attributes, **summary})
            sys.audit("vipetsc.clean", str(self._parts))
            discard(self._parts)

        try:
            # All ranks read before any creates the file: ranks create it together, and one that failed would leave the
            # others waiting.
            read = on_every_rank(self.comm, read_chunks)
            if read:
                small, log = read
                in_order = sort_over_ranks(chunks.writers(self), log, ("onset", "site"))
                contents = _Contents(small=small, log=in_order)
            # Ranks that do not write wait here as well, so that an error of a writer is raised on all.
            on_every_rank(self.comm, write if writes else lambda: None)
            on_root(self.comm, conclude)
        finally:
            if self.comm.rank == 0:
                aside.unlink(missing_ok=True)

    def _write(self, path: Path, contents: _Contents) -> None:
        """Write a file of the run to ``path``, together with the other writers."""
        together: dict[str, Any] = {}
        if self.recording.together:
            together = {"driver": "mpio", "comm": self.comm}
        log = contents.log
        columns = chunks.log_columns(log.rows, log.first)
        sizes = {**contents.small.sizes, "episode": log.total}
        with h5py.File(path, "w", **together) as file:
            put_dataset(file, contents.small, write=self.comm.rank == 0)
            # All datasets are created before any is filled: ranks create them together, but each copies by itself, and
            # may fail.
            large = {}
            for name in (*columns, *self.recording.of_sites, *self.recording.fields):
                description = chunks.described(name, contents.small)
                dtype = np.dtype(float)
                if name in columns:
                    dtype = columns[name].dtype
                about = description.attributes | chunks.coordinates(name)
                shape = [sizes[dim] for dim in description.dims]
                large[name] = add_variable(file, name, description.dims, shape, dtype, about)

            for name, dataset in large.items():
                if name not in columns:
                    chunks.put_chunks(dataset, self, name)
                elif log.rows.size:
                    dataset[log.first : log.first + log.rows.size] = columns[name]


class FieldMemory:
    """Memory for the fields of runs that follow one another; those of a run are lost when the next one begins.

    It is used again because the operating system fills new memory with zeros, a tenth of the time that a member of a
    sweep takes.
    """

    def __init__(self) -> None:
        self._numbers = np.empty(0)

    def array(self, shape: tuple[int, ...]) -> np.ndarray:
        """An array of this ``shape``, not initialised, in the memory of the last one if that is large enough."""
        size = math.prod(shape)
        if size > self._numbers.size:
            self._numbers = np.empty(size)
        return self._numbers[:size].reshape(shape)


class RunMemory:
    """Output of a run into memory instead of a ``RunFolder``, with the same methods; a run that is stopped is lost.

    Rank 0 of ``comm`` has all fields, whatever ``output.writer`` is; they lie in memory as (t, dof, cell), and on one
    rank the engine writes them where they stay.

    Parameters
    ----------
    states_every
        Samples between two checkpoints, which are then kept; by default there are none.
    fields
        Memory for the fields, which one run after another uses; by default each run has its own.

    Attributes
    ----------
    dataset
        The run as of ``open_run``, on rank 0; None on the others and before the end.
    states
        The parts of each checkpoint (checkpoint, rank), on all ranks.
    end
        Displacements and velocities (cell, 2 dof) at the last sample of a complete run, if the caller has set them; the
        dataset then has ``end/displacement`` and ``end/velocity``.
    """

    folder = None
    recording: Recording

    def __init__(
        self, comm: MPI.Comm = MPI.COMM_SELF, states_every: int | None = None, fields: FieldMemory | None = None
    ) -> None:
        self.comm = comm
        self._memory = fields
        self.saves_states = states_every is not None
        # Checkpoints are the same on any number of ranks: what continues from one has the same bits then.
        self.chunk_length = states_every
        if states_every is None and comm.size == 1:
            # The fields of one rank are not copied, so that chunks need not be small.
            self.chunk_length = sys.maxsize
        self.states: list[list[Arrays]] = []
        self.count = 0
        self.dataset: xr.Dataset | None = None
        self.end: np.ndarray | None = None

    def begin(self, case: str) -> None:
        """Make ready for a run of ``case`` (TOML)."""
        self.case = case
        self.count = 0
        self.states = []
        self._rows = 0
        self._chunks: list[Arrays] = []
        # The fields of the run before, kept by ``cached_property``.
        vars(self).pop("_fields", None)

    @cached_property
    def _fields(self) -> np.ndarray:
        """All fields (field, sample, dof, cell), allocated when they are first used."""
        # Not in ``begin``, since the recording, which has the shape, is set after it.
        dofs = len(self.recording.given["dof"])
        cells = len(self.recording.given["cell"])
        shape = (len(self.recording.fields), self.recording.rows, dofs, cells)
        if self._memory is None:
            return np.empty(shape)
        return self._memory.array(shape)

    def room(self, shape: tuple[int, ...]) -> np.ndarray:
        """Array (field, sample, dof, cell) for this rank's fields of the next chunk, not initialised."""
        if self.comm.size > 1:
            return np.empty(shape)
        return self._fields[:, self._rows : self._rows + shape[1]]

    def append(self, chunk: Arrays | None) -> None:
        """Store the next chunk in memory."""
        arrays = dict(chunk or {})
        fields = [arrays.pop(name) for name in self.recording.fields if name in arrays]
        rows = slice(self._rows, self._rows + len(arrays.get("field_time", ())))
        # On one rank the engine has written the fields there already, into the ``room`` that it asked for.
        if self.comm.size > 1 and fields:
            self._fields[:, rows] = fields
        self._rows = rows.stop
        self._chunks.append(arrays)
        self.count += 1

    def ranks(self, number: int) -> list[int]:
        """The ranks with a part of chunk ``number``: rank 0 alone."""
        return [0]

    def read(self, number: int, rank: int, wanted: Collection[str]) -> Arrays:
        """All arrays of chunk ``number``, the ``wanted`` ones among them, without a copy."""
        return self._chunks[number]

    def save_state(self, state: Arrays) -> None:
        """Keep the parts of a checkpoint of all ranks; all ranks must call it."""
        self.states.append(self.comm.allgather(state))

    def last_state(self) -> None:
        """Return None: a run in memory cannot be resumed."""

    def finish(self, attributes: Mapping[str, Any], summary: Mapping[str, Any]) -> None:
        """Create the dataset; all ranks must call it."""
        if self.comm.rank == 0:
            variables = chunks.small_variables(self)
            log = sort_over_ranks(MPI.COMM_SELF, chunks.read_log(self), ("onset", "site"))
            large = {**chunks.joined(self, self.recording.of_sites), **chunks.log_columns(log.rows)}
            recorded = self._fields[:, : self._rows].swapaxes(2, 3)
            large |= dict(zip(self.recording.fields, recorded, strict=True))
            if self.end is not None:
                displacement, velocity = np.split(self.end[self.recording.given["cell"] - 1], 2, axis=1)
                large |= {"end/displacement": displacement, "end/velocity": velocity}
            for name, values in large.items():
                description = chunks.described(name, variables)
                variables[name] = (description.dims, values, description.attributes)
            # In one call, since xarray compares the dimensions of all variables whenever some are added.
            self.dataset = with_point_names(chunks.run_dataset(self, variables, attributes))
        self._chunks = []


RunOutput = RunFolder | RunMemory
