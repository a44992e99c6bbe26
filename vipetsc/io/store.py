"""Where a run goes: a folder, which ends with ``run.h5`` and ``summary.json``, or memory.

While a run goes on, its samples are kept as chunks (``io.chunks``); when it has ended they become one dataset in the
layout of ``io.netcdf``. Fields (t, cell, dof) are too large to be held whole: a writer is a context manager that gives
a mapping by which ``fields[name][samples, cells] = values`` puts them where they belong, in a file of one rank, in one
that all ranks share, or in memory; the writers differ in open and close only.
"""

import json
import os
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from mpi4py import MPI

import h5py
import numpy as np
import xarray as xr

from vipetsc.io.atomic import write_text
from vipetsc.io.chunks import ChunkFiles, ChunkList
from vipetsc.io.folder import RUN, claim_folder
from vipetsc.io.netcdf import add_variable, put_dataset, variable
from vipetsc.parallel import on_every_rank, on_root

Chunks = ChunkFiles | ChunkList
GATHER_LIMIT = 2 * 2**30  # bytes of fields above which writer = "auto" has every rank write its own
FIELDS = {"displacement": "m", "velocity": "m/s"}
LEDGER = {
    "kinetic": "kinetic energy",
    "spring": "energy of the springs",
    "contact": "elastic energy of the contacts",
    "work": "work done by the drive",
    "dissipated": "energy dissipated in contacts",
}
IMPACTS = {
    "site": ("1", "site, counted from 1"),
    "side": ("1", "side of the clearance: +1 or -1"),
    "onset": ("s", "time of onset"),
    "approach_velocity": ("m/s", "relative velocity at onset, w'_minus"),
    "separation": ("s", "time of separation; NaN if still in contact"),
    "indentation": ("m", "largest indentation"),
    "force": ("N", "largest contact force"),
    "loss": ("J", "energy dissipated in the episode"),
}


@dataclass(frozen=True)
class RunDescription:
    """What ``run.h5`` tells of its case.

    ``case``: as TOML; ``cells`` (cell,): the recorded ones of the whole lattice, from 1; ``dofs``: masses in a cell;
    ``sites`` (site,): their cells, from 1; ``clearances`` (site,) in m; ``fields``: which of ``FIELDS`` are recorded.
    """

    case: str
    cells: np.ndarray
    dofs: int
    sites: tuple[int, ...]
    clearances: tuple[float, ...]
    fields: tuple[str, ...]


class RunOutput(ABC):
    """Takes a run's ``chunks``, on all ranks of ``comm`` together, and what is told of it when it has ended.

    ``shared`` outputs let every rank write its own cells; ``folder`` is None for a run in memory.
    """

    shared: ClassVar[bool]
    folder: Path | None
    comm: MPI.Comm
    chunks: Chunks

    @abstractmethod
    def begin(self, description: RunDescription, force: bool, resume: bool) -> None:
        """Make ready for a run, or for one that goes on; all ranks must call it. Raises FolderError."""

    @abstractmethod
    def finish(self, attributes: Mapping[str, Any], columns: slice | None, summary: Mapping[str, Any]) -> None:
        """Put the chunks together; all ranks must call it. Raises OSError on all ranks if one cannot write.

        Parameters
        ----------
        attributes
            Root attributes besides the case; the same on all ranks.
        columns
            The recorded cells whose fields this rank's chunks hold; None: rank 0's hold those of all.
        summary
            What ``summary.json`` tells besides ``attributes``.
        """


class RunFolder(RunOutput):
    """The folder of one run: ``case.toml``, ``parts/`` while it runs, ``run.h5`` and ``summary.json`` after."""

    shared = True

    def __init__(self, folder: Path, comm: MPI.Comm) -> None:
        self._path = self.folder = Path(folder)
        self.comm = comm
        self.chunks = ChunkFiles(self._path / "parts", comm)

    def begin(self, description: RunDescription, force: bool, resume: bool) -> None:
        """See ``RunOutput``."""
        self._description = description

        def claim() -> None:
            claim_folder(self._path, RUN, description.case, force=force, resume=resume)
            self.chunks.begin()

        on_root(self.comm, claim)

    def finish(self, attributes: Mapping[str, Any], columns: slice | None, summary: Mapping[str, Any]) -> None:
        """See ``RunOutput``: ``run.h5`` takes its name when it is complete, then the chunks go."""
        target, aside = self._path / "run.h5", self._path / ".run.h5.part"

        def write() -> None:
            if columns is None and self.comm.rank:
                return
            names, sharing = self._description.fields, None if columns is None else self.comm
            data = run_dataset(self._description, self.chunks, attributes)
            try:
                with fields_in_file(aside, data, names, sharing) as fields:
                    put_chunks(fields, self.chunks, self.comm.rank, names, columns or slice(None))
            except (OSError, RuntimeError) as error:  # h5py raises either when HDF5 cannot write
                message = f"{target} could not be written; make room and go on with --resume: {error}"
                raise OSError(message) from error

        def conclude() -> None:
            os.replace(aside, target)
            text = json.dumps({**attributes, **summary}, indent=2, allow_nan=False)
            write_text(self._path / "summary.json", text + "\n")
            self.chunks.remove()

        try:
            on_every_rank(self.comm, write)
            on_root(self.comm, conclude)
        finally:
            if self.comm.rank == 0:
                aside.unlink(missing_ok=True)


class RunMemory(RunOutput):
    """Keeps a run in memory: ``dataset`` on rank 0 of ``comm``, None on the others and before its end.

    Its fields are gathered whatever the case's writer is; a run that is stopped is lost.
    """

    shared = False
    folder = None

    def __init__(self, comm: MPI.Comm = MPI.COMM_SELF) -> None:
        self.comm, self.chunks = comm, ChunkList()
        self.dataset: xr.Dataset | None = None

    def begin(self, description: RunDescription, force: bool, resume: bool) -> None:
        """See ``RunOutput``; raises ValueError for ``resume``."""
        if resume:
            raise ValueError("a run in memory cannot be resumed")
        self._description = description
        self.chunks.begin()

    def finish(self, attributes: Mapping[str, Any], columns: slice | None, summary: Mapping[str, Any]) -> None:
        """See ``RunOutput``."""
        if self.comm.rank == 0:
            names = self._description.fields
            self.dataset = run_dataset(self._description, self.chunks, attributes)
            with fields_in_memory(self.dataset, names) as fields:
                put_chunks(fields, self.chunks, 0, names, slice(None))
        self.chunks.remove()


@contextmanager
def fields_in_file(
    path: Path, data: xr.Dataset, names: tuple[str, ...], comm: MPI.Comm | None = None
) -> Iterator[Mapping[str, Any]]:
    """The fields ``names`` of a new file with all of ``data``: of one rank's, or of one that ``comm`` shares."""
    with h5py.File(path, "w", **({"driver": "mpio", "comm": comm} if comm else {})) as file:
        put_dataset(file, data, write=comm is None or comm.rank == 0)
        for name, (dims, shape, attributes) in describe_fields(data, names).items():
            add_variable(file, name, dims, shape, float, attributes)
        yield file


@contextmanager
def fields_in_memory(data: xr.Dataset, names: tuple[str, ...]) -> Iterator[Mapping[str, Any]]:
    """The fields ``names`` as arrays, which become variables of ``data``."""
    described = describe_fields(data, names)
    arrays = {name: np.empty(shape) for name, (_, shape, _) in described.items()}
    yield arrays
    for name, (dims, _, attributes) in described.items():
        data[name] = dims, arrays[name], attributes


def describe_fields(data: xr.Dataset, names: tuple[str, ...]) -> dict[str, tuple[list[str], list[int], dict[str, str]]]:
    """Dimensions, shape and attributes of the fields ``names`` beside ``data``."""
    dims = ["field_time" if "field_time" in data else "time", "cell", "dof"]
    shape = [data.sizes[dim] for dim in dims]
    return {name: (dims, shape, {"units": FIELDS[name], "long_name": f"{name} of each mass"}) for name in names}


def put_chunks(fields: Mapping[str, Any], chunks: Chunks, rank: int, names: tuple[str, ...], columns: slice) -> None:
    """Copy the fields ``names`` of all ``chunks`` of ``rank`` to the cells ``columns`` of ``fields``."""
    first = 0
    for number in range(chunks.count if names else 0):
        chunk = chunks.read(number, rank, names)
        samples = slice(first, first + len(chunk[names[0]]))
        for name in names:
            # h5py leaves out empty selections, on which writing together would hang.
            if chunk[name].size:
                fields[name][samples, columns] = chunk[name]
        first = samples.stop


def run_dataset(description: RunDescription, chunks: Chunks, attributes: Mapping[str, Any]) -> xr.Dataset:
    """All of a run but its fields, from the chunks of rank 0; episodes in the order of their onsets."""
    wanted = {"time", "field_time", "dissipated_by_site", *LEDGER, *(f"impact_{name}" for name in IMPACTS)}
    parts = [chunks.read(number, 0, wanted) for number in range(chunks.count)]
    table = {name: np.concatenate([part[name] for part in parts]) for name in wanted}
    order = np.lexsort((table["impact_site"], table["impact_onset"]))
    sites, clearances = np.asarray(description.sites, np.int64), np.asarray(description.clearances, float)
    by_site = variable(("time", "site"), table["dissipated_by_site"], "J", "energy dissipated at each site")
    variables = {
        "time": variable("time", table["time"], "s", "time"),
        "cell": variable("cell", description.cells, "1", "cell, counted from 1"),
        "dof": variable("dof", np.arange(1, description.dofs + 1), "1", "mass within the cell, from 1"),
        "site": variable("site", np.arange(1, len(sites) + 1), "1", "contact site, from 1"),
        "episode": variable("episode", np.arange(1, len(order) + 1), "1", "contact episode, by onset"),
        "sites/cell": variable("site", sites, "1", "cell of the site"),
        "sites/clearance": variable("site", clearances, "m", "clearance of the site"),
        **{f"energy/{name}": variable("time", table[name], "J", text) for name, text in LEDGER.items()},
        "energy/dissipated_by_site": by_site,
    }
    for name, (units, text) in IMPACTS.items():
        variables[f"impacts/{name}"] = variable("episode", table[f"impact_{name}"][order], units, text)
    if len(table["field_time"]) != len(table["time"]):
        variables["field_time"] = variable("field_time", table["field_time"], "s", "time of the recorded fields")
    return xr.Dataset(variables, attrs={"case": description.case, **attributes})
