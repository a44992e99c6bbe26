"""The measures of one run: ``run.h5`` in, ``analysis.h5`` out."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from scipy import fft

from vipetsc.case import Case
from vipetsc.io.atomic import atomic_write
from vipetsc.io.run_file import RunFile
from vipetsc.lattice import pass_bands
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
from vipetsc.studies.datasets import put
from vipetsc.studies.wavelets import SNAPSHOTS, put_wavelets

FORMAT_VERSION = 2
IN_MEMORY = 2**30  # bytes of velocity that are read at once; larger fields are read mass by mass
MAP_SIZE = 20_000_000  # values of a (t, cell) map that are written; longer records are thinned out in time
HEADROOM = 1.5  # dispersion is kept up to this many times the top band's edge


# What is measured of one run, and of every run of a sweep; "maps" are the space-time maps of the other measures.
FULL = ("kinetic", "wavenumber", "dispersion", "partition", "entropy", "bands", "maps")
REDUCED = ("entropy", "bands")


@dataclass(frozen=True)
class Arrival:
    """When the wave reached the first site: ``sample`` of the fields, and by what it is told."""

    sample: int
    reason: str


def analyse(
    run: RunFile | str | Path, out_path: str | Path, measures: Sequence[str] = FULL, arrival: float | None = None
) -> None:
    """Measure ``run`` and write ``out_path``, complete or not at all.

    Kinetic energy in space-time, wavenumber content, dispersion of the whole record and of the cells before
    and after the first site, wavenumber partition, entropy, energies of the pass bands and gaps, and the
    inter-band transfer. What a run cannot give (no sites, a single cell) is left out and named in the
    attribute ``left_out``.

    Parameters
    ----------
    run
        An open run, or the path of ``run.h5``.
    measures
        Which of ``FULL``; "maps" are the space-time maps of what else is named.
    arrival
        The paper's t_hat in s, the time of the largest host velocity at the first site in the linear run. By
        default it is estimated from the group velocity: half the burst and the way to the site.

    Raises
    ------
    OSError, ValueError
        If the run cannot be read or is not one of ours.
    """
    with ExitStack() as stack:
        aside = stack.enter_context(atomic_write(Path(out_path)))
        if not isinstance(run, RunFile):
            run = stack.enter_context(RunFile(run))
        out = stack.enter_context(h5py.File(aside, "w"))
        _measure(run, out, frozenset(measures), arrival)


def describe(out: h5py.File, case: Case, status: str) -> None:
    """Root attributes of an analysis: the resolved case and how its run ended."""
    out.attrs["format_version"] = FORMAT_VERSION
    out.attrs["case"] = case.to_toml()
    out.attrs["status"] = status


def _measure(run: RunFile, out: h5py.File, measures: frozenset[str], arrival: float | None) -> None:
    describe(out, run.case, run.file.attrs.get("status", ""))
    if "velocity" not in run.file:
        out.attrs["left_out"] = "everything: the velocity was not recorded"
        return
    velocity = run.velocity if run.velocity.nbytes > IN_MEMORY else run.velocity[...]
    nt, cells = velocity.shape[:2]
    thinning = -(-nt * cells // MAP_SIZE) if "maps" in measures else -(-nt // SNAPSHOTS)
    thin = slice(None, None, thinning)
    out.attrs["thinning"] = thinning
    left_out = []

    put(out, "time", run.field_time[thin], "s", "time")
    put(out, "cell", run.cells, "1", "cell")
    kinetic = kinetic_energy(velocity, run.masses) if {"kinetic", "bands"} & measures else None
    if "kinetic" in measures:
        put(out, "kinetic_energy", kinetic[thin], "J", "kinetic energy of a cell", "time", "cell")
    if cells > 1 and "wavenumber" in measures:
        wavenumber, content = wavenumber_content(velocity, run.masses)
        put(out, "wavenumber", wavenumber / run.spacing, "rad/cell", "wavenumber")
        long_name = "kinetic energy per wavenumber bin"
        put(out, "wavenumber_content", content[thin], "J", long_name, "time", "wavenumber")
    if nt < 2:
        left_out.append("dispersion, bands, ibtet, partition, entropy: fewer than two samples were recorded")
    else:
        if "dispersion" in measures:
            left_out += _put_dispersions(run, velocity, out)
        if "bands" in measures:
            _put_bands(run, velocity, kinetic, out, thin)
        if cells > 1 and {"partition", "entropy"} & measures:
            left_out += put_wavelets(run, velocity, out, measures, arrival)
    if cells == 1:
        left_out.append("wavenumber_content, partition, entropy: a single cell was recorded")
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
            put(out, "frequency", spectrum.frequency, "rad/s", "angular frequency")
        where = name.removeprefix("dispersion").strip("_")
        long_name = "mean kinetic energy per bin" + (f", cells {where} the first site" if where else "")
        put(out, name, spectrum.energy, "J", long_name, "wavenumber", "frequency")
    return left_out


def _put_bands(run: RunFile, velocity: np.ndarray, kinetic: np.ndarray, out: h5py.File, thin: slice) -> None:
    """Write the energies of the parts and the inter-band transfer."""
    parts = Parts.of(pass_bands(run.model.chain.cell))
    energy = part_energies(velocity, run.masses, run.field_interval, parts.edges)
    above = parts.above(run.model.drive.frequency)
    arrival = _arrival(run, kinetic)
    bands = out.create_group("bands")
    put(bands, "edge", np.arange(len(parts.edges)), "1", "edge of a part")
    put(bands, "part", np.arange(1, len(parts.names) + 1), "1", "part of the frequency axis")
    put(bands, "edges", parts.edges, "rad/s", "edges of the pass bands and gaps", "edge")
    put(bands, "energy", energy[:, thin], "J", "kinetic energy of a part", "part", "time")
    put(bands, "above", above.astype(np.int8), "1", "1 for a pass band above the driven one", "part")
    bands["energy"].attrs["parts"] = list(parts.names)
    put(bands, "total", kinetic.sum(axis=1)[thin], "J", "kinetic energy", "time")
    whole = energy[:, arrival.sample :].sum(axis=0)
    moving = whole > 0
    shares = (energy[:, arrival.sample :][:, moving] / whole[moving]).mean(axis=1)
    put(bands, "share", shares, "1", "mean share of a part after the wave's arrival", "part")
    share = put(out, "ibtet", ibtet(energy, above, arrival.sample), "1", "inter-band energy transfer")
    share.attrs["start"] = run.field_time[arrival.sample]
    share.attrs["starts_when"] = arrival.reason


def _arrival(run: RunFile, kinetic: np.ndarray) -> Arrival:
    if run.leading_site is None:
        after = int(np.searchsorted(run.field_time, run.model.drive.duration))
        return Arrival(min(after, len(run.field_time) - 1), "the drive ends (the lattice has no sites)")
    site = run.nearest(run.site_cells[run.leading_site])
    reason = f"the kinetic energy of cell {run.cells[site]} first exceeds 1 % of its largest value"
    return Arrival(front_arrival(kinetic[:, site]), reason)
