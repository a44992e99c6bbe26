"""Steps of a plan: a case file each, made in a folder of its own, and how far each has come."""

from __future__ import annotations

import json
import tomllib
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from mpi4py import MPI

import h5py
import numpy as np

from vipetsc.case import Sweep
from vipetsc.case.design import DesignCase
from vipetsc.case.nnm import NnmCase
from vipetsc.io.ensemble_file import EnsembleFile
from vipetsc.modes.follow import follow_all, prepare_folder
from vipetsc.modes.system import System
from vipetsc.parallel import StopRequest, on_root
from vipetsc.studies.backbone import relate_folders
from vipetsc.studies.design import search_design
from vipetsc.studies.sweep import run_sweep

DONE, BEGUN, STALE, MISSING = "done", "begun", "stale", "missing"


@dataclass(frozen=True)
class Step(ABC):
    """One case made in ``root/<name>``.

    ``file`` is the case file, ``changes`` what is changed in it (``section.key=value``), ``cost`` the CPU time in s
    of all of it (of a member, for sweeps) on a core of the 2020s, used until rates are measured.
    """

    name: str
    file: Path
    changes: tuple[str, ...] = ()
    cost: float = 1.0

    def folder(self, root: Path) -> Path:
        """Where the step's files are."""
        return root / self.name

    def changed(self, *changes: str) -> Step:
        """The same step with further changes to its case."""
        return replace(self, changes=(*self.changes, *changes))

    @property
    @abstractmethod
    def text(self) -> str:
        """The resolved case as TOML; raises CaseError or OSError."""

    @abstractmethod
    def complete(self, folder: Path) -> bool:
        """Whether all results of this case are in ``folder``."""

    @abstractmethod
    def results(self, folder: Path) -> list[Path]:
        """The files in ``folder`` that pictures and claims are made from."""

    @abstractmethod
    def make(self, folder: Path, comm: MPI.Comm, stop: StopRequest, afresh: bool) -> None:
        """Make what is missing on all ranks of ``comm``, everything if ``afresh``; may leave early on ``stop``."""

    def state(self, root: Path) -> str:
        """DONE, BEGUN, MISSING, or STALE if the folder holds another case."""
        folder = self.folder(root)
        if not (folder / "case.toml").exists():
            return MISSING
        if not self._is_own((folder / "case.toml").read_text(encoding="utf-8")):
            return STALE
        return DONE if self.complete(folder) else BEGUN

    def _is_own(self, text: str) -> bool:
        """Whether a case in TOML is this step's, in whatever order its keys stand."""
        return tomllib.loads(text) == tomllib.loads(self.text)

    def left(self, root: Path) -> float:
        """CPU time in s that is still needed."""
        return 0.0 if self.state(root) == DONE else self.cost

    def changed_at(self, root: Path) -> int:
        """When the results were last written, in ns; 0 without any."""
        return max((p.stat().st_mtime_ns for p in self.results(self.folder(root)) if p.exists()), default=0)

    def statistics(self, root: Path) -> dict[str, Any]:
        """Numbers about the results for a report; empty where there are none to tell."""
        return {}

    def sound(self, root: Path) -> bool:
        """Whether nothing of the step failed, once it is done."""
        found = self.statistics(root)
        return not found.get("failed") and not any("failed" in ending for ending in found.get("endings", ()))


class SweepStep(Step):
    """A sweep; its members are kept when it is stopped."""

    @cached_property
    def plan(self) -> Sweep:
        """The sweep of the case file."""
        return Sweep.load(self.file, self.changes)

    @property
    def text(self) -> str:
        """See ``Step``."""
        return self.plan.to_toml()

    def complete(self, folder: Path) -> bool:
        """See ``Step``."""
        if not (folder / "ensemble.h5").exists():
            return False
        with h5py.File(folder / "ensemble.h5") as file:
            return self._is_own(file.attrs["case"])

    def results(self, folder: Path) -> list[Path]:
        """See ``Step``."""
        return [folder / "ensemble.h5", folder / "backbone.h5"]

    def make(self, folder: Path, comm: MPI.Comm, stop: StopRequest, afresh: bool) -> None:
        """See ``Step``."""
        run_sweep(self.plan, folder, comm, force=afresh, stop=stop, progress=True)

    def left(self, root: Path) -> float:
        """CPU time of the members not made, at the mean of those that were, or at ``cost`` if that is more."""
        state, folder = self.state(root), self.folder(root)
        if state == DONE:
            return 0.0
        made = _cpu_times(folder) if state == BEGUN else []
        rate = max(float(np.mean(made)), self.cost) if made else self.cost  # measuring a run takes time as well
        return rate * max(int(np.prod(self.plan.shape)) - len(made), 0)

    def statistics(self, root: Path) -> dict[str, Any]:
        """Members and how they ended, contact episodes, the largest error of the ledger, CPU time in s."""
        with EnsembleFile(self.folder(root)) as ensemble:
            status, episodes = ensemble.values("status"), ensemble.values("contact_episodes")
            ledger = ensemble.values("ledger_error")
        return {
            "members": int(status.size),
            "simulated": int((status == 0).sum()),
            "scaled": int((status == 1).sum()),
            "failed": int((status == 2).sum()),
            "episodes": int(np.nansum(episodes)),
            "ledger": float(np.nanmax(ledger, initial=0.0)),
            "cpu": float(sum(_cpu_times(self.folder(root)))),
        }


class BranchStep(Step):
    """Frequency-energy branches; a branch that was cut off goes on."""

    @cached_property
    def case(self) -> NnmCase:
        """The case of the branches."""
        return NnmCase.load(self.file, self.changes)

    @property
    def text(self) -> str:
        """See ``Step``."""
        return self.case.to_toml()

    def results(self, folder: Path) -> list[Path]:
        """See ``Step``."""
        system = System.from_case(self.case)
        return [folder / f"branch-{system.branch_name(mode - 1)}.h5" for mode in self.case.nnm.modes]

    def complete(self, folder: Path) -> bool:
        """Whether every branch ended, by itself or in a failure that it names."""
        return all(path.exists() and _ended(path) for path in self.results(folder))

    def make(self, folder: Path, comm: MPI.Comm, stop: StopRequest, afresh: bool) -> None:
        """See ``Step``."""
        resume = not afresh and on_root(comm, (folder / "case.toml").exists)
        on_root(comm, lambda: prepare_folder(self.case, folder, afresh, resume))
        follow_all(self.case, folder, comm, resume)

    def statistics(self, root: Path) -> dict[str, Any]:
        """Points, largest residual and endings of the branches."""
        points, residual, endings = 0, 0.0, []
        for path in self.results(self.folder(root)):
            with h5py.File(path) as file:
                regular = file["kind"][...] == 0
                points += int(regular.sum())
                residual = max(residual, float(file["residual"][...][regular].max(initial=0.0)))
                endings.append(f"{file.attrs['name']}: {file.attrs['ending']}")
        return {"points": points, "residual": residual, "endings": endings}


class DesignStep(Step):
    """The (lambda, eta) search, on one rank."""

    @cached_property
    def case(self) -> DesignCase:
        """The case of the search."""
        return DesignCase.load(self.file, self.changes)

    @property
    def text(self) -> str:
        """See ``Step``."""
        return self.case.to_toml()

    def results(self, folder: Path) -> list[Path]:
        """See ``Step``."""
        return [folder / "design.h5"]

    def complete(self, folder: Path) -> bool:
        """See ``Step``."""
        if not (folder / "design.h5").exists():
            return False
        with h5py.File(folder / "design.h5") as file:
            return self._is_own(file.attrs["case"])

    def make(self, folder: Path, comm: MPI.Comm, stop: StopRequest, afresh: bool) -> None:
        """See ``Step``."""
        begun = on_root(comm, (folder / "case.toml").exists)
        on_root(comm, lambda: search_design(self.case, folder, afresh or begun))


@dataclass(frozen=True)
class Relation:
    """A sweep laid over branches: ``backbone.h5`` beside the sweep, made again when one of them is newer."""

    sweep: Step
    branches: tuple[Step, ...]

    def make(self, root: Path, comm: MPI.Comm) -> bool:
        """Relate what there is, on rank 0; whether something was written."""
        return on_root(comm, lambda: self._make(root))

    def _make(self, root: Path) -> bool:
        branches = [b for b in self.branches if b.state(root) == DONE]
        if self.sweep.state(root) != DONE or not branches:
            return False
        path = self.sweep.folder(root) / "backbone.h5"
        newest = max(step.changed_at(root) for step in (self.sweep, *branches))
        if path.exists() and path.stat().st_mtime_ns >= newest:
            return False
        return bool(relate_folders([self.sweep.folder(root), *(b.folder(root) for b in branches)]))


def _cpu_times(folder: Path) -> list[float]:
    """CPU times in s of the members in ``folder`` that are complete; 0 for scaled ones."""
    found = []
    for path in folder.glob("*/summary.json"):
        about = json.loads(path.read_text(encoding="utf-8"))
        statistics = about.get("statistics", {})
        if about.get("complete"):
            found.append(0.0 if "scaled_from" in statistics else float(statistics.get("cpu_seconds", 0.0)))
    return found


def _ended(path: Path) -> bool:
    with h5py.File(path) as file:
        return bool(file.attrs["complete"]) or str(file.attrs["ending"]).startswith("failed")


def newest(steps: Iterable[Step], root: Path) -> int:
    """When the results of any of ``steps`` were last written, in ns."""
    return max((step.changed_at(root) for step in steps), default=0)
