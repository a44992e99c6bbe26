"""The measures of one run: ``run.h5`` in, ``analysis.h5`` out.

Kinetic energy in space and time, wavenumber content, dispersion (of the whole record, and of the cells before and
after the first site), wavenumber partition and entropy (wavelets over the cells), energies of the pass bands and
gaps, the inter-band targeted energy transfer, and the energies of the linear modes. The measures themselves stand in
``vipetsc.spectra``.
"""

import json
import sys
from collections.abc import Collection
from typing import Any

import numpy as np
import xarray as xr
from scipy import fft

import vipetsc
from vipetsc import spectra
from vipetsc.case.schema import AnalysisTable
from vipetsc.io.netcdf import tabulated
from vipetsc.lattice import pass_bands
from vipetsc.lattice.chain import cells_between
from vipetsc.studies.band_measures import BANDS, band_energies
from vipetsc.studies.modal_measures import MODAL, modal_energies
from vipetsc.studies.velocity_record import VelocityRecord, options_of

FORMAT_VERSION = 3
HEADROOM = 1.5  # dispersion is kept up to this many times the top band's edge
SNAPSHOTS = 500  # at most this many samples are transformed by wavelets
MOST_CELLS = 40_000  # wavelets of longer lattices take minutes: left to those who window the record

# What is measured of a run whose fields are kept; "maps" are the space-time maps of the other measures.
FULL = ("kinetic", "wavenumber", "dispersion", "partition", "entropy", "bands", "modal", "transfers", "maps")
# Of a member of a sweep whose fields are kept, by the sweep's ``measures``: what its pictures show.
WHOLE = {
    "entropy": ("kinetic", "wavenumber", "dispersion", "partition", "entropy", "maps"),
    "transfer": ("kinetic", "dispersion", "bands", "modal", "maps"),
}

# Dimensions, units and description of every variable; dimensions of a group are named without it, so none may be
# called as one outside that the group uses.
LAYOUT = (
    {
        "time": ("time", "s", "time"),
        "cell": ("cell", "1", "cell"),
        "kinetic_energy": ("time cell", "J", "kinetic energy of a cell"),
        "wavenumber": ("wavenumber", "rad/cell", "wavenumber"),
        "wavenumber_content": ("time wavenumber", "J", "kinetic energy per wavenumber bin"),
        "frequency": ("frequency", "rad/s", "angular frequency"),
        "dispersion": ("wavenumber frequency", "J", "mean kinetic energy per bin"),
        "dispersion_before": ("wavenumber frequency", "J", "mean kinetic energy per bin, cells before the first site"),
        "dispersion_after": ("wavenumber frequency", "J", "mean kinetic energy per bin, cells after the first site"),
        "entropy/snapshot": ("entropy/snapshot", "s", "time of a snapshot"),
        "entropy/history": ("entropy/snapshot", "bit", "energy-weighted mean entropy of a snapshot"),
        "entropy/energy_weighted": ("", "bit", "mean over time of the energy-weighted entropy"),
        "entropy/masked": ("", "bit", "mean entropy where the wave is louder than 1 % of its loudest"),
        "entropy/joint": ("", "bit", "mean over time of the entropy over cells and wavenumbers together"),
        "entropy/error": ("", "bit", "deviation over the cells of the masked time mean"),
        "entropy/cell": ("entropy/cell", "1", "cell"),
        "entropy/local": ("entropy/snapshot entropy/cell", "bit", "entropy over wavenumbers at a cell"),
        "entropy/weight": ("entropy/snapshot entropy/cell", "m2/s2", "wavelet energy at a cell"),
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
    | BANDS
    | MODAL
)


def analyse(
    run: xr.Dataset,
    measures: Collection[str] = FULL,
    arrival: float | None = None,
    options: AnalysisTable | None = None,
) -> xr.Dataset:
    """The content of ``analysis.h5``, from a ``run``, open or in memory, with its case in the attribute ``case``.

    Of ``FULL`` those ``measures`` are taken; "maps" are the space-time maps of what else is named. ``arrival`` is the
    paper's t_hat in s, the time of the largest host velocity at the first site in the linear run; by default it is
    estimated from the group velocity: half the burst and the way to the site. ``options`` are the case's where none
    are given. What the run cannot give (no sites, a single cell) is left out and named in the attribute ``left_out``;
    what the samples and cells that were kept do not resolve is named in the list ``warnings`` as well.
    """
    sys.audit("vipetsc.analyse")
    about = {"format_version": FORMAT_VERSION, "vipetsc_version": vipetsc.__version__}
    about |= {"case": run.attrs["case"], "status": run.attrs.get("status", "")}
    options = options or options_of(run)
    about["analysis"] = describe_options(options)
    if "velocity" not in run:
        return xr.Dataset(attrs=about | {"left_out": "everything: the velocity was not recorded"})
    record = VelocityRecord(run, options)
    nt, cells = record.velocity.shape[:2]
    measures = set(measures) - record.unresolved()
    values: dict[str, Any] = _maps(record, measures) if {"kinetic", "wavenumber"} & measures else {}
    if nt < 2:
        record.left_out.append("dispersion, bands, ibtet, partition, entropy: fewer than two samples were recorded")
    else:
        values |= _dispersions(record) if "dispersion" in measures else {}
        values |= band_energies(record, measures) if "bands" in measures else {}
        values |= _wavelets(record, measures, arrival) if cells > 1 else {}
    values |= modal_energies(run, record, measures) if {"modal", "transfers"} & measures else {}
    if cells == 1:
        record.left_out.append("wavenumber_content, partition, entropy: a single cell was recorded")
    left_out = "; ".join(record.left_out + record.warnings)
    about |= {"left_out": left_out, "warnings": json.dumps(record.warnings)}
    about |= record.attributes.pop("", {})
    dims = {dim for name in values for dim in LAYOUT[name][0].split()}
    axes = {"time": record.mean_time, "cell": record.mean_cells, "bands/sample": record.time}
    values = {name: axis for name, axis in axes.items() if name in dims} | values
    data = xr.Dataset(tabulated(LAYOUT, values), attrs=about)
    for name, attributes in record.attributes.items():
        data[name].attrs.update(attributes)
    return data


def describe_options(options: AnalysisTable) -> str:
    """The ``options`` that results depend on, as the attribute ``analysis`` of a file tells them."""
    return json.dumps(options.model_dump(exclude={"memory"}))


def _maps(record: VelocityRecord, measures: Collection[str]) -> dict[str, Any]:
    """Kinetic energy of cells and of wavenumbers over time, from blocks of samples."""
    (nt, cells, dofs), (samples, _) = record.velocity.shape, record.sizes
    kinetic, contents, total, wavenumber = [], [], [], np.zeros(0)
    for rows in spectra.blocks(-(-nt // samples), 8 * samples * cells * dofs, record.memory):
        held = np.asarray(record.weighted[rows.start * samples : rows.stop * samples])
        energy = spectra.kinetic_energy(held, record.masses)
        total.append(energy.sum(axis=1))
        kinetic.append(record.mean(energy))
        if "wavenumber" in measures and cells > 1:
            wavenumber, content = spectra.wavenumber_content(held, record.masses)
            size = -(-cells // (2 * record.options.pixels))
            wavenumber = spectra.block_means(wavenumber, size, 0)
            contents.append(spectra.block_sums(spectra.block_means(content, samples, 0), size, 1).astype(np.float32))
    values = {"kinetic_energy": np.concatenate(kinetic)} if "kinetic" in measures else {}
    if "kinetic" in measures and "bands" in measures and nt > 1:
        values["bands/total"] = np.concatenate(total)
    return values | ({"wavenumber": wavenumber, "wavenumber_content": np.concatenate(contents)} if contents else {})


def _dispersions(record: VelocityRecord) -> dict[str, Any]:
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
    count = np.count_nonzero(2 * np.pi * fft.rfftfreq(lengths[0], record.interval) <= highest)
    sizes = [-(-n // (2 * record.options.pixels)) for n in (cells, count)]
    measured = record.weighted, record.masses, record.interval
    given: dict[str, Any] = {"lengths": lengths, "highest": highest, "memory": record.memory}
    for name, window in windows.items():
        if len(range(cells)[window]) < 2:
            record.left_out.append(f"{name}: fewer than two of its cells were recorded")
            continue
        # A wave that crosses the border of a window would smear over all wavenumbers.
        given |= {"cells": window, "tapers": (spectra.TAPER, spectra.TAPER if name == "dispersion" else 0.5)}
        pieces = []
        for some in spectra.blocks(-(-count // sizes[1]), 16 * cells * sizes[1], record.memory):
            rows = slice(some.start * sizes[1], some.stop * sizes[1])
            pieces.append(spectra.dispersion(*measured, **given, rows=rows).folded().pooled(*sizes))
        energy = np.concatenate([part.energy for part in pieces], axis=1).astype(np.float32)
        frequency = np.concatenate([part.frequency for part in pieces])
        values |= {"wavenumber": pieces[0].wavenumber, "frequency": frequency, name: energy}
    return values


def _wavelets(record: VelocityRecord, measures: Collection[str], arrival: float | None) -> dict[str, Any]:
    """Wavenumber entropy of the host velocity, and partition of the velocity, at snapshots."""
    nt, cells = record.velocity.shape[:2]
    if cells > MOST_CELLS and {"partition", "entropy"} & set(measures):
        record.left_out.append(f"partition, entropy: more than {MOST_CELLS} cells were recorded")
        return {}
    stride, maps = -(-nt // (SNAPSHOTS + 1)), "maps" in measures
    values = _partition(record, stride * record.options.snapshot_stride, maps) if "partition" in measures else {}
    return values | (_entropies(record, stride, arrival, maps) if "entropy" in measures else {})


def _entropies(record: VelocityRecord, stride: int, arrival: float | None, maps: bool) -> dict[str, Any]:
    """Entropy of the host velocity at every ``stride``-th sample, with its ``maps``."""
    options, time = record.options, record.time[:: stride * record.options.snapshot_stride]
    reason = "the largest host velocity at the first site in the linear run"
    if arrival is None:
        chain, start = record.model.chain, record.model.drive_cell
        distance = 0 if record.site is None else cells_between(record.site - 1, start, chain.cells, chain.ends)
        arrival = float(0.5 * record.model.drive.duration + distance / (record.model.speed or np.inf))
        reason = "half the burst and the way to the first site at the group velocity"
    # A record that ends before keeps its last snapshot.
    start = min(int(np.searchsorted(time, arrival)), len(time) - 1)
    host = np.ascontiguousarray(record.velocity[::stride, :, record.model.chain.cell.host])
    entropy = spectra.entropy(host, start * options.snapshot_stride, options.cell_stride, options.snapshot_stride)
    local, weight = entropy.local[start:], entropy.weight[start:]
    doubled = spectra.averages(local[::2, ::2], weight[::2, ::2], 0, 2 * options.cell_stride, weight.max())
    values: dict[str, Any] = {"entropy/snapshot": time, "entropy/history": entropy.snapshot}
    for name in ("energy_weighted", "masked", "joint", "error"):
        values[f"entropy/{name}"] = getattr(entropy, name)
        about = options.model_dump(include={"snapshot_stride", "cell_stride"})
        about |= {"sampling_error": abs(getattr(doubled, name) - getattr(entropy, name))}
        record.attributes[f"entropy/{name}"] = about
    record.attributes[""] = {"entropy/start": time[start], "entropy/starts_when": reason}
    if maps:
        size = -(-entropy.local.shape[1] // options.pixels)
        values["entropy/cell"] = spectra.block_means(record.cells[:: options.cell_stride], size, 0)
        for name in ("local", "weight"):
            values[f"entropy/{name}"] = spectra.block_means(getattr(entropy, name), size, 1).astype(np.float32)
    return values


def _partition(record: VelocityRecord, every: int, maps: bool) -> dict[str, Any]:
    """Kinetic energies of the wavenumber bins at every ``every``-th sample, with their ``maps``."""
    time = record.time[::every]
    blocks = spectra.blocks(len(time), 8 * np.prod(record.velocity.shape[1:]), record.memory)
    windows = (record.weighted[some.start * every : some.stop * every : every] for some in blocks)
    mean_over = record.sizes[1] if maps else 0
    parts = [spectra.partition(window, record.masses, mean_over=mean_over) for window in windows]
    bins = len(parts[0].energy)
    names = "energy", "kinetic", "reconstructed", "error", "cross_share"
    values: dict[str, Any] = {"partition/snapshot": time, "partition/bin": np.arange(1, bins + 1)}
    values |= {"partition/bound": np.arange(bins + 1), "partition/bounds": np.arange(bins + 1) * np.pi / bins}
    values |= {f"partition/{name}": np.concatenate([getattr(p, name) for p in parts], axis=-1) for name in names}
    if maps:
        values["partition/kinetic_energy"] = np.concatenate([p.field for p in parts], axis=1).astype(np.float32)
    return values
