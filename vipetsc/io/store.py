"""Where a run goes: a folder, which ends with ``run.h5`` and ``summary.json``, or memory.

While a run goes on, its samples are kept as chunks: chunk k holds those between the checkpoints k - 1 and k. A chunk
and a checkpoint are named arrays; a rank writes its share of each into a file of its own, so nothing is sent while a
run goes on. Every share says what it is of, so that another number of ranks can go on with it. When the run has
ended, ``io.chunks`` puts them together. Fields (t, cell, dof) and losses (t, site) are too large to be held whole: they
are copied chunk by chunk, to a file of one rank or to one that all ranks share; these hold a part of the log each.
"""

import json
import os
import sys
import tomllib
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from mpi4py import MPI

import h5py
import numpy as np
import xarray as xr

from vipetsc.io import chunks
from vipetsc.io.atomic import Arrays, discard, load_arrays, save_arrays, unwritten, write_text
from vipetsc.io.chunks import LOSSES, Recording
from vipetsc.io.lock import FolderError
from vipetsc.io.netcdf import add_variable, put_dataset
from vipetsc.io.read import open_run
from vipetsc.parallel import on_every_rank, on_root, sort_over_ranks

GATHER_LIMIT = 2 * 2**30  # bytes of fields above which writer = "auto" has every rank write its own


class RunFolder:
    """The folder of one run: ``case.toml``, ``parts/`` while it runs, ``run.h5`` and ``summary.json`` after.

    It takes the run's chunks, ``count`` of them, on all ranks of ``comm`` together, and puts them together at the end;
    ``recording`` tells it what they hold.
    """

    recording: Recording

    def __init__(self, folder: Path, comm: MPI.Comm) -> None:
        self.folder, self.comm, self.count = Path(folder), comm, 0
        self._parts = self.folder / "parts"

    def begin(self, case: str) -> None:
        """Make ready for a run of ``case`` (TOML), or for one that goes on; all ranks must call it."""
        self.case = case
        on_root(self.comm, lambda: self._parts.mkdir(parents=True, exist_ok=True))

    def ending(self) -> dict[str, Any] | None:
        """The root attributes of ``run.h5``; None if the run has not ended. All ranks must call it.

        ``summary.json`` is written again where it is lost. Raises FolderError if ``run.h5`` cannot be read.
        """

        def read() -> dict[str, Any] | None:
            path = self.folder / "run.h5"
            if not path.exists() or any(self._parts.glob("*")):
                return None
            try:
                with open_run(path) as run:
                    told = {key: np.asarray(value).item() for key, value in run.attrs.items()}
            except (OSError, ValueError) as error:
                raise FolderError(f"{error}; --force makes the run again") from error
            told |= {key: json.loads(told[key]) for key in ("statistics", "warnings") if key in told}
            if not (self.folder / "summary.json").exists():
                self._summarise(told | {"case": tomllib.loads(told["case"])})
            return told

        return on_root(self.comm, read)

    def _summarise(self, told: Mapping[str, Any]) -> None:
        write_text(self.folder / "summary.json", json.dumps(told, indent=2, allow_nan=False) + "\n")

    def room(self, shape: tuple[int, ...]) -> np.ndarray:
        """Room (field, sample, dof, cell) for this rank's fields of the next chunk."""
        return np.empty(shape)

    def append(self, chunk: Arrays | None) -> None:
        """Keep this rank's share of the next chunk, None for no share; all ranks must call it.

        Raises OSError on all ranks if one cannot write.
        """
        path = self._chunk(self.count, self.comm.rank)
        on_every_rank(self.comm, lambda: None if chunk is None else save_arrays(path, chunk))
        self.count += 1

    def read(self, number: int, rank: int, wanted: Collection[str]) -> Arrays:
        """The arrays ``wanted`` of chunk ``number`` as ``rank`` kept it."""
        return load_arrays(self._chunk(number, rank), wanted)

    def save_state(self, state: Arrays) -> None:
        """Keep this rank's checkpoint after the last chunk, and the one before; as ``append``."""
        number, path = self.count - 1, self._state(self.count - 1, self.comm.rank, self.comm.size)

        def replace_oldest() -> None:
            save_arrays(path, state)
            if self.comm.rank == 0:
                for old in self._parts.glob(f"state-{number - 2:06d}-*"):
                    old.unlink()

        on_every_rank(self.comm, replace_oldest)

    def last_state(self) -> Sequence[Arrays] | None:
        """Go back to the last checkpoint that is complete, if there is one: ``count``, and the shares of all its ranks.

        However many there were; all ranks must call it.
        """

        def last_complete() -> tuple[int, int]:
            names = [path.stem.split("-") for path in self._parts.glob("state-*.npy")]
            counts = Counter((int(number), int(size)) for _, number, _, size in names)
            last = max((key for key, count in counts.items() if count == key[1]), default=(-1, 0))
            for path in self._parts.glob("*-*-*.npy"):
                if int(path.stem.split("-")[1]) > last[0]:
                    path.unlink()  # another number of ranks would not replace it
            return last

        number, size = on_root(self.comm, last_complete)
        self.count = number + 1
        paths = [self._state(number, rank, size) for rank in range(size)]
        return on_every_rank(self.comm, lambda: [load_arrays(path, copy=False) for path in paths]) if paths else None

    def _chunk(self, number: int, rank: int) -> Path:
        return self._parts / f"part-{number:06d}-{rank}.npy"

    def _state(self, number: int, rank: int, size: int) -> Path:
        return self._parts / f"state-{number:06d}-{rank}-{size}.npy"

    def ranks(self, number: int) -> list[int]:
        """Those that kept a share of chunk ``number``."""
        return [int(path.stem.split("-")[2]) for path in self._parts.glob(f"part-{number:06d}-*.npy")]

    def finish(self, attributes: Mapping[str, Any], summary: Mapping[str, Any]) -> None:
        """Put the chunks together; all ranks must call it. Raises OSError on all ranks if one cannot write.

        ``attributes`` besides the case are the root's, the same on all ranks; ``summary.json`` tells them and
        ``summary``. ``run.h5`` takes its name when it is complete, then the chunks go.
        """
        target, aside, together = self.folder / "run.h5", self.folder / ".run.h5.part", self.recording.together

        def read_chunks() -> tuple[xr.Dataset, np.ndarray] | None:
            sys.audit("vipetsc.assemble", str(target))
            writes = together or self.comm.rank == 0
            return (chunks.small_dataset(self, attributes), chunks.read_log(self)) if writes else None

        def write() -> None:
            try:
                with h5py.File(aside, "w", **({"driver": "mpio", "comm": self.comm} if together else {})) as file:
                    put_dataset(file, data, write=self.comm.rank == 0)
                    columns, sizes = chunks.log_columns(log, first), {**data.sizes, "episode": total}
                    # All of them first: ranks create together, but each copies and may fail alone.
                    large = {}
                    for name in (*columns, LOSSES, *self.recording.fields):
                        dims, about = chunks.described(name, data)
                        dtype = columns[name].dtype if name in columns else float
                        about |= chunks.coordinates(name)
                        large[name] = add_variable(file, name, dims, [sizes[dim] for dim in dims], dtype, about)
                    for name, dataset in large.items():
                        if name not in columns:
                            chunks.put_chunks(dataset, self, name)
                        elif log.size:
                            dataset[first : first + log.size] = columns[name]
            except (OSError, RuntimeError) as error:  # h5py raises either when HDF5 cannot write
                raise unwritten(target, error) from error

        def conclude() -> None:
            sys.audit("vipetsc.conclude", str(self.folder))
            os.replace(aside, target)
            self._summarise({**attributes, **summary})
            sys.audit("vipetsc.clean", str(self._parts))
            discard(self._parts)

        try:
            # A rank that cannot must not leave the others creating a file.
            parts = on_every_rank(self.comm, read_chunks)
            if parts:
                data, (log, first, total) = parts[0], sort_over_ranks(chunks.writers(self), parts[1], ("onset", "site"))
            on_every_rank(self.comm, write if parts else lambda: None)
            on_root(self.comm, conclude)
        finally:
            if self.comm.rank == 0:
                aside.unlink(missing_ok=True)


class RunMemory:
    """Keeps a run in memory: ``dataset`` on rank 0 of ``comm``, None on the others and before its end.

    It is used as a ``RunFolder``. Its fields are gathered whatever the case's writer is; a run that is stopped is lost.
    They lie in memory as (t, dof, cell): on one rank the engine writes them where they stay. ``end`` are the
    displacements and velocities (cell, 2 dof) at the last sample of a run that is complete; see ``end/displacement``.
    """

    folder = None
    recording: Recording

    def __init__(self, comm: MPI.Comm = MPI.COMM_SELF) -> None:
        self.comm, self.count = comm, 0
        self.dataset: xr.Dataset | None = None
        self.end: np.ndarray | None = None

    def begin(self, case: str) -> None:
        """Make ready."""
        self.case, self.count, self._rows = case, 0, 0
        self._chunks: list[Arrays] = []
        vars(self).pop("_fields", None)

    @cached_property
    def _fields(self) -> np.ndarray:
        sizes = (len(self.recording.given[name]) for name in ("dof", "cell"))
        return np.empty((len(self.recording.fields), self.recording.rows, *sizes))

    def room(self, shape: tuple[int, ...]) -> np.ndarray:
        """Room (field, sample, dof, cell) for this rank's fields of the next chunk."""
        return self._fields[:, self._rows :][:, : shape[1]] if self.comm.size == 1 else np.empty(shape)

    def append(self, chunk: Arrays | None) -> None:
        """Keep the next chunk."""
        arrays = dict(chunk or {})
        fields = [arrays.pop(name) for name in self.recording.fields if name in arrays]
        rows = slice(self._rows, self._rows + len(arrays.get("field_time", ())))
        if self.comm.size > 1 and fields:
            self._fields[:, rows] = fields
        self._rows = rows.stop
        self._chunks.append(arrays)
        self.count += 1

    def ranks(self, number: int) -> list[int]:
        """Rank 0 alone."""
        return [0]

    def read(self, number: int, rank: int, wanted: Collection[str]) -> Arrays:
        """Chunk ``number`` of this rank, which has what is ``wanted``."""
        return self._chunks[number]

    def save_state(self, state: Arrays) -> None:
        """Nothing: a run in memory cannot be gone on with."""

    def last_state(self) -> None:
        """No checkpoint."""

    def finish(self, attributes: Mapping[str, Any], summary: Mapping[str, Any]) -> None:
        """Make the dataset; all ranks must call it."""
        if self.comm.rank == 0:
            self.dataset = chunks.small_dataset(self, attributes)
            log, *_ = sort_over_ranks(MPI.COMM_SELF, chunks.read_log(self), ("onset", "site"))
            fields = dict(zip(self.recording.fields, self._fields[:, : self._rows].swapaxes(2, 3), strict=True))
            if self.end is not None:
                last = np.split(self.end[self.recording.given["cell"] - 1], 2, axis=1)
                fields |= dict(zip(("end/displacement", "end/velocity"), last, strict=True))
            for name, values in {**chunks.joined(self, [LOSSES]), **chunks.log_columns(log), **fields}.items():
                dims, about = chunks.described(name, self.dataset)
                self.dataset[name] = dims, values, about
        self._chunks = []


RunOutput = RunFolder | RunMemory
