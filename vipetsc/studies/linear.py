"""The linear wave that the members of a sweep share: what the lattice without contacts does under a drive of 1 N.

Until the first contact a lattice is linear, so displacements go with the drive's amplitude and energies with its
square; what a member without contact measures is then that of its linear run, scaled.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

import vipetsc
from vipetsc.case import Case
from vipetsc.io.netcdf import open_netcdf, tabulated, write_netcdf
from vipetsc.io.read import field_time


@dataclass(frozen=True)
class LinearWave:
    """What the linear lattice does under a drive of 1 N, cell by cell.

    ``envelope`` (cell): largest sqrt(w^2 + (w'/Om)^2) in m of the contact pair's relative displacement w, Om the
    drive's angular frequency. ``arrival`` (cell): time in s of the largest host velocity, the paper's t_hat when taken
    at the first site.
    """

    envelope: np.ndarray
    arrival: np.ndarray

    @classmethod
    def of(cls, run: xr.Dataset) -> LinearWave:
        """Measure a linear run with both fields of all cells."""
        model = Case.of(run).model()
        host, resonator = model.chain.cell.host, model.chain.cell.resonator
        displacement, velocity = run["displacement"].values, run["velocity"].values
        w = displacement[..., resonator] - displacement[..., host]
        rate = velocity[..., resonator] - velocity[..., host]
        envelope = np.sqrt(np.max(w**2 + (rate / model.drive.frequency) ** 2, axis=0))
        return cls(envelope, field_time(run)[np.argmax(np.abs(velocity[..., host]), axis=0)])

    @classmethod
    def read(cls, path: Path) -> LinearWave:
        """The wave that ``write`` left; raises OSError or ValueError."""
        with open_netcdf(path, "linear wave", ("envelope", "arrival")) as file:
            return cls(file["envelope"].values, file["arrival"].values)

    def write(self, path: Path) -> None:
        """Leave the wave in ``path``, whole or not at all."""
        layout = {
            "cell": ("cell", "1", "cell, counted from 1"),
            "envelope": ("cell", "m", "largest relative displacement at 1 N"),
            "arrival": ("cell", "s", "time of the largest host velocity"),
        }
        values = np.arange(1, len(self.envelope) + 1), self.envelope, self.arrival
        data = tabulated(layout, dict(zip(layout, values, strict=True)))
        write_netcdf(path, xr.Dataset(data, attrs={"vipetsc_version": vipetsc.__version__}))

    def reached(self, case: Case) -> np.ndarray:
        """Linear relative displacement over clearance (site) at the amplitude of ``case``."""
        sites = np.asarray(case.contacts.sites, int) - 1
        return abs(case.drive.amplitude) * self.envelope[sites] / np.asarray(case.contacts.clearance or [], float)

    def arrival_at(self, case: Case) -> float | None:
        """The paper's t_hat in s, when the wave is largest at the first site of ``case``; None without sites."""
        cell = leading_cell(case)
        return float(self.arrival[cell - 1]) if cell else None


def linear_case(case: Case) -> Case:
    """The lattice of ``case`` without contacts under 1 N; cases that differ in those alone share it."""
    table = case.model_dump(by_alias=True, exclude_none=True)
    table["contacts"] = {"sites": 0}
    table["drive"]["amplitude"] = 1.0
    table["output"] = {"stride": case.output.stride}
    return Case.from_table(table | {"name": "linear"})


def leading_cell(case: Case) -> int:
    """Cell (1-based) of the site nearest to the drive; 0 without sites."""
    cells = np.asarray(case.contacts.sites, np.int64)
    return int(cells[np.argmin(np.abs(cells - case.drive.cell))]) if cells.size else 0


def with_sites(linear: xr.Dataset, case: Case) -> xr.Dataset:
    """The ``linear`` run as a run of ``case`` under 1 N whose sites nothing touches."""
    sites = np.asarray(case.contacts.sites, np.int64)
    clearances = np.asarray(case.contacts.clearance or [], float)
    untouched = np.zeros((linear.sizes["time"], len(sites)))
    variables = {
        "site": ("site", np.arange(1, len(sites) + 1), linear["site"].attrs),
        "sites/cell": ("site", sites, linear["sites/cell"].attrs),
        "sites/clearance": ("site", clearances, linear["sites/clearance"].attrs),
        "energy/dissipated_by_site": (("time", "site"), untouched, linear["energy/dissipated_by_site"].attrs),
    }
    unit = Case.from_table(case.model_dump(by_alias=True, exclude_none=True), ["drive.amplitude=1.0"])
    return linear.drop_dims("site").assign(variables).assign_attrs(case=unit.to_toml())


def scaled(data: xr.Dataset, factor: float) -> xr.Dataset:
    """``data`` with all energies (in J) times ``factor``."""
    energies = [name for name in data.data_vars if data[name].attrs.get("units") == "J"]
    with xr.set_options(keep_attrs=True):
        return data.assign({name: data[name] * factor for name in energies})
