"""A read-only view of ``run.h5``, for measures and pictures; needs no MPI and no PETSc."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path

import h5py
import numpy as np

from vipetsc.case import Case, Model

IMPACTS = (
    "site",
    "side",
    "onset",
    "approach_velocity",
    "separation",
    "indentation",
    "force",
    "loss",
)
ENERGIES = ("kinetic", "spring", "contact", "work", "dissipated")


class RunFile:
    """What a finished or interrupted run left: SI units, cells and sites counted from 1.

    Made from the path of ``run.h5``, or from the file already open (closing this closes it).
    Use it as a context manager; fields are HDF5 datasets (t, cell, dof), read where they are sliced.

    Raises
    ------
    OSError
        If the file cannot be opened.
    ValueError
        If it is not one of ours.
    """

    def __init__(self, path: str | Path | h5py.File) -> None:
        opened = isinstance(path, h5py.File)
        self.path = Path(path.filename if opened else path)
        self.file = path if opened else h5py.File(self.path, "r")
        missing = [name for name in ("time", "cell", "energy") if name not in self.file]
        if missing or "case" not in self.file.attrs:
            self.file.close()
            raise ValueError(f"{self.path} is not a run of vipetsc: it has no {', '.join(missing) or 'case'}")

    def __enter__(self) -> RunFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()

    @cached_property
    def case(self) -> Case:
        """The resolved case."""
        return Case.from_toml(self.file.attrs["case"])

    @cached_property
    def model(self) -> Model:
        """The case in the lattice's own terms (0-based)."""
        return self.case.model()

    @cached_property
    def masses(self) -> np.ndarray:
        """Masses (dof) of a cell in kg."""
        return np.asarray(self.model.chain.cell.masses)

    @cached_property
    def time(self) -> np.ndarray:
        """Times (nt) in s of the ledger."""
        return self.file["time"][...]

    @cached_property
    def field_time(self) -> np.ndarray:
        """Times (t) in s of the fields, ``time`` or every n-th of it."""
        return self.file["field_time"][...] if "field_time" in self.file else self.time

    @property
    def field_interval(self) -> float:
        """Sampling interval of the fields in s."""
        return float(self.field_time[1] - self.field_time[0]) if len(self.field_time) > 1 else np.nan

    @cached_property
    def cells(self) -> np.ndarray:
        """Recorded cells (cell), 1-based, rising."""
        return self.file["cell"][...]

    @property
    def spacing(self) -> int:
        """Distance in cells between recorded cells."""
        return int(self.cells[1] - self.cells[0]) if len(self.cells) > 1 else 1

    @property
    def displacement(self) -> h5py.Dataset:
        """Displacement (t, cell, dof) in m."""
        return self.file["displacement"]

    @property
    def velocity(self) -> h5py.Dataset:
        """Velocity (t, cell, dof) in m/s."""
        return self.file["velocity"]

    @cached_property
    def energies(self) -> dict[str, np.ndarray]:
        """Kinetic, spring and contact energy, work and dissipated energy (nt) in J."""
        return {name: self.file["energy"][name][...] for name in ENERGIES}

    @cached_property
    def site_cells(self) -> np.ndarray:
        """Cells (site) that carry contacts, 1-based."""
        return self.file["sites/cell"][...] if "sites" in self.file else np.zeros(0, int)

    @cached_property
    def clearances(self) -> np.ndarray:
        """Clearances (site) in m."""
        return self.file["sites/clearance"][...] if "sites" in self.file else np.zeros(0)

    @cached_property
    def impacts(self) -> dict[str, np.ndarray]:
        """The impact log, one array (episode) a column; sites counted from 1."""
        return {n: self.file["impacts"][n][...] if "impacts" in self.file else np.zeros(0) for n in IMPACTS}

    @property
    def leading_site(self) -> int | None:
        """The site (0-based) nearest to the drive, which the wave reaches first; None without sites."""
        if not len(self.site_cells):
            return None
        return int(np.argmin(np.abs(self.site_cells - 1 - self.model.drive_cell)))

    def nearest(self, cell: int) -> int:
        """Index of the recorded cell nearest to ``cell`` (1-based)."""
        return int(np.argmin(np.abs(self.cells - cell)))
