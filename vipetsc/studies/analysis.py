"""The measures of one run: ``run.h5`` in, ``analysis.h5`` out.

Kinetic energy in space and time, wavenumber content, dispersion (of the whole record, and of the cells before and
after the first site), wavenumber partition and entropy (wavelets over the cells), energies of the pass bands and
gaps, and the inter-band targeted energy transfer. The measures themselves stand in ``vipetsc.spectra``.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from scipy import fft

import vipetsc
from vipetsc.case import Case, Model
from vipetsc.io.netcdf import Variables, variable
from vipetsc.io.read import field_interval, field_time, leading_site
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
from vipetsc.studies.wavelets import entropy_variables, partition_variables

FORMAT_VERSION = 2
IN_MEMORY = 2**30  # bytes of velocity that are read at once; larger fields are read mass by mass
MAP_SIZE = 20_000_000  # values of a (t, cell) map that are kept; longer records are thinned out in time
HEADROOM = 1.5  # dispersion is kept up to this many times the top band's edge
SNAPSHOTS = 500  # at most this many samples are transformed by wavelets; averages over time need no more
MOST_CELLS = 40_000  # wavelets of longer lattices take minutes: left to those who window the record

# What is measured of one run, and of every run of a sweep; "maps" are the space-time maps of the other measures.
FULL = ("kinetic", "wavenumber", "dispersion", "partition", "entropy", "bands", "maps")
REDUCED = ("entropy", "bands")


def analyse(run: xr.Dataset, measures: Collection[str] = FULL, arrival: float | None = None) -> xr.Dataset:
    """Measure a run.

    Parameters
    ----------
    run
        A run, open or in memory, with its case in the attribute ``case``.
    measures
        Which of ``FULL``; "maps" are the space-time maps of what else is named.
    arrival
        The paper's t_hat in s, the time of the largest host velocity at the first site in the linear run. By
        default it is estimated from the group velocity: half the burst and the way to the site.

    Returns
    -------
    xarray.Dataset
        The content of ``analysis.h5``. What the run cannot give (no sites, a single cell) is left out and named in
        the attribute ``left_out``.
    """
    about = {"format_version": FORMAT_VERSION, "vipetsc_version": vipetsc.__version__}
    about |= {"case": run.attrs["case"], "status": run.attrs.get("status", "")}
    if "velocity" not in run:
        return xr.Dataset(attrs=about | {"left_out": "everything: the velocity was not recorded"})
    analysis = _Analysis.of(run, frozenset(measures), arrival)
    analysis.add_space_time()
    nt, cells = analysis.velocity.shape[:2]
    if nt < 2:
        analysis.left_out.append("dispersion, bands, ibtet, partition, entropy: fewer than two samples were recorded")
    else:
        analysis.add_dispersions()
        analysis.add_bands()
        analysis.add_wavelets()
    if cells == 1:
        analysis.left_out.append("wavenumber_content, partition, entropy: a single cell was recorded")
    about |= {"thinning": analysis.thin.step, "left_out": "; ".join(analysis.left_out)} | analysis.attributes
    return xr.Dataset(analysis.variables, attrs=about)


class _StoredField:
    """A field (t, cell, dof) that stays in its file; what is sliced is read."""

    def __init__(self, field: xr.DataArray) -> None:
        self._field = field
        self.shape = field.shape

    def __getitem__(self, index: Any) -> np.ndarray:
        return np.asarray(self._field[index].values)


@dataclass
class _Analysis:
    """A run on its way to an analysis: what the measures need of it, and what they have given so far.

    ``velocity`` (t, cell, dof) in m/s, ``time`` (t) and ``interval`` in s, ``cells`` (cell) as numbers from 1, ``site``
    the cell of the leading site, None without sites; ``thin`` picks the samples of the space-time maps.
    """

    model: Model
    velocity: Any
    time: np.ndarray
    interval: float
    cells: np.ndarray
    site: int | None
    measures: frozenset[str]
    arrival: float | None
    thin: slice
    variables: Variables = field(default_factory=dict)
    attributes: dict[str, Any] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, run: xr.Dataset, measures: frozenset[str], arrival: float | None) -> _Analysis:
        recorded, leading = run["velocity"], leading_site(run)
        velocity = _StoredField(recorded) if recorded.nbytes > IN_MEMORY else recorded.values
        site = None if leading is None else int(run["sites/cell"].values[leading])
        nt, cells = velocity.shape[:2]
        thin = slice(None, None, -(-nt * cells // MAP_SIZE) if "maps" in measures else -(-nt // SNAPSHOTS))
        model, interval = Case.of(run).model(), field_interval(run)
        return cls(model, velocity, field_time(run), interval, run["cell"].values, site, measures, arrival, thin)

    @property
    def masses(self) -> np.ndarray:
        """Masses (dof) of a cell in kg."""
        return np.asarray(self.model.chain.cell.masses)

    @cached_property
    def kinetic(self) -> np.ndarray:
        """Kinetic energy (t, cell) in J."""
        return kinetic_energy(self.velocity, self.masses)

    def add_space_time(self) -> None:
        """Kinetic energy of the cells, and by wavenumber, over time."""
        self.variables["time"] = variable("time", self.time[self.thin], "s", "time")
        self.variables["cell"] = variable("cell", self.cells, "1", "cell")
        if "kinetic" in self.measures:
            dims, long_name = ("time", "cell"), "kinetic energy of a cell"
            self.variables["kinetic_energy"] = variable(dims, self.kinetic[self.thin], "J", long_name)
        if "wavenumber" in self.measures and len(self.cells) > 1:
            wavenumber, content = wavenumber_content(self.velocity, self.masses)
            wavenumber = wavenumber / int(self.cells[1] - self.cells[0])
            dims, long_name = ("time", "wavenumber"), "kinetic energy per wavenumber bin"
            self.variables["wavenumber"] = variable("wavenumber", wavenumber, "rad/cell", "wavenumber")
            self.variables["wavenumber_content"] = variable(dims, content[self.thin], "J", long_name)

    def add_dispersions(self) -> None:
        """Dispersion of all cells, of those before and of those after the first site."""
        if "dispersion" not in self.measures:
            return
        nt, cells = self.velocity.shape[:2]
        if cells < 2:
            self.left_out.append("dispersion: a single cell was recorded")
            return
        windows = {"dispersion": slice(None)}
        if self.site is None:
            self.left_out.append("dispersion_before, dispersion_after: the lattice has no sites")
        else:
            low, high = map(int, np.searchsorted(self.cells, [self.site, self.site + 1]))
            sides = slice(0, low), slice(high, cells)
            before, after = sides if self.model.drive_cell < self.site else sides[::-1]
            windows |= {"dispersion_before": before, "dispersion_after": after}
        lengths = fft.next_fast_len(nt, real=True), cells
        highest = HEADROOM * pass_bands(self.model.chain.cell)[-1].high
        for name, window in windows.items():
            if len(range(cells)[window]) < 2:
                self.left_out.append(f"{name}: fewer than two of its cells were recorded")
                continue
            side = name.removeprefix("dispersion").strip("_")
            # A wave that crosses the border of a window would smear over all wavenumbers.
            tapers = TAPER, 0.5 if side else TAPER
            field = self.velocity, self.masses, self.interval
            spectrum = dispersion(*field, cells=window, tapers=tapers, lengths=lengths, highest=highest).folded()
            long_name = "mean kinetic energy per bin" + (f", cells {side} the first site" if side else "")
            self.variables["frequency"] = variable("frequency", spectrum.frequency, "rad/s", "angular frequency")
            self.variables[name] = variable(("wavenumber", "frequency"), spectrum.energy, "J", long_name)

    def add_bands(self) -> None:
        """Energies of the pass bands and gaps, and the inter-band transfer."""
        if "bands" not in self.measures:
            return
        parts = Parts.of(pass_bands(self.model.chain.cell))
        energy = part_energies(self.velocity, self.masses, self.interval, parts.edges)
        above = parts.above(self.model.drive.frequency)
        first, reason = self._front()
        total = energy[:, first:].sum(axis=0)
        moving = total > 0
        shares = (energy[:, first:][:, moving] / total[moving]).mean(axis=1)
        edge, part = "bands/edge", "bands/part"
        numbers, names = np.arange(1, len(parts.names) + 1), list(parts.names)
        long_name = "kinetic energy of a part"
        self.variables |= {
            edge: variable(edge, np.arange(len(parts.edges)), "1", "edge of a part"),
            part: variable(part, numbers, "1", "part of the frequency axis"),
            "bands/edges": variable(edge, parts.edges, "rad/s", "edges of the pass bands and gaps"),
            "bands/energy": variable((part, "time"), energy[:, self.thin], "J", long_name, parts=names),
            "bands/above": variable(part, above.astype(np.int8), "1", "1 for a pass band above the driven one"),
            "bands/total": variable("time", self.kinetic.sum(axis=1)[self.thin], "J", "kinetic energy"),
            "bands/share": variable(part, shares, "1", "mean share of a part after the wave's arrival"),
        }
        transfer, told = ibtet(energy, above, first), {"start": self.time[first], "starts_when": reason}
        self.variables["ibtet"] = variable((), transfer, "1", "inter-band energy transfer", **told)

    def _front(self) -> tuple[int, str]:
        """The sample at which the wave reaches the first site, and by what it is told."""
        if self.site is None:
            after = int(np.searchsorted(self.time, self.model.drive.duration))
            return min(after, len(self.time) - 1), "the drive ends (the lattice has no sites)"
        at = int(np.argmin(np.abs(self.cells - self.site)))
        reason = f"the kinetic energy of cell {self.cells[at]} first exceeds 1 % of its largest value"
        return front_arrival(self.kinetic[:, at]), reason

    def add_wavelets(self) -> None:
        """Wavenumber entropy of the host velocity, and partition of the velocity."""
        nt, cells = self.velocity.shape[:2]
        if cells < 2 or not {"partition", "entropy"} & self.measures:
            return
        if cells > MOST_CELLS:
            self.left_out.append(f"partition, entropy: more than {MOST_CELLS} cells were recorded")
            return
        stride = -(-nt // (SNAPSHOTS + 1))
        time, maps = self.time[::stride], "maps" in self.measures
        if "entropy" in self.measures:
            arrival, reason = self._arrival()
            # A record that ends before keeps its last snapshot.
            start = min(int(np.searchsorted(time, arrival)), len(time) - 1)
            host = np.ascontiguousarray(self.velocity[::stride, :, self.model.chain.cell.host])
            self.variables |= entropy_variables(host, time, start, maps)
            self.attributes |= {"entropy/start": time[start], "entropy/starts_when": reason}
        if "partition" in self.measures:
            self.variables |= partition_variables(self.velocity[::stride], self.masses, time, maps)

    def _arrival(self) -> tuple[float, str]:
        """The paper's t_hat in s, and by what it is told."""
        if self.arrival is not None:
            return self.arrival, "the largest host velocity at the first site in the linear run"
        distance = 0 if self.site is None else abs(self.site - 1 - self.model.drive_cell)
        estimate = 0.5 * self.model.drive.duration + distance / self.model.speed
        return estimate, "half the burst and the way to the first site at the group velocity"
