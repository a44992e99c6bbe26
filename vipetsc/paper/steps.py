"""The steps of the paper made, as far as they are missing: parts that single ranks make shared out, then the sweeps."""

import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from mpi4py import MPI

from vipetsc.paper.build_record import read_record, write_record
from vipetsc.paper.plan import STALE, PaperStep, Plan
from vipetsc.parallel import StoppedError, StopRequest, on_root
from vipetsc.studies.pool import DISK_FULL, TaskPool


@contextmanager
def noted(comm: MPI.Comm, name: str, notes: list[str]) -> Iterator[None]:
    """Note what is raised and go on; not where one rank failed alone, nor for a full disk."""
    try:
        yield
    except StoppedError:
        raise
    except Exception as error:
        alone = comm.size > 1 and not getattr(error, "from_root", False)
        if alone or getattr(error, "errno", None) in DISK_FULL:
            raise
        notes.append(f"failed: {name}: {error or type(error).__name__}")


def make_steps(
    plan: Plan, root: Path, comm: MPI.Comm, stop: StopRequest, tell: Callable[[str], None], notes: list[str]
) -> tuple[str, ...]:
    """Make the steps that are not done or had failures, until a request to stop; returns their names.

    First the parts that single ranks make, of all steps together, then the sweeps one by one.
    """
    left, stale = on_root(comm, lambda: (plan.left(root), {s.name for s in plan.steps if s.state(root) == STALE}))
    missing = [step for step in plan.steps if step.name in left]

    def say(*names: str) -> None:
        if comm.rank == 0:
            tell(f"{', '.join(names)}: about {duration(sum(left[name] for name in names) / comm.size)}")

    made: list[str] = []
    parted = [step for step in missing if step.parts]
    if parted and not stop.agreed(comm):
        say(*(step.name for step in parted))
        made += _make_parts(parted, stale, root, comm, stop, notes)
    for step in (step for step in missing if not step.parts):
        if stop.agreed(comm):
            break
        say(step.name)
        with noted(comm, step.name, notes):
            sys.audit("vipetsc.member", step.name)
            begin = time.process_time()
            warnings = step.sweep(root, comm, stop, step.name in stale)
            notes += [f"warning: {step.name}: {warning}" for warning in warnings]
            made.append(step.name)
            _account(root, comm, {step.name: time.process_time() - begin}, step.name in stale)
    return tuple(step.name for step in missing if step.name in made)


def _make_parts(
    steps: Sequence[PaperStep], stale: Collection[str], root: Path, comm: MPI.Comm, stop: StopRequest, notes: list[str]
) -> list[str]:
    """Share all parts of ``steps`` over the ranks, the longest first; returns the steps without failures."""
    cpu = dict[str, float]()
    with ExitStack() as claims:
        begun = {}
        for step in steps:
            with noted(comm, step.name, notes):
                begun[step.name] = claims.enter_context(step.claimed(root, comm, stop, step.name in stale))
        jobs = [(cost, step.name, part) for step in steps if step.name in begun for part, cost in step.parts.items()]

        def work(job: tuple[float, str, int]) -> None:
            _, name, part = job
            begin = time.process_time()
            begun[name].make(part)
            cpu[name] = cpu.get(name, 0.0) + time.process_time() - begin

        pool = TaskPool(comm, MPI.COMM_SELF, stop)
        reasons: dict[str, str] = {}
        pool.run(sorted(jobs, reverse=True), work, fail=lambda job, reason: reasons.update({job[1]: reason}))
        failed = {name: reason for share in comm.allgather(reasons) for name, reason in share.items()}
        notes += [f"failed: {name}: {reason}" for name, reason in failed.items()]
        made = [name for name in begun if name not in failed]
        if not (pool.stopped or stop.agreed(comm)):
            for name in made:
                begun[name].publish()
    _account(root, comm, cpu, afresh=False)
    return made


def _account(root: Path, comm: MPI.Comm, steps: Mapping[str, float], afresh: bool) -> None:
    """Add the CPU time in s that each rank spent on ``steps`` to the record; of steps made ``afresh`` only this."""
    spent = Counter[str]()
    for share in comm.allgather(steps):
        spent.update(share)

    def write() -> None:
        record = read_record(root)
        before = {} if afresh else record["cpu"]["steps"]
        record["cpu"]["steps"] |= {name: before.get(name, 0.0) + seconds for name, seconds in spent.items()}
        write_record(root, record)

    on_root(comm, write)


def duration(seconds: float) -> str:
    """A time in words; a dash for none."""
    if seconds <= 0:
        return "-"
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
