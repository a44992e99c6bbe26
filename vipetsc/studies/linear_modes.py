"""Linear modes of a finite lattice near a frequency, with their place, band and shape, in ``modes.h5``.

They solve K x = Om^2 M x, x^T M x = 1; contacts that are pressed at rest count as springs. A mode in a pass band is of
the "bulk"; one in a gap decays away from where something differs, and is named after the place of its energy: an end
("edge"), a site or a cell.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case import Case, CaseError, Model
from vipetsc.case.section import Problem
from vipetsc.dynamics.eigen import modes_near
from vipetsc.dynamics.matrices import LatticeMatrices
from vipetsc.dynamics.memory import LARGEST_MESSAGE
from vipetsc.io.folder import provenance
from vipetsc.io.netcdf import tabulated, write_netcdf
from vipetsc.lattice import Band, Chain, wave_bands
from vipetsc.parallel import on_root
from vipetsc.spectra.modal_energies import EDGE

# Part of the cells that counts as one end. A mode has its place there if it has half of its energy at the ends, where
# one that is spread evenly has a fifth.
END = 0.1
TIE = 1e-9  # two numbers whose relative difference is smaller may be equal but for rounding
LAYOUT = {
    "mode": ("mode", "1", "mode, lowest first"),
    "cell": ("cell", "1", "cell"),
    "dof": ("dof", "1", "mass of the cell"),
    "frequency": ("mode", "rad/s", "angular frequency"),
    "band": ("mode", "1", "pass band that the frequency lies in; 0 for a gap"),
    "participation": (
        "mode",
        "1",
        "number of participating cells: 1 over the sum of the squares of their energy fractions",
    ),
    "left": ("mode", "1", "fraction of the kinetic energy in the first tenth of the cells"),
    "right": ("mode", "1", "fraction of the kinetic energy in the last tenth of the cells"),
    "peak": ("mode", "1", "cell with most kinetic energy"),
    "kind": ("mode", "1", "bulk, edge, at a site, or in a cell"),
    "residual": ("mode", "1", "norm of K x - Om^2 M x over the norm of M x times the largest Om^2"),
    "shape": ("mode cell dof", "1/sqrt(kg)", "displacement, normalised to unit modal mass"),
}


def find_modes(case: Case, count: int, near: float, folder: Path, comm: MPI.Comm) -> xr.Dataset | None:
    """Return the ``count`` linear modes nearest to ``near`` in rad/s, on rank 0, which writes ``folder/modes.h5``.

    All ranks must call it. Raises CaseError if there are not so many, or SLEPc is missing.
    """
    chain = case.model().chain
    check_modes(case, count, near)
    matrices = LatticeMatrices(chain, comm, pressed_contacts(case.model()))
    modes = modes_near(matrices, count, near)
    # Freed here, on all ranks together: garbage collection would come on each rank at its own time.
    matrices.destroy()
    parts = comm.gather(modes.shapes)
    written: list[xr.Dataset] = []

    def write() -> None:
        shape = np.concatenate(parts or [], axis=1)
        # The sign of a mode is arbitrary: its largest displacement is positive.
        flat = shape.reshape(count, -1)
        flat *= np.sign(flat[np.arange(count), first_largest(np.abs(flat))])[:, None]
        values = {
            "mode": np.arange(1, count + 1),
            "cell": np.arange(1, chain.cells + 1),
            "dof": np.arange(1, chain.cell.dofs + 1),
            "frequency": modes.frequency,
            "residual": modes.residual,
            "shape": shape,
        }
        values |= classify(chain, modes.frequency, shape)
        data = xr.Dataset(tabulated(LAYOUT, values), attrs={"case": case.to_toml(), "near": near} | provenance(comm))
        write_netcdf(folder / "modes.h5", data)
        written.append(data)

    # The shapes may be large: they stay on rank 0.
    on_root(comm, write)
    return written[0] if written else None


def check_modes(case: Case, count: int, near: float) -> None:
    """Raise CaseError if ``count`` modes near ``near`` cannot be found."""
    model = case.model()
    chain = model.chain
    masses = chain.cells * chain.cell.dofs
    if not 1 <= count <= masses:
        raise CaseError([Problem("--modes", count, f"the lattice has {masses} modes")])
    for number, stops in enumerate(chain.sites.gaps, start=1):
        if min(stops) == 0:
            remedy = (
                f"site {number} touches its stop at rest, which resists on one side only: no motion about it is linear,"
                " however small"
            )
            raise CaseError([Problem("contacts.clearance", case.contacts.clearance, remedy)], case.name)
    # The comparison is false for NaN too; far below 1e50 squares of frequencies do not overflow.
    if not 0 <= near < 1e50:
        raise CaseError([Problem("--near", near, "give a frequency in rad/s that is not negative")])
    if 8 * count * masses > LARGEST_MESSAGE:
        raise CaseError([Problem("--modes", count, "one rank cannot gather all shapes; request fewer modes")])


def pressed_contacts(model: Model) -> list[float]:
    """Return stiffnesses in N/m of contacts of a ``model`` for small motions: slopes, 0 if not pressed."""
    stiffness = []
    for site in model.chain.sites:
        pressed = -min(site.gaps)
        slope = 0.0
        if pressed > 0:
            slope = float(site.law.elastic_slope(pressed))
        stiffness.append(slope)
    return stiffness


def classify(chain: Chain, frequency: np.ndarray, shape: np.ndarray) -> dict[str, Any]:
    """Return bands, cells and kinds of modes with ``frequency`` (mode) and ``shape`` (mode, cell, dof), by name."""
    energy = np.sum(shape**2 * chain.masses().reshape(shape.shape[1:]), axis=2)
    end = max(int(END * chain.cells), 1)
    left = energy[:, :end].sum(axis=1)
    right = energy[:, -end:].sum(axis=1)
    peak = first_largest(energy)

    all_bands = wave_bands(chain.cell)
    bands = [_band_of(all_bands, f) for f in frequency]
    kinds = []
    for band, cell, at_ends in zip(bands, peak, left + right, strict=True):
        kinds.append("bulk" if band else _place(chain, int(cell), float(at_ends)))
    return {
        "band": np.array(bands),
        "participation": 1 / (energy**2).sum(axis=1),
        "left": left,
        "right": right,
        "peak": peak + 1,
        "kind": np.array(kinds),
    }


def first_largest(values: np.ndarray) -> np.ndarray:
    """Return the place (mode) of the first of the largest ``values`` (mode, place) of each mode.

    In a lattice that is its own mirror image two places have equal values. Which of them rounding makes the larger one
    may differ between two calls on the same ranks, because the direct solver of several ranks adds in the order in
    which messages come.
    """
    return np.asarray((values >= (1 - TIE) * values.max(axis=1, keepdims=True)).argmax(axis=1))


def _band_of(bands: Sequence[Band], frequency: float) -> int:
    """Return the number of the first of ``bands`` that ``frequency`` in rad/s lies in; 0 in a gap."""
    if not bands:
        return 0
    tolerance = EDGE * bands[-1].high
    for band in bands:
        if band.low - tolerance <= frequency <= band.high + tolerance:
            return band.number
    return 0


def _place(chain: Chain, cell: int, at_ends: float) -> str:
    """Return the place of a mode in a gap whose energy is largest in ``cell`` (from 0).

    ``at_ends`` is the fraction of its energy at the ends.
    """
    if chain.ends != "periodic" and at_ends > 0.5:
        return "edge"
    sites = chain.sites.cells
    # A contact with the next cell may have its energy on either side.
    near = sites[np.abs(sites - cell) <= 1]
    return f"at site {near[0] + 1}" if near.size else f"in cell {cell + 1}"


def modes_report(data: xr.Dataset) -> str:
    """Return the modes as a table."""
    lines = ["mode  frequency (rad/s)  band  cells taking part  left   right  kind"]
    for number in range(data.sizes["mode"]):
        mode = data.isel(mode=number)
        band = mode["band"].item()
        lines.append(
            f"{number + 1:4d} {mode['frequency'].item():18.6f} {band or 'gap':>5} {mode['participation'].item():18.2f}"
            f"  {mode['left'].item():.3f}  {mode['right'].item():.3f}  {mode['kind'].item()}"
        )
    return "\n".join([*lines, f"largest residual {float(data['residual'].max()):.1e}"])
