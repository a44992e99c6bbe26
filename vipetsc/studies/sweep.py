"""Every member of a sweep, over all ranks: linear runs first, then the longest; resumes, and goes on past failures."""

import json
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from mpi4py import MPI

import numpy as np

from vipetsc.case import Sweep, SweepMember
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import SWEEP, claim_folder
from vipetsc.parallel import Progress, SharedCounter, StopRequest, on_every_rank, on_root
from vipetsc.studies.ensemble import COMPLETE, FAILED, SCALED, STATUS, Outcome, assemble
from vipetsc.studies.members import MemberStore, StoppedError, reached

FORMAT_VERSION = 1
# What a member may raise and leave the others to go on: the machine's limits, a solver's or a file's refusal.
FAILURES = (ArithmeticError, MemoryError, OSError, RuntimeError, ValueError)

Job = TypeVar("Job", bound=Hashable)


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


def run_sweep(
    plan: Sweep,
    folder: str | Path,
    comm: MPI.Comm = MPI.COMM_WORLD,
    *,
    force: bool = False,
    stop: StopRequest | None = None,
    progress: bool = False,
) -> SweepResult:
    """Make every member of ``plan`` in ``folder``, then ``index.json`` and ``ensemble.h5``.

    Members that are complete and made by this version are not made again, so a sweep that was killed goes on where
    it was; ``force`` begins anew. A member that fails is recorded with its reason and the others go on. All ranks of
    ``comm`` make members; ``[sweep] ranks`` of them share each.

    Raises CaseError if no member is a valid case, FolderError if the folder holds anything but this sweep.
    """
    folder, stop = Path(folder), stop or StopRequest()
    begin = time.perf_counter()
    members = plan.members()
    on_root(comm, lambda: claim_folder(folder, SWEEP, plan.to_toml(), force=force, resume=None))
    team = comm.Split(comm.rank // plan.options.ranks, comm.rank)
    pool = TaskPool(comm, team, stop)
    store = MemberStore(folder, plan.options, team, stop)

    cases = {m.id: m.case for m in members if m.case}
    missing = on_root(comm, lambda: [key for key, case in cases.items() if not store.is_complete(case, current=True)])
    source = {key: store.linear_folder(cases[key]) for key in missing}
    linear = {source[key]: cases[key] for key in missing}
    absent = on_root(comm, lambda: [path for path, case in linear.items() if not store.has_wave(case)])
    failures = pool.share(absent, lambda path: store.make_linear(linear[path]), None)
    ready = on_root(comm, lambda: [path for path, case in linear.items() if store.has_wave(case)])
    waves = on_every_rank(comm, lambda: {p: wave for p in ready if (wave := store.wave(linear[p])) is not None})

    def cost(key: str) -> float:
        """Relative cost of a member: contacts at every site that the linear wave would reach, samples anyhow."""
        touching = np.minimum(reached(waves[source[key]], cases[key]), 10.0)
        return float(touching.sum()) + 1e-3 * float(cases[key].time.end)

    order = sorted((key for key in missing if source[key] in waves), key=cost, reverse=True)
    bar = Progress(comm, len(order), "runs", show=progress)
    made = pool.share(order, lambda key: store.make(cases[key], waves[source[key]]), bar)
    reasons = {key: failures.get(source[key], "") for key in missing} | made

    seconds = time.perf_counter() - begin
    busy = tuple(comm.allgather(pool.busy / seconds))
    outcomes = on_root(comm, lambda: conclude(plan, members, store, reasons))
    team.Free()
    return SweepResult(outcomes, sum(reason == "" for reason in made.values()), seconds, busy, folder)


def conclude(
    plan: Sweep, members: Sequence[SweepMember], store: MemberStore, reasons: Mapping[str, str]
) -> tuple[Outcome | None, ...]:
    """Write ``index.json`` and, once no member is missing, ``ensemble.h5``; returns how the members ended.

    ``reasons`` names the members (by id) that failed just now, and why.
    """
    outcomes, rows = [], []
    for member in members:
        outcome, reason = None, reasons.get(member.id) or member.problem
        if reason:
            outcome = Outcome(FAILED, reason)
        elif member.case and store.is_complete(member.case):
            summary = store.summary(member.case)
            status = SCALED if "scaled_from" in summary["statistics"] else COMPLETE
            outcome = Outcome(status, summary["status"], summary["statistics"])
        outcomes.append(outcome)
        told = (STATUS[outcome.status], outcome.reason) if outcome else ("missing", "")
        rows.append({"place": member.index, "id": member.id, "status": told[0], "reason": told[1]})
    names = plan.names()
    axes = [{"keys": axis.keys, "names": [names[k] for k in axis.keys], "values": axis.values} for axis in plan.axes]
    index = {"format_version": FORMAT_VERSION, "sweep": plan.name, "axes": axes, "members": rows}
    write_text(store.folder / "index.json", json.dumps(index, indent=1) + "\n")
    ended = [outcome for outcome in outcomes if outcome]
    if len(ended) == len(outcomes):
        assemble(plan, members, ended, store.folder)
    return tuple(outcomes)


class TaskPool:
    """Teams of ranks that draw jobs until none are left; ``busy`` is the time in s that this rank worked on them."""

    def __init__(self, comm: MPI.Comm, team: MPI.Comm, stop: StopRequest) -> None:
        self.comm, self.team, self.stop = comm, team, stop
        self.busy = 0.0

    def share(self, jobs: Sequence[Job], work: Callable[[Job], None], progress: Progress | None) -> dict[Job, str]:
        """Do all ``jobs``; returns for each one done the reason why it failed, "" if it did not. Collective."""
        drawn, ended = SharedCounter(self.comm), SharedCounter(self.comm)
        reasons: dict[Job, str] = {}
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
        return {job: reason for share in everything for job, reason in share.items()}

    def _reason(self, work: Callable[[Job], None], job: Job) -> str:
        """Do ``job``; returns why it failed, "" if it did not."""
        if self.team.size > 1:  # ranks that meet in a member cannot go on without one of theirs: all end
            work(job)
            return ""
        try:
            work(job)
        except FAILURES as error:
            return f"{type(error).__name__}: {error}" if not isinstance(error, RuntimeError) else str(error)
        return ""
