"""Every member of a sweep, over all ranks: linear runs first, then the longest; resumes, and goes on past failures.

The measures of runs already made, of one or of all members of a sweep whose fields were kept, are taken anew here too.
"""

import json
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from mpi4py import MPI

import numpy as np
import xarray as xr

import vipetsc
from vipetsc.case import Case, Sweep, SweepMember
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import SWEEP, FolderError, claimed
from vipetsc.io.netcdf import open_netcdf, write_netcdf
from vipetsc.io.read import open_run
from vipetsc.parallel import Progress, StopRequest, on_every_rank, on_root
from vipetsc.studies.analysis import analyse
from vipetsc.studies.ensemble import COMPLETE, FAILED, MISSING, SCALED, STATUS, Outcome, assemble
from vipetsc.studies.members import MemberStore, arrival_at, linear_folder, reached, read_wave
from vipetsc.studies.pool import TaskPool

FORMAT_VERSION = 1


@dataclass(frozen=True)
class SweepResult:
    """How a sweep ended: outcomes in the members' order.

    ``made`` counts the members simulated or scaled now; ``busy`` (rank) is the share of the time in which each
    rank worked on members. ``warnings`` are sentences about files made again and about the members' results.
    """

    outcomes: list[Outcome]
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
        return [outcome.status for outcome in self.outcomes].count(status)


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
    """Make every member of ``plan`` in ``folder``, then ``index.json`` and ``ensemble.h5``.

    Members that are complete and made by this version are not made again, so a sweep that was killed goes on where
    it was; ``force`` begins anew and replaces the sweep in the folder when the new one has ended, ``resume`` needs one
    to go on with. A member that fails is recorded with its reason and the others go on. All ranks of
    ``comm`` make members; ``[sweep] ranks`` of them share each.

    Raises CaseError if no member is a valid case, FolderError if the folder holds anything but this sweep.
    """
    members = plan.members()
    with claimed(comm, folder, SWEEP, plan.to_toml(), force=force, resume=resume) as claim:
        result = _make_all(plan, members, claim.folder, comm, stop or StopRequest(), progress)
        if not result.resumable:
            claim.publish()
    return replace(result, folder=claim.path)


def _make_all(
    plan: Sweep, members: Sequence[SweepMember], folder: Path, comm: MPI.Comm, stop: StopRequest, progress: bool
) -> SweepResult:
    """Make what is missing of the ``members`` in ``folder``, on all ranks, and put together what is there."""
    begin = time.perf_counter()
    sys.audit("vipetsc.plan", plan.name)
    team = comm.Split(comm.rank // plan.options.ranks, comm.rank)
    pool = TaskPool(comm, team, stop)
    store = MemberStore(folder, plan.options, team, stop)

    cases = {m.id: m.case for m in members if m.case}
    # What there is and what comes first is decided on one rank: another may not see the files of the others yet.
    source = {key: linear_folder(folder, case) for key, case in cases.items()}
    linear = on_root(comm, lambda: {source[key]: c for key, c in cases.items() if not store.has_linear(c)})
    failures = pool.share(list(linear), lambda path: store.make_linear(linear[path]))
    missing, order, waves = on_root(comm, lambda: _plan(cases, source, store))
    bar = Progress(comm, len(order), "runs", show=progress)
    made = pool.share(order, lambda key: store.make(cases[key], waves[source[key]]), bar)
    reasons = {key: reason for key in missing if (reason := failures.get(source[key]))} | made

    seconds = time.perf_counter() - begin
    busy = tuple(comm.allgather(pool.busy / seconds))
    noticed = [warning for warnings in comm.allgather(store.warnings) for warning in warnings]
    outcomes, warnings = on_root(comm, lambda: conclude(plan, members, store, reasons))
    team.Free()
    count = sum(reason == "" for reason in made.values())
    return SweepResult(outcomes, count, seconds, busy, folder, [*dict.fromkeys(noticed), *warnings])


def _plan(
    cases: Mapping[str, Case], source: Mapping[str, Path], store: MemberStore
) -> tuple[list[str], list[str], dict[Path, xr.Dataset]]:
    """The missing members; those of them whose linear run (``source``) came out, the longest first; linear waves."""
    missing = [key for key, case in cases.items() if not store.summary(case, current=True)]
    stored = {source[key]: store.wave(cases[key]) for key in missing}
    waves = {path: wave for path, wave in stored.items() if wave is not None}

    def cost(key: str) -> float:
        """Relative cost of a member: contacts at every site that the linear wave would reach, samples anyhow."""
        touching = np.minimum(reached(waves[source[key]], cases[key]), 10.0)
        return float(touching.sum()) + 1e-3 * float(cases[key].time.end)

    return missing, sorted((key for key in missing if source[key] in waves), key=cost, reverse=True), waves


def conclude(
    plan: Sweep, members: Sequence[SweepMember], store: MemberStore, reasons: Mapping[str, str], afresh: bool = False
) -> tuple[list[Outcome], list[str]]:
    """Write ``ensemble.h5``, once no member is missing, and ``index.json``; how the members ended, and warnings.

    ``reasons`` names the members (by id) that were made just now, and why they failed. What is there stays as it is
    if there are none, unless ``afresh``.
    """
    sys.audit("vipetsc.conclude", str(store.folder))
    outcomes, rows, warned = [], [], Counter[str]()
    for member in members:
        outcome = Outcome(MISSING)
        if reason := reasons.get(member.id) or member.problem:
            outcome = Outcome(FAILED, reason)
        elif member.case and (summary := store.summary(member.case)):
            status = SCALED if "scaled_from" in summary["statistics"] else COMPLETE
            outcome = Outcome(status, summary["status"], summary["statistics"])
            # An amplitude sweep goes below the onset on purpose.
            warned.update(text for text in summary.get("warnings", ()) if not text.startswith("no contact"))
        outcomes.append(outcome)
        ending = {"status": STATUS[outcome.status], "reason": outcome.reason}
        rows.append({"place": member.index, "id": member.id} | ending)
    names = plan.names()
    axes = [{"keys": [*axis], "names": [names[k] for k in axis], "values": [*axis.values()]} for axis in plan.axes]
    index = {"format_version": FORMAT_VERSION, "sweep": plan.name, "axes": axes, "members": rows}
    warnings = [f"{count} members: {sentence}" for sentence, count in warned.items()]
    path, text = store.folder / "index.json", json.dumps(index, indent=1) + "\n"
    told = path.exists() and path.read_text(encoding="utf-8", errors="replace") == text
    finished = all(outcome.status != MISSING for outcome in outcomes)
    # The index comes last: with it and nothing made since, the ensemble is that of these members.
    if finished and (reasons or afresh or not told or not store.is_whole(store.folder / "ensemble.h5")):
        assemble(plan, members, outcomes, store.folder, warnings)
    if not told:
        write_text(path, text)
    return outcomes, warnings


def reanalyse_folders(paths: list[Path], comm: MPI.Comm) -> list[Path]:
    """Measure the runs in ``paths`` (folders of runs or sweeps, or ``run.h5``); returns the files written.

    The runs are shared over the ranks of ``comm``. Members of a sweep that kept no fields stay as they are; the
    sweep's ensemble is put together anew.

    Raises FolderError if a path holds neither runs nor a sweep; nothing is written then.
    """
    runs = on_root(comm, lambda: [folder for path in paths for folder in _measurable(path)])

    def reassemble(folder: Path) -> Path:
        plan = Sweep.load(folder / "case.toml")
        store = MemberStore(folder, plan.options, MPI.COMM_SELF, StopRequest())
        outcomes, _ = conclude(plan, plan.members(), store, {}, afresh=True)
        if any(outcome.status == MISSING for outcome in outcomes):
            raise FolderError(f"{folder}: the sweep is not finished; the verb sweep goes on with it")
        return folder / "ensemble.h5"

    measured = on_every_rank(comm, lambda: [measure_run(folder) for folder in runs[comm.rank :: comm.size]])
    written = sorted(path for paths in comm.allgather(measured) for path in paths)
    return written + on_root(comm, lambda: [reassemble(path) for path in paths if (path / "index.json").exists()])


def _measurable(path: Path) -> Iterator[Path]:
    """The folders of the runs in ``path`` that can be measured, every run checked; raises FolderError."""
    folder = path.parent if path.name == "run.h5" else path
    sweep = (folder / "index.json").exists()
    if not sweep and not (folder / "run.h5").exists():
        raise FolderError(f"{path}: holds no run.h5; the folder of a finished run or sweep is needed")
    for file in sorted(folder.glob("*/run.h5")) if sweep else [folder / "run.h5"]:
        try:
            with open_run(file) as run:
                if "velocity" in run or not (file.parents[1] / "index.json").exists():
                    yield file.parent
        except (OSError, ValueError, KeyError) as error:
            raise FolderError(f"{file}: is not a run of vipetsc ({error})") from None


def measure_run(folder: Path) -> Path:
    """Write ``folder/analysis.h5`` and return its path; a sweep knows when the wave arrives. Raises as ``open_run``."""
    with open_run(folder / "run.h5") as run:
        case = Case.of(run)
        arrival = arrival_at(read_wave(folder.parent, case), case)
        write_netcdf(folder / "analysis.h5", analyse(run, arrival=arrival))
    return folder / "analysis.h5"


def is_measured(folder: Path) -> bool:
    """Whether ``folder/analysis.h5`` was measured by this version from ``run.h5`` as it is; raises as ``open_run``."""
    with open_run(folder / "run.h5") as run:
        expected = {key: run.attrs.get(key) for key in ("case", "status")} | {"vipetsc_version": vipetsc.__version__}
        with suppress(OSError), open_netcdf(folder / "analysis.h5", "analysis") as analysis:  # it is there, and whole
            return all(analysis.attrs.get(key) == value for key, value in expected.items())
    return False
