"""Every member of a sweep, over all ranks: linear runs first, then the longest; resumes, and goes on past failures."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mpi4py import MPI

import numpy as np

from vipetsc.case import Case, Sweep, SweepMember
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import FolderError
from vipetsc.io.store import claim_folder
from vipetsc.parallel import Progress, SharedCounter, StopRequest, on_root
from vipetsc.studies.ensemble import COMPLETE, FAILED, SCALED, Outcome, assemble
from vipetsc.studies.members import LinearWave, Members, StoppedError

FORMAT_VERSION = 1
# What a member may raise and leave the others to go on: the machine's limits, a solver's or a file's refusal.
FAILURES = (ArithmeticError, MemoryError, OSError, RuntimeError, ValueError)


@dataclass(frozen=True)
class SweepResult:
    """How a sweep ended: outcomes in the members' order, None for those not reached before a stop.

    ``made`` counts the members simulated or scaled now; ``busy`` (rank) is the share of the time in which each
    rank worked on members.
    """

    outcomes: tuple[Outcome | None, ...]
    made: int
    seconds: float
    busy: tuple[float, ...]
    folder: Path

    @property
    def complete(self) -> bool:
        """Whether every member is there."""
        return all(o is not None and o.status != FAILED for o in self.outcomes)

    def count(self, status: int) -> int:
        """Number of members that ended so."""
        return sum(o is not None and o.status == status for o in self.outcomes)


def sweep(
    plan: Sweep,
    folder: str | Path,
    comm: MPI.Comm = MPI.COMM_WORLD,
    *,
    force: bool = False,
    stop: StopRequest | None = None,
    progress: bool = False,
) -> SweepResult:
    """Make every member of ``plan`` in ``folder``, then ``index.json`` and ``ensemble.h5``.

    Members that are complete are not made again, so a sweep that was killed goes on where it was; ``force``
    begins anew. A member that fails is recorded with its reason and the others go on. All ranks of ``comm`` make
    members; ``[sweep] ranks`` of them share each.

    Raises
    ------
    CaseError
        If no member is a sound case.
    FolderError
        If the folder holds anything but this sweep.
    """
    folder, stop = Path(folder), stop or StopRequest()
    begin = time.perf_counter()
    members = plan.members()
    on_root(comm, lambda: _prepare(plan, folder, force))
    team = comm.Split(comm.rank // plan.options.ranks, comm.rank)
    crew = TaskPool(comm, team, stop)
    shop = Members(folder, plan.options, team, stop)

    cases = {m.id: m.case for m in members if m.case}
    missing = on_root(comm, lambda: [key for key, case in cases.items() if not shop.is_complete(case)])
    linear = {shop.linear_folder(cases[key]): cases[key] for key in missing}
    absent = on_root(comm, lambda: [path for path in linear if not (path / "wave.h5").exists()])
    reasons = crew.share(absent, lambda path: shop.make_linear(linear[path]), None)
    broken = {path: reason for path, reason in reasons.items() if reason}
    waves = {path: shop.wave(case) for path, case in linear.items() if (path / "wave.h5").exists()}
    feasible = [key for key in missing if shop.linear_folder(cases[key]) in waves]
    order = sorted(feasible, key=lambda key: -_cost(cases[key], waves[shop.linear_folder(cases[key])]))
    bar = Progress(comm, len(order), "runs", show=progress)
    made = crew.share(order, lambda key: shop.make(cases[key], waves[shop.linear_folder(cases[key])]), bar)
    reasons = {key: broken.get(shop.linear_folder(cases[key])) for key in missing if key not in feasible} | made

    seconds = time.perf_counter() - begin
    busy = tuple(comm.allgather(crew.busy / seconds))
    outcomes = on_root(comm, lambda: conclude(plan, members, shop, reasons))
    team.Free()
    return SweepResult(outcomes, sum(r == "" for r in made.values()), seconds, busy, folder)


def conclude(
    plan: Sweep, members: list[SweepMember], shop: Members, reasons: dict[str, str | None]
) -> tuple[Outcome | None, ...]:
    """Write ``index.json`` and, once no member is missing, ``ensemble.h5``; returns how the members ended.

    ``reasons`` names the members (by id) that failed just now, and why.
    """
    outcomes = tuple(_outcome(member, shop, reasons) for member in members)
    _write_index(plan, members, outcomes, shop.folder)
    if all(outcomes):
        assemble(plan, members, outcomes, shop.folder)
    return outcomes


class TaskPool:
    """Teams of ranks that draw jobs until none are left."""

    def __init__(self, comm: MPI.Comm, team: MPI.Comm, stop: StopRequest) -> None:
        self.comm, self.team, self.stop = comm, team, stop
        self.busy = 0.0

    def share(self, jobs: list, work: Callable, progress: Progress | None) -> dict:
        """Do all ``jobs``; returns for each one done the reason why it failed, "" if it did not. Collective."""
        drawn, ended, reasons = SharedCounter(self.comm), SharedCounter(self.comm), {}
        leader = self.team.rank == 0
        while not self.stop.requested:
            number = self.team.bcast(drawn.draw() if leader else None)
            if number >= len(jobs):
                break
            begin = time.perf_counter()
            try:
                reasons[jobs[number]] = self._reason(work, jobs[number])
            except StoppedError:
                break
            finally:
                self.busy += time.perf_counter() - begin
            done = ended.draw(1 if leader else 0)
            if progress:
                progress.update(done + 1)
        everything = self.comm.allgather(reasons)
        if progress:
            progress.close()
        drawn.free()
        ended.free()
        return {job: reason for found in everything for job, reason in found.items()}

    def _reason(self, work: Callable, job: object) -> str:
        if self.team.size > 1:  # ranks that meet in a member cannot go on without one of theirs: all end
            work(job)
            return ""
        try:
            work(job)
        except FAILURES as error:
            return f"{type(error).__name__}: {error}" if not isinstance(error, RuntimeError) else str(error)
        return ""


def _prepare(plan: Sweep, folder: Path, force: bool) -> None:
    kept, text = folder / "case.toml", plan.to_toml()
    sweeps = (folder / "index.json").exists() or (folder / "linear").is_dir()
    if kept.exists() and kept.read_text(encoding="utf-8") == text and not force:
        return
    if kept.exists() and not sweeps and any(folder.glob("*.h5")):
        raise FolderError(f"{folder}: holds results of another kind; choose another --out")
    if kept.exists() and not force:
        raise FolderError(f"{folder}: holds another sweep; --force replaces it, --out chooses another folder")
    claim_folder(folder, force, ("branch-*.h5", "run.h5"))
    for path in folder.iterdir() if force else ():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name in ("index.json", "ensemble.h5", "backbone.h5"):
            path.unlink()
    write_text(kept, text)
    (folder / "linear").mkdir(exist_ok=True)


def _cost(case: Case, wave: LinearWave) -> float:
    """Relative cost of a member: contacts at every site that the linear wave would reach, samples anyhow."""
    return float(np.minimum(wave.reached(case), 10.0).sum()) + 1e-3 * case.time.end


def _outcome(member: SweepMember, shop: Members, reasons: dict[str, str | None]) -> Outcome | None:
    if member.case is None:
        return Outcome(FAILED, member.problem)
    summary = shop.summary(member.case)
    if reasons.get(member.id):
        return Outcome(FAILED, reasons[member.id])
    if not shop.is_complete(member.case):
        return None
    return Outcome(
        SCALED if "scaled_from" in summary["statistics"] else COMPLETE, summary["status"], summary["statistics"]
    )


def _write_index(plan: Sweep, members: list[SweepMember], outcomes: tuple[Outcome | None, ...], folder: Path) -> None:
    names = plan.names()
    axes = [{"keys": axis.keys, "names": [names[k] for k in axis.keys], "values": axis.values} for axis in plan.axes]
    rows = []
    for member, outcome in zip(members, outcomes, strict=True):
        row = {"place": member.index, "id": member.id}
        row |= {"status": outcome.name, "reason": outcome.reason} if outcome else {"status": "missing", "reason": ""}
        rows.append(row)
    index = {"format_version": FORMAT_VERSION, "sweep": plan.name, "axes": axes, "members": rows}
    write_text(folder / "index.json", json.dumps(index, indent=1) + "\n")
