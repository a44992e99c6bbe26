"""The runs of a sweep: members are simulated and measured, or scaled from a linear run, and each leaves a record."""

import json
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case import Case, Sweep
from vipetsc.dynamics.recorded_sizes import recorded_cells
from vipetsc.io.atomic import discard, write_text
from vipetsc.io.folder import origin
from vipetsc.io.netcdf import write_netcdf
from vipetsc.io.read import open_run
from vipetsc.io.records import Record
from vipetsc.io.store import FieldMemory, RunFolder, RunMemory
from vipetsc.parallel import StopRequest, on_root
from vipetsc.progress import Progress
from vipetsc.spectra.measures import can_be_scaled
from vipetsc.studies.analysis import analyse
from vipetsc.studies.linear_run import (
    LINEAR,
    MARGIN,
    MEMBER,
    MEMBERS,
    LinearRun,
    factor,
    first_site_cell,
    linear_name,
    measured,
    simulate_linear,
)
from vipetsc.studies.pool import reason_of
from vipetsc.studies.recorded_runs import Key, RecordedRuns

FIELDS = ("displacement", "velocity")
# What pictures of members whose fields are kept need beside the groups of measures that the sweep takes, by these.
PICTURED = {
    "entropy": ("kinetic_energy", "wavenumber_content", "dispersion", "partition/kinetic_energy", "entropy/local"),
    "transfer": ("kinetic_energy", "dispersion", "bands/kinetic_energy", "bands/total"),
}


class NeededRun(NamedTuple):
    """A linear run that is missing: a ``case`` that needs it, and the first ``sites`` (cells) to measure it for."""

    case: Case
    sites: list[int]


class SweepRuns:
    """The members of the sweep ``plan`` and its linear runs, ``recorded`` in ``folder``.

    All ranks of ``comm`` must construct one; the ranks of a team work together on each run. If the sweep keeps fields,
    each member also has a folder ``<id>/`` with ``run.h5`` and ``analysis.h5``. ``linear`` holds the linear runs that
    this rank has so far, by name; ``failed`` the reasons of those that failed, by name and first site (0 for none).
    """

    def __init__(self, plan: Sweep, folder: Path, comm: MPI.Comm, stop: StopRequest) -> None:
        self.plan = plan
        self.folder = folder
        self.ids = plan.ids()
        self.measures = measures_of(plan)
        # Most exceptions count as failures of the member: a sweep goes on past them.
        self.recorded = RecordedRuns(MEMBERS, folder, comm, stop, ranks=plan.options.ranks, failures=(Exception,))
        self.linear: dict[str, LinearRun] = {}
        self.failed: dict[tuple[str, int], str] = {}
        # Members use one block of memory for their fields, one after the other: none is needed once it is measured.
        self._fields = FieldMemory()

    def make_linear(self, needed: Mapping[str, NeededRun]) -> None:
        """Simulate the linear runs that are ``needed``, by name, and give them to all ranks. Collective."""
        keys = {_linear_key(name, run.sites): name for name, run in needed.items()}

        def make(key: Key) -> Record:
            run = needed[keys[str(key)]]
            return self._linear_record(run.case, run.sites)

        self.recorded.compute(keys, make, kind=LINEAR)
        for key, name in keys.items():
            # A run that a request to stop kept from being made has no record.
            record = self.recorded.records.get(key)
            if record is not None:
                self._take_linear(name, needed[name].sites, record)

    def _take_linear(self, name: str, sites: Sequence[int], record: Record) -> None:
        """Take the ``record`` of the linear run ``name`` for the first ``sites`` (cells), or why it failed."""
        if "reason" not in record:
            self.linear[name] = LinearRun.from_record(record).joined(self.linear.get(name))
        # What failed for several sites together is tried again for each: measures from one of them may be to blame.
        elif len(sites) < 2:
            self.failed[name, max(sites, default=0)] = record["reason"]

    def _linear_record(self, case: Case, sites: Collection[int]) -> Record:
        """Simulate the linear run of ``case``, and measure it for members with a first site among ``sites`` (cells).

        Returns its record. Raises StoppedError, or RuntimeError if the run fails.
        """
        name = linear_name(case)
        run, statistics = simulate_linear(case, self.recorded.team, self.recorded.stop)
        return on_root(
            self.recorded.team, lambda: LinearRun.of(run, statistics, sites=sites, names=self.measures).record(name)
        )

    def make_members(self, numbers: Iterable[int], progress: bool) -> int:
        """Simulate or scale the members with these ``numbers``; returns how many succeeded. Collective."""
        number_of = {self.ids[number]: number for number in numbers}

        def make(key: Key) -> Record:
            return self._member_record(number_of[str(key)])

        # The records of a large sweep would not fit into the memory of all ranks: they are read when all are there.
        return self.recorded.compute(number_of, make, kind=MEMBER, progress=progress, keep=False)

    def make_chains(self, numbers: Iterable[int], progress: bool) -> int:
        """Simulate the members with these ``numbers`` of a sweep whose members follow one another; returns how many.

        A chain of such members depends on the state of the one before, so that one team computes it, one run after the
        other; ranks share chains, not their members. Collective.
        """
        wanted = set(numbers)
        # The missing members of each chain, by the last one, whose record is that of the task.
        left: dict[Key, list[int]] = {}
        for chain in self.plan.chains():
            missing = [number for number in chain if number in wanted]
            if missing:
                left[self.ids[missing[-1]]] = missing

        # One chain would be reported at its end alone: its runs are counted in its place.
        is_one = len(left) == 1
        runs = Progress(self.recorded.comm, len(wanted), "runs", show=progress and is_one)

        def make(key: Key) -> Record:
            members = left[key]
            while len(members) > 1:
                began = time.process_time()
                record = self._following_record(members[0])
                record["cpu_seconds"] = round(time.process_time() - began, 4)
                self.recorded.keep_part(self.ids[members.pop(0)], record, kind=MEMBER)
                if is_one:
                    runs.update(len(wanted) - len(members))
            return self._following_record(members[0])

        def fail(key: Key, reason: str) -> None:
            # Those behind a member that failed have no state to begin with.
            for number in left[key]:
                self.recorded.append(self.ids[number], {"reason": reason}, MEMBER)

        shows_chains = progress and not is_one
        what = "chains of runs"
        self.recorded.compute(left, make, kind=MEMBER, what=what, progress=shows_chains, keep=False, fail=fail)
        if is_one:
            runs.update(len(wanted))
            runs.close()
        return len(wanted)

    def _following_record(self, number: int) -> Record:
        """Simulate the member ``number`` of a chain, from the end of the one before it; returns its record."""
        # One rank reads the state of the run before: on a network file system another one may not see it yet.
        case = on_root(self.recorded.team, lambda: self.plan.case_in(self.folder, number))
        record = self._simulate(case, self.folder / self.ids[number], None)
        return record | {"rtol": case.time.rtol}

    def _member_record(self, number: int) -> Record:
        """Simulate the member ``number``, or scale it; returns its record.

        Raises as ``_linear_of``, and RuntimeError if its case is impossible or its run fails.
        """
        member = self.plan.member(number)
        if member.case is None:
            raise RuntimeError("; ".join(map(str, member.problems)))

        case = member.case
        site = first_site_cell(case)
        name = linear_name(case)
        linear = self._linear_of(case, name, site)
        modules: list[str] = []
        if case.plugins:
            modules = case.plugins.modules
        scales = not self.plan.options.fields and can_be_scaled(modules)
        if scales and bool((linear.reached(case) < MARGIN).all()):
            record = _scaled(case, linear, name, site)
        else:
            record = self._simulate(case, self.folder / self.ids[number], linear.arrival_at(site))
        return record | {"rtol": case.time.rtol}

    def _linear_of(self, case: Case, name: str, site: int) -> LinearRun:
        """Return the linear run ``name`` of ``case``, measured for the first ``site`` (cell); simulated if missing.

        Raises StoppedError, or RuntimeError if the run fails, or has failed before: then it is not tried again.
        """
        # Where fields are kept members are measured, not scaled, and need no measures of the linear run.
        sites = [site]
        if self.plan.options.fields:
            sites = []
        linear = self.linear.get(name)
        if linear is not None and linear.measures.keys() >= {*sites}:
            return linear

        failed = self.failed.get((name, max(sites, default=0)))
        if failed is not None:
            raise RuntimeError(failed)
        try:
            record = self._linear_record(case, sites)
        except Exception as error:
            # Every member that needs it fails with this reason, without another try.
            self._take_linear(name, sites, {"reason": reason_of(error)})
            raise
        self.recorded.keep_part(_linear_key(name, sites), record, kind=LINEAR)
        self._take_linear(name, sites, record)
        return self.linear[name]

    def _simulate(self, case: Case, folder: Path, arrival: float | None) -> Record:
        """Simulate and measure a member of which all samples and cells are recorded; returns its record.

        If the sweep keeps fields, its run is written to ``folder``, cut down to what the case keeps. ``arrival`` is the
        time in s at which the linear wave arrives at the first site. Raises StoppedError, or RuntimeError if the run
        fails.
        """
        fields = self.plan.options.fields
        all_kept = keeps_all(case) and "displacement" in case.output.fields

        def begin() -> None:
            """Prepare the member's folder, and empty it unless it holds the beginning of a run of the same case."""
            marker = folder / "case.toml"
            text = case.to_toml()
            if not (marker.exists() and marker.read_bytes() == text.encode()):
                discard(folder)
                folder.mkdir()
                write_text(marker, text)

        if fields:
            on_root(self.recorded.team, begin)
        # Measures need all samples and cells, also those that the member does not keep.
        memory = RunMemory(self.recorded.team, fields=self._fields)
        output: RunMemory | RunFolder = memory
        simulated = _with_everything(case, ["velocity"])
        if fields:
            output = RunFolder(folder, self.recorded.team)
            simulated = _with_everything(case, [*FIELDS])
            if all_kept:
                simulated = case
        result = self.recorded.simulate(simulated, output)

        def measure() -> Record:
            run = memory.dataset
            if run is None:
                run = open_run(folder / "run.h5")
            with run:
                analysis = analyse(run, self.measures, arrival, case=simulated)
                if fields and not all_kept:
                    write_netcdf(folder / "run.h5", thinned(run, case).assign_attrs(case=case.to_toml()))
            if fields:
                about = origin() | analysis.attrs
                write_netcdf(folder / "analysis.h5", analysis.assign_attrs(about, case=case.to_toml()))
                # Their content is in the record and in the run.
                for file in ("summary.json", "case.toml"):
                    (folder / file).unlink(missing_ok=True)
            return {
                "statistics": result.statistics,
                "warnings": [*result.warnings, *json.loads(analysis.attrs.get("warnings", "[]"))],
                "measures": measured(analysis),
            }

        return on_root(self.recorded.team, measure)


def _linear_key(name: str, sites: Iterable[int]) -> str:
    """Return the key of the linear run ``name`` that is measured for the first ``sites`` (cells)."""
    return " ".join([name, *map(str, sites)])


def _scaled(case: Case, linear: LinearRun, name: str, site: int) -> Record:
    """Return the record of a member without contact: its ``linear`` run ``name``, scaled to the amplitude of ``case``.

    ``site`` is the member's first site (cell), for which the linear run was measured.
    """
    return {
        "linear": name,
        "site": site,
        "factor": factor(case),
        "statistics": {
            "engine": linear.statistics["engine"],
            "ledger_error": linear.statistics["ledger_error"],
            "episodes": 0,
            "work": linear.statistics["work"] * factor(case) ** 2,
            "dissipated": 0.0,
        },
        "warnings": [],
    }


def _with_everything(case: Case, fields: list[str]) -> Case:
    """Return the ``case`` of which all samples and cells of the ``fields`` are recorded."""
    output = {"fields": fields, "window": None, "every": 1, "stride": 1}
    return case.model_copy(update={"output": case.output.model_copy(update=output)})


def measures_of(plan: Sweep) -> set[str]:
    """Return the measures that ``analyse`` takes of a member: those asked for, and its pictures' if fields are kept."""
    measures: set[str] = {"motion", *plan.options.measures}
    if plan.options.fields:
        for group in plan.options.measures:
            measures |= {*PICTURED.get(group, ())}
    return measures


def keeps_all(case: Case) -> bool:
    """Return whether all cells of the velocity are kept at all samples."""
    output = case.output
    return "velocity" in output.fields and (output.window, output.every, output.stride) == (None, 1, 1)


def thinned(run: xr.Dataset, case: Case) -> xr.Dataset:
    """Cut a ``run`` with all its fields down to what the section ``[output]`` of ``case`` keeps of them."""
    output = case.output
    if "displacement" not in output.fields:
        # The last displacement stays: a later analysis takes the energies of the linear modes from it.
        run = run.assign({"end/displacement": run["displacement"].variable[-1]})
    run = run.drop_vars([name for name in FIELDS if name in run and name not in output.fields])
    run = run.isel(cell=list(recorded_cells(output, case.lattice.cells)))

    if "point" in run.coords:
        # A dataset in memory names the points, a file numbers them, as those of single runs do: the case has the names.
        run = run.assign_coords(point=("point", np.arange(1, run.sizes["point"] + 1), run["point"].attrs))

    fields = {}
    for name in output.fields:
        field = run[name].isel(time=slice(None, None, output.stride))
        if output.stride > 1:
            field = field.rename(time="field_time")
        fields[name] = field
    return run.drop_vars(output.fields).assign(fields)
