"""Where a run goes: a folder, which ends with ``run.h5`` and ``summary.json``, or memory.

While a run goes on, its samples are kept as chunks (``io.chunks``); when it has ended they become one dataset in the
layout of ``io.netcdf``, by one of the writers of ``io.writers``. Every file is whole or not there, so that a reader,
or a run that goes on after a kill, never meets a half one.
"""

from __future__ import annotations

import json
import os
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from mpi4py import MPI

import h5py
import numpy as np
import xarray as xr

from vipetsc.io import folder as folders
from vipetsc.io.atomic import write_text
from vipetsc.io.chunks import ChunkFiles, ChunkList
from vipetsc.io.folder import RUN, FolderError
from vipetsc.io.netcdf import variable
from vipetsc.io.writers import fields_in_file, fields_in_memory
from vipetsc.parallel import on_every_rank, on_root

GATHER_LIMIT = 2 * 2**30  # bytes of fields above which writer = "auto" has every rank write its own

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

    Attributes
    ----------
    case
        The resolved case as TOML.
    cells
        (cell,) the recorded cells of the whole lattice, from 1.
    dofs
        Masses in a cell.
    sites, clearances
        (site,) cells of the contact sites, from 1, and their clearances in m.
    fields
        Which of ``displacement`` and ``velocity`` are recorded.
    """

    case: str
    cells: np.ndarray
    dofs: int
    sites: tuple[int, ...]
    clearances: tuple[float, ...]
    fields: tuple[str, ...]


class RunOutput(ABC):
    """Takes a run's chunks and checkpoints, and what is told of it when it has ended.

    ``chunks`` are written on all ranks of ``comm`` together; ``shared`` outputs let every rank write its own cells.
    """

    shared: ClassVar[bool]
    comm: MPI.Comm

    @property
    @abstractmethod
    def chunks(self) -> ChunkFiles | ChunkList:
        """The chunks and checkpoints of the run."""

    @property
    def folder(self) -> Path | None:
        """The folder that holds the run, if one does."""
        return None

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

    def __init__(self, path: Path, comm: MPI.Comm) -> None:
        self.path = Path(path)
        self.comm = comm
        self._chunks = ChunkFiles(self.path / "parts", comm)

    @property
    def chunks(self) -> ChunkFiles:
        """See ``RunOutput``."""
        return self._chunks

    @property
    def folder(self) -> Path:
        """See ``RunOutput``."""
        return self.path

    @property
    def run_file(self) -> Path:
        """The finished run."""
        return self.path / "run.h5"

    def begin(self, description: RunDescription, force: bool, resume: bool) -> None:
        """See ``RunOutput``."""
        self._description = description

        def claim() -> None:
            folders.claim_folder(self.path, RUN, description.case, force=force, resume=resume)
            self._chunks.folder.mkdir(exist_ok=True)

        on_root(self.comm, claim)

    def finish(self, attributes: Mapping[str, Any], columns: slice | None, summary: Mapping[str, Any]) -> None:
        """See ``RunOutput``: ``run.h5`` takes its name when it is complete, then the chunks go."""
        aside = self.path / f".{self.run_file.name}.part"

        def write() -> None:
            if columns is None and self.comm.rank:
                return
            data = run_dataset(self._description, self.chunks, attributes)
            names, sharing = self._description.fields, None if columns is None else self.comm
            try:
                with fields_in_file(aside, data, names, sharing) as fields:
                    put_chunks(fields, self.chunks, self.comm.rank, names, columns or slice(None))
            except (OSError, RuntimeError) as error:  # h5py raises either when HDF5 cannot write
                message = f"{self.run_file} could not be written; make room and go on with --resume: {error}"
                raise OSError(message) from error

        def conclude() -> None:
            os.replace(aside, self.run_file)
            text = json.dumps({**attributes, **summary}, indent=2, allow_nan=False)
            write_text(self.path / "summary.json", text + "\n")
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

    def __init__(self, comm: MPI.Comm = MPI.COMM_SELF) -> None:
        self.comm = comm
        self._chunks = ChunkList()
        self.dataset: xr.Dataset | None = None

    @property
    def chunks(self) -> ChunkList:
        """See ``RunOutput``."""
        return self._chunks

    def begin(self, description: RunDescription, force: bool, resume: bool) -> None:
        """See ``RunOutput``; raises ValueError for ``resume``."""
        if resume:
            raise ValueError("a run in memory cannot be resumed")
        self._description = description
        self.chunks.remove()

    def finish(self, attributes: Mapping[str, Any], columns: slice | None, summary: Mapping[str, Any]) -> None:
        """See ``RunOutput``."""
        if self.comm.rank == 0:
            names = self._description.fields
            self.dataset = run_dataset(self._description, self.chunks, attributes)
            with fields_in_memory(self.dataset, names) as fields:
                put_chunks(fields, self.chunks, 0, names, slice(None))
        self.chunks.remove()


def put_chunks(
    fields: Mapping[str, Any], chunks: ChunkFiles | ChunkList, rank: int, names: tuple[str, ...], columns: slice
) -> None:
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


def run_dataset(
    description: RunDescription, chunks: ChunkFiles | ChunkList, attributes: Mapping[str, Any]
) -> xr.Dataset:
    """All of a run but its fields, from the chunks of rank 0; episodes in the order of their onsets."""
    wanted = {"time", "field_time", "dissipated_by_site", *LEDGER, *(f"impact_{name}" for name in IMPACTS)}
    parts = [chunks.read(number, 0, wanted) for number in range(chunks.count)]
    table = {name: np.concatenate([part[name] for part in parts]) for name in wanted}
    order = np.lexsort((table["impact_site"], table["impact_onset"]))
    sites, clearances = np.asarray(description.sites, np.int64), np.asarray(description.clearances, float)
    variables = {
        "time": variable("time", table["time"], "s", "time"),
        "cell": variable("cell", description.cells, "1", "cell, counted from 1"),
        "dof": variable("dof", np.arange(1, description.dofs + 1), "1", "mass within the cell, from 1"),
        "site": variable("site", np.arange(1, len(sites) + 1), "1", "contact site, from 1"),
        "episode": variable("episode", np.arange(1, len(order) + 1), "1", "contact episode, by onset"),
        "sites/cell": variable("site", sites, "1", "cell of the site"),
        "sites/clearance": variable("site", clearances, "m", "clearance of the site"),
    }
    if len(table["field_time"]) != len(table["time"]):
        text = "time of the recorded fields"
        variables["field_time"] = variable("field_time", table["field_time"], "s", text)
    for name, text in LEDGER.items():
        variables[f"energy/{name}"] = variable("time", table[name], "J", text)
    text = "energy dissipated at each site"
    variables["energy/dissipated_by_site"] = variable(("time", "site"), table["dissipated_by_site"], "J", text)
    for name, (units, text) in IMPACTS.items():
        variables[f"impacts/{name}"] = variable("episode", table[f"impact_{name}"][order], units, text)
    return xr.Dataset(variables, attrs={"case": description.case, **attributes})


def claim_folder(path: Path, force: bool, foreign: tuple[str, ...], begun: str = "") -> None:
    """Make ``path`` an output folder; what is in it is ours to replace only with ``force``.

    Parameters
    ----------
    path
        The folder, made if it is not there.
    force
        Whether results of the same kind may be replaced.
    foreign
        Patterns of files that show that the folder holds results of another kind.
    begun
        What else a user can do about unfinished results in it.

    Raises
    ------
    FolderError
        If it is a file, holds anything but our results of this kind, or holds those and ``force`` is off.
    """
    if path.exists() and not path.is_dir():
        raise FolderError(f"{path}: is a file, not a folder; choose another --out")
    if path.is_dir() and any(path.iterdir()):
        if not (path / "case.toml").exists() or any(any(path.glob(pattern)) for pattern in foreign):
            raise FolderError(f"{path}: holds files that are not a run's of this kind; choose another --out")
        if not force:
            raise FolderError(f"{path}: exists; {begun}--force replaces what is in it, --out chooses another")
    path.mkdir(parents=True, exist_ok=True)


class Coordinates:
    """Writes datasets with named dimensions into an HDF5 file, as netCDF-4 does."""

    def __init__(self, file: h5py.File) -> None:
        self.file = file

    def add(self, name: str, values: np.ndarray, unit: str, text: str, write: bool = True) -> None:
        """A coordinate: a one-dimensional dataset that is the scale of the dimension ``name``."""
        values = np.asarray(values)
        dataset = self.file.create_dataset(name, values.shape, values.dtype)
        dataset.make_scale(name)
        self._describe(dataset, unit, text)
        if write and values.size:
            dataset[...] = values

    def dataset(self, name: str, dimensions: tuple[str, ...], shape, dtype, unit: str, text: str) -> h5py.Dataset:
        """An empty dataset over coordinates added before."""
        dataset = self.file.create_dataset(name, shape, dtype)
        for axis, dimension in enumerate(dimensions):
            dataset.dims[axis].attach_scale(self.file[dimension])
        self._describe(dataset, unit, text)
        return dataset

    def put(self, name: str, dimensions: tuple[str, ...], values: np.ndarray, unit: str, text: str) -> None:
        """A dataset with its values."""
        values = np.asarray(values)
        dataset = self.dataset(name, dimensions, values.shape, values.dtype, unit, text)
        if values.size:
            dataset[...] = values

    @staticmethod
    def _describe(dataset: h5py.Dataset, unit: str, text: str) -> None:
        dataset.attrs["units"] = unit
        dataset.attrs["long_name"] = text
