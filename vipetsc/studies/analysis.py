"""The measures of one run: the content of ``analysis.h5`` from that of ``run.h5``.

They are the kinetic energy in space and time, the wavenumber content, the dispersion (of all cells, and of those before
and after the first site), the wavenumber partition and entropy (by wavelets over the cells), the energies of the pass
bands and gaps, the inter-band targeted energy transfer, and the energies of the linear modes. ``vipetsc.spectra`` has
the formulas; ``studies.reanalysis`` writes the file.
"""

import json
import sys
from collections.abc import Callable, Collection
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
from vipetsc.lattice import pass_bands, wave_bands
from vipetsc.parallel import divided, on_every_rank, on_root
from vipetsc.sources import source_key
from vipetsc.spectra import Parts
from vipetsc.spectra.histories import History, SteadyDrive
from vipetsc.spectra.measures import MEASURES, MOTIONS, PART, PERIODS, TOLERANCE, RunRecord, names_in, row_of, take
from vipetsc.studies.analysis_options import describe_options
from vipetsc.studies.band_measures import BANDS, band_energies
from vipetsc.studies.dispersion_measures import DISPERSIONS, dispersions_by_side
from vipetsc.studies.modal_measures import MODAL, modal_energies
from vipetsc.studies.velocity_record import VelocityRecord
from vipetsc.wording import joined

# Intervals, at most, between the samples that are transformed by wavelets. In two runs of 300 cells with 4421 samples
# mean entropies from 500 differ by 0.004 bit at most from those of all samples, from 125 by up to 0.015. 500 take 0.2 s
# of CPU, and all samples nine times as many transforms.
SNAPSHOTS = 500
MOST_CELLS = 40_000  # wavelets of longer lattices take minutes: a window of cells is needed

# Dimensions, units and description of every variable. In the file a dimension of a group is named without the group, so
# that a group must not use both: ``partition/kinetic_energy`` uses ``cell``, and there is no ``partition/cell``.
MAPS = {
    "kinetic_energy": ("time cell", "J", "kinetic energy of a cell"),
    "wavenumber": ("wavenumber", "rad/cell", "wavenumber"),
    "wavenumber_content": ("time wavenumber", "J", "kinetic energy per wavenumber bin"),
    "bands/total": ("bands/sample", "J", "kinetic energy"),
}
ENTROPY = {
    "entropy/snapshot": ("entropy/snapshot", "s", "time of a snapshot"),
    "entropy/history": ("entropy/snapshot", "bit", "energy-weighted mean entropy of a snapshot"),
    "entropy/energy_weighted": MEASURES["entropy/energy_weighted"].row,
    "entropy/masked": MEASURES["entropy/masked"].row,
    "entropy/joint": MEASURES["entropy/joint"].row,
    "entropy/error": MEASURES["entropy/error"].row,
    "entropy/at_cell": ("entropy/at_cell", "1", "cell"),
    "entropy/local": ("entropy/snapshot entropy/at_cell", "bit", "entropy over wavenumbers at a cell"),
    "entropy/weight": ("entropy/snapshot entropy/at_cell", "m2/s2", "wavelet energy at a cell"),
}
PARTITION = {
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


class Need(NamedTuple):
    """What measures need of a record: ``reason`` is why it lacks that, empty if it does not.

    ``is_warning``: whether a user who has not asked for less would want to know.
    """

    reason: Callable[[VelocityRecord], str]
    is_warning: bool = False


def _without_bands(record: VelocityRecord) -> str:
    return "" if record.model.chain.cell.joins_cells else "without springs from cell to cell a lattice has no bands"


def _aliased_in_time(record: VelocityRecord) -> str:
    """Return why fields that are stored at too few samples do not show waves: the top band would appear at lower ones.

    That is so beyond the Nyquist limit.
    """
    # Without waves the highest frequency is 0; a single sample has no interval (NaN).
    top = max((band.high for band in wave_bands(record.model.chain.cell)), default=0.0)
    if not record.interval * top >= np.pi:
        return ""
    return f"fields stored every {record.interval:.4g} s resolve {np.pi / record.interval:.5g} of {top:.5g} rad/s"


def _aliased_in_space(record: VelocityRecord) -> str:
    """Return why fields of every n-th cell do not show waves: short ones would appear as longer ones."""
    every = int(np.diff(record.cells).max(initial=1))
    return f"fields of one cell in {every} do not resolve waves shorter than {2 * every} cells" if every > 1 else ""


def _single_sample(record: VelocityRecord) -> str:
    return "" if len(record.time) > 1 else "fewer than two samples were recorded"


def _single_cell(record: VelocityRecord) -> str:
    return "" if len(record.cells) > 1 else "a single cell was recorded"


def _many_cells(record: VelocityRecord) -> str:
    return "" if len(record.cells) <= MOST_CELLS else f"more than {MOST_CELLS} cells were recorded"


def _without_displacement(record: VelocityRecord) -> str:
    is_recorded = "displacement" in record.run or "end/displacement" in record.run
    return "" if is_recorded else "the displacement was not recorded"


def _missing_cells(record: VelocityRecord) -> str:
    missing = record.model.chain.cells - len(record.cells)
    return f"{missing} cells were not recorded" if missing else ""


BANDED = Need(_without_bands)
RESOLVED_IN_TIME = Need(_aliased_in_time, is_warning=True)
RESOLVED_IN_SPACE = Need(_aliased_in_space, is_warning=True)
SAMPLES = Need(_single_sample)
CELLS = Need(_single_cell)
FEW_CELLS = Need(_many_cells)
DISPLACEMENT = Need(_without_displacement)
ALL_CELLS = Need(_missing_cells)


class Kind(NamedTuple):
    """Measures that are computed together: their ``names`` in sentences, and what they need, the first reason first.

    They are taken if any of the variables that the kind ``gives`` is asked for, maps and histories among them only if
    they are. Kinds that have one function, ``take(record, asked)``, are measured in one pass through the record.
    """

    names: tuple[str, ...]
    take: Callable[[VelocityRecord, Collection[str]], xr.Dataset]
    gives: Collection[str]
    needs: tuple[Need, ...] = ()


def analyse(
    run: xr.Dataset,
    measures: Collection[str] | None = None,
    arrival: float | None = None,
    options: AnalysisTable | None = None,
    comm: MPI.Comm = MPI.COMM_SELF,
    case: Case | None = None,
) -> xr.Dataset:
    """Return content of ``analysis.h5``, from a ``run``, open or in memory, with its case in the attribute ``case``.

    ``measures`` are names of variables of the file, with those that are computed together with them, or of groups of
    them ("entropy", "transfer", "motion", "statistics"); by default all. ``arrival`` is the paper's t_hat in s, when
    the peak of the linear wave is at the first site (``spectra.arrivals``); by default it is estimated from the group
    velocity. Entropies are averaged from it on, energies of bands from the front of the run's own wave on. ``options``
    are the case's where none are given. ``case`` is the run's, where the caller has it. Measures that the run does not
    allow (no sites, a single cell) are left out and named in the attribute ``left_out``; those that the stored samples
    and cells do not resolve are also named in the list ``warnings``.

    The ranks of ``comm`` take different measures of the same run; all must call it, and all get all measures.
    """
    sys.audit("vipetsc.analyse")
    if case is None:
        case = Case.of(run)
    options = options or case.analysis or AnalysisTable.model_validate({})
    asked = None if measures is None else names_in(measures)
    # On one rank, since they include measures of a user's module.
    numbers = on_root(comm, lambda: _numbers(run, case, options, asked))
    unsettled = numbers.attrs.pop("warnings")
    parts = [numbers]
    left_out = ["all measures of fields: the velocity was not recorded"]
    warnings: list[str] = []
    if "velocity" in run:
        left_out = []
        record = on_every_rank(comm, lambda: VelocityRecord(run, case, options))
        lacking: dict[Need, list[str]] = {}
        jobs: dict[Callable[[VelocityRecord, Collection[str]], xr.Dataset], set[str]] = {}
        for kind in kinds_of(arrival):
            wanted = {*kind.gives} if asked is None else asked & {*kind.gives}
            if not wanted:
                continue
            missing = [need for need in kind.needs if need.reason(record)]
            if not missing:
                jobs.setdefault(kind.take, set()).update(wanted)
            elif kind.names:
                lacking.setdefault(missing[0], []).extend(kind.names)
        for need, names in lacking.items():
            if need.is_warning:
                warnings.append(f"{need.reason(record)}: {joined(names)} are not measured")
            else:
                left_out.append(f"{', '.join(names)}: {need.reason(record)}")
        parts += divided(comm, [partial(take, record, names) for take, names in jobs.items()])

    warnings += unsettled
    about = {
        "vipetsc_version": vipetsc.__version__,
        "source": source_key(),
        "case": run.attrs["case"],
        "status": run.attrs.get("status", ""),
        "analysis": describe_options(options),
        "unsettled": json.dumps(unsettled),
    }
    for part in parts:
        left_out += part.attrs.pop("left_out")
        about |= part.attrs
    about["left_out"] = "; ".join(left_out + warnings)
    about["warnings"] = json.dumps(warnings)
    return xr.Dataset({name: item for part in parts for name, item in part.variables.items()}, attrs=about)


def _numbers(run: xr.Dataset, case: Case, options: AnalysisTable, asked: Collection[str] | None) -> xr.Dataset:
    """Return the numbers of a ``run``, or one for each part of the bands, by the measures of the registry ``asked``."""
    record = record_of(run, case, options)
    taken = take(record, asked)
    layout: dict[str, tuple[str, str, str]] = {}
    values = dict(taken)
    attributes: dict[str, dict[str, Any]] = {}
    for name in taken:
        dimension, unit, text = row_of(name)
        if dimension == PART:
            dimension = "bands/part"  # its name in files of a single run
            layout[dimension] = BANDS[dimension]
            values[dimension] = np.arange(1, len(record.parts) + 1)
            attributes[name] = {"parts": list(record.parts)}
        layout[name] = (dimension, unit, text)
        if name.startswith("steady"):
            attributes[name] = {"periods": record.periods, "tolerance": record.tolerance}
    data = xr.Dataset(tabulated(layout, values), attrs={"left_out": [], "warnings": record.warnings})
    for name, texts in attributes.items():
        data[name].attrs.update(texts)
    return data


def _maps(record: VelocityRecord, asked: Collection[str]) -> xr.Dataset:
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
        if "wavenumber_content" in asked:
            wavenumber, content = spectra.wavenumber_content(velocity, record.masses)
            wavenumber = spectra.block_means(wavenumber, pooled, 0)
            mean_content = spectra.block_means(content, samples, 0)
            contents.append(spectra.block_sums(mean_content, pooled, 1).astype(np.float32))

    values: dict[str, Any] = {}
    if "kinetic_energy" in asked:
        values["kinetic_energy"] = np.concatenate(kinetic)
    if "bands/total" in asked:
        # The total of the bands comes from the same pass through the field.
        values["bands/total"] = np.concatenate(total)
    if contents:
        values["wavenumber"] = wavenumber
        values["wavenumber_content"] = np.concatenate(contents)
    return record.measures(MAPS, values)


def _stride(record: VelocityRecord) -> int:
    """Return every which sample is transformed by wavelets."""
    return -(-len(record.time) // (SNAPSHOTS + 1))


def _entropies(record: VelocityRecord, asked: Collection[str], arrival: float | None) -> xr.Dataset:
    """Return the wavenumber entropy of the host velocity at snapshots, with its maps where they are ``asked`` for."""
    options = record.options
    stride = _stride(record)
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
    attributes: dict[str, dict[str, Any]] = {}
    for name in ("energy_weighted", "masked", "joint", "error"):
        value = getattr(entropy, name)
        values[f"entropy/{name}"] = value
        attributes[f"entropy/{name}"] = strides | {"sampling_error": abs(getattr(coarse, name) - value)}
    if "entropy/local" in asked:
        size = -(-entropy.local.shape[1] // options.pixels)
        values["entropy/at_cell"] = spectra.block_means(record.cells[:: options.cell_stride], size, 0)
        values["entropy/local"] = spectra.block_means(entropy.local, size, 1).astype(np.float32)
        values["entropy/weight"] = spectra.block_means(entropy.weight, size, 1).astype(np.float32)
    about = {"entropy/start": time[start], "entropy/starts_when": reason}
    return record.measures(ENTROPY, values, attributes, **about)


def _estimated_peak(record: VelocityRecord) -> float:
    """Return the time in s at which the middle of the burst reaches the first site at the group velocity."""
    chain = record.model.chain
    distance = 0
    if record.site is not None:
        distance = int(chain.topology.distance(record.site - 1, record.model.drive_cell))
    return spectra.estimated_peak(record.model.drive.duration, distance, record.model.speed)


def _partition(record: VelocityRecord, asked: Collection[str]) -> xr.Dataset:
    """Return the kinetic energies of the wavenumber bins at snapshots, with their maps where they are ``asked`` for."""
    every = _stride(record) * record.options.snapshot_stride
    maps = "partition/kinetic_energy" in asked
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
    return record.measures(PARTITION, values)


def kinds_of(arrival: float | None = None) -> tuple[Kind, ...]:
    """Return all kinds of measures of fields; entropies are averaged from the ``arrival`` in s on, or its estimate."""
    entropies = partial(_entropies, arrival=arrival)
    wavelets = (RESOLVED_IN_SPACE, SAMPLES, CELLS, FEW_CELLS)
    spectral = (BANDED, RESOLVED_IN_TIME, SAMPLES)
    modal = ("upper_share_at_end", "bands/modal_energy")
    return (
        Kind(("kinetic_energy",), _maps, ["kinetic_energy"]),
        Kind((), _maps, ["bands/total"], spectral),
        Kind(("wavenumber_content",), _maps, ["wavenumber_content"], (RESOLVED_IN_SPACE, CELLS)),
        Kind(("dispersion",), dispersions_by_side, DISPERSIONS, (*spectral, RESOLVED_IN_SPACE, CELLS)),
        Kind(("partition",), _partition, PARTITION, wavelets),
        Kind(("entropy",), entropies, ENTROPY, wavelets),
        Kind(("bands", "ibtet"), band_energies, BANDS, spectral),
        Kind(modal, modal_energies, MODAL, (DISPLACEMENT, ALL_CELLS, BANDED)),
    )


def record_of(run: xr.Dataset, case: Case, options: AnalysisTable) -> RunRecord:
    """Return the record of a ``run`` of ``case``, open or in memory; ``options`` say how its steady state is found."""
    output = case.output
    cell = case.lattice.unit_cell()
    # Cells that contacts alone join have no bands: the whole frequency axis is one part.
    parts = Parts(np.array([0.0, np.inf]), ("above",), ((),))
    if cell.joins_cells:
        parts = Parts.of(pass_bands(cell))

    points: dict[str, History] = {}
    if "points/velocity" in run:
        time = run["time"].values
        motion = {quantity: run[f"points/{quantity}"].values for quantity in MOTIONS}
        for number, point in enumerate(output.points or []):
            columns = {quantity: values[:, number] for quantity, values in motion.items()}
            points[point.name] = History(time=time, **columns)
    return RunRecord(
        run=run,
        points=points,
        # Without the points' motion nothing is transmitted between them.
        pairs=(output.transmission or []) if points else [],
        edges=np.asarray(parts.edges),
        parts=parts.names,
        drive=steady_drive(case),
        periods=options.steady_periods or PERIODS,
        tolerance=options.steady_tolerance or TOLERANCE,
    )


def steady_drive(case: Case) -> SteadyDrive | None:
    """Return the harmonic part of the first drive of ``case``, between its ramps; None without a harmonic drive."""
    drive = case.drive
    if drive.kind != "harmonic" or not drive.amplitude or not drive.frequency:
        return None
    ramp = drive.ramp or 0.0
    stop = np.inf
    if drive.duration is not None:
        # It falls over a ramp as long as the first one.
        stop = drive.duration - ramp
    return SteadyDrive(frequency=drive.frequency, start=ramp, stop=stop)
