"""Does trials one after another, on all ranks of mpirun together: ``python -m tests.faults.worker FOLDER PATIENCE``.

Each line of stdin is a task in JSON, until stdin is closed. A trial calls the program in this process while one rank
meets a fault, checks the files that are left, calls the program again, and compares the results with those of a call
without a fault. A fault that ends one process ends all; ``trials`` then starts a new worker, whose first task is the
second call. Lines of JSON in FOLDER/results.jsonl report the stages of a task.
"""

from __future__ import annotations

import faulthandler
import json
import logging
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import petsc4py

petsc4py.init(["faults", "-no_signal_handler"])

from mpi4py import MPI

from tests.faults.failing_calls import FailingCalls
from tests.faults.inject import Injector
from tests.faults.scenarios import (
    SCENARIOS,
    Scenario,
    copy,
    difference,
    prepare,
    shrink_paper,
    shrink_pictures,
    unreadable,
    words_of,
)
from vipetsc.cli.main import main as vipetsc
from vipetsc.parallel import install_abort_hook, on_root

SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGUSR1)
Task = dict[str, Any]


class _Quiet:
    """A communicator for the abort hook that does not end its processes."""

    def __init__(self, comm: MPI.Comm) -> None:
        self.rank = comm.rank
        self.size = comm.size

    def Abort(self, code: int) -> None:
        """Raise SystemExit where MPI would end all processes."""
        raise SystemExit(code)


@dataclass
class Worker:
    """Does tasks in ``folder``; a call must end within ``patience`` s."""

    folder: Path
    patience: float

    def __post_init__(self) -> None:
        self.comm = MPI.COMM_WORLD.Dup()
        self.injector = Injector()
        self.calls = FailingCalls()
        self.errors = self.folder / f"errors-{self.comm.rank}"

    def do(self, task: Task) -> None:
        """Do one task; all ranks call it."""
        scenario = SCENARIOS[task["scenario"]]
        # To load the paper takes a second, and only its own scenario needs it.
        if scenario.verb.name == "paper":
            shrink_paper()
        if task["do"] == "reference":
            self._reference(task, scenario)
            return

        out = self.folder / scenario.name
        words = words_of(scenario.words, self._case(scenario), out)
        if task["do"] == "trial":
            self._meet_the_fault(task, words, out, self._before(scenario))
            # Another worker makes the second call, because the signal may still reach this one.
            if "delay" in task:
                raise SystemExit(0)

        ended = self._call(words)
        differs = difference(self._wanted(scenario), out) if self.comm.rank == 0 else ""
        self._report(task, "finished", **ended, differs=differs)

    def _meet_the_fault(self, task: Task, words: list[str], out: Path, before: Path) -> None:
        """Call the program on the folder ``out``, a copy of ``before``, while a rank meets the fault of ``task``."""
        if self.comm.rank == 0:
            copy(before, out)
            (self.folder / "fired").unlink(missing_ok=True)
        self.comm.Barrier()

        if self.comm.rank == task["rank"] and "phase" in task:
            self.injector.arm(task["phase"], task["number"], task["kind"], self.folder / "fired")
        if self.comm.rank == task["rank"] and "call" in task:
            self.calls.arm(task["call"], task["kind"], out, self.folder / "fired")
        self._report(task, "begun", processes=self.comm.allgather(os.getpid()))
        ended = self._call(words)
        self.injector.disarm()
        self.calls.disarm()
        self._report(task, "ended", **ended, **self._left_behind(out))

    def _case(self, scenario: Scenario) -> Path:
        """The scenario's case file."""
        return self.folder / f"{scenario.name}.toml"

    def _before(self, scenario: Scenario) -> Path:
        """The folder of results as the scenario's earlier call leaves it."""
        return self.folder / f"{scenario.name}-before"

    def _wanted(self, scenario: Scenario) -> Path:
        """The folder of results as the scenario's call without a fault leaves it."""
        return self.folder / f"{scenario.name}-done"

    def _reference(self, task: Task, scenario: Scenario) -> None:
        """Call the program without a fault; keep its results, and report how often each rank reaches each phase."""
        case = self._case(scenario)
        before = self._before(scenario)
        wanted = self._wanted(scenario)
        if self.comm.rank == 0:
            prepare(scenario, self.folder)
            copy(self.folder / "nothing", before)
        self.comm.Barrier()

        if scenario.before:
            if scenario.stop and self.comm.rank == 0:
                self.injector.arm("step", scenario.stop, "sigterm")
            self._call(words_of(scenario.before, case, before), 10.0)
        if self.comm.rank == 0:
            copy(before, wanted)
        self.comm.Barrier()

        self.injector.disarm()
        self.calls.arm(0, "sigkill", wanted)
        # The call may have to compile kernels.
        ended = self._call(words_of(scenario.words, case, wanted), 10.0)
        counts = self.comm.gather(self.injector.disarm())
        calls = self.comm.gather(self.calls.disarm())
        self._report(task, "finished", **ended, counts=counts, calls=calls)

    def _left_behind(self, out: Path) -> dict[str, Any]:
        """Return whether the fault came, the time in s since then, and files of results that cannot be read."""
        fired = self.folder / "fired"
        since = time.time() - float(fired.read_text()) if fired.exists() else 0.0
        # Only rank 0 reports.
        broken = unreadable(out) if self.comm.rank == 0 else []
        return {"fired": fired.exists(), "since": since, "broken": broken}

    def _call(self, words: list[str], leave: float = 1.0) -> dict[str, Any]:
        """Call the program; return, on all ranks, the largest exit code, the time, and the stderr of all ranks.

        The call must end within ``leave`` times ``patience``.
        """
        # A new process begins with the default handlers too.
        for number in SIGNALS:
            signal.signal(number, signal.SIG_DFL)

        begin = time.monotonic()
        code: Any = 1
        error: BaseException | None = None
        with self._redirected():
            faulthandler.dump_traceback_later(leave * self.patience, exit=True)
            try:
                code = vipetsc(list(words))
            except SystemExit as end:
                code = end.code
            except BaseException as raised:
                error = raised

            # If only some ranks raise an error, the others wait for them and do not come here.
            if not self._all_are_here(1.0 if error else 2 * leave * self.patience):
                # The hook ends all ranks, as it does at the end of a process with an error.
                sys.excepthook(type(error), error, error.__traceback__)
            self._report_error(error)
            faulthandler.cancel_dump_traceback_later()

        errors = self.comm.allgather(self.errors.read_text(errors="replace"))
        codes = self.comm.allgather(code)
        return {"code": max(codes), "errors": "".join(errors), "seconds": time.monotonic() - begin}

    def _report_error(self, error: BaseException | None) -> None:
        """Print the error that all ranks raised as the abort hook prints it, and continue."""
        agreed = getattr(error, "from_root", False)
        everywhere = all(self.comm.allgather(agreed))
        if error is None or (agreed and everywhere and self.comm.rank):
            return

        # The program's own communicator would end this process.
        hook = sys.excepthook
        install_abort_hook(_Quiet(self.comm))
        try:
            sys.excepthook(type(error), error, error.__traceback__)
        except SystemExit:
            pass
        finally:
            sys.excepthook = hook

    def _all_are_here(self, patience: float) -> bool:
        """Return whether all ranks make this call within ``patience`` s."""
        request = self.comm.Ibarrier()
        deadline = time.monotonic() + patience
        while not request.Test():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.002)
        return True

    @contextmanager
    def _redirected(self) -> Iterator[None]:
        """Redirect stderr to this rank's file of errors and discard stdout, by descriptor, for PETSc and MPI too."""
        sys.stdout.flush()
        sys.stderr.flush()
        saved = [os.dup(number) for number in (1, 2)]
        nothing = os.open(os.devnull, os.O_WRONLY)
        target = os.open(self.errors, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(nothing, 1)
        os.dup2(target, 2)

        try:
            yield
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for number, old in enumerate(saved, 1):
                os.dup2(old, number)
                os.close(old)
            os.close(nothing)
            os.close(target)

    def _report(self, task: Task, stage: str, **more: Any) -> None:
        """Write a line that reports a ``stage`` of a task."""
        if self.comm.rank == 0:
            with (self.folder / "results.jsonl").open("a") as file:
                file.write(json.dumps({"id": task["id"], "stage": stage, "time": time.time(), **more}) + "\n")


def tasks(comm: MPI.Comm) -> Iterator[Task]:
    """Yield, on all ranks, the tasks that come to the stdin of rank 0; ranks sleep until a task comes."""
    while line := on_root(comm, sys.stdin.readline):
        yield json.loads(line)


def main() -> int:
    """Do tasks until there are no more."""
    logging.basicConfig(format="%(message)s")
    logging.getLogger("vipetsc").setLevel(logging.INFO)
    install_abort_hook()
    shrink_pictures()
    worker = Worker(folder=Path(sys.argv[1]), patience=float(sys.argv[2]))
    for task in tasks(MPI.COMM_WORLD):
        worker.do(task)
    return 0


if __name__ == "__main__":
    sys.exit(main())
