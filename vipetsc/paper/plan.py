"""The plan of the verb ``paper``, in full or on coarse grids: steps, each of which computes one case in its folder.

A step knows the state of its folder and what is left to compute; the plan knows the inputs of figures and claims.
"""

import hashlib
import json
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple, Self

from mpi4py import MPI

import h5py
import numpy as np

import vipetsc
from vipetsc.case import DesignCase, NnmCase, Sweep
from vipetsc.case.predict import PredictCase
from vipetsc.endings import Ending
from vipetsc.io.errors import UnreadableFileError, is_of_file_system
from vipetsc.io.folder import FolderError, provenance
from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.read import open_ensemble
from vipetsc.modes.branches.follow import Follower, claim_branches
from vipetsc.modes.system import System
from vipetsc.paper.cell_search import search_design
from vipetsc.paper.claims import measure_claims
from vipetsc.paper.claims.criteria import CLAIMS
from vipetsc.paper.engines import agreement, sampled
from vipetsc.paper.paper_figures import PAPER_FIGURES, RELATED, PaperFigure
from vipetsc.parallel import StopRequest
from vipetsc.studies.ensemble import COMPLETE, FAILED, SCALED, Results
from vipetsc.studies.prediction import predict
from vipetsc.studies.sweep import has_all_records, run_sweep
from vipetsc.wording import system_number, system_reason

FULL, QUICK = "full", "quick"
COARSE = "quick: coarse grid"  # the note on every picture of the quick grid
DONE, BEGUN, STALE, MISSING = "done", "begun", "stale", "missing"
SEED = 2024  # of the choice of members that the engine ts simulates too
TS_COST = 2.5  # CPU time in s of such a member by ts
IN_PHASE = 10  # cost of the in-phase branch, which goes through all tongues, over that of the out-of-phase branch
RELATION = "backbone.h5"  # the relation of a sweep to branches, in the folder of the sweep

# Steps from which a claim is measured, besides those whose results its figures show.
FURTHER_STEPS = {"C8": ("scattering",), "C15": ("nnm-hertz", "nnm-bilinear"), "C16": RELATED}

StepCase = Sweep | NnmCase | DesignCase | PredictCase
KINDS: dict[str, type[StepCase]] = {
    "sweep": Sweep,
    "branches": NnmCase,
    "search": DesignCase,
    "prediction": PredictCase,
}


class PartMaker(NamedTuple):
    """Functions that compute the parts of a step: ``make`` is called on one rank with the number of a part.

    ``publish`` is called on all ranks when all parts are there, and puts them in the place of earlier ones.
    """

    make: Callable[[int], object]
    publish: Callable[[], None] = lambda: None


@dataclass(frozen=True)
class PaperStep:
    """A step of the paper, a case that is computed in ``root/<name>``: a sweep, branches, a search or a prediction.

    ``kind`` is the class of the case in ``file``, ``changes`` are made in it (``section.key=value``). ``cost`` is the
    CPU time in s of a part, of a sweep's member, or of the whole step if it has neither, on a core of the 2020s. A step
    with ``checks``, the name of another step, simulates ``sample`` members of that sweep by the engine ``ts``.
    """

    name: str
    kind: type[StepCase]
    file: Path
    changes: tuple[str, ...] = ()
    cost: float = 1.0
    checks: str = ""
    sample: int = 0

    def folder(self, root: Path) -> Path:
        """Return the folder of the step's files in the folder ``root`` of the paper."""
        return root / self.name

    @cached_property
    def case(self) -> StepCase:
        """The resolved case; raises CaseError."""
        case = self.kind.load(self.file, self.changes)
        if self.checks and isinstance(case, Sweep):
            return sampled(case, self.sample, SEED)
        return case

    @cached_property
    def text(self) -> str:
        """The resolved case as TOML; raises CaseError."""
        return self.case.to_toml()

    def results(self, root: Path) -> list[Path]:
        """Return the files of results of which pictures and claims are made; they need not be there yet."""
        if isinstance(self.case, NnmCase):
            system = System.from_case(self.case)
            names = [f"branch-{system.branch_name(mode - 1)}.h5" for mode in self.case.nnm.modes]
        elif isinstance(self.case, Sweep):
            names = ["ensemble.h5"]
        elif isinstance(self.case, PredictCase):
            names = ["prediction.h5"]
        else:
            names = ["design.h5"]
        return [self.folder(root) / name for name in names]

    @property
    def parts(self) -> dict[int, float]:
        """The parts that single ranks compute, by number, with their CPU times in s.

        They are the branches by their modes, or the search as part 1. Sweeps and predictions, on which all ranks work
        together, have none.
        """
        if isinstance(self.case, NnmCase):
            costs = dict.fromkeys(self.case.nnm.modes, self.cost)
            if 1 in costs:
                costs[1] *= IN_PHASE
            return costs
        if isinstance(self.case, DesignCase):
            return {1: self.cost}
        return {}

    @contextmanager
    def claimed(self, root: Path, comm: MPI.Comm, stop: StopRequest, afresh: bool) -> Iterator[PartMaker]:
        """Claim the folder of a step with parts, on all ranks, and give the functions that compute the missing parts.

        With ``afresh`` all parts are computed, and replace those of another case.
        """
        case = self.case
        folder = self.folder(root)
        if isinstance(case, NnmCase):
            with claim_branches(case, folder, comm, afresh) as claim:
                follower = partial(Follower, case, claim.folder, provenance(comm), stop=stop, resume=claim.going_on)
                yield PartMaker(lambda mode: follower().follow(mode - 1), claim.publish)
        else:
            assert isinstance(case, DesignCase)
            yield PartMaker(lambda part: search_design(case, folder, MPI.COMM_SELF, force=afresh))

    def compute_together(self, root: Path, comm: MPI.Comm, stop: StopRequest, afresh: bool) -> list[str]:
        """Compute what is missing of a step without parts, a sweep or a prediction, on all ranks.

        With ``afresh`` all of it is computed. A request to ``stop`` ends it early. Returns warnings about the results.
        """
        if isinstance(self.case, PredictCase):
            predict(self.case, self.folder(root), comm, force=afresh, stop=stop)
            return []
        assert isinstance(self.case, Sweep)
        return run_sweep(self.case, self.folder(root), comm, force=afresh, stop=stop, progress=True).warnings

    def state(self, root: Path) -> str:
        """Return the state of the step: DONE, BEGUN, MISSING, or STALE for results of another case or version."""
        folder = self.folder(root)
        if not (folder / "case.toml").exists():
            return MISSING
        if not self._is_case_of(folder):
            return STALE
        if all(map(self._is_complete, self.results(root))):
            return DONE
        return BEGUN

    def _is_case_of(self, folder: Path) -> bool:
        """Return whether a ``folder`` is marked as one for results of this case."""
        marker = folder / "case.toml"
        return marker.exists() and self._is_same_case(marker.read_text(encoding="utf-8", errors="replace"))

    def _is_complete(self, path: Path) -> bool:
        """Return whether the file ``path`` is a finished result of this step, and of its case.

        A branch is finished when it has ended, also in a failure that it names; a sweep when its
        ensemble has all records.
        """
        try:
            with h5py.File(path) as file:
                if "ending" in file.attrs:
                    return bool(file.attrs["complete"]) or file.attrs["ended"] == Ending.FAILED.name
                if isinstance(self.case, Sweep) and not has_all_records(path.parent):
                    return False
                return self._is_same_case(file.attrs["case"])
        # One that was cut off does not open.
        except OSError as error:
            if is_of_file_system(error):
                reason = f"{path} cannot be read: {system_reason(error)}"
                raise UnreadableFileError(system_number(error), reason) from error
        return False

    def _is_same_case(self, text: str) -> bool:
        """Return whether the case ``text`` in TOML is this step's, in whatever order its keys stand."""
        # A text that cannot be read is no case of this step, which will say so when it claims its folder.
        with suppress(tomllib.TOMLDecodeError, RecursionError):
            return tomllib.loads(text) == tomllib.loads(self.text)
        return False

    def identity(self, root: Path) -> str:
        """Return the hash of the case and of the contents of its results."""
        # With the relation to branches, which is drawn from the folder of the sweep.
        paths = [*self.results(root), self.folder(root) / RELATION]
        return fingerprint(self.text, *(path.read_bytes() for path in paths if path.exists()))

    def left(self, root: Path) -> float:
        """Return CPU time in s that the step still needs.

        A sweep needs it for its missing members, each at the mean time of the finished ones, but at least at ``cost``.
        """
        state = self.state(root)
        if state == DONE:
            return 0.0
        if not isinstance(self.case, Sweep):
            return sum(self.parts.values()) or self.cost

        times: list[float] = []
        if state == BEGUN:
            # The members that are done show how fast this machine is.
            times = [*Results(self.case, self.folder(root)).cpu_seconds.values()]
        rate = self.cost
        if times:
            rate = max(float(np.mean(times)), self.cost)
        return rate * max(int(np.prod(self.case.shape)) - len(times), 0)

    def failures(self, root: Path) -> int:
        """Return the number of members or branches that failed, of a step whose state is DONE."""
        if isinstance(self.case, NnmCase):
            return int(_branch_statistics(self.results(root))["failed"])
        if isinstance(self.case, Sweep):
            # The status alone: a call with nothing to do asks every sweep, and to read all measures takes much longer.
            with open_netcdf(self.folder(root) / "ensemble.h5", "sweep's ensemble", ("status",)) as ensemble:
                return int((ensemble["status"] == FAILED).sum())
        return 0

    def statistics(self, root: Path) -> dict[str, Any]:
        """Return numbers about the results for a report, once they are there; empty where there are none."""
        if isinstance(self.case, NnmCase):
            return _branch_statistics(self.results(root))

        statistics: dict[str, Any] = {}
        if isinstance(self.case, Sweep):
            statistics |= _sweep_statistics(self.folder(root))
        if self.checks:
            statistics["agreement"] = agreement(root / self.checks, self.folder(root))
        return statistics


@dataclass(frozen=True)
class Plan:
    """The steps in the order in which they are computed, and the figures of the paper.

    ``grid`` is "full" or "quick"; ``note`` is printed on every picture; ``measure`` returns the rows of ``claims.json``
    from the folder that has the folders of all steps, and the steps that cannot be used (``unusable``).
    """

    grid: str
    steps: tuple[PaperStep, ...]
    figures: Sequence[PaperFigure] = PAPER_FIGURES
    note: str = ""
    measure: Callable[[Path, Mapping[str, str]], Sequence[Mapping[str, Any]]] = measure_claims

    def only(self, ids: Sequence[str]) -> Self:
        """Return the part of the plan that the figures and claims ``ids`` need; the whole plan without any.

        Raises FolderError for an id that the plan does not have.
        """
        if not ids:
            return self

        names = {figure.id.lower() for figure in self.figures}
        unknown = [i for i in ids if i.lower() not in names and i.upper() not in CLAIMS]
        if unknown:
            choices = f"figures are {', '.join(f.id for f in self.figures)}; claims are C1 to C{len(CLAIMS)}"
            raise FolderError(f"--only {' '.join(unknown)}: {choices}")

        wanted = {i.lower() for i in ids}
        claims = {i.upper() for i in ids}
        figures = [f for f in self.figures if f.id.lower() in wanted or claims & set(f.claims)]
        shown = claims.union(*(figure.claims for figure in figures))
        needed = {step for figure in figures for step in figure.steps}
        needed = needed.union(*(FURTHER_STEPS.get(claim, ()) for claim in shown))
        return replace(self, steps=tuple(s for s in self.steps if s.name in needed), figures=figures)

    def left(self, root: Path) -> dict[str, float]:
        """Return the steps that are not done or had failures, by name, with the CPU time in s that they still need."""
        return {s.name: s.left(root) for s in self.steps if s.state(root) != DONE or s.failures(root)}

    def folders(self, root: Path) -> Mapping[str, Path]:
        """Return the folders of the steps that are done, by name."""
        return {step.name: step.folder(root) for step in self.steps if step.state(root) == DONE}

    def unusable(self, root: Path) -> Mapping[str, str]:
        """Return why a step has results that no claim is measured from, by its name: they are stale, or a part."""
        reasons = {STALE: "has results of another case or version: compute it again", BEGUN: "is not finished"}
        states = {step.name: step.state(root) for step in self.steps}
        return {name: reasons[state] for name, state in states.items() if state in reasons}

    def claims_of(self, step: PaperStep) -> list[str]:
        """Return the ids of the claims that are measured from a step, or whose figures show it."""
        claims = {claim for figure in self.figures if step.name in figure.steps for claim in figure.claims}
        claims |= {claim for claim, steps in FURTHER_STEPS.items() if step.name in steps}
        return [claim for claim in CLAIMS if claim in claims]

    def inputs(self, root: Path) -> dict[str, str]:
        """Return the hash of what each figure is drawn from, by id; under "claims" that of all finished steps."""
        steps = {step.name: step.name + step.identity(root) for step in self.steps if step.state(root) == DONE}
        # The note is printed on every picture. Another version of the package may draw or measure otherwise.
        version = (vipetsc.__version__, self.note)
        inputs: dict[str, str] = {}
        for figure in self.figures:
            inputs[figure.id] = fingerprint(*version, *(steps[name] for name in figure.steps if name in steps))
        inputs["claims"] = fingerprint(*version, *steps.values())
        return inputs


def paper_plan(grid: str = FULL) -> Plan:
    """Return the whole paper, from ``plan.toml`` and the case files of the package.

    The quick grid has fewer amplitudes, wavenumbers and sites and leaves out the in-phase branches; both laws and both
    readings stay.
    """
    folder = files("vipetsc.paper")
    steps: list[PaperStep] = []
    for name, row in tomllib.loads((folder / "plan.toml").read_text(encoding="utf-8")).items():
        file = Path(str(folder / "cases" / f"{row.get('case', name)}.toml"))
        changes = [*row.get("changes", ())]
        if grid == QUICK:
            # Later changes win: the quick grid overrides those of the full one.
            changes += row.get("quick", ())
        # The figures of the paper are drawn from all sweeps together, not by each sweep.
        if row["kind"] == "sweep":
            changes.insert(0, "output.figures=false")
        steps.append(
            PaperStep(
                name=name,
                kind=KINDS[row["kind"]],
                file=file,
                changes=tuple(changes),
                cost=row["cost"],
                sample=row.get("sample", 0),
            )
        )
    steps += [replace(s, name=f"{s.name}-ts", cost=TS_COST, checks=s.name) for s in steps if s.sample]
    return Plan(grid, tuple(steps), note=COARSE if grid == QUICK else "")


def _sweep_statistics(folder: Path) -> dict[str, Any]:
    """Return numbers of the sweep in ``folder`` for the report: members by ending, contacts, ledger, CPU time in s."""
    ensemble = open_ensemble(folder)
    status = ensemble["status"].values
    return {
        "simulated": int((status == COMPLETE).sum()),
        "scaled": int((status == SCALED).sum()),
        "failed": int((status == FAILED).sum()),
        "members": status.size,
        "episodes": int(np.nansum(ensemble["contact_episodes"].values)),
        "ledger": float(np.nanmax(ensemble["ledger_error"].values, initial=0.0)),
        "cpu": sum(Results(Sweep.of(ensemble), folder).cpu_seconds.values()),
    }


def _branch_statistics(paths: Sequence[Path]) -> dict[str, Any]:
    """Return numbers of the branches in the files ``paths`` for the report.

    ``points`` and their largest ``residual``, the ``endings`` with tongues and warnings, and how many ``failed``.
    """
    residuals: list[float] = []
    endings: list[str] = []
    failed = 0
    for path in paths:
        with open_netcdf(path, "branch", ("kind", "residual", "ending")) as branch:
            # Special points are located to their own tolerance; the residual of the branch is that of its steps.
            regular = branch["kind"].values == 0
            residuals.extend(branch["residual"].values[regular].tolist())
            remarks = [branch.attrs["ending"]]
            if branch.attrs.get("tongues"):
                remarks.append(f"{branch.attrs['tongues']} tongues")
            remarks += json.loads(branch.attrs.get("warnings", "[]"))
            failed += branch.attrs["ended"] == Ending.FAILED.name
            endings.append(f"{branch.attrs['name']}: {', '.join(remarks)}")

    return {"points": len(residuals), "residual": max(residuals, default=0.0), "endings": endings, "failed": failed}


def read_json(path: Path) -> Any:
    """Return the content of a JSON file; None if it is not there or was cut off."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        if is_of_file_system(error):
            raise
        return None


def fingerprint(*parts: str | bytes) -> str:
    """Return the hash of all ``parts`` together, in this order."""
    # Digests have one length: a text that moves from the end of one part to the beginning of the next changes the hash.
    digests = [hashlib.sha256(part.encode() if isinstance(part, str) else part).hexdigest() for part in parts]
    return hashlib.sha256(" ".join(digests).encode()).hexdigest()
