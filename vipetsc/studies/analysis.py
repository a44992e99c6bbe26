"""The measures of one run: ``run.h5`` in, ``analysis.h5`` out."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from scipy import fft

from vipetsc.files import written_aside
from vipetsc.lattice import pass_bands
from vipetsc.records import RunFile
from vipetsc.spectra import (
    TAPER,
    Parts,
    dispersion,
    front_arrival,
    ibtet,
    kinetic_energy,
    part_energies,
    wavenumber_content,
)

FORMAT_VERSION = 1
IN_MEMORY = 2**30  # bytes of velocity that are read at once; larger fields are read mass by mass
MAP_SIZE = 20_000_000  # values of a (t, cell) map that are written; longer records are thinned out in time
HEADROOM = 1.5  # dispersion is kept up to this many times the top band's edge


@dataclass(frozen=True)
class Arrival:
    """When the wave reached the first site: ``sample`` of the fields, and by what it is told."""

    sample: int
    reason: str


def analyse(run_path: str | Path, out_path: str | Path) -> None:
    """Measure the run in ``run_path`` and write ``out_path``, complete or not at all.

    Kinetic energy in space-time, wavenumber content, dispersion of the whole record and of the cells before
    and after the first site, energies of the pass bands and gaps, and the inter-band transfer. What a run
    cannot give (no sites, a single cell) is left out and named in the attribute ``left_out``.

    Raises
    ------
    OSError, ValueError
        If the run cannot be read or is not one of ours.
    """
    with written_aside(Path(out_path)) as aside, RunFile(run_path) as run, h5py.File(aside, "w") as out:
        _measure(run, out)


def _measure(run: RunFile, out: h5py.File) -> None:
    out.attrs["format_version"] = FORMAT_VERSION
    out.attrs["case"] = run.file.attrs["case"]
    out.attrs["status"] = run.file.attrs.get("status", "")
    if "velocity" not in run.file:
        out.attrs["left_out"] = "everything: the velocity was not recorded"
        return
    velocity = run.velocity if run.velocity.nbytes > IN_MEMORY else run.velocity[...]
    nt, cells = velocity.shape[:2]
    thinning = -(-nt * cells // MAP_SIZE)
    thin = slice(None, None, thinning)
    out.attrs["thinning"] = thinning
    left_out = []

    _put(out, "time", run.field_time[thin], "s", "time")
    _put(out, "cell", run.cells, "1", "cell")
    kinetic = kinetic_energy(velocity, run.masses)
    _put(out, "kinetic_energy", kinetic[thin], "J", "kinetic energy of a cell", "time", "cell")
    if cells > 1:
        wavenumber, content = wavenumber_content(velocity, run.masses)
        _put(out, "wavenumber", wavenumber / run.spacing, "rad/cell", "wavenumber")
        long_name = "kinetic energy per wavenumber bin"
        _put(out, "wavenumber_content", content[thin], "J", long_name, "time", "wavenumber")
    else:
        left_out.append("wavenumber_content: a single cell was recorded")
    if nt < 2:
        left_out.append("dispersion, bands, ibtet: fewer than two samples were recorded")
    else:
        left_out += _put_dispersions(run, velocity, out)
        _put_bands(run, velocity, kinetic, out, thin)
    out.attrs["left_out"] = "; ".join(left_out)


def _put_dispersions(run: RunFile, velocity: np.ndarray, out: h5py.File) -> list[str]:
    """Write the dispersion of all cells, of those before and of those after the first site."""
    nt, cells = velocity.shape[:2]
    if cells < 2:
        return ["dispersion: a single cell was recorded"]
    windows, left_out = {"dispersion": slice(None)}, []
    if run.leading_site is None:
        left_out.append("dispersion_before, dispersion_after: the lattice has no sites")
    else:
        site = run.site_cells[run.leading_site]
        low, high = np.searchsorted(run.cells, [site, site + 1])
        sides = slice(0, int(low)), slice(int(high), cells)
        before, after = sides if run.model.drive_cell < site else sides[::-1]
        windows |= {"dispersion_before": before, "dispersion_after": after}
    lengths = fft.next_fast_len(nt, real=True), cells
    highest = HEADROOM * pass_bands(run.model.chain.cell)[-1].high
    for name, window in windows.items():
        if len(range(cells)[window]) < 2:
            left_out.append(f"{name}: fewer than two of its cells were recorded")
            continue
        spectrum = dispersion(
            velocity,
            run.masses,
            run.field_interval,
            cells=window,
            # A wave that crosses the border of a window would smear over all wavenumbers.
            tapers=(TAPER, TAPER if name == "dispersion" else 0.5),
            lengths=lengths,
            highest=highest,
        ).folded()
        if "frequency" not in out:
            _put(out, "frequency", spectrum.frequency, "rad/s", "angular frequency")
        where = name.removeprefix("dispersion").strip("_")
        long_name = "mean kinetic energy per bin" + (f", cells {where} the first site" if where else "")
        _put(out, name, spectrum.energy, "J", long_name, "wavenumber", "frequency")
    return left_out


def _put_bands(run: RunFile, velocity: np.ndarray, kinetic: np.ndarray, out: h5py.File, thin: slice) -> None:
    """Write the energies of the parts and the inter-band transfer."""
    parts = Parts.of(pass_bands(run.model.chain.cell))
    energy = part_energies(velocity, run.masses, run.field_interval, parts.edges)
    above = parts.above(run.model.drive.frequency)
    arrival = _arrival(run, kinetic)
    bands = out.create_group("bands")
    _put(bands, "edge", np.arange(len(parts.edges)), "1", "edge of a part")
    _put(bands, "part", np.arange(1, len(parts.names) + 1), "1", "part of the frequency axis")
    _put(bands, "edges", parts.edges, "rad/s", "edges of the pass bands and gaps", "edge")
    _put(bands, "energy", energy[:, thin], "J", "kinetic energy of a part", "part", "time")
    _put(bands, "above", above.astype(np.int8), "1", "1 for a pass band above the driven one", "part")
    bands["energy"].attrs["parts"] = list(parts.names)
    share = _put(out, "ibtet", ibtet(energy, above, arrival.sample), "1", "inter-band energy transfer")
    share.attrs["start"] = run.field_time[arrival.sample]
    share.attrs["starts_when"] = arrival.reason


def _arrival(run: RunFile, kinetic: np.ndarray) -> Arrival:
    if run.leading_site is None:
        after = int(np.searchsorted(run.field_time, run.model.drive.duration))
        return Arrival(min(after, len(run.field_time) - 1), "the drive ends (the lattice has no sites)")
    site = run.nearest(run.site_cells[run.leading_site])
    reason = f"the kinetic energy of cell {run.cells[site]} first exceeds 1 % of its largest value"
    return Arrival(front_arrival(kinetic[:, site]), reason)


def _put(group: h5py.Group, name: str, values: object, units: str, long_name: str, *dims: str) -> h5py.Dataset:
    """Write ``values`` over the named dimensions; without any, an array becomes a dimension scale itself."""
    data = group.create_dataset(name, data=values)
    data.attrs["units"], data.attrs["long_name"] = units, long_name
    if not dims and data.ndim:
        data.make_scale(name)
    for axis, dim in enumerate(dims):
        data.dims[axis].attach_scale(group[dim] if dim in group else group.file[dim])
    return data
