"""Runs of a study, made over ranks and recorded as they come: a study that was stopped or killed goes on with them."""

import time
from collections.abc import Callable, Iterable
from pathlib import Path

from mpi4py import MPI

import xarray as xr

import vipetsc
from vipetsc.case import Case
from vipetsc.dynamics import simulate
from vipetsc.dynamics.run import Result
from vipetsc.io.records import Line, Record, RecordFile, merge_records, read_records
from vipetsc.io.store import RunMemory
from vipetsc.parallel import Progress, StoppedError, StopRequest, on_root
from vipetsc.studies.pool import TaskPool

Key = str | float | tuple[str, float]
FAILURES = RuntimeError, ArithmeticError  # of the run itself; too little memory (also as CaseError) or disk is none


class RecordedRuns:
    """The records of runs by key in ``folder``: those ``known`` to begin with, and more as they are made.

    They stand in ``<study>-runs-<rank>.jsonl``, and in ``<study>-runs.jsonl`` when all are put together. ``ranks`` of
    ``comm``, a ``team``, share each run. All ranks hold all records.
    """

    def __init__(self, study: str, folder: Path, comm: MPI.Comm, stop: StopRequest, ranks: int = 1) -> None:
        self.path, self.comm, self.stop = folder / f"{study}-runs.jsonl", comm, stop
        self.team = comm.Split(comm.rank // ranks, comm.rank)
        self.file = RecordFile(self.path.with_stem(f"{self.path.stem}-{comm.rank}"))
        self.known = on_root(comm, lambda: {key: record for key, (record, _) in self._read().items()})

    def make(
        self,
        keys: Iterable[Key],
        work: Callable[[Key], Record],
        *,
        what: str = "runs",
        progress: bool = False,
        failures: bool = False,
    ) -> None:
        """Make the records of unknown ``keys`` by ``work``, which all ranks of a team call. Collective.

        The record of a run that fails is its ``reason`` if ``failures`` may be; else RuntimeError is raised on all
        ranks. Raises OSError on all, and there is no record, if memory or disk is short or if it was no failure
        of the run itself: it may come out the next time. Raises StoppedError on all if some rank got a request to stop.
        """
        missing = [key for key in dict.fromkeys(keys) if key not in self.known]
        made, failed = dict[Key, Record](), list[str]()

        def one(key: Key) -> None:
            begin, record = time.process_time(), work(key)
            record = {"cpu_seconds": round(time.process_time() - begin, 4)} | record
            on_root(self.team, lambda: keep(key, record))

        def keep(key: Key, record: Record) -> None:
            made[key] = {"key": key, "vipetsc_version": vipetsc.__version__} | record
            self.file.append(made[key])

        def fail(key: Key, reason: str) -> None:
            if failures:
                keep(key, {"reason": reason})
            else:
                failed.append(f"{key}: {reason}")

        pool = TaskPool(self.comm, self.team, self.stop, FAILURES)
        pool.run(missing, one, Progress(self.comm, len(missing), what, show=progress and bool(missing)), fail)
        self.file.close()
        for more in self.comm.allgather(made):
            self.known |= more
        if pool.stopped:
            raise StoppedError(f"stopped on request with {len(self.known)} runs; the same command goes on")
        reasons = [reason for some in self.comm.allgather(failed) for reason in some]

        def check() -> None:
            if reasons:
                raise RuntimeError(f"one of the {what} did not come out, {reasons[0]}")

        on_root(self.comm, check)

    def finish(self) -> None:
        """Put the records of all ranks into one file and let go of the team. Collective.

        To be called before the result is written: a study that has one is complete.
        """

        def merge() -> None:
            if parts := self._parts():
                merge_records(self.path, [line for _, line in self._read().values()], parts)

        on_root(self.comm, merge)
        self.team.Free()

    def _read(self) -> dict[Key, tuple[Record, Line]]:
        """Records of this version and their lines by key; a damaged line is as if it had never been."""
        read: dict[Key, tuple[Record, Line]] = {}
        for path in (self.path, *self._parts()):
            for record, line in read_records(path, lambda text: None) if path.exists() else ():
                key = tuple(record["key"]) if isinstance(record["key"], list) else record["key"]
                if record["vipetsc_version"] == vipetsc.__version__:
                    read[key] = record, line
        return read

    def _parts(self) -> list[Path]:
        return sorted(self.path.parent.glob(f"{self.path.stem}-*.jsonl"))


def run_in_memory(case: Case, team: MPI.Comm, stop: StopRequest) -> tuple[xr.Dataset, Result]:
    """A run of ``case`` on all ranks of ``team``: its content, empty on all but the first, and how it ended.

    Raises as ``completed``.
    """
    memory = RunMemory(team)
    result = completed(simulate(case, memory, team, stop=stop))
    return xr.Dataset() if memory.dataset is None else memory.dataset, result


def completed(result: Result) -> Result:
    """The ``result`` of a run that is complete; raises StoppedError if it was stopped, RuntimeError if it failed."""
    if result.resumable:
        raise StoppedError(result.sentence)
    if not result.complete:
        raise RuntimeError(result.sentence)
    return result
