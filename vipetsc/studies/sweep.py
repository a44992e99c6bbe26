"""Sweeps: all members are simulated on all ranks, and their measures are collected in ``ensemble.h5``.

The linear runs come first, since members without contact are scaled from them. Then come the members, the longest
first. A sweep goes on after members that fail, and can be resumed after an interruption.
"""

import re
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from mpi4py import MPI

import numpy as np

from vipetsc.case import Case, CaseError, Problem, Sweep
from vipetsc.case.html import html_table
from vipetsc.io.atomic import discard
from vipetsc.io.folder import claimed
from vipetsc.io.kinds import SWEEP
from vipetsc.io.read import open_ensemble
from vipetsc.parallel import StopRequest, on_every_rank, on_one_machine, on_root
from vipetsc.plugins import announce_parts
from vipetsc.progress import say
from vipetsc.studies.ensemble import COMPLETE, FAILED, MISSING, SCALED, STATUS, FailedMember, Results, assemble
from vipetsc.studies.linear_run import MEMBERS, LinearRun, first_site_cell, linear_name
from vipetsc.studies.recorded_runs import RecordPaths
from vipetsc.studies.study import is_whole
from vipetsc.studies.sweep_runs import NeededRun, SweepRuns
from vipetsc.wording import counted

if TYPE_CHECKING:
    import xarray as xr

MOST_FAILURES = 10  # failed members that every rank gets, and that messages name
MOST_SURVEYED = 10_000  # members whose cases are resolved beforehand, for their linear runs and what they will cost


@dataclass(frozen=True)
class SweepResult:
    """Outcome of a sweep, the same on all ranks but for ``held``.

    ``status`` (member,) says how each member ended, as an index of ``studies.ensemble.STATUS``. ``computed`` is the
    number of members that this call simulated or scaled, ``seconds`` its wall time, ``busy`` (rank) the fraction of it
    in which each rank worked on members. ``warnings`` are sentences about lost results and about the members,
    ``failures`` the first members that failed (at most ``MOST_FAILURES``; the attribute ``failed`` of the ensemble, in
    JSON, has all). A sweep without a ``folder`` has its ensemble in memory, ``held`` by rank 0.
    """

    status: np.ndarray
    computed: int
    seconds: float
    busy: tuple[float, ...]
    folder: Path | None
    warnings: list[str]
    failures: list[FailedMember]
    held: "xr.Dataset | None" = field(default=None, repr=False, compare=False)

    @cached_property
    def dataset(self) -> "xr.Dataset | None":
        """The ensemble, from its folder or from memory; None while members are missing, and in memory beyond rank 0."""
        if self.folder is None or self.resumable:
            return self.held
        return open_ensemble(self.folder)

    def _repr_html_(self) -> str:
        """Return the numbers of members by how they ended, and the warnings, as a notebook shows them."""
        rows: list[tuple[str, object]] = [(name, self.count(code) or None) for code, name in enumerate(STATUS)]
        rows += [("time in s", round(self.seconds, 1)), ("ensemble", self.folder or "in memory, as `dataset`")]
        rows += [("warning", warning) for warning in self.warnings]
        return html_table(f"sweep of {self.status.size} members", rows)

    @property
    def complete(self) -> bool:
        """Whether every member has measures: none has failed, and none is missing."""
        return not self.failed and not self.count(MISSING)

    @property
    def failed(self) -> int:
        """The number of members that have failed."""
        return self.count(FAILED)

    @property
    def resumable(self) -> bool:
        """Whether it was stopped before every member was complete or had failed."""
        return self.count(MISSING) > 0

    def count(self, status: int) -> int:
        """Return the number of members with this ``status``."""
        return int((self.status == status).sum())


def run_sweep(
    plan: Sweep,
    folder: str | Path | None = None,
    comm: MPI.Comm = MPI.COMM_WORLD,
    *,
    force: bool = False,
    resume: bool = False,
    stop: StopRequest | None = None,
    progress: bool = False,
) -> SweepResult:
    """Simulate every member of ``plan`` in ``folder``, then write ``ensemble.h5``.

    The ensemble is ``result.dataset``, an xarray dataset. Without a folder it is held in memory; a sweep that is
    stopped then stays in a temporary folder, which ``result.folder`` names.

    Members that this version has completed are not simulated again, so that an interrupted sweep continues. ``force``
    starts again, and replaces the sweep in the folder at the end; ``resume`` requires an existing sweep. A member that
    fails is recorded with its reason, and the others continue. All ranks of ``comm`` work, ``[sweep] ranks`` of them
    together on each member.

    Raises CaseError if no member is a valid case (of a sample, if there are many), or if fields of members are to be
    stored without a folder; FolderError if the folder contains anything else; ValueError without a folder if the ranks
    are on several machines.
    """
    Sweep.expect(plan, "sweep")
    # For its errors alone: an empty list is sent to the other ranks, not all cases.
    on_root(comm, lambda: plan.tried()[:0])
    if folder is None:
        return _in_memory(plan, comm, stop, progress)
    with claimed(comm, folder, SWEEP, plan.to_toml(), force=force, resume=resume) as claim:
        result = _make_all(plan, claim.folder, comm, stop or StopRequest(), progress)
        if not result.resumable:
            claim.publish()
    return replace(result, folder=claim.folder)


def _in_memory(plan: Sweep, comm: MPI.Comm, stop: StopRequest | None, progress: bool) -> SweepResult:
    """Run the sweep in a temporary folder, which rank 0 removes after it has read the ensemble; raises as `run_sweep`.

    A sweep that was stopped, or that an error ended, keeps the folder.
    """
    if plan.options.fields:
        remedy = "stores files of every member: give a folder for them, as in sweep(plan, 'my-sweep')"
        raise CaseError([Problem("sweep.fields", True, remedy)], plan.name)
    if not on_one_machine(comm):
        raise ValueError("ranks on several machines need a folder that all of them see, as in sweep(plan, 'my-sweep')")
    folder = Path(on_root(comm, lambda: tempfile.mkdtemp(prefix="vipetsc-sweep-")))
    try:
        result = run_sweep(plan, folder, comm, stop=stop, progress=progress)
    except BaseException:
        if comm.rank == 0:
            say(f"vipetsc: complete members remain in {folder}; sweep(plan, {str(folder)!r}) goes on")
        raise
    if result.resumable:
        return result

    def read() -> "xr.Dataset":
        ensemble = open_ensemble(folder)
        # The folder is removed below.
        del ensemble.attrs["folder"]
        discard(folder)
        return ensemble

    def read_on_root() -> "xr.Dataset | None":
        if comm.rank > 0:
            return None
        return read()

    return replace(result, folder=None, held=on_every_rank(comm, read_on_root))


def _make_all(plan: Sweep, folder: Path, comm: MPI.Comm, stop: StopRequest, progress: bool) -> SweepResult:
    """Simulate the missing members in ``folder`` on all ranks, and assemble the results."""
    begin = time.perf_counter()
    sys.audit("vipetsc.plan", plan.name)
    runs = SweepRuns(plan, folder, comm, stop)

    # One rank looks at what there is and decides on the order: on a network file system another rank may not see the
    # files yet. The survey stays there, in this list; the others get the parts of it that they need.
    surveys: list[_Survey] = []

    def look() -> tuple[dict[str, NeededRun], dict[str, LinearRun]]:
        survey = _survey(plan, folder)
        surveys.append(survey)
        # Another rank may be the first that calls a part which never returns.
        if comm.size > 1 and survey.drawn and (named := survey.drawn[0].case.plugins):
            announce_parts(named.modules)
        # Where no member is missing, no rank needs the linear runs, which may be large to send.
        linear: dict[str, LinearRun] = {}
        if len(survey.missing):
            linear |= survey.results.linear
        return survey.needed, linear

    # Linear runs first: members without contact are scaled from them, and they show what the others will cost.
    needed, runs.linear = on_root(comm, look)
    runs.make_linear(needed)
    order = on_root(comm, lambda: surveys[0].order(runs.linear))
    if plan.options.follow == "none":
        computed = runs.make_members(order, progress)
    else:
        computed = runs.make_chains(order, progress)

    seconds = time.perf_counter() - begin
    busy = tuple(comm.allgather(runs.recorded.pool.busy / seconds))

    def put_together() -> tuple[np.ndarray, list[str], list[FailedMember]]:
        survey = surveys[0]
        results = survey.results
        if needed or order:
            results = Results(plan, folder)
        status, warnings = conclude(results, afresh=bool(order))
        warnings = [*dict.fromkeys([*survey.results.damaged, *survey.lost, *warnings])]
        return status, warnings, results.failures(MOST_FAILURES)

    status, warnings, failures = on_root(comm, put_together)
    # MPI has a limited number of communicators, and a process may run many sweeps.
    runs.recorded.team.Free()
    return SweepResult(
        status=status,
        computed=computed,
        seconds=seconds,
        busy=busy,
        folder=folder,
        warnings=warnings,
        failures=failures,
    )


class DrawnMember(NamedTuple):
    """A missing member whose ``case`` was resolved beforehand; ``linear`` is the name of its linear run."""

    number: int
    case: Case
    linear: str


class _Survey(NamedTuple):
    """State of a sweep before members are simulated.

    ``results`` are those that are there, ``missing`` (member,) the numbers of the members that are not, ``lost``
    sentences about files that cannot be read. The cases of the ``drawn`` members are resolved: of all missing ones, or
    of a sample if they are many. They show what members will cost, and which linear runs are ``needed``, by name.
    """

    results: Results
    missing: np.ndarray
    drawn: list[DrawnMember]
    needed: dict[str, NeededRun]
    lost: list[str]

    def order(self, linear: dict[str, LinearRun]) -> list[int]:
        """Return the numbers of the missing members in the order in which they are simulated.

        Members of one linear run follow each other, since ranks keep few of these runs. The longest come first, so that
        no rank ends with a long one while the others wait. What a member will cost is judged by its contacts, which
        cost most: the sum over sites of the linear wave over the clearance, out of ``linear``, the linear runs by name.
        """
        # Each list begins with an entry for the missing members before the first one that was drawn.
        numbers = [-1]
        costs = [0.0]
        runs = [""]
        for member in self.drawn:
            run = linear.get(member.linear)
            if run is not None:
                # Beyond ten clearances a site costs little more: a member of five sites takes 0.38 s of CPU at one or
                # two clearances, 0.56 at 6, 0.64 at 19 and 0.97 at 620. The end time orders members without contacts.
                contacts = float(np.minimum(run.reached(member.case), 10.0).sum())
                numbers.append(member.number)
                costs.append(contacts + 1e-3 * float(member.case.time.end))
                runs.append(member.linear)

        dearest: dict[str, float] = {}
        for name, cost in zip(runs, costs, strict=True):
            dearest[name] = max(cost, dearest.get(name, 0.0))
        ranking = {name: rank for rank, name in enumerate(sorted(dearest, key=lambda name: (-dearest[name], name)))}
        # A member that was not drawn has the cost and the linear run of the last one before it that was.
        nearest = np.searchsorted(numbers, self.missing, "right") - 1
        # By linear run, then by falling cost. The sort is stable: equal members stay in order, the same in every call.
        order = np.lexsort((-np.array(costs)[nearest], np.array([ranking[name] for name in runs])[nearest]))
        return list(self.missing[order].tolist())


def _survey(plan: Sweep, folder: Path) -> _Survey:
    """Survey the sweep ``plan`` in ``folder``.

    Members that have failed count as missing, since they may succeed now, and so do those whose fields cannot be read.
    """
    results = Results(plan, folder)
    lost: list[str] = []
    absent = (results.status != COMPLETE) & (results.status != SCALED)
    if plan.options.fields:
        for number, name in enumerate(results.ids):
            whole = is_whole(folder / name / "run.h5", lost) and is_whole(folder / name / "analysis.h5", lost)
            absent[number] |= not whole

    # Equal members are simulated once, as the first of them.
    missing = np.unique(results.first[absent])
    tried = missing
    if len(missing) > MOST_SURVEYED:
        tried = np.sort(np.random.default_rng(0).choice(missing, MOST_SURVEYED, replace=False))
    drawn = []
    for number in tried.tolist():
        case = plan.member(number).case
        if case:
            drawn.append(DrawnMember(number, case, linear_name(case)))
    needed: dict[str, NeededRun] = {}
    # Members that follow one another are not scaled from linear runs.
    if plan.options.follow == "none":
        needed = _needed_runs(plan, results, drawn)
    return _Survey(results=results, missing=missing, drawn=drawn, needed=needed, lost=lost)


def _needed_runs(plan: Sweep, results: Results, drawn: Sequence[DrawnMember]) -> dict[str, NeededRun]:
    """Return linear runs of the ``drawn`` members, by name, that are not there or not measured for all first sites."""
    runs: dict[str, NeededRun] = {}
    for member in drawn:
        run = runs.setdefault(member.linear, NeededRun(member.case, []))
        site = first_site_cell(member.case)
        measured_run = results.linear.get(member.linear)
        measured = measured_run is not None and site in measured_run.measures
        # Where fields are kept members are measured, not scaled, and nobody needs measures of the linear run.
        if not plan.options.fields and not measured and site not in run.sites:
            run.sites.append(site)
    return {name: run for name, run in runs.items() if run.sites or name not in results.linear}


def conclude(results: Results, afresh: bool = False) -> tuple[np.ndarray, list[str]]:
    """Write ``ensemble.h5`` once no member is missing; returns ``status`` (member,) and warnings.

    An ensemble that has all records stays as it is, unless ``afresh``.
    """
    folder = results.folder
    sys.audit("vipetsc.conclude", str(folder))
    warnings = summarise([text for first in results.first for text in results.warnings.get(int(first), ())])
    warnings += results.gaps()
    if (results.status == MISSING).any():
        return results.status, warnings

    # Records first, then the ensemble, each whole before it replaces the one before: after a kill the folder can be
    # read, and an ensemble that is older than its records is made again.
    lost: list[str] = []
    results.merge_files()
    if afresh or not has_all_records(folder) or not is_whole(folder / "ensemble.h5", lost):
        assemble(results, warnings)
    return results.status, warnings + lost


def has_all_records(folder: Path) -> bool:
    """Return whether the ensemble in the folder of a sweep was made after the last record of its members."""
    ensemble = folder / "ensemble.h5"
    records = RecordPaths(folder, MEMBERS).existing()
    return ensemble.exists() and all(file.stat().st_mtime_ns <= ensemble.stat().st_mtime_ns for file in records)


def summarise(sentences: Sequence[str]) -> list[str]:
    """Return warnings of members in short: of ``sentences`` that differ in numbers alone one, after how many there are.

    It is the last one in the alphabet, so that the choice does not depend on the order of the members.
    """
    kinds: dict[str, list[str]] = {}
    for sentence in sentences:
        without_numbers = re.sub(r"\d[\d.e+-]*", "0", sentence)
        kinds.setdefault(without_numbers, []).append(sentence)

    summary = []
    for texts in kinds.values():
        members = counted(len(texts), "member")
        if len(set(texts)) > 1:
            members += ", for instance"
        summary.append(f"{members}: {max(texts)}")
    return summary
