"""Files: parts written while a run goes on, and the HDF5 file they become when it ends.

Every file is written under a temporary name and renamed when complete, so a reader, or a run that goes on after
a kill, only ever meets whole ones. ``run.h5`` follows netCDF-4's conventions (dimension scales, ``units``,
``long_name``): xarray opens it.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from mpi4py import MPI

import h5py
import numpy as np
from numpy.lib import format as npy

from vipetsc.case import Case
from vipetsc.io.atomic import atomic_write, write_text
from vipetsc.io.folder import FolderError

GATHER_LIMIT = 2 * 2**30  # bytes of fields above which writer = "auto" has every rank write its own

_LEDGER = {
    "kinetic": "kinetic energy",
    "spring": "energy of the springs",
    "contact": "elastic energy of the contacts",
    "work": "work done by the drive",
    "dissipated": "energy dissipated in contacts",
}
_IMPACTS = {
    "site": ("1", "site, counted from 1"),
    "side": ("1", "side of the clearance: +1 or -1"),
    "onset": ("s", "time of onset"),
    "approach_velocity": ("m/s", "relative velocity at onset, w'_minus"),
    "separation": ("s", "time of separation; NaN if still in contact"),
    "indentation": ("m", "largest indentation"),
    "force": ("N", "largest contact force"),
    "loss": ("J", "energy dissipated in the episode"),
}
_FIELDS = {"displacement": "m", "velocity": "m/s"}


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


class RunFolder:
    """The folder of one run: ``case.toml``, parts and states while it runs, ``run.h5`` and ``summary.json`` after.

    Parts are numbered from 0; part k holds the samples between checkpoints k and k + 1.
    """

    def __init__(self, path: Path, comm: MPI.Comm) -> None:
        self.path = Path(path)
        self.comm = comm
        self.parts = self.path / "parts"

    @property
    def run_file(self) -> Path:
        """The finished run."""
        return self.path / "run.h5"

    def prepare(self, case: Case, force: bool, resume: bool) -> None:
        """Make the folder ready for ``case`` (rank 0 only); raises FolderError if it holds something else."""
        text = case.to_toml()
        kept = self.path / "case.toml"
        if resume:
            if not kept.exists() or not self.parts.is_dir():
                raise FolderError(f"{self.path}: holds no unfinished run to resume; leave out --resume")
            if kept.read_text(encoding="utf-8") != text:
                lines = _difference(kept.read_text(encoding="utf-8"), text)
                raise FolderError(f"{self.path}: --resume needs the case it was begun with; differing: {lines}")
            return
        begun = "--resume goes on with the unfinished run in it, " if self.parts.is_dir() else ""
        claim_folder(self.path, force, ("branch-*.h5", "design.h5"), begun)
        shutil.rmtree(self.parts, ignore_errors=True)
        self.parts.mkdir()
        write_text(kept, text)

    def write_part(self, number: int, part: dict[str, np.ndarray] | None) -> None:
        """Write this rank's share of a part; None writes nothing. All ranks must call it."""
        if part is not None:
            _save(self._part(number, self.comm.rank), part)
        self.comm.Barrier()

    def write_state(self, number: int, state: dict[str, np.ndarray]) -> None:
        """Write this rank's checkpoint after part ``number``; the part is complete on all ranks by then."""
        _save(self._state(number, self.comm.rank), state)
        self._state(number - 2, self.comm.rank).unlink(missing_ok=True)

    def last_state(self) -> int:
        """Number of the last checkpoint that all ranks wrote, -1 if there is none; raises FolderError.

        Rank 0 only.
        """
        found: dict[int, int] = {}
        sizes = set()
        for path in self.parts.glob("state-*.npy"):
            _, number, _, size = path.stem.split("-")
            found[int(number)] = found.get(int(number), 0) + 1
            sizes.add(int(size))
        if sizes - {self.comm.size}:
            raise FolderError(f"{self.path}: was begun on {max(sizes)} ranks; resume with mpirun -n {max(sizes)}")
        return max((n for n, count in found.items() if count == self.comm.size), default=-1)

    def read_state(self, number: int) -> dict[str, np.ndarray]:
        """Checkpoint ``number`` of this rank."""
        return _load(self._state(number, self.comm.rank))

    def read_part(self, number: int, rank: int, wanted: Collection[str]) -> Mapping[str, np.ndarray]:
        """The arrays ``wanted`` of part ``number`` as ``rank`` wrote it."""
        return _load(self._part(number, rank), wanted)

    def _part(self, number: int, rank: int) -> Path:
        return self.parts / f"part-{number:06d}-{rank}.npy"

    def _state(self, number: int, rank: int) -> Path:
        return self.parts / f"state-{number:06d}-{rank}-{self.comm.size}.npy"

    def assemble(self, case: Case, cells: np.ndarray, parts: int, parallel: bool, about: dict[str, Any]) -> None:
        """Turn the first ``parts`` parts into ``run.h5``; all ranks must call it.

        Parameters
        ----------
        case
            The resolved case.
        cells
            The recorded cells (1-based) of the whole lattice if this rank writes them all, else this rank's.
        parts
            Number of parts.
        parallel
            Every rank writes its own cells (one file, collectively) instead of rank 0 all.
        about
            Root attributes besides the case.
        """
        shares = self.comm.allgather(len(cells)) if parallel else [len(cells)]
        writers = self.comm if parallel else MPI.COMM_SELF
        if parallel or self.comm.rank == 0:
            first = sum(shares[: writers.rank])
            driver = {"driver": "mpio", "comm": writers} if writers.size > 1 else {}
            target = self.path / ".run.h5.part"
            try:
                with h5py.File(target, "w", **driver) as file:
                    self._fill(file, case, cells, first, sum(shares), parts, about, writers)
            except (OSError, RuntimeError) as error:  # h5py raises either when HDF5 cannot write
                target.unlink(missing_ok=True)
                raise OSError(
                    f"{self.run_file} could not be written; make room and go on with --resume: {error}"
                ) from error
            writers.Barrier()
            if writers.rank == 0:
                os.replace(target, self.run_file)
        self.comm.Barrier()

    def _fill(self, file: h5py.File, case: Case, cells, first, total, parts, about, writers) -> None:
        own = slice(first, first + len(cells))
        times, field_times, energies, by_site, impacts = self._read_ledger(parts)
        coordinates = Coordinates(file)
        coordinates.add("time", times, "s", "time")
        coordinates.add("cell", np.zeros(total, np.int64), "1", "cell, counted from 1", write=False)
        coordinates.add("dof", np.arange(1, case.unit_cell().dofs + 1), "1", "mass within the cell, from 1")
        coordinates.add("site", np.arange(1, len(case.contacts.sites) + 1), "1", "contact site, from 1")
        coordinates.add("episode", np.arange(1, len(impacts["site"]) + 1), "1", "contact episode, by onset")
        _write_share(file["cell"], own, cells)
        at = "time"
        if len(field_times) != len(times):
            coordinates.add("field_time", field_times, "s", "time of the recorded fields")
            at = "field_time"
        for name in case.output.fields:
            shape = (len(field_times), total, case.unit_cell().dofs)
            coordinates.dataset(name, (at, "cell", "dof"), shape, float, _FIELDS[name], f"{name} of each mass")
        sample = 0
        rank = writers.rank
        for number in range(parts):
            part = self.read_part(number, rank, case.output.fields)
            count = part[case.output.fields[0]].shape[0] if case.output.fields else 0
            for name in case.output.fields:
                _write_share(file[name], (slice(sample, sample + count), own), part[name])
            sample += count
        for name, text in _LEDGER.items():
            coordinates.put(f"energy/{name}", ("time",), energies[name], "J", text)
        text = "energy dissipated at each site"
        coordinates.put("energy/dissipated_by_site", ("time", "site"), by_site, "J", text)
        coordinates.put("sites/cell", ("site",), np.asarray(case.contacts.sites, np.int64), "1", "cell of the site")
        clearances = np.asarray(case.contacts.clearance or [], float)
        coordinates.put("sites/clearance", ("site",), clearances, "m", "clearance of the site")
        for name, (unit, text) in _IMPACTS.items():
            coordinates.put(f"impacts/{name}", ("episode",), impacts[name], unit, text)
        file.attrs["case"] = case.to_toml()
        for key, value in about.items():
            file.attrs[key] = json.dumps(value) if isinstance(value, dict) else value

    def _read_ledger(self, parts: int) -> tuple:
        gathered: dict[str, list[np.ndarray]] = {}
        wanted = {"time", "field_time", "dissipated_by_site", *_LEDGER, *(f"impact_{n}" for n in _IMPACTS)}
        for number in range(parts):
            part = self.read_part(number, 0, wanted)
            for key in wanted:
                gathered.setdefault(key, []).append(part[key])
        joined = {key: np.concatenate(arrays) for key, arrays in gathered.items()}
        impacts = {name: joined[f"impact_{name}"] for name in _IMPACTS}
        order = np.lexsort((impacts["site"], impacts["onset"]))
        impacts = {name: values[order] for name, values in impacts.items()}
        energies = {name: joined[name] for name in _LEDGER}
        return joined["time"], joined["field_time"], energies, joined["dissipated_by_site"], impacts

    def finish(self, summary: dict[str, Any]) -> None:
        """Write ``summary.json`` and drop the parts (rank 0 only); ``run.h5`` is in place by then."""
        write_text(self.path / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
        shutil.rmtree(self.parts)


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


def _write_share(dataset: h5py.Dataset, where: Any, values: np.ndarray) -> None:
    """Write one rank's share. Independently: h5py leaves out empty selections, on which collective writing hangs."""
    if values.size:
        dataset[where] = values


def _save(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
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


def _load(path: Path, wanted: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """What ``_save`` wrote, or the ``wanted`` arrays of it."""
    found = {}
    with path.open("rb") as file:
        for name in np.load(file):
            npy.read_magic(file)
            shape, _, kind = npy.read_array_header_1_0(file)
            count = int(np.prod(shape))
            if wanted is None or name in wanted:
                found[str(name)] = np.fromfile(file, kind, count).reshape(shape)
            else:
                file.seek(count * kind.itemsize, os.SEEK_CUR)
    return found


def _difference(old: str, new: str) -> str:
    before, after = set(old.splitlines()), set(new.splitlines())
    return "; ".join(sorted(line.strip() for line in before ^ after if line.strip()))
