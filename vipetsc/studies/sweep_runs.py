"""The runs of a sweep, each of which ends as a record: simulated and measured, or scaled from a linear run."""

import json
import time
from collections.abc import Collection
from pathlib import Path

from mpi4py import MPI

import numpy as np
import xarray as xr

import vipetsc
from vipetsc.case import Case, Sweep
from vipetsc.dynamics import simulate
from vipetsc.dynamics.recorder import recorded_cells
from vipetsc.dynamics.run import Result
from vipetsc.io.atomic import discard, write_text
from vipetsc.io.folder import origin
from vipetsc.io.netcdf import write_netcdf
from vipetsc.io.read import open_run
from vipetsc.io.records import Record, RecordFile
from vipetsc.io.store import RunFolder, RunMemory, RunOutput
from vipetsc.parallel import StopRequest, on_root
from vipetsc.studies.analysis import WHOLE, analyse
from vipetsc.studies.ensemble import COMPLETE, FAILED, SCALED, STATUS
from vipetsc.studies.linear_run import (
    MARGIN,
    PARTS,
    LinearRun,
    factor,
    leading_cell,
    linear_case,
    linear_name,
    measured,
)
from vipetsc.studies.recorded_runs import completed

FIELDS = "displacement", "velocity"
# What ``analyse`` calls those of ``[sweep] measures``.
ANALYSED = {"entropy": ("entropy",), "transfer": ("bands", "modal")}


class MemberStore:
    """Makes the members of the sweep ``plan`` in ``folder``; all ranks of ``team`` work on each together.

    The first of them, whose ``rank`` among all is given, appends the records. Members whose fields are kept have
    folders ``<id>/`` with ``run.h5`` and ``analysis.h5`` besides. ``linear`` are the linear runs known so far by name,
    or why one did not come out.
    """

    def __init__(self, plan: Sweep, folder: Path, team: MPI.Comm, stop: StopRequest, rank: int = 0) -> None:
        self.plan, self.folder, self.team, self.stop = plan, folder, team, stop
        self.ids = plan.ids()
        self.file = RecordFile(folder / PARTS.replace("*", str(rank)))
        self.linear: dict[str, LinearRun | str] = {}
        self.measures = measures_of(plan)

    def make_linear(self, case: Case, sites: Collection[int]) -> None:
        """Simulate the linear run of ``case``, and measure it for members with each of the first ``sites`` (cells).

        Raises StoppedError, or RuntimeError if it does not come out, and again whenever it is asked for.
        """
        name, memory = linear_name(case), RunMemory(self.team)
        if isinstance(reason := self.linear.get(name), str):
            raise RuntimeError(reason)

        def measure() -> LinearRun:
            assert memory.dataset is not None
            linear = LinearRun.of(memory.dataset, result.statistics, sites, self.measures)
            self.file.append(linear.record(name))
            return linear

        try:
            result = self._simulate(linear_case(case), memory)
            self.linear[name] = on_root(self.team, measure).joined(self.linear.get(name))
        except Exception as error:
            self.linear[name] = str(error) or type(error).__name__
            raise

    def make(self, number: int) -> None:
        """Simulate the member ``number``, or scale it; raises as ``make_linear``, for an impossible case too."""
        begin, member = time.process_time(), self.plan.member(number)
        if member.case is None:
            raise RuntimeError("; ".join(map(str, member.problems)))
        case, name, site = member.case, linear_name(member.case), leading_cell(member.case)
        linear, whole = self.linear.get(name), self.plan.options.fields
        if not isinstance(linear, LinearRun) or (not whole and site not in linear.measures):
            self.make_linear(case, () if whole else (site,))
            linear = self.linear[name]
        assert isinstance(linear, LinearRun)
        quiet = not whole and bool((linear.reached(case) < MARGIN).all())
        if quiet:
            ended = {"episodes": 0, "work": linear.statistics["work"] * factor(case) ** 2, "dissipated": 0.0}
            statistics = {key: linear.statistics[key] for key in ("engine", "ledger_error")} | ended
            record = {"reason": "complete: scaled from the linear run", "linear": name, "site": site}
            record |= {"statistics": statistics, "warnings": []}
        else:
            record = self._run(case, self.folder / self.ids[number], linear.arrival_at(site))
        record |= {"rtol": case.time.rtol, "cpu_seconds": round(time.process_time() - begin, 4)}
        on_root(self.team, lambda: self._append(number, SCALED if quiet else COMPLETE, record))

    def fail(self, number: int, reason: str) -> None:
        """Record why a member failed, on the first rank of its team."""
        self._append(number, FAILED, {"reason": reason})

    def _append(self, number: int, status: int, record: Record) -> None:
        ended = {"id": self.ids[number], "place": [*map(int, np.unravel_index(number, self.plan.shape))]}
        about = {"status": STATUS[status], "vipetsc_version": vipetsc.__version__}
        self.file.append(ended | about | record)

    def _run(self, case: Case, folder: Path, arrival: float | None) -> Record:
        """Simulate and measure a member with all its samples and cells; what is kept of them comes after that."""
        whole, all_kept = self.plan.options.fields, keeps_all(case) and "displacement" in case.output.fields

        def begin() -> None:
            """A run with its fields that was cut off goes on, if it is of the same case."""
            marker, text = folder / "case.toml", case.to_toml()
            if whole and not (marker.exists() and marker.read_text(encoding="utf-8") == text):
                discard(folder)
                folder.mkdir()
                write_text(marker, text)

        on_root(self.team, begin)
        fields = [*FIELDS[not whole :]]
        memory = RunMemory(self.team)
        output = {"fields": fields, "window": None, "every": 1, "stride": 1, "writer": "gather"}
        everything = case.model_copy(update={"output": case.output.model_copy(update=output)})
        simulated = case if whole and all_kept else everything
        result = self._simulate(simulated, RunFolder(folder, self.team) if whole else memory)

        def measure() -> Record:
            with open_run(folder / "run.h5") if memory.dataset is None else memory.dataset as run:
                analysis = analyse(run, self.measures, arrival)
                if whole and not all_kept:
                    write_netcdf(folder / "run.h5", thinned(run, case).assign_attrs(case=case.to_toml()))
            if whole:
                write_netcdf(
                    folder / "analysis.h5", analysis.assign_attrs(origin() | analysis.attrs, case=case.to_toml())
                )
                for name in ("summary.json", "case.toml"):  # the record and the run tell both
                    (folder / name).unlink(missing_ok=True)
            warnings = [*result.warnings, *json.loads(analysis.attrs.get("warnings", "[]"))]
            told = {"reason": result.sentence, "statistics": result.statistics, "warnings": warnings}
            return told | {"measures": measured(analysis)}

        return on_root(self.team, measure)

    def _simulate(self, case: Case, output: RunOutput) -> Result:
        return completed(simulate(case, output, self.team, stop=self.stop))


def measures_of(plan: Sweep) -> set[str]:
    """What ``analyse`` is asked for of a member: what its pictures show if its fields are kept."""
    asked = WHOLE if plan.options.fields else ANALYSED
    return {measure for name in plan.options.measures for measure in asked[name]}


def keeps_all(case: Case) -> bool:
    """Whether all cells of the velocity are kept at all samples."""
    output = case.output
    return "velocity" in output.fields and (output.window, output.every, output.stride) == (None, 1, 1)


def thinned(run: xr.Dataset, case: Case) -> xr.Dataset:
    """``run`` with what the section ``[output]`` of ``case`` keeps of its fields."""
    output = case.output
    if "displacement" not in output.fields:
        run = run.assign({"end/displacement": run["displacement"].variable[-1]})
    run = run.drop_vars([name for name in FIELDS if name in run and name not in output.fields])
    run = run.isel(cell=list(recorded_cells(output, case.lattice.cells)))
    fields = {name: run[name].isel(time=slice(None, None, output.stride)) for name in output.fields}
    if output.stride > 1:
        fields = {name: field.rename(time="field_time") for name, field in fields.items()}
    return run.drop_vars(output.fields).assign(fields)
