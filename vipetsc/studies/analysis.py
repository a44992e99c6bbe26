"""The measures of one run: ``run.h5`` in, ``analysis.h5`` out.

Kinetic energy in space and time, wavenumber content, dispersion (of the whole record, and of the cells before and
after the first site), wavenumber partition and entropy (wavelets over the cells), energies of the pass bands and
gaps, and the inter-band targeted energy transfer. The measures themselves stand in ``vipetsc.spectra``.
"""

import json
import sys
from collections.abc import Collection
from functools import cached_property
from typing import Any

import numpy as np
import xarray as xr
from scipy import fft

import vipetsc
from vipetsc import spectra
from vipetsc.case import Case
from vipetsc.io.netcdf import tabulated
from vipetsc.io.read import field_interval, field_time, leading_site
from vipetsc.lattice import pass_bands
from vipetsc.lattice.chain import cells_between

FORMAT_VERSION = 2
IN_MEMORY = 2**30  # bytes of velocity that are read at once; larger fields are read mass by mass
MAP_SIZE = 20_000_000  # values of a (t, cell) map that are kept; longer records are thinned out in time
HEADROOM = 1.5  # dispersion is kept up to this many times the top band's edge
SNAPSHOTS = 500  # at most this many samples are transformed by wavelets; averages over time need no more
MOST_CELLS = 40_000  # wavelets of longer lattices take minutes: left to those who window the record
ENDS = 0.02  # share of a record at either end where band energies are too inaccurate for a mean (manual, files.md)

# What is measured of a run whose fields are kept; "maps" are the space-time maps of the other measures.
FULL = ("kinetic", "wavenumber", "dispersion", "partition", "entropy", "bands", "maps")

# Dimensions, units and description of every variable; dimensions of a group are named without it.
LAYOUT = {
    "time": ("time", "s", "time"),
    "cell": ("cell", "1", "cell"),
    "kinetic_energy": ("time cell", "J", "kinetic energy of a cell"),
    "wavenumber": ("wavenumber", "rad/cell", "wavenumber"),
    "wavenumber_content": ("time wavenumber", "J", "kinetic energy per wavenumber bin"),
    "frequency": ("frequency", "rad/s", "angular frequency"),
    "dispersion": ("wavenumber frequency", "J", "mean kinetic energy per bin"),
    "dispersion_before": ("wavenumber frequency", "J", "mean kinetic energy per bin, cells before the first site"),
    "dispersion_after": ("wavenumber frequency", "J", "mean kinetic energy per bin, cells after the first site"),
    "ibtet": ("", "1", "inter-band energy transfer"),
    "ibtet_whole": ("", "1", "inter-band energy transfer as the paper's: the record's last samples are in the mean"),
    "bands/edge": ("bands/edge", "1", "edge of a part"),
    "bands/part": ("bands/part", "1", "part of the frequency axis"),
    "bands/edges": ("bands/edge", "rad/s", "edges of the pass bands and gaps"),
    "bands/energy": ("bands/part time", "J", "kinetic energy of a part"),
    "bands/above": ("bands/part", "1", "1 for a pass band above the driven one"),
    "bands/total": ("time", "J", "kinetic energy"),
    "bands/share": ("bands/part", "1", "mean share of a part after the wave's arrival"),
    "entropy/snapshot": ("entropy/snapshot", "s", "time of a snapshot"),
    "entropy/history": ("entropy/snapshot", "bit", "energy-weighted mean entropy of a snapshot"),
    "entropy/energy_weighted": ("", "bit", "mean over time of the energy-weighted entropy"),
    "entropy/masked": ("", "bit", "mean entropy where the wave is louder than 1 % of its loudest"),
    "entropy/joint": ("", "bit", "mean over time of the entropy over cells and wavenumbers together"),
    "entropy/error": ("", "bit", "deviation over the cells of the masked time mean"),
    "entropy/local": ("entropy/snapshot cell", "bit", "entropy over wavenumbers at a cell"),
    "entropy/weight": ("entropy/snapshot cell", "m2/s2", "wavelet energy at a cell"),
    "partition/snapshot": ("partition/snapshot", "s", "time of a snapshot"),
    "partition/bin": ("partition/bin", "1", "wavenumber bin"),
    "partition/bound": ("partition/bound", "1", "bound of a bin"),
    "partition/bounds": ("partition/bound", "rad/cell", "bounds of the bins"),
    "partition/energy": ("partition/bin partition/snapshot", "J", "kinetic energy of a bin"),
    "partition/kinetic": ("partition/snapshot", "J", "kinetic energy"),
    "partition/reconstructed": ("partition/snapshot", "J", "kinetic energy of the bins' sum"),
    "partition/error": ("partition/snapshot", "1", "relative error of the reconstructed kinetic energy"),
    "partition/cross_share": ("partition/snapshot", "1", "share of the energy between bins"),
    "partition/kinetic_energy": ("partition/bin partition/snapshot cell", "J", "kinetic energy of a bin in a cell"),
}


def analyse(run: xr.Dataset, measures: Collection[str] = FULL, arrival: float | None = None) -> xr.Dataset:
    """The content of ``analysis.h5``, from a ``run``, open or in memory, with its case in the attribute ``case``.

    Of ``FULL`` those ``measures`` are taken; "maps" are the space-time maps of what else is named. ``arrival`` is the
    paper's t_hat in s, the time of the largest host velocity at the first site in the linear run; by default it is
    estimated from the group velocity: half the burst and the way to the site. What the run cannot give (no sites, a
    single cell) is left out and named in the attribute ``left_out``; what the samples and cells that were kept do not
    resolve is named in the list ``warnings`` as well.
    """
    sys.audit("vipetsc.analyse")
    about = {"format_version": FORMAT_VERSION, "vipetsc_version": vipetsc.__version__}
    about |= {"case": run.attrs["case"], "status": run.attrs.get("status", "")}
    if "velocity" not in run:
        return xr.Dataset(attrs=about | {"left_out": "everything: the velocity was not recorded"})
    record = _Record(run)
    nt, cells = record.velocity.shape[:2]
    measures = set(measures) - record.unresolved()
    step = -(-nt * cells // MAP_SIZE) if "maps" in measures else -(-nt // SNAPSHOTS)
    values: dict[str, Any] = {"time": record.time, "cell": record.cells}
    if "kinetic" in measures:
        values["kinetic_energy"] = record.kinetic
    if "wavenumber" in measures and cells > 1:
        content = spectra.wavenumber_content(record.velocity, record.masses)
        values["wavenumber"], values["wavenumber_content"] = content
    if nt < 2:
        record.left_out.append("dispersion, bands, ibtet, partition, entropy: fewer than two samples were recorded")
    else:
        values |= _dispersions(record) if "dispersion" in measures else {}
        values |= _bands(record) if "bands" in measures else {}
        values |= _wavelets(record, measures, arrival) if cells > 1 else {}
    if cells == 1:
        record.left_out.append("wavenumber_content, partition, entropy: a single cell was recorded")
    left_out = "; ".join(record.left_out + record.warnings)
    about |= {"thinning": step, "left_out": left_out, "warnings": json.dumps(record.warnings)}
    about |= record.attributes.pop("", {})
    data = xr.Dataset(tabulated(LAYOUT, values), attrs=about)
    for name, attributes in record.attributes.items():
        data[name].attrs.update(attributes)
    return data.isel(time=slice(None, None, step))


class _Record:
    """What the measures need of a run, and what they tell besides their values: attributes, and what is left out.

    ``masses`` (dof) in kg, ``velocity`` (t, cell, dof) in m/s, ``time`` (t) and ``interval`` in s, ``cells`` (cell) and
    ``site``, the leading one's cell, as numbers from 1. ``attributes`` are those of variables, of groups under "".
    """

    def __init__(self, run: xr.Dataset) -> None:
        field, leading = run["velocity"], leading_site(run)
        self.model = Case.of(run).model()
        self.masses = np.asarray(self.model.chain.cell.masses)
        self.velocity: Any = _StoredField(field) if field.nbytes > IN_MEMORY else field.values
        self.time, self.interval, self.cells = field_time(run), field_interval(run), run["cell"].values
        self.site = None if leading is None else int(run["sites/cell"].values[leading])
        self.attributes: dict[str, dict[str, Any]] = {}
        self.left_out: list[str] = []
        self.warnings: list[str] = []

    def unresolved(self) -> set[str]:
        """Measures that would take waves for longer or slower ones in what was kept; warns of them."""
        top, every = pass_bands(self.model.chain.cell)[-1].high, int(np.diff(self.cells).max(initial=1))
        names: set[str] = set()
        if self.interval * top >= np.pi:
            text = f"fields kept every {self.interval:.4g} s resolve {np.pi / self.interval:.5g} of {top:.5g} rad/s"
            self.warnings.append(f"{text}: dispersion, bands and ibtet are not measured")
            names |= {"dispersion", "bands"}
        if every > 1:
            text = f"fields of one cell in {every} do not resolve waves shorter than {2 * every} cells"
            self.warnings.append(f"{text}: wavenumber_content, dispersion, partition and entropy are not measured")
            names |= {"wavenumber", "dispersion", "partition", "entropy"}
        return names

    @cached_property
    def kinetic(self) -> np.ndarray:
        """Kinetic energy (t, cell) in J."""
        return spectra.kinetic_energy(self.velocity, self.masses)


class _StoredField:
    """A field (t, cell, dof) that stays in its file; what is sliced is read."""

    def __init__(self, field: xr.DataArray) -> None:
        self._field, self.shape = field, field.shape

    def __getitem__(self, index: Any) -> np.ndarray:
        return np.asarray(self._field[index].values)


def _dispersions(record: _Record) -> dict[str, Any]:
    """Dispersion of all cells, of those before and of those after the first site."""
    nt, cells = record.velocity.shape[:2]
    if cells < 2:
        record.left_out.append("dispersion: a single cell was recorded")
        return {}
    values: dict[str, Any] = {}
    windows = {"dispersion": slice(None)}
    if record.site is None:
        record.left_out.append("dispersion_before, dispersion_after: the lattice has no sites")
    elif record.model.chain.ends == "periodic":
        record.left_out.append("dispersion_before, dispersion_after: on a ring the wave goes both ways")
    else:
        low, high = map(int, np.searchsorted(record.cells, [record.site, record.site + 1]))
        sides = slice(0, low), slice(high, cells)
        before, after = sides if record.model.drive_cell < record.site else sides[::-1]
        windows |= {"dispersion_before": before, "dispersion_after": after}
    lengths = fft.next_fast_len(nt, real=True), cells
    highest = HEADROOM * pass_bands(record.model.chain.cell)[-1].high
    measured = record.velocity, record.masses, record.interval
    for name, window in windows.items():
        if len(range(cells)[window]) < 2:
            record.left_out.append(f"{name}: fewer than two of its cells were recorded")
            continue
        # A wave that crosses the border of a window would smear over all wavenumbers.
        tapers = spectra.TAPER, spectra.TAPER if name == "dispersion" else 0.5
        spectrum = spectra.dispersion(*measured, cells=window, tapers=tapers, lengths=lengths, highest=highest).folded()
        values |= {"frequency": spectrum.frequency, name: spectrum.energy}
    return values


def _bands(record: _Record) -> dict[str, Any]:
    """Energies of the pass bands and gaps, and the inter-band transfer from the wave's arrival on."""
    parts = spectra.Parts.of(pass_bands(record.model.chain.cell))
    energy = spectra.part_energies(record.velocity, record.masses, record.interval, parts.edges)
    above = parts.above(record.model.drive.frequency)
    if record.site is None:
        after = int(np.searchsorted(record.time, record.model.drive.duration))
        first, reason = min(after, len(record.time) - 1), "the drive ends (the lattice has no sites)"
    else:
        at = int(np.argmin(np.abs(record.cells - record.site)))
        first = spectra.front_arrival(record.kinetic[:, at])
        reason = f"the kinetic energy of cell {record.cells[at]} first exceeds 1 % of its largest value"
    # The filters see less than the waves' length at the record's ends.
    nt, ends = len(record.time), int(np.ceil(ENDS * len(record.time)))
    first = min(max(first, ends), nt - 1)
    last = max(nt - ends, first + 1)
    total = energy[:, first:last].sum(axis=0)
    moving = total > 0
    about = {"start": record.time[first], "starts_when": f"{reason}, or after the first {ENDS:.0%} of the record"}
    about |= {"end": record.time[last - 1], "ends_when": f"before the last {ENDS:.0%} of the record"}
    record.attributes |= {"bands/energy": {"parts": list(parts.names)}, "bands/share": about, "ibtet": about}
    record.attributes["ibtet_whole"] = {"start": about["start"], "end": record.time[-1]}
    return {
        "bands/edge": np.arange(len(parts.edges)),
        "bands/part": np.arange(1, len(parts.names) + 1),
        "bands/edges": parts.edges,
        "bands/energy": energy,
        "bands/above": above.astype(np.int8),
        "bands/total": record.kinetic.sum(axis=1),
        "bands/share": (energy[:, first:last][:, moving] / total[moving]).mean(axis=1),
        "ibtet": spectra.ibtet(energy[:, :last], above, first),
        "ibtet_whole": spectra.ibtet(energy, above, first),
    }


def _wavelets(record: _Record, measures: Collection[str], arrival: float | None) -> dict[str, Any]:
    """Wavenumber entropy of the host velocity, and partition of the velocity, at snapshots."""
    nt, cells = record.velocity.shape[:2]
    values: dict[str, Any] = {}
    if cells > MOST_CELLS and {"partition", "entropy"} & set(measures):
        record.left_out.append(f"partition, entropy: more than {MOST_CELLS} cells were recorded")
        return values
    stride, maps, cell = -(-nt // (SNAPSHOTS + 1)), "maps" in measures, record.model.chain.cell
    time = record.time[::stride]
    if "entropy" in measures:
        reason = "the largest host velocity at the first site in the linear run"
        if arrival is None:
            chain, start = record.model.chain, record.model.drive_cell
            distance = 0 if record.site is None else cells_between(record.site - 1, start, chain.cells, chain.ends)
            arrival = float(0.5 * record.model.drive.duration + distance / record.model.speed)
            reason = "half the burst and the way to the first site at the group velocity"
        # A record that ends before keeps its last snapshot.
        start = min(int(np.searchsorted(time, arrival)), len(time) - 1)
        entropy = spectra.entropy(np.ascontiguousarray(record.velocity[::stride, :, cell.host]), start)
        names = "energy_weighted", "masked", "joint", "error", *(("local", "weight") if maps else ())
        values |= {"entropy/snapshot": time, "entropy/history": entropy.snapshot}
        values |= {f"entropy/{name}": getattr(entropy, name) for name in names}
        record.attributes[""] = {"entropy/start": time[start], "entropy/starts_when": reason}
    if "partition" in measures:
        partition = spectra.partition(record.velocity[::stride], record.masses, fields=maps)
        bins = len(partition.energy)
        names = "energy", "kinetic", "reconstructed", "error", "cross_share"
        values |= {"partition/snapshot": time, "partition/bin": np.arange(1, bins + 1)}
        values |= {"partition/bound": np.arange(bins + 1), "partition/bounds": np.arange(bins + 1) * np.pi / bins}
        values |= {f"partition/{name}": getattr(partition, name) for name in names}
        values |= {"partition/kinetic_energy": partition.field} if maps else {}
    return values
