"""Trials with faults: which there are, done by workers under mpirun, and judged."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

from tests.conftest import clean_environment
from tests.faults.inject import KINDS
from tests.faults.scenarios import unreadable

ROOT = Path(__file__).parents[2]
AT_ONCE = 60  # tasks of one worker
ALLOWED = 10.0  # time in s from the fault to the end of all ranks
STOPPED = 75
# What a call may end with; mpirun, which a kill or the signal itself may end, has codes of its own.
CODES = {"sigterm": {0, STOPPED}, "sigkill": {128 + signal.SIGKILL}}
OF_MPIRUN = {"sigterm": {128 + signal.SIGTERM, 1}, "sigkill": {-signal.SIGKILL}}
Task = dict[str, Any]
Record = dict[str, Any]


@dataclass
class Crew:
    """Workers on a number of ``ranks`` that do tasks in ``folder``; a call has ``patience`` s to end."""

    folder: Path
    ranks: int
    patience: float = 40.0

    def do(self, tasks: Sequence[Task]) -> Iterator[tuple[Task, dict[str, Record]]]:
        """Do all ``tasks``: each with its records by stages, when it is done.

        After a task that ended its worker a new worker goes on.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        left = list(tasks)
        stages_of: dict[str, dict[str, Record]] = {}
        while left:
            (self.folder / "results.jsonl").write_text("")
            code, messages = self._launch(left[:AT_ONCE])
            for line in (self.folder / "results.jsonl").read_text().splitlines():
                record = json.loads(line)
                stages_of.setdefault(record["id"], {})[record["stage"]] = record
            while left and "finished" in stages_of.get(left[0]["id"], {}):
                task = left.pop(0)
                yield task, stages_of.pop(task["id"])
            if not left:
                return

            # The next task is the one that ended its worker, unless the worker was done with all that it was given.
            task = left[0]
            stages = stages_of.setdefault(task["id"], {})
            if code == 0 and "ended" not in stages:
                continue
            end = self._end(code, messages)
            if "begun" in stages and task["do"] == "trial":
                stages.setdefault("ended", end | {"broken": unreadable(self.folder / task["scenario"])})
                left[0] = task | {"do": "finish"}
            else:
                left.pop(0)
                yield task, stages | {"finished": end | {"differs": "it did not end by itself"}}

    def _end(self, code: int, messages: str) -> Record:
        """What a call that ended its worker has left: exit code, messages, the time since its fault."""
        errors = "".join(path.read_text(errors="replace") for path in sorted(self.folder.glob("errors-*")))
        fired = self.folder / "fired"
        since = time.time() - float(fired.read_text()) if fired.exists() else 0.0
        return {"code": code, "errors": errors, "since": since, "fired": fired.exists(), "mpirun": messages}

    def _launch(self, tasks: Sequence[Task]) -> tuple[int, str]:
        """One mpirun with a worker; code and messages of mpirun. No process of it is left."""
        worker = [sys.executable, "-m", "tests.faults.worker", str(self.folder), json.dumps(tasks), str(self.patience)]
        command = ["mpirun", "--oversubscribe", "-n", str(self.ranks), *worker]
        environment = clean_environment() | {"PYTHONPATH": str(ROOT), "OMPI_MCA_mpi_yield_when_idle": "1"}
        log = self.folder / "mpirun.log"
        with log.open("w") as file:
            process = subprocess.Popen(
                command, cwd=ROOT, env=environment, stdout=file, stderr=file, start_new_session=True
            )
            code = self._await(process, {task["id"]: task for task in tasks if "delay" in task})
        for number in processes_of(self.folder):
            with suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
        return code, log.read_text(errors="replace")

    def _await(self, process: subprocess.Popen, kills: dict[str, Task]) -> int:
        """The exit code of a worker; it is killed when it reports nothing for longer than any call may take.

        ``kills`` are tasks by their ids that are to meet a signal from outside, a ``delay`` in s after they began.
        """
        results = self.folder / "results.jsonl"
        reported = -1
        last = time.monotonic()
        while process.poll() is None:
            size = results.stat().st_size
            if size != reported:
                reported = size
                last = time.monotonic()
                lines = results.read_text().splitlines()
                record = json.loads(lines[-1]) if lines else {}
                kill = kills.get(record.get("id", "")) if record.get("stage") == "begun" else None
                if kill and not self._changes(results, size, record["time"] + kill["delay"]):
                    (self.folder / "fired").write_text(str(time.time()))
                    self._kill(process.pid, record["processes"], kill)
            elif time.monotonic() - last > 15 * self.patience:
                os.killpg(process.pid, signal.SIGKILL)
            time.sleep(0.01)
        return process.returncode

    def _changes(self, results: Path, size: int, until: float) -> bool:
        """Whether the worker reports something before the time ``until``."""
        while (left := until - time.time()) > 0 and results.stat().st_size == size:
            time.sleep(min(left, 0.01))
        return results.stat().st_size != size

    def _kill(self, mpirun: int, processes: list[int], task: Task) -> None:
        """Send the signal of ``task`` to one rank, or to all: as a terminal or a scheduler does it, to mpirun."""
        number = {"sigterm": signal.SIGTERM, "sigkill": signal.SIGKILL}[task["kind"]]
        victims = [processes[task["rank"]]] if task["rank"] >= 0 else [mpirun]
        if task["rank"] < 0 and number == signal.SIGKILL:
            victims += processes
        for victim in victims:
            with suppress(ProcessLookupError):
                os.kill(victim, number)


def processes_of(folder: Path) -> list[int]:
    """The processes that were started for ``folder`` and have not ended."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            ended = (path / "stat").read_text().rpartition(")")[2].split()[0] in "ZX"
            if not ended and os.fsencode(folder) in (path / "cmdline").read_bytes().split(b"\0"):
                found.append(int(path.name))
    return found


def references(crew: Crew, names: Sequence[str]) -> dict[str, Record]:
    """Unbroken calls of the scenarios: ``counts``, how often every phase came (by rank), and their time in ``seconds``.

    Raises RuntimeError if one fails.
    """
    found = {}
    for task, stages in crew.do([{"id": name, "do": "reference", "scenario": name} for name in names]):
        found[task["scenario"]] = result = stages["finished"]
        if result["code"] != 0:
            raise RuntimeError(f"{task['id']} on {crew.ranks} ranks: {result['code']}, {result['errors']}")
    return found


def matrix(unbroken: dict[str, Record], kinds: Sequence[str] = KINDS) -> Iterator[Task]:
    """A trial with every kind of fault at every phase of the scenarios, rank and occurrence in turn."""
    turn = 0
    for name, reference in unbroken.items():
        ranks = reference["counts"]
        for phase in sorted(set().union(*ranks)):
            taking_part = [rank for rank, count in enumerate(ranks) if count.get(phase)]
            for kind in kinds:
                rank = taking_part[turn % len(taking_part)]
                most = ranks[rank][phase]
                number = (1, most, (most + 1) // 2)[turn // len(ranks) % 3]
                yield {
                    "id": f"{name} {phase} {kind} rank {rank} of {len(ranks)}, time {number}", "do": "trial",
                    "scenario": name, "phase": phase, "kind": kind, "rank": rank, "number": number,
                }  # fmt: skip
                turn += 1


def kills(seconds: dict[tuple[str, int], float], seed: int, count: int) -> Iterator[Task]:
    """Signals at random times of calls that take so many ``seconds`` (by scenario and ranks), to one rank or to all."""
    random = Random(seed)
    for number in range(count):
        (name, ranks), duration = random.choice(sorted(seconds.items()))
        kind = random.choice(("sigkill", "sigterm"))
        rank = random.randrange(-1, ranks)
        delay = round(0.8 * random.random() * duration, 3)
        whom = "all" if rank < 0 else f"rank {rank}"
        yield {
            "id": f"{number}: {name} on {ranks} ranks, {kind} to {whom} after {delay} s", "do": "trial",
            "scenario": name, "kind": kind, "rank": rank, "ranks": ranks, "delay": delay,
        }  # fmt: skip


def judge(task: Task, stages: dict[str, Record], allowed: float = ALLOWED) -> list[str]:
    """What is wrong with how a trial ended, in words."""
    ended = stages.get("ended", {})
    finished = stages.get("finished", {})
    if not ended.get("fired"):  # what ranks draw from a count may have gone to another
        return [] if ended.get("code") == finished.get("code") == 0 else ["it ends before the fault"]

    kind = task["kind"]
    errors = ended.get("errors", "")
    wrong = []
    if "Timeout (" in errors:
        wrong.append("hangs")
    elif ended["since"] > allowed:
        wrong.append(f"all ranks ended after {ended['since']:.0f} s")

    # A file that cannot be read may be another's, or made again.
    codes = CODES.get(kind, {0, 1, 2} if task.get("phase") == "read" else {1})
    if "delay" in task:
        codes = codes | OF_MPIRUN[kind]
    if ended["code"] not in codes:
        wrong.append(f"exit code {ended['code']}")

    messages = re.findall(r"^vipetsc: (?!warning:)", errors, re.MULTILINE)
    if len(messages) > (kind != "sigkill"):
        wrong.append(f"{len(messages)} messages")
    if "Traceback" in errors and kind != "exception":
        wrong.append("traceback")

    wrong += ended["broken"]
    if finished.get("code") != 0:
        wrong.append(f"the same command then: exit code {finished.get('code')}")
    elif finished["differs"]:
        wrong.append(f"the same command then: {finished['differs']}")
    return wrong


def last_words(stages: dict[str, Record]) -> str:
    """The last line on stderr of the call after the fault, else of the one with it."""
    lines: list[str] = []
    for stage in ("ended", "finished"):
        lines += stages.get(stage, {}).get("errors", "").splitlines()
    return lines[-1] if lines else ""
