"""The measures of one run: the content of ``analysis.h5`` from that of ``run.h5``.

They are the kinetic energy in space and time, the wavenumber content, the dispersion (of all cells, and of those before
and after the first site), the wavenumber partition and entropy (by wavelets over the cells), the energies of the pass
bands and gaps, the inter-band targeted energy transfer, and the energies of the linear modes. ``vipetsc.spectra`` has
the formulas; ``studies.reanalysis`` writes the file.
"""

import json
import sys
from collections.abc import Callable, Collection, Mapping
from functools import partial
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
import xarray as xr

import vipetsc
from vipetsc import spectra
from vipetsc.case import Case
from vipetsc.case.schema import AnalysisTable
from vipetsc.io.netcdf import tabulated
from vipetsc.parallel import divided, on_every_rank, on_root
from vipetsc.sources import source_key
from vipetsc.spectra.measures import MEASURES, PART, row_of, take
from vipetsc.studies.analysis_options import describe_options
from vipetsc.studies.band_measures import BANDS, band_energies
from vipetsc.studies.dispersion_measures import dispersions_by_side
from vipetsc.studies.modal_measures import MODAL, modal_energies
from vipetsc.studies.run_record import record_of
from vipetsc.studies.velocity_record import VelocityRecord

# Intervals, at most, between the samples that are transformed by wavelets. In two runs of 300 cells with 4421 samples
# mean entropies from 500 differ by 0.004 bit at most from those of all samples, from 125 by up to 0.015. 500 take 0.2 s
# of CPU, and all samples nine times as many transforms.
SNAPSHOTS = 500
MOST_CELLS = 40_000  # wavelets of longer lattices take minutes: a window of cells is needed

# Measures of a run's fields; "maps" are the space-time maps of the others.
OF_FIELDS = ("kinetic", "wavenumber", "dispersion", "partition", "entropy", "bands", "modal", "transfers", "maps")
# Measures of a run whose fields are stored: "motion" are those of named points and the largest force, "statistics"
# those of the run's ledger and log.
FULL = (*OF_FIELDS, "motion", "statistics")
# Measures of a sweep's member whose fields are stored, by the sweep's ``measures``, as its pictures need them.
WHOLE = {
    "entropy": ("kinetic", "wavenumber", "dispersion", "partition", "entropy", "maps"),
    "transfer": ("kinetic", "dispersion", "bands", "modal", "maps"),
}

# Dimensions, units and description of every variable. In the file a dimension of a group is named without the group, so
# that a group must not use both: ``partition/kinetic_energy`` uses ``cell``, and there is no ``partition/cell``.
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
        "entropy/energy_weighted": MEASURES["entropy/energy_weighted"].row,
        "entropy/masked": MEASURES["entropy/masked"].row,
        "entropy/joint": MEASURES["entropy/joint"].row,
        "entropy/error": MEASURES["entropy/error"].row,
        "entropy/at_cell": ("entropy/at_cell", "1", "cell"),
        "entropy/local": ("entropy/snapshot entropy/at_cell", "bit", "entropy over wavenumbers at a cell"),
        "entropy/weight": ("entropy/snapshot entropy/at_cell", "m2/s2", "wavelet energy at a cell"),
        "partition/snapshot": ("partition/snapshot", "s", "time of a snapshot"),
        "partition/bin": ("partition/bin", "1", "wavenumber bin"),
        "partition/bound": ("partition/bound", "1", "bound of a bin"),
        "partition/bounds": ("partition/bound", "rad/cell", "bounds of the bins"),
        "partition/energy": ("partition/bin partition/snapshot", "J", "kinetic energy of a bin"),
        "partition/kinetic": ("partition/snapshot", "J", "kinetic energy"),
        "partition/reconstructed": ("partition/snapshot", "J", "kinetic energy of the sum of all bins"),
        "partition/error": ("partition/snapshot", "1", "relative error of the reconstructed kinetic energy"),
        "partition/cross_share": ("partition/snapshot", "1", "fraction of the energy in products of different bins"),
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
    comm: MPI.Comm = MPI.COMM_SELF,
    case: Case | None = None,
) -> xr.Dataset:
    """Return content of ``analysis.h5``, from a ``run``, open or in memory, with its case in the attribute ``case``.

    Those ``measures`` of ``FULL`` are taken; "maps" are the space-time maps of what else is named. ``arrival`` is the
    paper's t_hat in s, when the peak of the linear wave is at the first site (``spectra.arrivals``); by default it is
    estimated from the group velocity. Entropies are averaged from it on, energies of bands from the front of the run's
    own wave on. ``options`` are the case's where none are given. ``case`` is the run's, where the caller has it.
    Measures that the run does not allow (no sites, a single cell) are left out and named in the attribute ``left_out``;
    those that the stored samples and cells do not resolve are also named in the list ``warnings``.

    The ranks of ``comm`` take different measures of the same run; all must call it, and all get all measures.
    """
    sys.audit("vipetsc.analyse")
    if case is None:
        case = Case.of(run)
    options = options or case.analysis or AnalysisTable.model_validate({})
    about = {
        "vipetsc_version": vipetsc.__version__,
        "source": source_key(),
        "case": run.attrs["case"],
        "status": run.attrs.get("status", ""),
        "analysis": describe_options(options),
    }
    # On one rank, since they include measures of a user's module.
    numbers = on_root(comm, lambda: _numbers(run, case, options, measures))
    about["unsettled"] = json.dumps(numbers.warnings)
    if "velocity" not in run:
        left_out = "all measures of fields: the velocity was not recorded"
        about |= {"left_out": left_out, "warnings": json.dumps(numbers.warnings)}
        return _dataset(LAYOUT | numbers.layout, numbers.values, about, numbers.attributes)

    record = on_every_rank(comm, lambda: VelocityRecord(run, case, options))
    wavelets = partial(_wavelets, arrival=arrival)
    values = _measure(run, record, set(measures) - record.unresolved(), wavelets, comm) | numbers.values
    layout = LAYOUT | numbers.layout
    record.warnings += numbers.warnings
    about["left_out"] = "; ".join(record.left_out + record.warnings)
    about["warnings"] = json.dumps(record.warnings)
    # Attributes of the file itself stand under the name "", since they belong to no variable.
    about |= record.attributes.pop("", {})

    # Axes are written only where some variable needs them.
    dims = {dim for name in values for dim in layout[name][0].split()}
    axes = {"time": record.mean_time, "cell": record.mean_cells, "bands/sample": record.time}
    values = {name: axis for name, axis in axes.items() if name in dims} | values
    return _dataset(layout, values, about, record.attributes | numbers.attributes)


def _dataset(
    layout: Mapping[str, tuple[str, str, str]],
    values: Mapping[str, Any],
    about: Mapping[str, Any],
    attributes: Mapping[str, Mapping[str, Any]],
) -> xr.Dataset:
    """Return the dataset of ``values`` by name in the ``layout``, with attributes of its own and of variables."""
    data = xr.Dataset(tabulated(layout, values), attrs=dict(about))
    for name, texts in attributes.items():
        data[name].attrs.update(texts)
    return data


class Numbers(NamedTuple):
    """Measures of ``spectra.measures`` that are single numbers of a run, or one number for each part of the bands.

    ``layout``, ``values`` and ``attributes`` have the rows of the layout, the values and the attributes of the
    variables by name; ``warnings`` are sentences about them.
    """

    layout: dict[str, tuple[str, str, str]]
    values: dict[str, Any]
    attributes: dict[str, dict[str, Any]]
    warnings: list[str]


def _numbers(run: xr.Dataset, case: Case, options: AnalysisTable, measures: Collection[str]) -> Numbers:
    """Return the numbers of a ``run`` by those ``measures`` that ``spectra.measures`` has."""
    record = record_of(run, case, options)
    taken = take(record, measures)
    layout: dict[str, tuple[str, str, str]] = {}
    values = dict(taken)
    attributes: dict[str, dict[str, Any]] = {}
    for name in taken:
        dimension, unit, text = row_of(name)
        if dimension == PART:
            dimension = "bands/part"  # its name in files of a single run
            values["bands/part"] = np.arange(1, len(record.parts) + 1)
            attributes[name] = {"parts": list(record.parts)}
        layout[name] = (dimension, unit, text)
        if name.startswith("steady"):
            attributes[name] = {"periods": record.periods, "tolerance": record.tolerance}
    return Numbers(layout, values, attributes, record.warnings)


class MeasuredKind(NamedTuple):
    """Measures of one kind: variables by name, attributes of these, sentences on what is left out."""

    values: dict[str, Any]
    attributes: dict[str, dict[str, Any]]
    left_out: list[str]


def _measure(
    run: xr.Dataset,
    record: VelocityRecord,
    measures: Collection[str],
    by_wavelets: Callable[[VelocityRecord, Collection[str]], dict[str, Any]],
    comm: MPI.Comm,
) -> dict[str, Any]:
    """Return variables of ``measures``, by the ranks of ``comm`` together; the ``record`` says what cannot be computed.

    ``by_wavelets`` gives the partition and the entropy of a record.
    """
    measures = set(measures)
    samples, cells = record.velocity.shape[:2]

    # Each kind enters its attributes and what it leaves out into a blank copy of the record: ranks take different
    # kinds.
    def maps(blank: VelocityRecord) -> dict[str, Any]:
        if {"kinetic", "wavenumber"} & measures:
            return _maps(blank, measures)
        return {}

    def dispersions(blank: VelocityRecord) -> dict[str, Any]:
        if samples < 2:
            blank.left_out.append("dispersion, bands, ibtet, partition, entropy: fewer than two samples were recorded")
            return {}
        if "dispersion" in measures:
            return dispersions_by_side(blank)
        return {}

    def bands(blank: VelocityRecord) -> dict[str, Any]:
        if samples > 1 and "bands" in measures:
            return band_energies(blank, measures)
        return {}

    def wavelets(blank: VelocityRecord) -> dict[str, Any]:
        if samples > 1 and cells > 1:
            return by_wavelets(blank, measures)
        return {}

    def modes(blank: VelocityRecord) -> dict[str, Any]:
        values: dict[str, Any] = {}
        # The energies of the modes at an instant need no second sample.
        if {"modal", "transfers"} & measures:
            values = modal_energies(run, blank, measures)
        if cells == 1:
            blank.left_out.append("wavenumber_content, partition, entropy: a single cell was recorded")
        return values

    def measured(kind: Callable[[VelocityRecord], dict[str, Any]]) -> MeasuredKind:
        blank = record.blank()
        return MeasuredKind(kind(blank), blank.attributes, blank.left_out)

    values: dict[str, Any] = {}
    for of_kind in divided(comm, [partial(measured, kind) for kind in (maps, dispersions, bands, wavelets, modes)]):
        values |= of_kind.values
        record.attributes |= of_kind.attributes
        record.left_out += of_kind.left_out
    return values


def _maps(record: VelocityRecord, measures: Collection[str]) -> dict[str, Any]:
    """Return kinetic energy of cells and of wavenumbers over time, from blocks of samples that fit into the memory."""
    nt, cells, dofs = record.velocity.shape
    samples = record.sizes[0]
    # Wavenumbers in a bin of the map; there are half as many wavenumbers from 0 to pi as cells.
    pooled = -(-cells // (2 * record.options.pixels))
    kinetic = []
    contents = []
    total = []
    wavenumber = np.zeros(0)
    # Blocks hold whole rows of the map, so that no mean is cut in two.
    for rows in spectra.blocks(-(-nt // samples), 8 * samples * cells * dofs, record.memory):
        velocity = np.asarray(record.weighted[rows.start * samples : rows.stop * samples])
        energy = spectra.kinetic_energy(velocity, record.masses)
        total.append(energy.sum(axis=1))
        kinetic.append(record.mean(energy))
        if "wavenumber" in measures and cells > 1:
            wavenumber, content = spectra.wavenumber_content(velocity, record.masses)
            wavenumber = spectra.block_means(wavenumber, pooled, 0)
            mean_content = spectra.block_means(content, samples, 0)
            contents.append(spectra.block_sums(mean_content, pooled, 1).astype(np.float32))

    values: dict[str, Any] = {}
    if "kinetic" in measures:
        values["kinetic_energy"] = np.concatenate(kinetic)
        if "bands" in measures and nt > 1:
            # The total of the bands comes from the same pass through the field.
            values["bands/total"] = np.concatenate(total)
    if contents:
        values["wavenumber"] = wavenumber
        values["wavenumber_content"] = np.concatenate(contents)
    return values


def _wavelets(record: VelocityRecord, measures: Collection[str], arrival: float | None) -> dict[str, Any]:
    """Return the wavenumber entropy of the host velocity, and partition of the velocity, at snapshots."""
    nt, cells = record.velocity.shape[:2]
    if cells > MOST_CELLS and {"partition", "entropy"} & set(measures):
        record.left_out.append(f"partition, entropy: more than {MOST_CELLS} cells were recorded")
        return {}

    stride = -(-nt // (SNAPSHOTS + 1))
    maps = "maps" in measures
    values: dict[str, Any] = {}
    if "partition" in measures:
        values |= _partition(record, stride * record.options.snapshot_stride, maps)
    if "entropy" in measures:
        values |= _entropies(record, stride, arrival, maps)
    return values


def _entropies(record: VelocityRecord, stride: int, arrival: float | None, maps: bool) -> dict[str, Any]:
    """Return the entropy of the host velocity at every ``stride``-th sample, with its ``maps``."""
    options = record.options
    time = record.time[:: stride * options.snapshot_stride]
    reason = "the peak of the linear wave at the first site: the largest host velocity there"
    if arrival is None:
        arrival = _estimated_peak(record)
        reason = "half the burst plus the travel time to the first site at the group velocity, which estimates its peak"
    # A record that ends before keeps its last snapshot.
    start = min(int(np.searchsorted(time, arrival)), len(time) - 1)

    host = record.model.chain.cell.host
    velocity = np.ascontiguousarray(record.velocity[::stride, :, host])
    entropy = spectra.entropy(
        velocity, start=start * options.snapshot_stride, stride=options.cell_stride, every=options.snapshot_stride
    )
    # The result from every second snapshot and cell estimates the error of the result from all.
    local = entropy.local[start:][::2, ::2]
    weight = entropy.weight[start:]
    coarse = spectra.averages(local, weight[::2, ::2], start=0, stride=2 * options.cell_stride, largest=weight.max())

    values: dict[str, Any] = {"entropy/snapshot": time, "entropy/history": entropy.snapshot}
    strides = options.model_dump(include={"snapshot_stride", "cell_stride"})
    for name in ("energy_weighted", "masked", "joint", "error"):
        value = getattr(entropy, name)
        values[f"entropy/{name}"] = value
        record.attributes[f"entropy/{name}"] = strides | {"sampling_error": abs(getattr(coarse, name) - value)}
    record.attributes[""] = {"entropy/start": time[start], "entropy/starts_when": reason}

    if maps:
        size = -(-entropy.local.shape[1] // options.pixels)
        values["entropy/at_cell"] = spectra.block_means(record.cells[:: options.cell_stride], size, 0)
        values["entropy/local"] = spectra.block_means(entropy.local, size, 1).astype(np.float32)
        values["entropy/weight"] = spectra.block_means(entropy.weight, size, 1).astype(np.float32)
    return values


def _estimated_peak(record: VelocityRecord) -> float:
    """Return the time in s at which the middle of the burst reaches the first site at the group velocity."""
    chain = record.model.chain
    distance = 0
    if record.site is not None:
        distance = int(chain.topology.distance(record.site - 1, record.model.drive_cell))
    return spectra.estimated_peak(record.model.drive.duration, distance, record.model.speed)


def _partition(record: VelocityRecord, every: int, maps: bool) -> dict[str, Any]:
    """Return the kinetic energies of the wavenumber bins at every ``every``-th sample, with their ``maps``."""
    time = record.time[::every]
    mean_over = record.sizes[1] if maps else 0
    parts = []
    for block in spectra.blocks(len(time), 8 * np.prod(record.velocity.shape[1:]), record.memory):
        snapshots = record.weighted[block.start * every : block.stop * every : every]
        parts.append(spectra.partition(snapshots, record.masses, mean_over=mean_over))

    bins = len(parts[0].energy)
    values: dict[str, Any] = {
        "partition/snapshot": time,
        "partition/bin": np.arange(1, bins + 1),
        "partition/bound": np.arange(bins + 1),
        "partition/bounds": np.arange(bins + 1) * np.pi / bins,
    }
    for name in ("energy", "kinetic", "reconstructed", "error", "cross_share"):
        values[f"partition/{name}"] = np.concatenate([getattr(part, name) for part in parts], axis=-1)
    if maps:
        values["partition/kinetic_energy"] = np.concatenate([part.field for part in parts], axis=1).astype(np.float32)
    return values
