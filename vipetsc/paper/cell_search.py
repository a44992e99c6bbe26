"""The (lambda, eta) search of the supplement: a case in, ``design.h5`` out."""

import sys
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any, Unpack

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case.design import DesignCase
from vipetsc.io.folder import provenance
from vipetsc.io.kinds import SEARCH
from vipetsc.io.netcdf import open_netcdf, tabulated
from vipetsc.lattice import bloch
from vipetsc.lattice.cell import Reading, four_band
from vipetsc.paper.cell_costs import COSTS, PAPER_CELL, CellSearch, search_cells, signed_deflection, unit_vectors
from vipetsc.studies.study import How, Study

UNITS = {"deflection": "1", "group_velocity": "cells/s", "weighted": "cells/s"}
BEST = ("optimum_lambda", "optimum_eta", "optimum_value")
# Dimensions of the values of every cell of the grid, and of every cost's best cell.
GRID = "reading lambda eta"
OPTIMUM = "reading cost"

# Dimensions, units and description of every variable.
LAYOUT = {
    "reading": ("reading", "1", "reading of the paper's parameters"),
    "lambda": ("lambda", "1", "stiffness of the resonator's spring over k (printed) or k2 (calibrated)"),
    "eta": ("eta", "1", "resonator's fraction of the mass m2 + m3"),
    "wavenumber": ("wavenumber", "rad/cell", "wavenumber"),
    "band": ("band", "1", "band, from 1"),
    "dof": ("dof", "1", "mass within the cell, from 1"),
    "cost": ("cost", "1", "what is maximised"),
    "frequency": (f"{GRID} wavenumber band", "rad/s", "angular frequency"),
    "signed_deflection": (f"{GRID} wavenumber", "1", "|u3 - u2| sign(-u2 u3) on band 2, unit-norm Bloch vectors"),
    "speed": (f"{GRID} band", "cells/s", "largest |group velocity| over wavenumber"),
    "out_of_phase": (GRID, "1", "1 where u2 and u3 are out of phase on band 2 at every wavenumber"),
    "deflection": (GRID, "1", "largest |u3 - u2| sign(-u2 u3) on band 2 over kappa, unit-norm Bloch vectors"),
    "group_velocity": (GRID, "cells/s", "sum over bands 2 to 4 of the largest |group velocity|"),
    "weighted": (GRID, "cells/s", "group velocity times deflection"),
    "paper_value": (OPTIMUM, "1", "the cost at the paper's lambda = {}, eta = {}".format(*PAPER_CELL)),
    "optimum_lambda": (OPTIMUM, "1", "lambda of the best cell that is out of phase"),
    "optimum_eta": (OPTIMUM, "1", "eta of the best cell that is out of phase"),
    "optimum_value": (OPTIMUM, "1", "cost of the best cell, in the units of the cost"),
    "optimum_amplitude": (f"{OPTIMUM} wavenumber dof band", "1", "|u| of each mass, unit-norm Bloch vectors"),
    "optimum_deflection": (f"{OPTIMUM} wavenumber band", "1", "|u3 - u2| sign(-u2 u3) on each band at the optimum"),
}


def search_design(
    case: DesignCase, folder: str | Path, comm: MPI.Comm = MPI.COMM_WORLD, **how: Unpack[How]
) -> xr.Dataset:
    """Search the grid of ``case`` in each of its readings; writes ``design.h5``, and returns its content.

    ``how`` it is computed, and what it raises, is in ``Study.run``. Rank 0 searches. That takes seconds, so that
    requests to stop are not looked at.
    """
    DesignCase.expect(case, "search_design")
    return STUDY.run(case, folder, comm, **how)


def read_design(folder: str | Path) -> xr.Dataset:
    """Return the content of ``design.h5`` in ``folder``; raises OSError or ValueError if it is none."""
    with open_netcdf(Path(folder) / "design.h5", "search", (*BEST, "summary")) as data:
        return data.load()


STUDY = Study(SEARCH, "design.h5", make=lambda case, work: lambda: _search(case), read=read_design)


def _search(case: DesignCase) -> xr.Dataset:
    """Search the grid of ``case``; returns the content of ``design.h5``."""
    options = case.design
    sys.audit("vipetsc.set-up", case.name)
    wavenumber = np.linspace(0, np.pi, options.wavenumbers)
    grids: dict[Reading, CellSearch] = {}
    for reading in options.readings:
        grids[reading] = search_cells(reading, options.lam.values(), options.eta.values(), wavenumber)
    results = list(grids.values())

    bands = np.arange(1, results[0].frequency.shape[-1] + 1)
    values: dict[str, Any] = {
        "reading": list(grids),
        "lambda": results[0].lam,
        "eta": results[0].eta,
        "cost": list(COSTS),
        "wavenumber": wavenumber,
        "band": bands,
        "dof": bands,
        # Integers, since netCDF has no booleans.
        "out_of_phase": np.stack([result.out_of_phase for result in results]).astype(np.int8),
    }
    for name in ("frequency", "signed_deflection", "speed"):
        values[name] = np.stack([getattr(result, name) for result in results])
    for name in COSTS:
        values[name] = np.stack([result.cost(name) for result in results])

    values |= _optima(grids, values)
    values["paper_value"] = np.array([_paper_costs(reading, wavenumber) for reading in options.readings])
    about = provenance(MPI.COMM_SELF) | {"case": case.to_toml()}
    if options.eta.last == 1:
        about["left_out"] = "eta = 1: the host mass m (1 - eta) vanishes"
    data = xr.Dataset(tabulated(LAYOUT, values), attrs=about)
    return data.assign_attrs(summary=_table(data))


def _paper_costs(reading: Reading, wavenumber: np.ndarray) -> list[float]:
    """Return the costs of the cell that the paper takes, in the order of ``COSTS``."""
    cell = search_cells(reading, *PAPER_CELL, wavenumber)
    return [cell.cost(name).item() for name in COSTS]


def _optima(grids: Mapping[Reading, CellSearch], values: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Return the best cell by each cost, and the Bloch vectors there: the variables ``optimum_*`` of ``LAYOUT``.

    They are NaN in a reading in which no cell is out of phase. Sizes of dimensions are those of the coordinates in
    ``values``.
    """
    optima: dict[str, np.ndarray] = {}
    for name, (dims, *_) in LAYOUT.items():
        if name.startswith("optimum_"):
            optima[name] = np.full([len(values[dim]) for dim in dims.split()], np.nan)

    for i, (reading, grid) in enumerate(grids.items()):
        for j, cost in enumerate(COSTS):
            best = grid.optimum(cost)
            if best is None:
                continue
            lam = grid.lam[best[0]]
            eta = grid.eta[best[1]]
            cell = four_band(reading, lam, eta)
            waves = bloch(cell, grid.wavenumber)
            optima["optimum_lambda"][i, j] = lam
            optima["optimum_eta"][i, j] = eta
            optima["optimum_value"][i, j] = grid.cost(cost)[best]
            optima["optimum_amplitude"][i, j] = np.abs(unit_vectors(waves))
            optima["optimum_deflection"][i, j] = signed_deflection(cell, waves)
    return optima


def _table(data: xr.Dataset) -> str:
    """Return the optima as text, with one line for each reading and cost."""
    sizes = data.sizes
    lines = [
        f"four-band cell, {sizes['lambda']} x {sizes['eta']} cells, {sizes['wavenumber']} wavenumbers;"
        " u2 and u3 out of phase on band 2 at every wavenumber",
        f"reading     cost            lambda     eta      value  at ({PAPER_CELL[0]:g}, {PAPER_CELL[1]:g})  unit",
    ]
    for (i, reading), (j, cost) in product(enumerate(data["reading"].values), enumerate(COSTS)):
        lam, eta, value, paper = (data[name].values[i, j] for name in (*BEST, "paper_value"))
        optimum = f"{lam:8.4g}{eta:8.4g}{value:11.5g}"
        if np.isnan(value):
            optimum = "    none is out of phase   "
        lines.append(f"{reading:<12}{cost:<14}{optimum}{paper:14.5g}  {UNITS[cost]}")
    return "\n".join(lines)
