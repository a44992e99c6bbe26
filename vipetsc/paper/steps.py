"""Steps of a plan: a case file each, made in a folder of its own, and how far each has come."""

import hashlib
import json
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

from mpi4py import MPI

import h5py
import numpy as np

from vipetsc.case import DesignCase, NnmCase, Sweep
from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.read import open_ensemble
from vipetsc.modes.follow import follow_all, prepare_folder
from vipetsc.modes.system import System
from vipetsc.parallel import StopRequest, on_root
from vipetsc.studies.design import search_design
from vipetsc.studies.sweep import run_sweep

DONE, BEGUN, STALE, MISSING = "done", "begun", "stale", "missing"
StepCase = Sweep | NnmCase | DesignCase
RELATION = "backbone.h5"  # beside a sweep that is laid over branches


@dataclass(frozen=True)
class Step:
    """One case made in ``root/<name>``: a sweep, branches or a search.

    ``kind`` of case and its ``file``, ``changes`` what is changed in it (``section.key=value``), ``cost`` the CPU time
    in s of all of it (of a member, for sweeps) on a core of the 2020s, used until rates are measured.
    """

    name: str
    kind: type[StepCase]
    file: Path
    changes: tuple[str, ...] = ()
    cost: float = 1.0

    def folder(self, root: Path) -> Path:
        """Where the step's files are."""
        return root / self.name

    def changed(self, *changes: str) -> Self:
        """The same step with further changes to its case."""
        return replace(self, changes=(*self.changes, *changes))

    @cached_property
    def case(self) -> StepCase:
        """The resolved case; raises CaseError."""
        return self.kind.load(self.file, self.changes)

    @cached_property
    def text(self) -> str:
        """The resolved case as TOML; raises CaseError."""
        return self.case.to_toml()

    def results(self, root: Path) -> list[Path]:
        """The files that pictures and claims are made from."""
        names = ["ensemble.h5" if isinstance(self.case, Sweep) else "design.h5"]
        if isinstance(self.case, NnmCase):
            system = System.from_case(self.case)
            names = [f"branch-{system.branch_name(mode - 1)}.h5" for mode in self.case.nnm.modes]
        return [self.folder(root) / name for name in names]

    def make(self, root: Path, comm: MPI.Comm, stop: StopRequest, afresh: bool) -> None:
        """Make what is missing on all ranks of ``comm``, everything if ``afresh``; may leave early on ``stop``."""
        case, folder = self.case, self.folder(root)
        begun = on_root(comm, (folder / "case.toml").exists)
        if isinstance(case, Sweep):
            run_sweep(case, folder, comm, force=afresh, stop=stop, progress=True)
        elif isinstance(case, NnmCase):
            resume = begun and not afresh
            on_root(comm, lambda: prepare_folder(case, folder, afresh, resume))
            follow_all(case, folder, comm, resume)
        else:
            on_root(comm, lambda: search_design(case, folder, afresh or begun))

    def state(self, root: Path) -> str:
        """DONE, BEGUN, MISSING, or STALE if the folder holds another case."""
        marker = self.folder(root) / "case.toml"
        if not marker.exists():
            return MISSING
        if not self._is_same_case(marker.read_text(encoding="utf-8")):
            return STALE
        return DONE if all(map(self._is_complete, self.results(root))) else BEGUN

    def _is_complete(self, path: Path) -> bool:
        """Whether a result is of this case; a branch has ended, by itself or in a failure that it names."""
        if not path.exists():
            return False
        with h5py.File(path) as file:
            if "ending" in file.attrs:
                return bool(file.attrs["complete"]) or str(file.attrs["ending"]).startswith("failed")
            return self._is_same_case(file.attrs["case"])

    def _is_same_case(self, text: str) -> bool:
        """Whether a case in TOML is this step's, in whatever order its keys stand."""
        return tomllib.loads(text) == tomllib.loads(self.text)

    def identity(self, root: Path) -> str:
        """Hash of the case and of what the results hold."""
        paths = [*self.results(root), self.folder(root) / RELATION]
        return fingerprint(self.text, *(path.read_bytes() for path in paths if path.exists()))

    def left(self, root: Path) -> float:
        """CPU time in s that is still needed; of a sweep, for the members not made, at the mean of those that were."""
        state = self.state(root)
        if state == DONE:
            return 0.0
        if not isinstance(self.case, Sweep):
            return self.cost
        times = _cpu_times(self.folder(root)) if state == BEGUN else []
        rate = max(float(np.mean(times)), self.cost) if times else self.cost  # measuring a run takes time as well
        return rate * max(int(np.prod(self.case.shape)) - len(times), 0)

    def statistics(self, root: Path) -> dict[str, Any]:
        """Numbers about the results for a report, once they are there; empty where there are none to tell."""
        if isinstance(self.case, NnmCase):
            return _branch_statistics(self.results(root))
        return _sweep_statistics(self.folder(root)) if isinstance(self.case, Sweep) else {}


def _sweep_statistics(folder: Path) -> dict[str, Any]:
    """Members and how they ended, contact episodes, the largest error of the ledger, CPU time in s."""
    ensemble = open_ensemble(folder)
    status = ensemble["status"].values
    counts = {name: int((status == code).sum()) for code, name in enumerate(("simulated", "scaled", "failed"))}
    return {"members": int(status.size)} | counts | {
        "episodes": int(np.nansum(ensemble["contact_episodes"].values)),
        "ledger": float(np.nanmax(ensemble["ledger_error"].values, initial=0.0)),
        "cpu": float(sum(_cpu_times(folder))),
    }  # fmt: skip


def _branch_statistics(paths: Sequence[Path]) -> dict[str, Any]:
    """Points, largest residual and endings of the branches, and how many of them failed."""
    points, residual, endings = 0, 0.0, []
    for path in paths:
        with open_netcdf(path, "branch", ("kind", "residual", "ending")) as branch:
            regular = branch["residual"].values[branch["kind"].values == 0]
            points += len(regular)
            residual = max(residual, float(regular.max(initial=0.0)))
            endings.append(f"{branch.attrs['name']}: {branch.attrs['ending']}")
    failed = sum("failed" in ending for ending in endings)
    return {"points": points, "residual": residual, "endings": endings, "failed": failed}


def _cpu_times(folder: Path) -> list[float]:
    """CPU times in s of the members in ``folder`` that are complete; 0 for scaled ones."""
    summaries = [json.loads(path.read_text(encoding="utf-8")) for path in folder.glob("*/summary.json")]
    statistics = [summary.get("statistics", {}) for summary in summaries if summary.get("complete")]
    return [0.0 if "scaled_from" in s else float(s.get("cpu_seconds", 0.0)) for s in statistics]


def fingerprint(*parts: str | bytes) -> str:
    """One hash of all ``parts``, in this order."""
    digests = [hashlib.sha256(part.encode() if isinstance(part, str) else part).hexdigest() for part in parts]
    return hashlib.sha256(" ".join(digests).encode()).hexdigest()
