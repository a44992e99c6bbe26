"""Every verb that leaves results, as a study of a tiny case, and what an undisturbed call of it leaves and passes.

The cases are those of ``tests/faults/scenarios.py``: a new verb is checked once it has a case there. Checks of all
studies are in ``verify/test_study_contract.py``, and of several ranks in ``mpi/test_study_contract.py``.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from mpi4py import MPI

from tests.faults.scenarios import SCENARIOS, Scenario
from vipetsc.cli.verb import Outcome, StudyVerb, Work
from vipetsc.parallel import StopRequest

# What makes another case of each verb, which has other results.
OTHERWISE = {
    "run": "drive.amplitude=9.0",
    "sweep": "drive.cycles=6",
    "law": "law.samples=2",
    "predict": "predict.points=17",
    "optimise": "optimise.seed=2",
    "identify": "identify.steps=3",
    "nnm": "nnm.tolerance=1e-11",
    "nfrc": "nfrc.harmonics=4",
    "design": "design.wavenumbers=12",
}
STUDIES = {
    name: scenario
    for name, scenario in SCENARIOS.items()
    if isinstance(scenario.verb, StudyVerb) and not scenario.before
}


def case_of(scenario: Scenario, *changes: str) -> Any:
    """Return the case of a scenario, with keys changed as by ``--set``."""
    return scenario.verb.case.from_table(tomllib.loads(scenario.case), changes)


def compute(
    name: str,
    folder: Path,
    comm: MPI.Comm = MPI.COMM_SELF,
    *changes: str,
    stop: StopRequest | None = None,
    force: bool = False,
    resume: bool = False,
) -> Outcome:
    """Compute the study called ``name`` into ``folder`` as its verb does; raises as the verb does."""
    scenario = STUDIES[name]
    options = argparse.Namespace(force=force, resume=resume, extend=False, member=None, case=None)
    work = Work(options, folder, comm, stop or StopRequest())
    outcome = scenario.verb.study(case_of(scenario, *changes), work)
    work.stop.check(comm)
    return outcome


class CountedLooks(StopRequest):
    """A request to stop that is never made, and counts how often it is looked at."""

    looks = 0

    @property
    def requested(self) -> bool:
        self.looks += 1
        return False


class Phases:
    """Calls a function at each phase of the program, while one is ``watched``."""

    def __init__(self) -> None:
        self._watch: Callable[[str], None] | None = None
        # A hook cannot be removed from a process.
        sys.addaudithook(self._hook)

    def _hook(self, event: str, _: tuple[Any, ...]) -> None:
        if self._watch and event.startswith("vipetsc."):
            watch = self._watch
            # What it does passes phases itself.
            self._watch = None
            watch(event.removeprefix("vipetsc."))
            self._watch = watch

    @contextmanager
    def watched(self, watch: Callable[[str], None]) -> Iterator[None]:
        """Call ``watch`` with the name of each phase within the block."""
        self._watch = watch
        try:
            yield
        finally:
            self._watch = None


@cache
def phases() -> Phases:
    """Return the one watcher of phases of this process."""
    return Phases()


@dataclass
class Undisturbed:
    """An undisturbed call of a study: its ``folder``, the phases that it passed in order, its looks at the request.

    ``kills`` are copies of the folder as kills would have left it: at phases in which the content differs.
    """

    folder: Path
    passed: list[str] = field(default_factory=list)
    kills: list[Path] = field(default_factory=list)
    looks: int = 0


# Phases that change no file.
UNCHANGED = {"step", "landing", "read", "lock", "set-up", "member", "plan", "analyse"}


def undisturbed(name: str, work: Path) -> Undisturbed:
    """Compute the study called ``name`` in the folder ``work``, which is kept as it is at each phase."""
    done = Undisturbed(work / "done")
    seen: set[tuple[Any, ...]] = set()

    def keep(phase: str) -> None:
        done.passed.append(phase)
        if phase in UNCHANGED or not done.folder.exists():
            return
        files = [path for path in sorted(done.folder.rglob("*")) if path.is_file()]
        content = tuple((str(path), path.stat().st_size) for path in files)
        if content not in seen:
            seen.add(content)
            copy = work / f"killed-{len(seen)}"
            shutil.copytree(done.folder, copy)
            done.kills.append(copy)

    stop = CountedLooks()
    with phases().watched(keep):
        compute(name, done.folder, stop=stop)
    done.looks = stop.looks
    return done


def some(items: list[Any], count: int) -> list[Any]:
    """Return at most ``count`` of ``items``, evenly spaced, with the first and the last."""
    if len(items) <= count:
        return items
    return [items[round(number * (len(items) - 1) / (count - 1))] for number in range(count)]
