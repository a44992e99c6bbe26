"""Linear runs, which members of a sweep share if they differ only in contacts and amplitude.

Until the first contact a lattice is linear: displacements are proportional to the drive's amplitude, and energies to
its square. The linear run, under 1 N and without contacts, shows which members have no contact: those of an amplitude A
in N with A e < ``MARGIN`` D at every site, where e is the envelope of w at the site in m/N and D the clearance in m.
They are scaled from it.
"""

import itertools
import json
from collections.abc import Collection, Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Self

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc import spectra
from vipetsc.case import Case, case_id
from vipetsc.case.contacts import gaps_of_sites
from vipetsc.case.law import lesser_clearances
from vipetsc.dynamics import simulate
from vipetsc.io.read import field_time
from vipetsc.io.records import Record
from vipetsc.io.store import RunMemory
from vipetsc.lattice.sites import Pair
from vipetsc.parallel import StopRequest, on_root
from vipetsc.spectra.measures import MEASURES as REGISTRY
from vipetsc.spectra.measures import PART, group_of, is_measure, row_of
from vipetsc.studies.analysis import analyse
from vipetsc.studies.recorded_runs import RecordPaths, completed

# A member is scaled where its linear wave stays below this fraction of every clearance: the largest w between samples
# exceeds the sampled envelope by less than what is left, for any burst of a few cycles.
MARGIN = 0.9
BLOCK = 64  # samples of which the envelope is taken together; any number that leaves arrays in the cache serves
REFERENCE = 1.0  # amplitude of a linear run, in N or m
MEMBERS = "members"  # what the records of a sweep are called
# Kinds of these records.
LINEAR = "linear"
MEMBER = "member"

# Measures of a member in the ensemble: further dimension, units and description.
FITTED = ("ibtet", "entropy/energy_weighted", "entropy/masked", "entropy/joint")
MEASURES = {name: measure.row for name, measure in REGISTRY.items() if measure.group in ("entropy", "transfer")}


class LinearRun(NamedTuple):
    """A linear wave, the statistics of its run, and the measures of members without contact.

    ``envelope`` (cell): largest sqrt(w^2 + (w'/Om)^2) in m of the contact pair's relative displacement w, Om the
    drive's angular frequency. ``arrival`` (cell): time in s of the wave's peak (``spectra.arrivals``), the paper's
    t_hat when taken at the first site. ``statistics`` are the run's; ``measures`` has what ``measured`` gives, by first
    site (cell).
    """

    envelope: np.ndarray
    arrival: np.ndarray
    statistics: dict[str, Any]
    measures: dict[int, Record]

    @classmethod
    def of(cls, run: xr.Dataset, statistics: dict[str, Any], sites: Collection[int], names: Collection[str]) -> Self:
        """Take the wave of a ``run`` with both fields of all cells, and the measures ``names`` of it.

        They are measured for each of the first ``sites`` (cells; 0 for none).
        """
        samples = run.sizes["time"]
        blocks = [*range(BLOCK, samples, BLOCK), samples]
        host_velocity = run["velocity"].values[..., Case.of(run).model().chain.cell.host]
        wave = cls(
            envelope=np.sqrt(np.max(envelope_squares(run, blocks), axis=0)),
            arrival=field_time(run)[spectra.peak_arrival(host_velocity)],
            statistics=statistics | {"work": float(run["energy/work"][-1])},
            measures={},
        )
        for site in sites:
            analysis = analyse(with_site(run, site), names, wave.arrival_at(site))
            wave.measures[site] = measured(analysis)
        return wave

    def arrival_at(self, site: int) -> float | None:
        """Return the paper's t_hat in s, when the peak is at the first ``site`` (cell); None for no site."""
        return float(self.arrival[site - 1]) if site else None

    def reached(self, case: Case) -> np.ndarray:
        """Return linear relative displacement over the lesser clearance (site) at the amplitude of ``case``.

        It is inf where contacts join other masses than the cell's pair, to which the envelope does not apply.
        """
        return reached(self.envelope, case)

    def joined(self, other: "LinearRun | None") -> "LinearRun":
        """Return the run with the measures that another record of it, ``other``, holds as well."""
        if other is None:
            return self
        return self._replace(measures=other.measures | self.measures)

    def record(self, name: str) -> Record:
        """Return the run as a record of the linear run ``name``."""
        return {
            "linear": name,
            "envelope": self.envelope.tolist(),
            "arrival": self.arrival.tolist(),
            "statistics": self.statistics,
            "measures": self.measures,
        }

    @classmethod
    def from_record(cls, record: Record) -> Self:
        """Return the run that a ``record`` holds."""
        return cls(
            envelope=np.array(record["envelope"], float),
            arrival=np.array(record["arrival"], float),
            statistics=record["statistics"],
            measures={int(site): row for site, row in record["measures"].items()},  # JSON has no numbers as keys
        )


def simulate_linear(case: Case, comm: MPI.Comm, stop: StopRequest) -> tuple[xr.Dataset, dict[str, Any]]:
    """Simulate the linear run of ``case`` on all ranks of ``comm``; returns its dataset and its statistics.

    The dataset is empty on all ranks but the first. Raises StoppedError, or RuntimeError if the run fails.
    """
    memory = RunMemory(comm)
    result = completed(simulate(linear_case(case), memory, comm, stop=stop))
    run = xr.Dataset()
    if memory.dataset is not None:
        run = memory.dataset
    return run, result.statistics


def linear_arrival(case: Case, comm: MPI.Comm, stop: StopRequest) -> float | None:
    """Return the time in s at which the linear wave of ``case`` arrives at its first site; None without sites.

    All ranks of ``comm`` must call it: they simulate the linear run together.
    """
    run, statistics = simulate_linear(case, comm, stop)
    return on_root(comm, lambda: LinearRun.of(run, statistics, sites=(), names=()).arrival_at(first_site_cell(case)))


def envelope_squares(run: xr.Dataset, stops: Sequence[int]) -> np.ndarray:
    """Return largest w^2 + (w'/Om)^2 in m^2 of each cell's contact pair in blocks of a linear ``run`` with both fields.

    The first block begins at the first sample, and each (block, cell) ends before one of the ``stops``.
    """
    model = Case.of(run).model()
    host = model.chain.cell.host
    resonator = model.chain.cell.resonator
    displacement = run["displacement"].values
    velocity = run["velocity"].values
    largest = np.zeros((len(stops), displacement.shape[1]))
    # Block by block, since temporary arrays of all samples would not fit into the cache.
    for number, (first, stop) in enumerate(itertools.pairwise([0, *stops])):
        block = slice(first, stop)
        w = displacement[block, :, resonator] - displacement[block, :, host]
        rate = velocity[block, :, resonator] - velocity[block, :, host]
        # With the rate in it, the envelope does not depend on where the samples fall.
        squares = w**2 + (rate / model.drive.frequency) ** 2
        largest[number] = squares.max(axis=0, initial=0.0)
    return largest


def reached(envelope: np.ndarray, case: Case) -> np.ndarray:
    """Return linear relative displacements over lesser clearances (..., site), by ``envelope`` (..., cell).

    The envelope in m is that of the linear run. It does not apply, and the result is inf, where contacts join other
    masses than the cell's pair, and at sites that touch their stop at rest.
    """
    contacts = case.contacts
    sites = np.asarray(contacts.sites, int) - 1
    waves = factor(case) * envelope[..., sites]
    if other_pairs(case):
        return np.full(waves.shape, np.inf)

    clearances = np.asarray(contacts.clearance or [], float)
    clearance = lesser_clearances(gaps_of_sites(contacts, clearances.tolist()))
    return np.divide(waves, clearance, out=np.full(waves.shape, np.inf), where=clearance > 0)


def measured(analysis: xr.Dataset) -> Record:
    """Return values that the ensemble takes from an ``analysis``: measures of the registry and their attributes.

    ``parts`` of the frequency axis by name, ``errors`` by the samples left out, the options of the ``analysis``,
    ``unsettled``: sentences about steady amplitudes that are none.
    """
    row: Record = {}
    errors: dict[str, float] = {}
    taken = [*MEASURES, *sorted(of_motion(map(str, analysis.data_vars)))]
    for name in taken:
        if name in analysis:
            row[name] = analysis[name].values.tolist()
            error = analysis[name].attrs.get("sampling_error")
            if error is not None:
                errors[name] = float(error)
    row["errors"] = errors
    if "analysis" in analysis.attrs:
        row["analysis"] = analysis.attrs["analysis"]

    for name in taken:
        if name in row and row_of(name)[0] == PART:
            # A file has a list of one text as that text.
            row["parts"] = np.atleast_1d(analysis[name].attrs["parts"]).tolist()
    if "bands/modal_energy" in row:
        # Of a history the ensemble has the last value: what the run leaves.
        row["bands/modal_energy"] = analysis["bands/modal_energy"].values[:, -1].tolist()
    unsettled = json.loads(analysis.attrs.get("unsettled", "[]"))
    if unsettled:
        row["unsettled"] = unsettled
    if "entropy/history" in row:
        row["entropy/start"] = float(analysis.attrs["entropy/start"])
    return row


def of_motion(names: Iterable[str]) -> list[str]:
    """Return the ``names`` that are measures of the group "motion", perhaps of points."""
    return [name for name in names if is_measure(name) and group_of(name) == "motion"]


def other_pairs(case: Case) -> tuple[Pair, ...]:
    """Return the masses that contacts join, if not everywhere those of the cell's pair."""
    chain = case.model().chain
    return tuple(chain.sites.pairs) if chain.has_own_pairs else ()


def is_proportional(case: Case) -> bool:
    """Return whether the motion is proportional to the amplitude of a single drive until the first contact."""
    if case.initial or case.drive.more or other_pairs(case):
        return False
    return case.model().chain.is_linear


def signed_factor(case: Case) -> float:
    """Return the ratio of the motion of ``case`` before its first contact to that of its linear run."""
    # Otherwise the linear run has the case's own amplitude: an initial motion or a second drive is not scaled by it.
    if not is_proportional(case):
        return 1.0
    return case.drive.amplitude / REFERENCE


def factor(case: Case) -> float:
    """Return the ratio of the wave of ``case`` to that of its linear run."""
    return abs(signed_factor(case))


def linear_case(case: Case) -> Case:
    """Return the lattice of ``case`` without contacts under 1 N; cases that differ in those alone have it in common.

    Unless it ``is_proportional``, the drives are those of the case. Contacts that join other masses than the cell's
    pair may be all that joins the cells: they stay.
    """
    return Case.from_table(_linear_table(case))


def linear_name(case: Case) -> str:
    """Return the name of the linear run of ``case``: a hash of its resolved case."""
    return _name_of(json.dumps(_linear_table(case), sort_keys=True))


# To check and resolve a case takes ten times as long as to write its table, and members of a sweep have few linear
# runs.
@lru_cache(maxsize=64)
def _name_of(table: str) -> str:
    """Return the name of the linear run with this ``table`` in JSON."""
    return case_id(Case.from_table(json.loads(table)))


def _linear_table(case: Case) -> dict[str, Any]:
    """Return the table of ``linear_case``."""
    amplitude = REFERENCE if is_proportional(case) else case.drive.amplitude
    output = case.output.of_points()
    drive = {"amplitude": amplitude}
    if other_pairs(case):
        return case.varied_table(name="linear", without=("output",), drive=drive, output=output)
    without = ("output", "contacts")
    # Without the whole section: cases that differ in a law or a clearance must have one linear run, and one name of
    # it.
    return case.varied_table(name="linear", without=without, drive=drive, contacts={"sites": 0}, output=output)


def first_site_cell(case: Case) -> int:
    """Return the cell (1-based) of the site nearest to the drive; 0 without sites."""
    cells = np.asarray(case.contacts.sites, np.int64)
    first = case.nearest_site(cells)
    return 0 if first is None else int(cells[first])


def with_site(linear: xr.Dataset, site: int) -> xr.Dataset:
    """Return the ``linear`` run as a member whose ``site`` (cell; 0 for none) has no contact."""
    cells = [site] if site else []
    return linear.drop_dims("site").assign({"sites/cell": ("site", np.array(cells, np.int64))})


def read_linear(sweep: Path, case: Case) -> LinearRun | None:
    """Return the linear run of ``case`` in the folder of a ``sweep``; None if there is no record of one."""
    run = None
    name = linear_name(case)
    for _, record, _ in RecordPaths(sweep, MEMBERS).read():
        if record["kind"] == LINEAR and record.get("linear") == name:
            run = LinearRun.from_record(record)
    return run
