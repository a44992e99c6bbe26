"""Where a run goes: a folder, which ends with ``run.h5`` and ``summary.json``, or memory.

While a run goes on, its samples are kept as chunks: chunk k holds those between the checkpoints k - 1 and k. A chunk
and a checkpoint are named arrays; a rank writes its share of each into a file of its own, so nothing is sent while a
run goes on. Every share says what it is of, so that another number of ranks can go on with it: fields come with
``columns``, the half-open range of the recorded cells that they are of. When the run has ended, the chunks become one
dataset in the layout of ``io.netcdf``. Its fields (t, cell, dof) are too large to be held whole: they are copied chunk
by chunk, to a file of one rank or to one that all ranks share.
"""

import json
import os
import sys
import tomllib
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

import h5py
import numpy as np
import xarray as xr

from vipetsc.io.atomic import Arrays, discard, load_arrays, save_arrays, unwritten, write_text
from vipetsc.io.lock import FolderError
from vipetsc.io.netcdf import add_variable, put_dataset, tabulated
from vipetsc.io.read import open_run
from vipetsc.parallel import on_every_rank, on_root

GATHER_LIMIT = 2 * 2**30  # bytes of fields above which writer = "auto" has every rank write its own
FIELDS = {
    "displacement": {"units": "m", "long_name": "displacement of each mass"},
    "velocity": {"units": "m/s", "long_name": "velocity of each mass"},
}
# Name in the file: dimensions, units, text. What a chunk holds besides fields, and what is known from the beginning.
SAMPLED = {
    "time": ("time", "s", "time"),
    "field_time": ("field_time", "s", "time of the recorded fields"),
    "energy/kinetic": ("time", "J", "kinetic energy"),
    "energy/spring": ("time", "J", "energy of the springs"),
    "energy/contact": ("time", "J", "elastic energy of the contacts"),
    "energy/work": ("time", "J", "work done by the drive"),
    "energy/dissipated": ("time", "J", "energy dissipated in contacts"),
    "energy/dissipated_by_site": ("time site", "J", "energy dissipated at each site"),
    "impacts/site": ("episode", "1", "site, counted from 1"),
    "impacts/side": ("episode", "1", "side of the clearance: +1 or -1"),
    "impacts/onset": ("episode", "s", "time of onset"),
    "impacts/approach_velocity": ("episode", "m/s", "relative velocity at onset, w'_minus"),
    "impacts/separation": ("episode", "s", "time of separation; NaN if still in contact"),
    "impacts/indentation": ("episode", "m", "largest indentation"),
    "impacts/force": ("episode", "N", "largest contact force"),
    "impacts/loss": ("episode", "J", "energy dissipated in the episode"),
}
GIVEN = {
    "cell": ("cell", "1", "cell, counted from 1"),
    "dof": ("dof", "1", "mass within the cell, from 1"),
    "site": ("site", "1", "contact site, from 1"),
    "episode": ("episode", "1", "contact episode, by onset"),
    "sites/cell": ("site", "1", "cell of the site"),
    "sites/clearance": ("site", "m", "clearance of the site"),
}


@dataclass(frozen=True)
class Recording:
    """What the chunks of a run hold.

    ``given``: the arrays of ``GIVEN``, but for the episodes; ``fields``: those of ``FIELDS`` that are recorded;
    ``together``: whether all ranks write the fields into one file that they share, instead of rank 0 alone.
    """

    given: Arrays
    fields: tuple[str, ...]
    together: bool


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
        return on_every_rank(self.comm, lambda: [load_arrays(path) for path in paths]) if paths else None

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

        def read_chunks() -> xr.Dataset | None:
            sys.audit("vipetsc.assemble", str(target))
            return dataset_without_fields(self, attributes) if together or self.comm.rank == 0 else None

        def write() -> None:
            if data is None:
                return
            try:
                with h5py.File(aside, "w", **({"driver": "mpio", "comm": self.comm} if together else {})) as file:
                    put_dataset(file, data, write=self.comm.rank == 0)
                    dims = field_dimensions(data)
                    shape = [data.sizes[dim] for dim in dims]
                    # All of them first: ranks create together, but each copies and may fail alone.
                    fields = {n: add_variable(file, n, dims, shape, float, FIELDS[n]) for n in self.recording.fields}
                    for name, field in fields.items():
                        put_chunks(field, self, name)
            except (OSError, RuntimeError) as error:  # h5py raises either when HDF5 cannot write
                raise unwritten(target, error) from error

        def conclude() -> None:
            sys.audit("vipetsc.conclude", str(self.folder))
            os.replace(aside, target)
            self._summarise({**attributes, **summary})
            sys.audit("vipetsc.clean", str(self._parts))
            discard(self._parts)

        try:
            data = on_every_rank(self.comm, read_chunks)  # a rank that cannot must not leave the others creating a file
            on_every_rank(self.comm, write)
            on_root(self.comm, conclude)
        finally:
            if self.comm.rank == 0:
                aside.unlink(missing_ok=True)


class RunMemory:
    """Keeps a run in memory: ``dataset`` on rank 0 of ``comm``, None on the others and before its end.

    It is used as a ``RunFolder``. Its fields are gathered whatever the case's writer is; a run that is stopped is lost.
    """

    folder = None
    recording: Recording

    def __init__(self, comm: MPI.Comm = MPI.COMM_SELF) -> None:
        self.comm, self.count = comm, 0
        self.dataset: xr.Dataset | None = None

    def begin(self, case: str) -> None:
        """Make ready."""
        self.case, self.count = case, 0
        self._chunks: list[Arrays] = []

    def append(self, chunk: Arrays | None) -> None:
        """Keep the next chunk."""
        self._chunks.append(chunk or {})
        self.count += 1

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
            self.dataset = dataset_without_fields(self, attributes)
            for name, values in joined(self, self.recording.fields).items():
                self.dataset[name] = field_dimensions(self.dataset), values, FIELDS[name]
        self._chunks = []


RunOutput = RunFolder | RunMemory


def joined(output: RunOutput, names: Collection[str]) -> dict[str, np.ndarray]:
    """The arrays ``names`` of rank 0, those of all chunks one after the other."""
    chunks = [output.read(number, 0, names) for number in range(output.count)]
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in names}


def dataset_without_fields(output: RunOutput, attributes: Mapping[str, Any]) -> xr.Dataset:
    """All of a run but its fields, from the chunks of rank 0; episodes in the order of their onsets."""
    arrays = joined(output, SAMPLED)
    order = np.lexsort((arrays["impacts/site"], arrays["impacts/onset"]))
    arrays |= {name: values[order] for name, values in arrays.items() if name.startswith("impacts/")}
    if len(arrays["field_time"]) == len(arrays["time"]):
        del arrays["field_time"]
    arrays |= {**output.recording.given, "episode": np.arange(1, len(order) + 1)}
    return xr.Dataset(tabulated(SAMPLED | GIVEN, arrays), attrs={"case": output.case, **attributes})


def field_dimensions(data: xr.Dataset) -> list[str]:
    """Dimensions of the fields beside ``data``."""
    return ["field_time" if "field_time" in data else "time", "cell", "dof"]


def put_chunks(field: h5py.Dataset, output: RunFolder, name: str) -> None:
    """Copy the field ``name`` of all chunks to ``field``; ranks that write together share the files."""
    first, comm = 0, output.comm
    for number in range(output.count):
        rows = output.read(number, 0, ["field_time"])["field_time"].size
        for rank in output.ranks(number):
            if output.recording.together and rank % comm.size != comm.rank:
                continue
            share = output.read(number, rank, [name, "columns"])
            # h5py leaves out empty selections, on which writing together would hang.
            if share[name].size:
                field[first : first + rows, slice(*share["columns"])] = share[name]
        first += rows
