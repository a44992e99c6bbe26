"""The linear wave that the members of a sweep share: what the lattice without contacts does under a drive of 1 N.

Until the first contact a lattice is linear, so displacements go with the drive's amplitude and energies with its
square; what a member without contact measures is then that of its linear run, scaled.
"""

from __future__ import annotations

import numpy as np
import xarray as xr

import vipetsc
from vipetsc.case import Case
from vipetsc.io.netcdf import tabulated
from vipetsc.io.read import field_time

LAYOUT = {
    "cell": ("cell", "1", "cell, counted from 1"),
    "envelope": ("cell", "m", "largest relative displacement at 1 N"),
    "arrival": ("cell", "s", "time of the largest host velocity"),
}


def linear_wave(run: xr.Dataset) -> xr.Dataset:
    """Measure a linear run with both fields of all cells.

    ``envelope`` (cell): largest sqrt(w^2 + (w'/Om)^2) in m of the contact pair's relative displacement w, Om the
    drive's angular frequency. ``arrival`` (cell): time in s of the largest host velocity, the paper's t_hat when taken
    at the first site.
    """
    model = Case.of(run).model()
    host, resonator = model.chain.cell.host, model.chain.cell.resonator
    displacement, velocity = run["displacement"].values, run["velocity"].values
    w = displacement[..., resonator] - displacement[..., host]
    rate = velocity[..., resonator] - velocity[..., host]
    envelope = np.sqrt(np.max(w**2 + (rate / model.drive.frequency) ** 2, axis=0))
    arrival = field_time(run)[np.argmax(np.abs(velocity[..., host]), axis=0)]
    values = {"cell": np.arange(1, len(envelope) + 1), "envelope": envelope, "arrival": arrival}
    return xr.Dataset(tabulated(LAYOUT, values), attrs={"vipetsc_version": vipetsc.__version__})


def reached(wave: xr.Dataset, case: Case) -> np.ndarray:
    """Linear relative displacement over clearance (site) at the amplitude of ``case``."""
    envelope = wave["envelope"].values[np.asarray(case.contacts.sites, int) - 1]
    return np.asarray(abs(case.drive.amplitude) * envelope / np.asarray(case.contacts.clearance or [], float))


def arrival_at(wave: xr.Dataset, case: Case) -> float | None:
    """The paper's t_hat in s, when the wave is largest at the first site of ``case``; None without sites."""
    cell = leading_cell(case)
    return float(wave["arrival"][cell - 1]) if cell else None


def leading_cell(case: Case) -> int:
    """Cell (1-based) of the site nearest to the drive; 0 without sites."""
    cells = np.asarray(case.contacts.sites, np.int64)
    return int(cells[np.argmin(np.abs(cells - case.drive.cell))]) if cells.size else 0


def linear_case(case: Case) -> Case:
    """The lattice of ``case`` without contacts under 1 N; cases that differ in those alone share it."""
    table = case.model_dump(by_alias=True, exclude_none=True)
    table["contacts"] = {"sites": 0}
    table["drive"]["amplitude"] = 1.0
    table["output"] = {"stride": case.output.stride}
    return Case.from_table(table | {"name": "linear"})


def with_sites(linear: xr.Dataset, case: Case) -> xr.Dataset:
    """The ``linear`` run as a run of ``case`` under 1 N whose sites nothing touches."""
    sites = np.asarray(case.contacts.sites, np.int64)
    values = {
        "site": ("site", np.arange(1, len(sites) + 1)),
        "sites/cell": ("site", sites),
        "sites/clearance": ("site", np.asarray(case.contacts.clearance or [], float)),
        "energy/dissipated_by_site": (("time", "site"), np.zeros((linear.sizes["time"], len(sites)))),
    }
    variables = {name: (*item, linear[name].attrs) for name, item in values.items()}
    unit = Case.from_table(case.model_dump(by_alias=True, exclude_none=True), ["drive.amplitude=1.0"])
    return linear.drop_dims("site").assign(variables).assign_attrs(case=unit.to_toml())


def scaled(data: xr.Dataset, factor: float) -> xr.Dataset:
    """``data`` with all energies (in J) times ``factor``."""
    energies = [name for name in data.data_vars if data[name].attrs.get("units") == "J"]
    with xr.set_options(keep_attrs=True):
        return data.assign({name: data[name] * factor for name in energies})
