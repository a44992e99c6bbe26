"""Every member of a sweep, over all ranks: linear runs first, then the longest; resumes, and goes on past failures."""

import json
import re
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from mpi4py import MPI

import h5py
import numpy as np

import vipetsc
from vipetsc.case import Case, Sweep
from vipetsc.case.sweep import MOST_TRIED
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import SWEEP, FolderError, claimed
from vipetsc.io.read import outdated
from vipetsc.parallel import Progress, StopRequest, on_root
from vipetsc.studies.ensemble import COMPLETE, FAILED, FORMAT_VERSION, MISSING, SCALED, STATUS, Results, assemble
from vipetsc.studies.linear_run import LinearRun, leading_cell, linear_name
from vipetsc.studies.pool import TaskPool
from vipetsc.studies.sweep_runs import MemberStore

MOST_SURVEYED = 10_000  # members whose cases are made beforehand, for their linear runs and what they will cost


@dataclass(frozen=True)
class SweepResult:
    """How a sweep ended: ``status`` (member), an index of ``studies.ensemble.STATUS``.

    ``made`` counts the members simulated or scaled now; ``busy`` (rank) is the share of the time in which each
    rank worked on members. ``warnings`` are sentences about records made again and about the members' results.
    """

    status: np.ndarray
    made: int
    seconds: float
    busy: tuple[float, ...]
    folder: Path
    warnings: list[str]

    @property
    def complete(self) -> bool:
        """Whether every member is there."""
        return not self.count(FAILED) and not self.count(MISSING)

    @property
    def resumable(self) -> bool:
        """Whether it was stopped before every member was made or had failed."""
        return self.count(MISSING) > 0

    def count(self, status: int) -> int:
        """Number of members that ended so."""
        return int((self.status == status).sum())


def run_sweep(
    plan: Sweep,
    folder: str | Path,
    comm: MPI.Comm = MPI.COMM_WORLD,
    *,
    force: bool = False,
    stop: StopRequest | None = None,
    resume: bool = False,
    progress: bool = False,
) -> SweepResult:
    """Make every member of ``plan`` in ``folder``, then ``ensemble.h5`` and ``index.json``.

    Members that are complete and made by this version are not made again, so a sweep that was killed goes on where
    it was; ``force`` begins anew and replaces the sweep in the folder when the new one has ended, ``resume`` needs one
    to go on with. A member that fails is recorded with its reason and the others go on. All ranks of
    ``comm`` make members; ``[sweep] ranks`` of them share each.

    Raises CaseError if no member is a valid case (of those drawn, where they are many), FolderError if the folder holds
    anything but this sweep.
    """
    on_root(comm, lambda: plan.members(MOST_TRIED)[:0])
    with claimed(comm, folder, SWEEP, plan.to_toml(), force=force, resume=resume) as claim:
        if reason := on_root(comm, lambda: outdated(claim.folder)):
            raise FolderError(reason)
        result = _make_all(plan, claim.folder, comm, stop or StopRequest(), progress)
        if not result.resumable:
            claim.publish()
    return replace(result, folder=claim.path)


def _make_all(plan: Sweep, folder: Path, comm: MPI.Comm, stop: StopRequest, progress: bool) -> SweepResult:
    """Make what is missing of the members in ``folder``, on all ranks, and put together what is there."""
    begin = time.perf_counter()
    sys.audit("vipetsc.plan", plan.name)
    team = comm.Split(comm.rank // plan.options.ranks, comm.rank)
    pool = TaskPool(comm, team, stop)
    store = MemberStore(plan, folder, team, stop, comm.rank)

    # What there is and what comes first is decided on one rank: another may not see the files of the others yet.
    survey: _Survey

    def look() -> tuple[dict[str, tuple[Case, list[int]]], dict[str, LinearRun | str]]:
        nonlocal survey
        survey = _survey(plan, folder)
        return survey.needed, dict(survey.results.linear if len(survey.missing) else {})

    linear, store.linear = on_root(comm, look)
    pool.run(list(linear), lambda name: store.make_linear(*linear[name]))
    for name, run in (item for known in comm.allgather(store.linear) for item in known.items()):
        store.linear[name] = run if isinstance(run, str) else run.joined(store.linear.get(name))
    order = on_root(comm, lambda: survey.order(store.linear))
    bar = Progress(comm, len(order), "runs", show=progress)
    made = pool.run(order, store.make, bar, store.fail)
    store.file.close()

    seconds = time.perf_counter() - begin
    busy = tuple(comm.allgather(pool.busy / seconds))

    def put_together() -> tuple[np.ndarray, list[str]]:
        results = Results(plan, folder) if linear or order else survey.results
        status, warnings = conclude(results, afresh=bool(order))
        return status, [*dict.fromkeys([*survey.results.damaged, *survey.lost, *warnings])]

    status, warnings = on_root(comm, put_together)
    team.Free()
    return SweepResult(status, made, seconds, busy, folder, warnings)


class _Survey(NamedTuple):
    """What there is of a sweep, the numbers of the ``missing`` members, and sentences about what is ``lost``.

    Of the missing members, if they are many, some are ``drawn`` that stand for the others: number, case, name of the
    linear run. They tell what a member costs, and the linear runs that are ``needed``: cases by name, with the first
    sites to measure them for.
    """

    results: Results
    missing: np.ndarray
    drawn: list[tuple[int, Case, str]]
    needed: dict[str, tuple[Case, list[int]]]
    lost: list[str]

    def order(self, linear: dict[str, LinearRun | str]) -> list[int]:
        """The missing members, the longest first: contacts at every site that the linear wave would reach cost most."""
        cost, known = [0.0], [-1]
        for number, case, name in self.drawn:
            if isinstance(run := linear.get(name), LinearRun):
                cost.append(float(np.minimum(run.reached(case), 10.0).sum()) + 1e-3 * float(case.time.end))
                known.append(number)
        # One that is not known costs what the last one before it does that is.
        place = np.searchsorted(known, self.missing, "right") - 1
        return list(self.missing[np.argsort(-np.array(cost)[place], kind="stable")].tolist())


def _survey(plan: Sweep, folder: Path) -> _Survey:
    """Look through ``folder``: members that have failed are missing, and those whose fields cannot be read."""
    results, lost = Results(plan, folder), list[str]()
    absent = (results.status != COMPLETE) & (results.status != SCALED)
    if plan.options.fields:
        files = "run.h5", "analysis.h5"
        absent |= [not all(is_whole(folder / name / file, lost) for file in files) for name in results.ids]
    some = missing = np.unique(results.first[absent])
    if len(missing) > MOST_SURVEYED:
        some = np.sort(np.random.default_rng(0).choice(missing, MOST_SURVEYED, replace=False))
    cases = [(number, plan.member(number).case) for number in some.tolist()]
    drawn = [(number, case, linear_name(case)) for number, case in cases if case]
    needed: dict[str, tuple[Case, list[int]]] = {}
    for _, case, name in drawn:
        _, sites = needed.setdefault(name, (case, []))
        known = results.linear[name].measures if name in results.linear else ()
        if not plan.options.fields and leading_cell(case) not in (*sites, *known):
            sites.append(leading_cell(case))
    needed = {name: run for name, run in needed.items() if run[1] or name not in results.linear}
    return _Survey(results, missing, drawn, needed, lost)


def is_whole(path: Path, lost: list[str]) -> bool:
    """Whether an HDF5 file is there and was not cut off, which HDF5 sees; if it was, ``lost`` says so."""
    try:
        h5py.File(path).close()
    except OSError as error:
        lost += [f"{path} cannot be read: {error}; made again"] if path.exists() else []
        return False
    return True


def conclude(results: Results, afresh: bool = False) -> tuple[np.ndarray, list[str]]:
    """Write ``ensemble.h5``, once no member is missing, and ``index.json``; how the members ended, and warnings.

    What is there stays as it is unless it is of other results, or ``afresh``.
    """
    plan, folder, status = results.plan, results.folder, results.status
    sys.audit("vipetsc.conclude", str(folder))
    failed = [
        {"place": np.unravel_index(n, plan.shape), "id": results.ids[n], "reason": results.reasons[results.first[n]]}
        for n in np.flatnonzero(status == FAILED)
    ]
    count = {name: int((status == code).sum()) for code, name in enumerate(STATUS)}
    about = {"format_version": FORMAT_VERSION, "vipetsc_version": vipetsc.__version__, "sweep": plan.name}
    index = about | {"members": count, "failed": failed}
    warnings = summarise([text for first in results.first for text in results.warnings.get(int(first), ())])
    path, text = folder / "index.json", json.dumps(index, indent=1, default=int) + "\n"
    told = path.exists() and path.read_text(encoding="utf-8", errors="replace") == text
    # The index comes last: with it and nothing made since, the ensemble is that of these members.
    if not count[STATUS[MISSING]]:
        lost: list[str] = []
        if afresh or not told or not is_whole(folder / "ensemble.h5", lost):
            assemble(results, warnings)
        warnings += lost
        results.merge_files()
    if not told:
        write_text(path, text)
    return status, warnings


def summarise(sentences: Sequence[str]) -> list[str]:
    """Warnings of members: of those that differ in numbers alone the last in the alphabet, with how many there are."""
    kinds: dict[str, list[str]] = {}
    for sentence in sentences:
        kinds.setdefault(re.sub(r"\d[\d.e+-]*", "0", sentence), []).append(sentence)
    counted = ((len(texts), len(set(texts)) > 1, max(texts)) for texts in kinds.values())
    return [f"{n} member{'s' * (n > 1)}{', for instance' * differ}: {text}" for n, differ, text in counted]
