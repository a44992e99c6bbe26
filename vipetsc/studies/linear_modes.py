"""Linear modes of a finite lattice near a frequency: where each is, of which band, and its shape, into ``modes.h5``."""

from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case import Case, CaseError
from vipetsc.case.case_file import Problem
from vipetsc.dynamics.eigen import modes_near
from vipetsc.dynamics.matrices import LatticeMatrices
from vipetsc.io.folder import provenance
from vipetsc.io.netcdf import tabulated, write_netcdf
from vipetsc.io.store import GATHER_LIMIT
from vipetsc.lattice import Chain, pass_bands
from vipetsc.parallel import on_root
from vipetsc.spectra.modal_energies import EDGE

END = 0.1  # share of the cells that count as one end
LAYOUT = {
    "mode": ("mode", "1", "mode, lowest first"),
    "cell": ("cell", "1", "cell"),
    "dof": ("dof", "1", "mass of the cell"),
    "frequency": ("mode", "rad/s", "angular frequency"),
    "band": ("mode", "1", "pass band that the frequency lies in; 0 for a gap"),
    "participation": ("mode", "1", "cells that take part: 1 over the sum of the squares of their shares of the energy"),
    "left": ("mode", "1", "share of the kinetic energy in the first tenth of the cells"),
    "right": ("mode", "1", "share of the kinetic energy in the last tenth of the cells"),
    "peak": ("mode", "1", "cell with most kinetic energy"),
    "kind": ("mode", "1", "bulk, edge, at a site, or in a cell"),
    "residual": ("mode", "1", "norm of K x - Om^2 M x over that of the largest Om^2 times M x"),
    "shape": ("mode cell dof", "1/sqrt(kg)", "displacement, its square times the masses sums to 1"),
}


def find_modes(case: Case, count: int, near: float, folder: Path, comm: MPI.Comm) -> xr.Dataset | None:
    """The ``count`` linear modes nearest to ``near`` in rad/s, on rank 0, which writes ``folder/modes.h5``.

    All ranks must call it. Raises CaseError if there are not so many, or SLEPc is missing.
    """
    chain, stops = case.model().chain, case.model().gaps
    masses = chain.cells * chain.cell.dofs
    if not 1 <= count <= masses:
        raise CaseError([Problem("--modes", count, f"the lattice has {masses} modes")])
    if stops and np.min(stops) <= 0:
        raise CaseError([Problem("contacts.clearance", None, "contacts that touch at rest are in no linear mode")])
    if not 0 <= near < 1e50:
        raise CaseError([Problem("--near", near, "give a frequency in rad/s, from 0 on")])
    if 8 * count * masses > GATHER_LIMIT:
        raise CaseError([Problem("--modes", count, "their shapes are more than one rank gathers; ask for fewer")])
    matrices = LatticeMatrices(chain, comm)
    modes = modes_near(matrices, count, near)
    matrices.destroy()
    parts = comm.gather(modes.shapes)

    def write() -> xr.Dataset:
        shape = np.concatenate(parts or [], axis=1)
        flat = shape.reshape(count, -1)
        flat *= np.sign(flat[np.arange(count), np.abs(flat).argmax(axis=1)])[:, None]
        numbers = {"mode": np.arange(1, count + 1), "cell": np.arange(1, chain.cells + 1)}
        numbers |= {"dof": np.arange(1, chain.cell.dofs + 1), "frequency": modes.frequency, "residual": modes.residual}
        values = numbers | {"shape": shape} | places(chain, modes.frequency, shape)
        data = xr.Dataset(tabulated(LAYOUT, values), attrs={"case": case.to_toml(), "near": near} | provenance(comm))
        write_netcdf(folder / "modes.h5", data)
        return data

    made: list[xr.Dataset] = []
    on_root(comm, lambda: made.append(write()))
    return made[0] if made else None


def places(chain: Chain, frequency: np.ndarray, shape: np.ndarray) -> dict[str, Any]:
    """In which band modes (mode, cell, dof) are, and in which cells."""
    energy = np.sum(shape**2 * chain.masses().reshape(shape.shape[1:]), axis=2)
    bands = pass_bands(chain.cell)
    reach, end = EDGE * bands[-1].high, max(int(END * chain.cells), 1)
    inside = [[b.number for b in bands if b.low - reach <= f <= b.high + reach] for f in frequency]
    left, right = energy[:, :end].sum(axis=1), energy[:, -end:].sum(axis=1)
    peak, sites = energy.argmax(axis=1), np.array(chain.sites, int)
    kinds = []
    for number, at, share in zip(inside, peak, left + right, strict=True):
        near_site = sites[np.abs(sites - at) <= 1]
        at_end = chain.ends != "periodic" and share > 0.5
        place = f"at site {near_site[0] + 1}" if near_site.size else f"in cell {at + 1}"
        kinds.append("bulk" if number else "edge" if at_end else place)
    return {
        "band": np.array([number[0] if number else 0 for number in inside]),
        "participation": 1 / (energy**2).sum(axis=1),
        "left": left,
        "right": right,
        "peak": peak + 1,
        "kind": np.array(kinds),
    }


def modes_report(data: xr.Dataset) -> str:
    """The modes as a table."""
    lines = ["mode  frequency (rad/s)  band  cells taking part  left   right  kind"]
    for i in range(data.sizes["mode"]):
        row = {name: data[name].values[i] for name in ("frequency", "band", "participation", "left", "right", "kind")}
        band = str(row["band"]) if row["band"] else "gap"
        lines.append(
            f"{i + 1:4d} {row['frequency']:18.6f} {band:>5} {row['participation']:18.2f}"
            f"  {row['left']:.3f}  {row['right']:.3f}  {row['kind']}"
        )
    return "\n".join([*lines, f"largest residual {float(data['residual'].max()):.1e}"])
