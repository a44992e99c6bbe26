"""The (lambda, eta) search of the supplement: a case in, ``design.h5`` out."""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

import h5py
import numpy as np

from vipetsc.case.design import DesignCase
from vipetsc.io.atomic import atomic_write, write_text
from vipetsc.io.folder import provenance
from vipetsc.io.store import Coordinates, claim_folder
from vipetsc.lattice.bloch import bloch
from vipetsc.lattice.cell import four_band
from vipetsc.lattice.search import COSTS, Search, search, signed_deflection, unit_vectors

PAPER = 0.1, 0.5  # the (lambda, eta) that the paper takes
UNITS = {"deflection": "1", "group_velocity": "cells/s", "weighted": "cells/s"}
_TEXTS = {
    "deflection": "largest |u3 - u2| sign(-u2 u3) on band 2 over kappa, unit-norm Bloch vectors",
    "group_velocity": "sum over bands 2 to 4 of the largest |group velocity|",
    "weighted": "group velocity times deflection",
}


def design(case: DesignCase, folder: str | Path, force: bool = False) -> str:
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
    claim_folder(folder, force, ("run.h5", "parts", "branch-*.h5", "index.json"))
    wavenumber = np.linspace(0, np.pi, options.wavenumbers)
    found = {r: search(r, options.lam.values(), options.eta.values(), wavenumber) for r in options.readings}
    paper = {r: search(r, *PAPER, wavenumber) for r in options.readings}
    write_text(folder / "case.toml", case.to_toml())
    with atomic_write(folder / "design.h5") as aside, h5py.File(aside, "w") as file:
        file.attrs.update(provenance(MPI.COMM_SELF) | {"case": case.to_toml()})
        if options.eta.last == 1:
            file.attrs["left_out"] = "eta = 1: the host mass m (1 - eta) vanishes"
        _put_grid(Coordinates(file), found, paper)
        _put_optima(Coordinates(file), found)
    return _table(found, paper)


def _put_grid(out: Coordinates, found: dict[str, Search], paper: dict[str, Search]) -> None:
    """Coordinates, bands and cost maps."""
    any_one = next(iter(found.values()))
    words = h5py.string_dtype()
    out.add("reading", np.array(list(found), words), "1", "reading of the paper's parameters")
    out.add("lambda", any_one.lam, "1", "stiffness of the resonator's spring over k (printed) or k2 (calibrated)")
    out.add("eta", any_one.eta, "1", "resonator's share of the mass m2 + m3")
    out.add("wavenumber", any_one.wavenumber, "rad/cell", "wavenumber")
    out.add("band", np.arange(1, any_one.frequency.shape[-1] + 1), "1", "band, from 1")
    out.add("dof", np.arange(1, any_one.frequency.shape[-1] + 1), "1", "mass within the cell, from 1")
    out.add("cost", np.array(COSTS, words), "1", "what is maximised")

    grid = "reading", "lambda", "eta"
    frequency = np.stack([s.frequency for s in found.values()])
    out.put("frequency", (*grid, "wavenumber", "band"), frequency, "rad/s", "angular frequency")
    deflection = np.stack([s.signed_deflection for s in found.values()])
    text = "|u3 - u2| sign(-u2 u3) on band 2, unit-norm Bloch vectors"
    out.put("signed_deflection", (*grid, "wavenumber"), deflection, "1", text)
    speed = np.stack([s.speed for s in found.values()])
    out.put("speed", (*grid, "band"), speed, "cells/s", "largest |group velocity| over wavenumber")
    feasible = np.stack([s.out_of_phase for s in found.values()]).astype(np.int8)
    out.put("out_of_phase", grid, feasible, "1", "1 where u2 and u3 are out of phase on band 2 at every wavenumber")
    for name in COSTS:
        out.put(name, grid, np.stack([s.cost(name) for s in found.values()]), UNITS[name], _TEXTS[name])
    at_paper = np.array([[s.cost(name).item() for name in COSTS] for s in paper.values()])
    lam, eta = PAPER
    out.put("paper_value", ("reading", "cost"), at_paper, "1", f"the cost at the paper's lambda = {lam}, eta = {eta}")


def _put_optima(out: Coordinates, found: dict[str, Search]) -> None:
    """Where each cost is largest, and the Bloch vectors there; NaN in a reading in which no cell is out of phase."""
    shape = len(found), len(COSTS)
    *_, points, bands = next(iter(found.values())).frequency.shape
    values = {name: np.full(shape, np.nan) for name in ("lambda", "eta", "value")}
    amplitude = np.full((*shape, points, bands, bands), np.nan)
    deflection = np.full((*shape, points, bands), np.nan)
    for i, (reading, result) in enumerate(found.items()):
        for j, name in enumerate(COSTS):
            best = result.optimum(name)
            if best is not None:
                values["lambda"][i, j], values["eta"][i, j], values["value"][i, j] = best.lam, best.eta, best.value
                cell = four_band(reading, best.lam, best.eta)
                point = bloch(cell, result.wavenumber)
                amplitude[i, j] = np.abs(unit_vectors(point))
                deflection[i, j] = signed_deflection(cell, point)
    at = "reading", "cost"
    out.put("optimum_lambda", at, values["lambda"], "1", "lambda of the best cell that is out of phase")
    out.put("optimum_eta", at, values["eta"], "1", "eta of the best cell that is out of phase")
    out.put("optimum_value", at, values["value"], "1", "cost of the best cell, in the units of the cost")
    dimensions = (*at, "wavenumber", "dof", "band")
    out.put("optimum_amplitude", dimensions, amplitude, "1", "|u| of each mass, unit-norm Bloch vectors")
    text = "|u3 - u2| sign(-u2 u3) on each band at the optimum"
    out.put("optimum_deflection", (*at, "wavenumber", "band"), deflection, "1", text)


def _table(found: dict[str, Search], paper: dict[str, Search]) -> str:
    first = next(iter(found.values()))
    lines = [
        f"four-band cell, {first.lam.size} x {first.eta.size} cells, {first.wavenumber.size} wavenumbers;"
        " u2 and u3 out of phase on band 2 at every wavenumber",
        f"reading     cost            lambda     eta      value  at ({PAPER[0]:g}, {PAPER[1]:g})  unit",
    ]
    for reading, result in found.items():
        for name in COSTS:
            best = result.optimum(name)
            place = f"{best.lam:8.4g}{best.eta:8.4g}{best.value:11.5g}" if best else "    none is out of phase   "
            at_paper = paper[reading].cost(name).item()
            lines.append(f"{reading:<12}{name:<14}{place}{at_paper:14.5g}  {UNITS[name]}")
    return "\n".join(lines)
