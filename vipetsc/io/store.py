"""Output of a run: a folder, which contains ``run.h5`` and ``summary.json`` at the end, or memory.

During a run its samples are stored as chunks: chunk k holds the samples between the checkpoints k - 1 and k. A chunk
is arrays by name, which rank 0 has of all ranks. Of a checkpoint each rank writes its part into a file of its own. The
part says which cells and sites it has, so that another number of ranks can go on with the run.

When the run has ended, ``io.chunks`` puts the parts together. Fields (t, cell, dof) and losses (t, site) may be too
large for the memory: rank 0 copies them chunk by chunk. The log of contacts is sorted by onset.
"""

from __future__ import annotations

import json
import math
import shutil
import sys
import tomllib
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import h5py
import numpy as np

from vipetsc.io import chunks
from vipetsc.io.atomic import atomic_write, discard, write_text
from vipetsc.io.chunks import Recording
from vipetsc.io.hdf5 import Arrays, StoredArrays, hdf5_file, read_arrays, save_arrays
from vipetsc.io.lock import FolderError
from vipetsc.io.netcdf import add_variable, not_finite_in, put_dataset
from vipetsc.io.read import open_run, with_point_names
from vipetsc.parallel import on_every_rank, on_root
from vipetsc.process import say
from vipetsc.sources import source_key

if TYPE_CHECKING:
    import xarray as xr


CHUNK_BYTES = 64 * 2**20  # of a run's file, in a chunk into which it is divided again


class RunFolder:
    """The folder of one run: ``case.toml``, ``parts/`` while it runs, ``run.h5`` and ``summary.json`` after.

    If it ``keeps_end``, the run's last checkpoint stays in ``end-state/``: with a later end the run goes on from there
    (``reopen``).

    It stores the ``count`` chunks of the run, on all ranks of ``comm``, and puts them together at the end. The caller
    sets ``recording``, which describes their contents, before the first one. A chunk has ``chunk_length`` samples; if
    that is None, as many as are copied and written at once.
    """

    recording: Recording
    saves_states = True
    chunk_length: int | None = None

    def __init__(self, folder: Path, comm: MPI.Comm, *, keeps_end: bool = False) -> None:
        self.folder = Path(folder)
        self.comm = comm
        self.keeps_end = keeps_end
        self.count = 0
        self._parts = self.folder / "parts"
        self._end = self.folder / "end-state"

    def begin(self, case: str) -> None:
        """Prepare the output of a new or continued run of ``case`` (TOML); all ranks must call it."""
        self.case = case
        on_root(self.comm, self._prepare_parts)

    def _prepare_parts(self) -> None:
        """Make the folder of the chunks; what other sources of the program have begun there is dropped."""
        stamp = self._parts / "source"
        if stamp.exists() and stamp.read_text(encoding="utf-8") == source_key():
            return
        if self._parts.exists() and any(self._parts.iterdir()):
            say(f"{self._parts}: was begun by other sources of vipetsc; the run begins again")
            discard(self._parts)
        self._parts.mkdir(parents=True, exist_ok=True)
        write_text(stamp, source_key())

    def ending(self) -> dict[str, Any] | None:
        """Return the root attributes of ``run.h5``; None if the run has not ended. All ranks must call it.

        A ``summary.json`` that is missing is written again. Raises FolderError on all ranks if ``run.h5`` cannot be
        read.
        """
        return on_root(self.comm, self._read_ending)

    def _read_ending(self) -> dict[str, Any] | None:
        """Return the attributes, on one rank; see ``ending``."""
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

    def extension_obstacle(self, then: float, now: float) -> str | None:
        """Return why the run in the folder, which was to end at ``then`` in s, cannot go on to ``now``; None if it can.

        What a longer extension has begun before it was killed is dropped. For one rank.
        """
        is_begun = any(self._parts.glob("*"))
        path = self.folder / "run.h5"
        if now < then:
            ended = then
            # Next to what an extension has begun lies the run from whose end it went on.
            if is_begun and path.exists():
                ended = _end_of(path)
            if not now > ended:
                return f"the run goes to {ended:g} s: set a later time.end"
            discard(self._parts)
            is_begun = False
        if not path.exists() or is_begun:
            return None
        stamp = self._end / "source"
        if not stamp.exists():
            return "the run broke off, or its end-state is gone: nothing can go on; repeat it with --force"
        if stamp.read_text(encoding="utf-8") != source_key():
            return "other sources of vipetsc made the run, whose bits would not go on; repeat it with --force"
        return None

    def reopen(self, end: float) -> None:
        """Let a run that has ended before ``end`` in s go on: divide its file into chunks again. Collective."""
        on_root(self.comm, lambda: self._reopen(end))

    def _reopen(self, end: float) -> None:
        """Divide the file on one rank; see ``reopen``. A kill leaves the run as it was, or reopened."""
        path = self.folder / "run.h5"
        if not path.exists() or any(self._parts.glob("*")):
            return
        aside = self.folder / ".parts.part"
        discard(aside)
        if not _end_of(path) < end:
            return
        with h5py.File(path) as file:
            aside.mkdir()
            count = 1 + path.stat().st_size // CHUNK_BYTES
            for number in range(count):
                save_arrays(aside / self._chunk(number).name, chunks.part_of(file, number, count))
        for state in self._end.glob("state-*.h5"):
            _, rank, size = state.stem.split("-")
            shutil.copy(state, aside / self._state(count - 1, int(rank), int(size)).name)
        shutil.copy(self._end / "source", aside)
        aside.replace(self._parts)

    def _keep_end(self) -> None:
        """Keep the last checkpoint, that of the run's end, from which a longer run goes on."""
        number, size = self._last_complete_state()
        self._end.mkdir()
        for rank in range(size):
            # A copy: after a kill here the run is put together from its parts again. Its name does not have the number
            # of chunks, which depends on where the run was stopped.
            shutil.copy(self._state(number, rank, size), self._end / f"state-{rank}-{size}.h5")
        # Last, as it says that all is there.
        write_text(self._end / "source", source_key())

    def _summarise(self, summary: Mapping[str, Any]) -> None:
        """Write ``summary.json``."""
        write_text(self.folder / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")

    def fields_of_chunk(self, shape: tuple[int, ...]) -> np.ndarray:
        """Return array (sample, field, dof, cell) for this rank's fields of the next chunk, not initialised."""
        return np.empty(shape)

    def append(self, chunk: Arrays) -> None:
        """Store the next chunk, which rank 0 has; all ranks must call it. Raises OSError on all if it cannot write."""
        on_root(self.comm, lambda: save_arrays(self._chunk(self.count), chunk))
        self.count += 1

    def read(self, number: int, wanted: Collection[str]) -> Arrays:
        """Return the arrays ``wanted`` of chunk ``number``."""
        return read_arrays(self._chunk(number), wanted)

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
        return on_every_rank(self.comm, lambda: [StoredArrays(path) for path in paths])

    def _last_complete_state(self) -> tuple[int, int]:
        """Return the number of the last complete checkpoint, and of the ranks that wrote it; (-1, 0) if there is none.

        Files of later chunks and checkpoints are removed.
        """
        names = [path.stem.split("-") for path in self._parts.glob("state-*.h5")]
        counts = Counter((int(number), int(size)) for _, number, _, size in names)
        # A checkpoint is complete when there are as many parts as ranks that wrote it.
        complete = [key for key, count in counts.items() if count == key[1]]
        number, size = max(complete, default=(-1, 0))

        for path in self._parts.glob("*-*.h5"):
            # Another number of ranks, which goes on with the run, would not replace all of them.
            if int(path.stem.split("-")[1]) > number:
                path.unlink()
        return number, size

    def _chunk(self, number: int) -> Path:
        """Return the file of chunk ``number``."""
        return self._parts / f"part-{number:06d}.h5"

    def _state(self, number: int, rank: int, size: int) -> Path:
        """Return the file of a rank's part of the checkpoint after chunk ``number``, which ``size`` ranks wrote."""
        return self._parts / f"state-{number:06d}-{rank}-{size}.h5"

    def finish(self, attributes: Mapping[str, Any], summary: Mapping[str, Any]) -> None:
        """Put the chunks together to ``run.h5``; all ranks must call it. Raises OSError on all if one cannot write.

        ``attributes``, the same on all ranks, become those of the root, with the case; ``summary.json`` holds them and
        ``summary``. The file has a temporary name until it is complete; the chunks are removed after that.
        """
        target = self.folder / "run.h5"

        def write() -> None:
            sys.audit("vipetsc.assemble", str(target))
            small = chunks.run_dataset(self, chunks.small_variables(self), attributes)
            log = chunks.read_log(self)
            with atomic_write(target) as aside, hdf5_file(aside) as file:
                self._fill(file, small, log)
            sys.audit("vipetsc.conclude", str(self.folder))
            self._summarise({**attributes, **summary})
            discard(self._end)
            if attributes["complete"] and self.keeps_end:
                self._keep_end()
            sys.audit("vipetsc.clean", str(self._parts))
            discard(self._parts)

        on_root(self.comm, write)

    def _fill(self, file: h5py.File, small: xr.Dataset, log: np.ndarray) -> None:
        """Put the ``small`` variables, the ``log`` of episodes and the content of the chunks into the ``file``."""
        put_dataset(file, small)
        columns = chunks.log_columns(log)
        sizes = {**small.sizes, "episode": len(log)}
        in_chunks = {}
        for name in (*columns, *self.recording.of_sites, *self.recording.fields):
            description = chunks.described(name, small)
            dtype = np.dtype(float)
            about: dict[str, Any] = description.attributes | chunks.coordinates(name)
            if name in columns:
                dtype = columns[name].dtype
                about |= not_finite_in(columns[name])
            shape = [sizes[dim] for dim in description.dims]
            dataset = add_variable(file, name, description.dims, shape, dtype, about)
            if name not in columns:
                in_chunks[name] = dataset
            elif len(log):
                dataset[...] = columns[name]
        chunks.put_chunks(in_chunks, self)


def _end_of(path: Path) -> float:
    """Return the end in s of the run in the file at ``path``; raises FolderError for one that cannot be read."""
    try:
        with h5py.File(path) as file:
            return float(tomllib.loads(file.attrs["case"])["time"]["end"])
    except OSError as error:
        raise FolderError(f"{path}: {error}; --force repeats the run") from error


class FieldMemory:
    """Memory for the fields of runs that follow one another; those of a run are lost when the next one begins.

    It is used again because the operating system fills new memory with zeros, a tenth of the time that a member of a
    sweep takes.
    """

    def __init__(self) -> None:
        self._numbers = np.empty(0)

    def array(self, shape: tuple[int, ...]) -> np.ndarray:
        """Return an array of this ``shape``, not initialised, in the memory of the last one if that is large enough."""
        size = math.prod(shape)
        if size > self._numbers.size:
            self._numbers = np.empty(size)
        return self._numbers[:size].reshape(shape)


class RunMemory:
    """Output of a run into memory instead of a ``RunFolder``, with the same methods; a run that is stopped is lost.

    Rank 0 of ``comm`` has all fields; they lie in memory as (t, dof, cell), and on one
    rank the engine writes them where they stay.

    Parameters
    ----------
    states_every
        Samples between two checkpoints, which are then kept; by default there are none.
    fields
        Memory for the fields, which one run after another uses; by default each run has its own.

    Attributes
    ----------
    states
        The parts of each checkpoint (checkpoint, rank), on all ranks.
    end_motion
        Displacements and velocities (cell, 2 dof) at the last sample of a complete run, if the caller has set them; the
        dataset then has ``end/displacement`` and ``end/velocity``.
    """

    folder = None
    keeps_end = False
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
        self._variables: dict[str, xr.Variable] | None = None
        self._attributes: Mapping[str, Any] = {}
        self.end_motion: np.ndarray | None = None

    def begin(self, case: str) -> None:
        """Make ready for a run of ``case`` (TOML)."""
        self.case = case
        self.count = 0
        self.states = []
        self._rows = 0
        self._chunks: list[Arrays] = []
        self._variables = None
        # What belongs to the run before, kept by ``cached_property``.
        for name in ("_fields", "dataset"):
            vars(self).pop(name, None)

    @cached_property
    def _fields(self) -> np.ndarray:
        """All fields (sample, field, dof, cell), allocated when they are first used."""
        # Not in ``begin``, since the recording, which has the shape, is set after it.
        dofs = len(self.recording.given["dof"])
        cells = len(self.recording.given["cell"])
        shape = (self.recording.rows, len(self.recording.fields), dofs, cells)
        if self._memory is None:
            return np.empty(shape)
        return self._memory.array(shape)

    def fields_of_chunk(self, shape: tuple[int, ...]) -> np.ndarray:
        """Return array (sample, field, dof, cell) for this rank's fields of the next chunk, not initialised."""
        if self.comm.size > 1:
            return np.empty(shape)
        return self._fields[self._rows : self._rows + shape[0]]

    def append(self, chunk: Arrays) -> None:
        """Store the next chunk, which rank 0 has, in memory."""
        arrays = dict(chunk)
        fields = [arrays.pop(name) for name in self.recording.fields if name in arrays]
        rows = slice(self._rows, self._rows + len(arrays.get("field_time", ())))
        # On one rank the engine has written the fields there already, into the array that it asked for.
        if self.comm.size > 1 and fields:
            self._fields[rows] = np.stack(fields, axis=1)
        self._rows = rows.stop
        self._chunks.append(arrays)
        self.count += 1

    def read(self, number: int, wanted: Collection[str]) -> Arrays:
        """Return all arrays of chunk ``number``, the ``wanted`` ones among them, without a copy."""
        return self._chunks[number]

    def save_state(self, state: Arrays) -> None:
        """Keep the parts of a checkpoint of all ranks; all ranks must call it."""
        self.states.append(self.comm.allgather(state))

    def last_state(self) -> None:
        """Return None: a run in memory cannot be resumed."""

    def finish(self, attributes: Mapping[str, Any], summary: Mapping[str, Any]) -> None:
        """Keep what the dataset consists of; all ranks must call it."""
        import xarray as xr

        if self.comm.rank == 0:
            variables = chunks.small_variables(self)
            large = {**chunks.joined(self, self.recording.of_sites), **chunks.log_columns(chunks.read_log(self))}
            recorded = self._fields[: self._rows].transpose(1, 0, 3, 2)
            large |= dict(zip(self.recording.fields, recorded, strict=True))
            if self.end_motion is not None:
                displacement, velocity = np.split(self.end_motion[self.recording.given["cell"] - 1], 2, axis=1)
                large |= {"end/displacement": displacement, "end/velocity": velocity}
            for name, values in large.items():
                description = chunks.described(name, variables)
                variables[name] = xr.Variable(description.dims, values, description.attributes)
            self._variables = variables
            self._attributes = attributes
        self._chunks = []

    # Who takes a few arrays of thousands of runs, as ``identify`` does, needs no dataset.
    @cached_property
    def dataset(self) -> xr.Dataset | None:
        """The run as of ``open_run``, on rank 0; None on the others and before the end."""
        if self._variables is None:
            return None
        # What is not finite is counted where a file counts it: not in the histories, which are large.
        large = {*self.recording.of_sites, *self.recording.fields}
        for name, item in self._variables.items():
            if name not in large:
                item.attrs |= not_finite_in(item.values)
        # In one call, since xarray compares the dimensions of all variables whenever some are added.
        return with_point_names(chunks.run_dataset(self, self._variables, self._attributes))

    def values(self, name: str) -> np.ndarray:
        """Return the values of a variable of a run that has ended, on rank 0."""
        assert self._variables is not None
        return np.asarray(self._variables[name].values)


RunOutput = RunFolder | RunMemory
