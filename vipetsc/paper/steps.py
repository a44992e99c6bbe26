"""Computation of the missing steps of the paper: first the parts of single ranks, then the sweeps."""

import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from mpi4py import MPI

from vipetsc.io.atomic import write_text
from vipetsc.io.errors import is_of_file_system
from vipetsc.paper.plan import MISSING, STALE, PaperStep, PartMaker, Plan, read_json
from vipetsc.parallel import StoppedError, StopRequest, on_root
from vipetsc.studies.pool import TaskPool

RECORD = "made.json"
FORMATS = ("png", "pdf")
# Bytes near the end of every whole file of a kind; a file that was cut off lacks them.
LAST = {".png": b"IEND", ".pdf": b"%%EOF", ".html": b"</html>"}


@contextmanager
def noted(comm: MPI.Comm, name: str, notes: list[str]) -> Iterator[None]:
    """Add a note about an exception of the block, called ``name``, and go on.

    StoppedError, errors of a full disk, and errors of one rank alone are raised.
    """
    try:
        yield
    except StoppedError:
        raise
    except Exception as error:
        # If one rank fails alone, the others are in a collective call and would wait for it for ever.
        alone = comm.size > 1 and not getattr(error, "from_root", False)
        if alone or is_of_file_system(error):
            raise
        notes.append(f"failed: {name}: {error or type(error).__name__}")


def make_steps(
    plan: Plan, root: Path, comm: MPI.Comm, stop: StopRequest, tell: Callable[[str], None], notes: list[str]
) -> tuple[str, ...]:
    """Compute the steps of ``plan`` in ``root`` that are not done or had failures; returns the names of those computed.

    The parts that single ranks compute come first, those of all steps together, then the sweeps, one by one. After a
    request to ``stop`` no further step begins. ``tell`` is called on rank 0 with what is about to be done; warnings
    and failures are added to ``notes``. Collective.
    """
    left = on_root(comm, lambda: plan.left(root))
    states = on_root(comm, lambda: {step.name: step.state(root) for step in plan.steps})
    stale = {name for name, state in states.items() if state == STALE}
    # If a time is on record for one of these steps, it was spent on results that are gone.
    afresh = {name for name, state in states.items() if state in (STALE, MISSING)}
    missing = [step for step in plan.steps if step.name in left]

    def announce(*names: str) -> None:
        if comm.rank == 0:
            tell(f"{', '.join(names)}: about {rough_time(sum(left[name] for name in names) / comm.size)}")

    finished: list[str] = []
    parted = [step for step in missing if step.parts]
    if parted and not stop.agreed(comm):
        announce(*(step.name for step in parted))
        computed, cpu = _make_parts(parted, stale, root, comm, stop, notes)
        finished += computed
        _account(root, comm, cpu, afresh)

    # Then the steps on which all ranks work: after an interruption at most one of them is incomplete.
    for step in missing:
        if step.parts:
            continue
        if stop.agreed(comm):
            break
        announce(step.name)
        with noted(comm, step.name, notes):
            sys.audit("vipetsc.member", step.name)
            begin = time.process_time()
            warnings = step.compute_together(root, comm, stop, step.name in stale)
            notes += [f"warning: {step.name}: {warning}" for warning in warnings]
            finished.append(step.name)
            _account(root, comm, {step.name: time.process_time() - begin}, afresh)

    return tuple(step.name for step in missing if step.name in finished)


class PartJob(NamedTuple):
    """The ``part`` with this number of a ``step``, which one rank computes at a ``cost`` in s of CPU time.

    The cost comes first, because jobs are sorted by it.
    """

    cost: float
    step: str
    part: int


def _make_parts(
    steps: Sequence[PaperStep], stale: Collection[str], root: Path, comm: MPI.Comm, stop: StopRequest, notes: list[str]
) -> tuple[list[str], dict[str, float]]:
    """Compute all parts of ``steps`` on single ranks, the longest first.

    Earlier results of ``stale`` steps are replaced. Failures are added to ``notes``. Returns the names of the steps
    without failures, and the CPU time in s that this rank has spent on each step. Collective.
    """
    cpu: dict[str, float] = {}
    reasons: dict[str, str] = {}
    with ExitStack() as claims:
        makers: dict[str, PartMaker] = {}
        jobs: list[PartJob] = []
        for step in steps:
            with noted(comm, step.name, notes):
                makers[step.name] = claims.enter_context(step.claimed(root, comm, stop, step.name in stale))
                jobs += [PartJob(cost, step.name, part) for part, cost in step.parts.items()]

        def work(job: PartJob) -> None:
            begin = time.process_time()
            makers[job.step].make(job.part)
            cpu[job.step] = cpu.get(job.step, 0.0) + time.process_time() - begin

        def fail(job: PartJob, reason: str) -> None:
            reasons[job.step] = reason

        # Parts of all steps together, the longest first: no rank waits long for the last.
        pool = TaskPool(comm, MPI.COMM_SELF, stop)
        pool.run(sorted(jobs, reverse=True), work, fail=fail)
        failed: dict[str, str] = {}
        for from_rank in comm.allgather(reasons):
            failed |= from_rank
        notes += [f"failed: {name}: {reason}" for name, reason in failed.items()]

        finished = [name for name in makers if name not in failed]
        # ``stopped`` is the same on all ranks, so that all reach the agreement or none does.
        if not (pool.stopped or stop.agreed(comm)):
            for name in finished:
                makers[name].publish()
    return finished, cpu


def _account(root: Path, comm: MPI.Comm, steps: Mapping[str, float], afresh: Collection[str]) -> None:
    """Add the CPU time in s that each rank has spent on ``steps`` to the record in ``root``. Collective.

    Of steps that were computed ``afresh`` the record has this time alone.
    """
    # Several ranks may have worked on a step.
    spent = Counter[str]()
    for from_rank in comm.allgather(steps):
        spent.update(from_rank)

    def write() -> None:
        record = read_record(root)
        steps = record["cpu"]["steps"]
        for name, seconds in spent.items():
            if name not in afresh:
                seconds += steps.get(name, 0.0)
            steps[name] = seconds
        write_record(root, record)

    on_root(comm, write)


def rough_time(seconds: float) -> str:
    """Return an estimated time as text, in whole seconds, from two minutes on in minutes; a dash if it is not above 0.

    Further digits would claim an accuracy that an estimate does not have.
    """
    if seconds <= 0:
        return "-"
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min"


BuildRecord = dict[str, Any]
"""The content of ``made.json``.

"claims" and "report" are hashes of their inputs. "figures" has for each figure, by id, the hash of its "inputs" and the
stems of its "pictures". "cpu" is CPU time in s of all ranks: of the "steps" by name, of "figures", "claims" and
"report".
"""


def read_record(root: Path) -> BuildRecord:
    """Return the content of ``made.json`` in ``root``; without it an empty record, which makes all but steps anew."""
    empty = {"figures": {}, "cpu": {"steps": {}, "figures": 0.0, "claims": 0.0, "report": 0.0}}
    return empty | (read_json(root / RECORD) or {})


def write_record(root: Path, record: BuildRecord) -> None:
    """Write ``record`` to ``made.json`` unless the file holds it already."""
    if record != read_record(root):
        write_text(root / RECORD, json.dumps(record, indent=1) + "\n")


def is_whole(path: Path) -> bool:
    """Return whether the picture or page ``path`` is there and was not cut off."""
    if not path.exists():
        return False
    with path.open("rb") as file:
        # The last bytes alone: pictures are large, and there are a hundred of them.
        file.seek(max(path.stat().st_size - 32, 0))
        return LAST[path.suffix] in file.read()


def is_drawn(root: Path, stem: str) -> bool:
    """Return whether the picture ``stem`` is there, whole, in each of ``FORMATS``."""
    return all(is_whole(root / "figures" / f"{stem}.{kind}") for kind in FORMATS)
