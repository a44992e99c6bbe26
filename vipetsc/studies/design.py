"""The (lambda, eta) search of the supplement: a case in, ``design.h5`` out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from operator import attrgetter, methodcaller
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case.design import DesignCase
from vipetsc.io.folder import SEARCH, claim_folder, provenance
from vipetsc.io.netcdf import Variables, variable, write_netcdf
from vipetsc.lattice.bloch import bloch
from vipetsc.lattice.cell import Reading, four_band
from vipetsc.lattice.search import COSTS, Search, search, signed_deflection, unit_vectors

PAPER = 0.1, 0.5  # the (lambda, eta) that the paper takes
UNITS = {"deflection": "1", "group_velocity": "cells/s", "weighted": "cells/s"}
_TEXTS = {
    "deflection": "largest |u3 - u2| sign(-u2 u3) on band 2 over kappa, unit-norm Bloch vectors",
    "group_velocity": "sum over bands 2 to 4 of the largest |group velocity|",
    "weighted": "group velocity times deflection",
}

Searches = Mapping[Reading, Search]


def search_design(case: DesignCase, folder: str | Path, force: bool = False) -> str:
    """Search the grid of ``case`` in each of its readings and write ``design.h5`` and ``case.toml``.

    Call it on one rank. ``force`` replaces an earlier search in ``folder``.

    Returns
    -------
    str
        A table of the optima.

    Raises
    ------
    FolderError
        If ``folder`` holds anything else, or a search and ``force`` is off.
    """
    folder, options = Path(folder), case.design
    claim_folder(folder, SEARCH, case.to_toml(), force=force)
    wavenumber = np.linspace(0, np.pi, options.wavenumbers)
    lam, eta = options.lam.values(), options.eta.values()
    searches = {reading: search(reading, lam, eta, wavenumber) for reading in options.readings}
    paper = {reading: search(reading, *PAPER, wavenumber) for reading in options.readings}
    about = provenance(MPI.COMM_SELF) | {"case": case.to_toml()}
    if options.eta.last == 1:
        about["left_out"] = "eta = 1: the host mass m (1 - eta) vanishes"
    write_netcdf(folder / "design.h5", xr.Dataset(_grid(searches, paper) | _optima(searches), attrs=about))
    return _table(searches, paper)


def _grid(searches: Searches, paper: Searches) -> Variables:
    """Coordinates, bands and cost maps (reading, lambda, eta)."""
    first = next(iter(searches.values()))
    bands = np.arange(1, first.frequency.shape[-1] + 1)
    grid = "reading", "lambda", "eta"

    def stacked(values: Callable[[Search], np.ndarray]) -> np.ndarray:
        return np.stack([values(one) for one in searches.values()])

    lam, eta = PAPER
    at_paper = np.array([[one.cost(name).item() for name in COSTS] for one in paper.values()])
    deflection = "|u3 - u2| sign(-u2 u3) on band 2, unit-norm Bloch vectors"
    phase = "1 where u2 and u3 are out of phase on band 2 at every wavenumber"
    stiffness = "stiffness of the resonator's spring over k (printed) or k2 (calibrated)"
    table: dict[str, tuple[Any, ...]] = {
        "reading": ("reading", list(searches), "1", "reading of the paper's parameters"),
        "lambda": ("lambda", first.lam, "1", stiffness),
        "eta": ("eta", first.eta, "1", "resonator's share of the mass m2 + m3"),
        "wavenumber": ("wavenumber", first.wavenumber, "rad/cell", "wavenumber"),
        "band": ("band", bands, "1", "band, from 1"),
        "dof": ("dof", bands, "1", "mass within the cell, from 1"),
        "cost": ("cost", list(COSTS), "1", "what is maximised"),
        "frequency": ((*grid, "wavenumber", "band"), stacked(attrgetter("frequency")), "rad/s", "angular frequency"),
        "signed_deflection": ((*grid, "wavenumber"), stacked(attrgetter("signed_deflection")), "1", deflection),
        "speed": ((*grid, "band"), stacked(attrgetter("speed")), "cells/s", "largest |group velocity| over wavenumber"),
        "out_of_phase": (grid, stacked(attrgetter("out_of_phase")).astype(np.int8), "1", phase),
        "paper_value": (("reading", "cost"), at_paper, "1", f"the cost at the paper's lambda = {lam}, eta = {eta}"),
    }
    for name in COSTS:
        table[name] = grid, stacked(methodcaller("cost", name)), UNITS[name], _TEXTS[name]
    return {name: variable(*row) for name, row in table.items()}


def _optima(searches: Searches) -> Variables:
    """Where each cost is largest, and the Bloch vectors there; NaN in a reading in which no cell is out of phase."""
    *_, points, bands = next(iter(searches.values())).frequency.shape
    at = "reading", "cost"
    deflection = "|u3 - u2| sign(-u2 u3) on each band at the optimum"
    table: dict[str, tuple[tuple[str, ...], tuple[int, ...], str]] = {
        "lambda": (at, (), "lambda of the best cell that is out of phase"),
        "eta": (at, (), "eta of the best cell that is out of phase"),
        "value": (at, (), "cost of the best cell, in the units of the cost"),
        "amplitude": (
            (*at, "wavenumber", "dof", "band"),
            (points, bands, bands),
            "|u| of each mass, unit-norm Bloch vectors",
        ),
        "deflection": ((*at, "wavenumber", "band"), (points, bands), deflection),
    }
    values = {name: np.full((len(searches), len(COSTS), *shape), np.nan) for name, (_, shape, _) in table.items()}
    for i, (reading, result) in enumerate(searches.items()):
        for j, name in enumerate(COSTS):
            best = result.optimum(name)
            if best is not None:
                cell = four_band(reading, best.lam, best.eta)
                point = bloch(cell, result.wavenumber)
                values["lambda"][i, j], values["eta"][i, j], values["value"][i, j] = best.lam, best.eta, best.value
                values["amplitude"][i, j] = np.abs(unit_vectors(point))
                values["deflection"][i, j] = signed_deflection(cell, point)
    return {f"optimum_{name}": variable(dims, values[name], "1", text) for name, (dims, _, text) in table.items()}


def _table(searches: Searches, paper: Searches) -> str:
    """The optima in words and numbers, one line a reading and cost."""
    first = next(iter(searches.values()))
    lines = [
        f"four-band cell, {first.lam.size} x {first.eta.size} cells, {first.wavenumber.size} wavenumbers;"
        " u2 and u3 out of phase on band 2 at every wavenumber",
        f"reading     cost            lambda     eta      value  at ({PAPER[0]:g}, {PAPER[1]:g})  unit",
    ]
    for reading, result in searches.items():
        for name in COSTS:
            best = result.optimum(name)
            optimum = f"{best.lam:8.4g}{best.eta:8.4g}{best.value:11.5g}" if best else "    none is out of phase   "
            at_paper = paper[reading].cost(name).item()
            lines.append(f"{reading:<12}{name:<14}{optimum}{at_paper:14.5g}  {UNITS[name]}")
    return "\n".join(lines)
