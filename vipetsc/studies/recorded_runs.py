"""Runs of a study, simulated by teams of ranks and recorded as they end, so that an interrupted study can continue.

Every study with many runs has one ``RecordedRuns``: the scattering law, a prediction, a search for an optimum, an
identification and a sweep. A record has the ``key`` of its run, a ``kind`` (a sweep has linear runs and members), the
version of the program, the time that it took, and what was measured, or the ``reason`` why the run failed.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from mpi4py import MPI

import xarray as xr

from vipetsc.case import Case
from vipetsc.dynamics import simulate
from vipetsc.dynamics.result import Result
from vipetsc.io.records import Line, Record, RecordFile, merge_records, read_records
from vipetsc.io.store import RunMemory, RunOutput
from vipetsc.parallel import StoppedError, StopRequest, StudyError, on_every_rank, on_root
from vipetsc.progress import Progress
from vipetsc.sources import source_key
from vipetsc.studies.pool import TaskPool
from vipetsc.wording import counted

Key = str | float | tuple[str, float] | tuple[str, float, int]
RUN = "run"  # the kind of a record, where a study has one kind
# Exceptions that say that a run itself has failed, and would fail again. Too little memory (MemoryError, or CaseError
# from a check before the run) and a full disk (OSError) are not among them: the next attempt may have more.
FAILURES = (RuntimeError, ArithmeticError)


class RecordPaths:
    """Files of the records called ``name`` in ``folder``: one for each rank, merged into one when a study has ended."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder = folder
        self.name = name

    @property
    def merged(self) -> Path:
        """The file of all records."""
        return self.folder / f"{self.name}.jsonl"

    def for_rank(self, rank: int) -> Path:
        """Return the file that ``rank`` appends to."""
        return self.folder / f"{self.name}-{rank}.jsonl"

    def by_rank(self) -> list[Path]:
        """Return the files of ranks that are there."""
        return sorted(self.folder.glob(f"{self.name}-*.jsonl"))

    def existing(self) -> list[Path]:
        """Return existing files, the merged one first; of two records of one run the later in this order counts."""
        files = self.by_rank()
        # What ranks appended after the last merger is newer than all that is in the merged file.
        if self.merged.exists():
            files.insert(0, self.merged)
        return files

    def read(self, damaged: Callable[[str], None] = lambda text: None) -> Iterator[tuple[Key, Record, Line]]:
        """Yield the records of these sources with their keys and places; a later one of a key replaces an earlier one.

        A failure after a success is passed over. ``damaged`` gets a sentence about each line that cannot be used.
        """
        succeeded: set[Key] = set()
        for path in self.existing():
            for record, line in read_records(path, damaged):
                # Other sources may simulate and measure otherwise: its runs are made again.
                if record["source"] != source_key():
                    continue
                key = record["key"]
                # JSON has no tuples.
                if isinstance(key, list):
                    key = tuple(key)
                if "reason" not in record:
                    succeeded.add(key)
                elif key in succeeded:
                    continue
                yield key, record, line

    def merge(self, lines: Iterable[Line]) -> None:
        """Merge the files of all ranks into one, which has the records at ``lines``."""
        merge_records(self.merged, lines, self.by_rank())


class RecordedRuns:
    """Runs simulated by teams of ``ranks`` of ``comm``, and their records called ``name`` in ``folder``.

    ``team`` is the communicator of the ranks that work on a run together with this one; the first of them appends its
    record. ``records`` are the records by key, the same on all ranks: those that ``read`` found in the files, and those
    that ``make`` added. ``failures`` are the exceptions that count as a failure of a single run; any other ends the
    study.
    """

    def __init__(
        self,
        name: str,
        folder: Path,
        comm: MPI.Comm,
        stop: StopRequest,
        ranks: int = 1,
        failures: tuple[type[Exception], ...] = FAILURES,
    ) -> None:
        self.comm = comm
        self.stop = stop
        self.team = comm.Split(comm.rank // ranks, comm.rank)
        self.pool = TaskPool(comm, self.team, stop, failures)
        self.paths = RecordPaths(folder, name)
        self.file = RecordFile(self.paths.for_rank(comm.rank))
        self.records: dict[Key, Record] = {}

    def read(self) -> "RecordedRuns":
        """Read the records in the files into ``records``, on all ranks; returns itself. Collective."""
        # Rank 0 reads for all ranks, which must agree on the runs that are missing.
        self.records = on_root(self.comm, lambda: {key: record for key, record, _ in self.paths.read()})
        return self

    def make(
        self,
        keys: Iterable[Key],
        work: Callable[[Key], Record],
        *,
        what: str = "runs",
        progress: bool = False,
        allow_failures: bool = False,
    ) -> None:
        """Compute the missing records of ``keys``; ``work`` returns that of a key. Collective.

        All ranks of a team call ``work`` for the same key. With ``allow_failures`` a run that fails is recorded with
        its ``reason``; otherwise it raises StudyError on all ranks once the others have ended. Raises as ``compute``,
        and StoppedError on all ranks after a request to stop; what has ended by then is recorded. ``what`` names the
        runs in messages and in the bar that ``progress`` shows.
        """
        failed: list[str] = []

        def fail(key: Key, reason: str) -> None:
            failed.append(f"{key}: {reason}")

        self.compute(keys, work, what=what, progress=progress, fail=None if allow_failures else fail)
        if self.pool.stopped:
            raise StoppedError(
                f"stopped on request with {counted(len(self.records), 'run')}; the same command continues"
            )

        # Every rank has to raise: one that went on alone would wait for the others for ever.
        reasons = [reason for from_rank in self.comm.allgather(failed) for reason in from_rank]

        def check() -> None:
            if reasons:
                raise StudyError(f"one of the {what} failed: {reasons[0]}")

        on_root(self.comm, check)

    def compute(
        self,
        keys: Iterable[Key],
        work: Callable[[Key], Record],
        *,
        kind: str = RUN,
        what: str = "runs",
        progress: bool = False,
        keep: bool = True,
        fail: Callable[[Key, str], None] | None = None,
    ) -> int:
        """Compute the missing records of ``keys``, of one ``kind``, until a request to stop; returns how many it made.

        Collective. ``fail`` is called on the first rank of a team with the key and the reason of a run that failed; by
        default the reason is recorded. With ``keep`` the records are added to ``records``, which is in memory.
        Raises OSError on all ranks, without a record, if memory or disk is short, or for an exception that is not among
        those that count as a failure of a run: the next call may succeed; PartError for a mistake in a user's module.
        """
        # A key that is given twice is computed once; the order stays, the same on all ranks.
        missing = [key for key in dict.fromkeys(keys) if key not in self.records]
        recorded: dict[Key, Record] = {}

        def make_one(key: Key) -> None:
            begin = time.process_time()
            record = work(key)
            timed = {"cpu_seconds": round(time.process_time() - begin, 4)} | record
            on_root(self.team, lambda: append(key, timed))

        def append(key: Key, record: Record) -> None:
            whole = self.append(key, record, kind)
            if keep:
                recorded[key] = whole

        def record_failure(key: Key, reason: str) -> None:
            append(key, {"reason": reason})

        bar = Progress(self.comm, len(missing), what, show=progress and bool(missing))
        done = self.pool.run(missing, make_one, bar, fail or record_failure)
        on_every_rank(self.comm, self.file.close)
        for records in self.comm.allgather(recorded):
            self.records |= records
        return done

    def append(self, key: Key, record: Record, kind: str) -> Record:
        """Append the ``record`` of ``key`` to this rank's file; returns it with its key, its kind and the version."""
        whole = {"kind": kind, "key": key, "source": source_key()} | record
        self.file.append(whole)
        return whole

    def keep_part(self, key: Key, record: Record, kind: str = RUN) -> None:
        """Append the ``record`` of a part of the team's run; after an interruption, ``read`` finds it.

        All ranks of the team must call it. Raises OSError on all if the disk is full.
        """
        on_root(self.team, lambda: self.append(key, record, kind))

    def simulate(self, case: Case, output: RunOutput) -> Result:
        """Run ``case`` on all ranks of the team into ``output``.

        Raises StoppedError if the run was stopped, RuntimeError if it failed.
        """
        return completed(simulate(case, output, self.team, stop=self.stop))

    def run_in_memory(self, case: Case) -> tuple[xr.Dataset, Result]:
        """Return dataset of a run of ``case`` by the team, empty on all ranks but its first, and how it ended.

        Raises as ``simulate``.
        """
        return run_in_memory(case, self.team, self.stop)

    def finish(self) -> None:
        """Merge the records of all ranks into one file and free the team's communicator. Collective.

        It is called before the result of a study is written: a study whose result is there has nothing left to do.
        """

        def merge() -> None:
            if self.paths.by_rank():
                self.paths.merge({key: line for key, _, line in self.paths.read()}.values())

        on_root(self.comm, merge)
        self.team.Free()


def run_in_memory(case: Case, team: MPI.Comm, stop: StopRequest) -> tuple[xr.Dataset, Result]:
    """Return dataset of a run of ``case`` by all ranks of ``team``, empty on all but the first, and how it ended.

    Raises StoppedError if the run was stopped, RuntimeError if it failed.
    """
    memory = RunMemory(team)
    result = completed(simulate(case, memory, team, stop=stop))
    return xr.Dataset() if memory.dataset is None else memory.dataset, result


def completed(result: Result) -> Result:
    """Return ``result`` of a run that is complete; raises StoppedError if it was stopped, RuntimeError if it failed."""
    if result.resumable:
        raise StoppedError(result.sentence)
    if not result.complete:
        raise RuntimeError(result.sentence)
    return result
