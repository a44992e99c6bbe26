"""Trials with faults: their list, their execution by workers under mpirun, and the judgement of their outcomes."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

from tests.conftest import clean_environment
from tests.faults.failing_calls import KINDS as ERRORS
from tests.faults.inject import KINDS
from tests.faults.scenarios import unreadable

ROOT = Path(__file__).parents[2]
# The number of tasks of one worker, after which a new one is started.
AT_ONCE = 60
# Time in s from the fault to the end of all ranks, at most.
ALLOWED = 10.0
STOPPED = 75
# Exit codes that a call may have after a signal, and those of an mpirun that the signal itself, or a kill, has ended.
CODES = {"sigterm": {0, STOPPED}, "sigkill": {128 + signal.SIGKILL}}
OF_MPIRUN = {"sigterm": {128 + signal.SIGTERM, 1}, "sigkill": {-signal.SIGKILL}}
# Exit codes at phases where the program may survive an exception. A file that cannot be read may belong to another
# program, or be written again. A sweep's linear run is a separate job: if it fails, the first member that needs the run
# simulates it.
CODES_AT_PHASES = {"read": {0, 1, 2}, "member": {0, 1}}
Task = dict[str, Any]
Record = dict[str, Any]


@dataclass
class Crew:
    """Workers on ``ranks`` ranks that do tasks in ``folder``; a call must end within ``patience`` s.

    ``preload`` is the library of ``failing_calls``, for trials with a failing call.

    A worker does one task after another until one of them ends it. ``with Crew(...) as crew`` leaves no process behind.
    """

    folder: Path
    ranks: int
    patience: float = 40.0
    preload: Path | None = None

    def __post_init__(self) -> None:
        self.worker: subprocess.Popen | None = None
        # Tasks that the worker may still be given.
        self.left = 0

    def __enter__(self) -> Crew:
        self.folder.mkdir(parents=True, exist_ok=True)
        return self

    def __exit__(self, *_: object) -> None:
        self.dismiss()

    def do(self, tasks: Iterable[Task]) -> Iterator[tuple[Task, dict[str, Record]]]:
        """Do all ``tasks``; yield each task when it is done, with its records by stage."""
        for task in tasks:
            stages, end = self._put(task)
            if end and task["do"] == "trial" and "begun" in stages:
                stages.setdefault("ended", end | {"broken": unreadable(self.folder / task["scenario"])})
                # The fault has ended the worker: a new one calls the same command again.
                found, end = self._put(task | {"do": "finish"})
                stages |= found

            if end:
                stages["finished"] = end | {"differs": "it did not end by itself"}
            yield task, stages

    def dismiss(self) -> None:
        """End the worker, if there is one: by closing its stdin, or by a kill after ``patience``."""
        if self.worker is None:
            return

        self.worker.stdin.close()
        try:
            self.worker.wait(self.patience)
        except subprocess.TimeoutExpired:
            os.killpg(self.worker.pid, signal.SIGKILL)
        self._bury()

    def _put(self, task: Task) -> tuple[dict[str, Record], Record | None]:
        """Have a worker do a task; return its records by stage, and the record of the worker's end, or None."""
        if self.left == 0:
            self.dismiss()
        if self.worker is None:
            self._launch()

        self.left -= 1
        (self.folder / "results.jsonl").write_text("")
        # A worker that has ended takes no task.
        with suppress(BrokenPipeError):
            self.worker.stdin.write(json.dumps(task) + "\n")
            self.worker.stdin.flush()
        self._await(task)

        stages = {record["stage"]: record for record in self._records()}
        if "finished" in stages:
            return stages, None
        return stages, self._end(*self._bury())

    def _records(self) -> list[Record]:
        """The records that the worker has written about its task."""
        # The last line may be incomplete.
        whole = (self.folder / "results.jsonl").read_text().rpartition("\n")[0]
        return [json.loads(line) for line in whole.splitlines()]

    def _end(self, code: int, messages: str) -> Record:
        """Return the record of a call that ended its worker: exit code, messages, and the time in s since its fault."""
        errors = "".join(path.read_text(errors="replace") for path in sorted(self.folder.glob("errors-*")))
        fired = self.folder / "fired"
        since = time.time() - float(fired.read_text()) if fired.exists() else 0.0
        return {"code": code, "errors": errors, "since": since, "fired": fired.exists(), "mpirun": messages}

    def _launch(self) -> None:
        """Start a worker under mpirun."""
        worker = [sys.executable, "-m", "tests.faults.worker", str(self.folder), str(self.patience)]
        command = ["mpirun", "--oversubscribe", "-n", str(self.ranks), *worker]
        environment = clean_environment() | {"PYTHONPATH": str(ROOT)}
        if self.preload:
            command[1:1] = ["-x", f"LD_PRELOAD={self.preload}"]
        with (self.folder / "mpirun.log").open("w") as file:
            # The worker gets a process group, which can be killed, but no session: Linux gives each session a fair part
            # of the cores, and the priority that scripts/test gives to mpirun holds only within a session.
            self.worker = subprocess.Popen(
                command, cwd=ROOT, env=environment, process_group=0,
                stdin=subprocess.PIPE, stdout=file, stderr=file, text=True,
            )  # fmt: skip
        self.left = AT_ONCE

    def _bury(self) -> tuple[int, str]:
        """Wait for the end of the worker and kill its remaining processes; return mpirun's code and messages."""
        code = self.worker.wait()
        self.worker = None
        self.left = 0
        # After a kill, ranks may outlive their mpirun.
        for number in processes_of(self.folder):
            with suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
        return code, (self.folder / "mpirun.log").read_text(errors="replace")

    def _await(self, task: Task) -> None:
        """Wait until the worker has finished a task or has ended; a worker that reports nothing for too long is killed.

        For a task with a ``delay``, send its signal ``delay`` s after the call has begun.
        """
        results = self.folder / "results.jsonl"
        reported = -1
        last = time.monotonic()
        while self.worker.poll() is None:
            size = results.stat().st_size
            if size != reported:
                reported = size
                last = time.monotonic()
                records = self._records()
                record = records[-1] if records else {}
                if record.get("stage") == "finished":
                    return

                # A call that has ended within the delay gets no signal.
                is_begun = record.get("stage") == "begun"
                if is_begun and "delay" in task and not self._changes(results, size, record["time"] + task["delay"]):
                    (self.folder / "fired").write_text(str(time.time()))
                    self._kill(self.worker.pid, record["processes"], task)
            # A reference may take ten times the patience, because it may have to compile kernels.
            elif time.monotonic() - last > 15 * self.patience:
                os.killpg(self.worker.pid, signal.SIGKILL)
            time.sleep(0.01)

    def _changes(self, results: Path, size: int, until: float) -> bool:
        """Return whether the worker writes a record before the time ``until``, in s since the epoch."""
        while (left := until - time.time()) > 0 and results.stat().st_size == size:
            time.sleep(min(left, 0.01))
        return results.stat().st_size != size

    def _kill(self, mpirun: int, processes: list[int], task: Task) -> None:
        """Send the signal of ``task`` to one rank, or to mpirun for all ranks, as a terminal or a scheduler does."""
        number = {"sigterm": signal.SIGTERM, "sigkill": signal.SIGKILL}[task["kind"]]
        if task["rank"] >= 0:
            victims = [processes[task["rank"]]]
        elif number == signal.SIGKILL:
            # mpirun cannot forward SIGKILL.
            victims = [mpirun, *processes]
        else:
            victims = [mpirun]

        for victim in victims:
            with suppress(ProcessLookupError):
                os.kill(victim, number)


def processes_of(folder: Path) -> list[int]:
    """Return the numbers of the processes whose command names ``folder`` and that have not ended."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        # A process may end while its files are read.
        with suppress(OSError):
            ended = (path / "stat").read_text().rpartition(")")[2].split()[0] in "ZX"
            if not ended and os.fsencode(folder) in (path / "cmdline").read_bytes().split(b"\0"):
                found.append(int(path.name))
    return found


def references(crew: Crew, names: Sequence[str]) -> dict[str, Record]:
    """Call the scenarios without a fault; return the record of each call, by scenario.

    ``counts`` of a record has, for each rank, how often it reached each phase; ``seconds`` is the time of the call.
    Raises RuntimeError if a call fails.
    """
    found = {}
    for task, stages in crew.do([{"id": name, "do": "reference", "scenario": name} for name in names]):
        result = stages["finished"]
        found[task["scenario"]] = result
        if result["code"] != 0:
            raise RuntimeError(f"{task['id']} on {crew.ranks} ranks: {result['code']}, {result['errors']}")
    return found


def matrix(unbroken: dict[str, Record], kinds: Sequence[str] = KINDS) -> Iterator[Task]:
    """Yield a trial for every kind of fault at every phase of the scenarios, with ranks and occurrences in turn."""
    turn = 0
    for name, reference in unbroken.items():
        ranks = reference["counts"]
        for phase in sorted(set().union(*ranks)):
            taking_part = [rank for rank, count in enumerate(ranks) if count.get(phase)]
            for kind in kinds:
                rank = taking_part[turn % len(taking_part)]
                most = ranks[rank][phase]
                # The fault comes at the first, the last or the middle occurrence: the next choice when every rank has
                # had a turn.
                number = (1, most, (most + 1) // 2)[turn // len(ranks) % 3]
                yield {
                    "id": f"{name} {phase} {kind} rank {rank} of {len(ranks)}, time {number}", "do": "trial",
                    "scenario": name, "phase": phase, "kind": kind, "rank": rank, "number": number,
                }  # fmt: skip
                turn += 1


def kills(seconds: dict[tuple[str, int], float], seed: int, count: int) -> Iterator[Task]:
    """Yield trials with signals to one rank or to all at random times.

    ``seconds`` is the time that a call takes, by scenario and number of ranks.
    """
    random = Random(seed)
    for number in range(count):
        (name, ranks), duration = random.choice(sorted(seconds.items()))
        kind = random.choice(("sigkill", "sigterm"))
        rank = random.randrange(-1, ranks)
        # A signal in the last fifth of the call's time would often come after its end.
        delay = round(0.8 * random.random() * duration, 3)
        whom = "all" if rank < 0 else f"rank {rank}"
        yield {
            "id": f"{number}: {name} on {ranks} ranks, {kind} to {whom} after {delay} s", "do": "trial",
            "scenario": name, "kind": kind, "rank": rank, "ranks": ranks, "delay": delay,
        }  # fmt: skip


def failing_calls(
    unbroken: dict[int, dict[str, Record]], seed: int, count: int, kinds: Sequence[str] = ERRORS
) -> Iterator[Task]:
    """Yield trials in which a call of the file system fails, or is the last of its process, at random.

    ``unbroken`` are the records of ``references``, by the number of ranks.
    """
    random = Random(seed)
    places = sorted((name, ranks) for ranks, records in unbroken.items() for name in records)
    for turn in range(count):
        # All scenarios in turn, since calls of one of them may be a hundred times those of another.
        name, ranks = places[turn % len(places)]
        calls = unbroken[ranks][name]["calls"]
        rank = random.choice([rank for rank, number in enumerate(calls) if number] or [0])
        call = random.randint(1, max(calls[rank], 1))
        kind = random.choice(kinds)
        yield {
            "id": f"{turn}: {name} on {ranks} ranks, {kind} at call {call} of {calls[rank]} of rank {rank}",
            "do": "trial", "scenario": name, "kind": kind, "rank": rank, "ranks": ranks, "call": call,
        }  # fmt: skip


def judge(task: Task, stages: dict[str, Record], allowed: float = ALLOWED) -> list[str]:
    """Return the defects of a trial, in words; ``allowed`` is the time in s from the fault to the end of all ranks."""
    ended = stages.get("ended", {})
    finished = stages.get("finished", {})
    # Ranks draw their jobs from a common counter. The rank of the fault may draw fewer jobs than in the reference, and
    # may not reach the phase often enough: then there is no fault, and both calls must end with 0.
    if not ended.get("fired"):
        return [] if ended.get("code") == finished.get("code") == 0 else ["it ends before the fault"]

    kind = task["kind"]
    errors = ended.get("errors", "")
    wrong = []
    if "Timeout (" in errors:
        wrong.append("hangs")
    # A call that goes on past a call of the file system that failed ends when it has done its work.
    elif ended["since"] > allowed and not ("call" in task and ended["code"] == 0):
        wrong.append(f"all ranks ended after {ended['since']:.0f} s")

    codes = CODES.get(kind, CODES_AT_PHASES.get(task.get("phase"), {1}))
    if "delay" in task:
        codes = codes | OF_MPIRUN[kind]
    # What need not be removed may stay; a folder that cannot be locked is refused.
    if "call" in task and kind != "sigkill":
        codes = {0, 1, 2}
    if ended["code"] not in codes:
        wrong.append(f"exit code {ended['code']}")

    # All ranks together print at most one message, and none if a rank is killed.
    messages = re.findall(r"^vipetsc: (?!warning:)", errors, re.MULTILINE)
    if len(messages) > (kind != "sigkill"):
        wrong.append(f"{len(messages)} messages")
    if "Traceback" in errors and kind != "exception":
        wrong.append("traceback")
    if "call" in task and ended["code"] in (1, 2):
        if not messages:
            wrong.append("no message")
        if "[Errno" in errors:
            wrong.append("the system's own sentence")

    wrong += ended["broken"]
    if finished.get("code") != 0:
        wrong.append(f"the same command then: exit code {finished.get('code')}")
    elif finished["differs"]:
        wrong.append(f"the same command then: {finished['differs']}")
    return wrong


def last_words(stages: dict[str, Record]) -> str:
    """Return the last line on stderr of the call after the fault, or else of the call with the fault."""
    lines: list[str] = []
    for stage in ("ended", "finished"):
        lines += stages.get(stage, {}).get("errors", "").splitlines()
    return lines[-1] if lines else ""
