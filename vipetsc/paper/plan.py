"""What the verb ``paper`` makes: steps, figures and claims, in full or on coarse grids."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from vipetsc.io.folder import FolderError
from vipetsc.paper.figures import PAPER_FIGURES, PaperFigure
from vipetsc.paper.steps import BranchStep, DesignStep, Relation, Step, SweepStep

FULL, QUICK = "full", "quick"
CLAIMS = tuple(f"C{number}" for number in range(1, 18))
COARSE = "quick: coarse grid"

# What a claim is measured from besides the figures that show it.
BESIDE = {"C8": ("scattering",), "C15": ("nnm-hertz", "nnm-bilinear")}

BRANCHES = ("nnm-hertz", "nnm-bilinear", "nnm-hertz-calibrated", "nnm-bilinear-calibrated")
OUT_OF_PHASE = "nnm.modes=[2]"

# CPU time in s: of a member of a sweep, else of the whole step.
COSTS = {
    "scattering-amplitudes": 4.0,
    "interband-amplitudes": 5.0,
    "interband-one-site": 4.0,
    "design": 15.0,
    "nnm-hertz": 45.0,
    "nnm-bilinear": 45.0,
    "nnm-hertz-calibrated": 20.0,
    "nnm-bilinear-calibrated": 20.0,
    "interband": 1.2,
    "scattering-neighbours": 0.4,
    "scattering": 0.4,
}

RUNS = ("output.figures=false",)  # of all sweeps: the figures of the paper are drawn from all of them together

COARSER = {
    "scattering": (
        'sweep.drive.wavenumber=["3pi/9", "5pi/9"]',
        "sweep.drive.amplitude={ log = [0.1, 20.0], count = 9 }",
        "sweep.contacts.sites=[2, 5, 20]",
    ),
    "scattering-neighbours": (
        "sweep.drive.amplitude={ log = [0.1, 20.0], count = 9 }",
        "sweep.contacts.sites.count=[2, 5, 20]",
    ),
    "interband": ("sweep.drive.amplitude={ log = [1.0, 1e4], count = 13 }",),
    "design": ("design.lambda.count=10", "design.eta.count=10", "design.wavenumbers=51"),
    "nnm-hertz": (OUT_OF_PHASE,),
    "nnm-bilinear": (OUT_OF_PHASE,),
}


@dataclass(frozen=True)
class Plan:
    """Steps in the order in which they are made, the relation drawn between some, and the figures of the paper.

    ``grid`` is "full" or "quick"; ``note`` stands on every picture; ``claims`` names the module that measures
    (``measure_claims``, ``write_claims``).
    """

    grid: str
    steps: tuple[Step, ...]
    relation: Relation | None = None
    plates: Sequence[PaperFigure] = PAPER_FIGURES
    note: str = ""
    claims: str = "vipetsc.paper.claims"

    def only(self, ids: Iterable[str]) -> Plan:
        """The part of the plan that figures and claims need; all of it without ``ids``.

        Raises
        ------
        FolderError
            For an id that is neither; names the valid ones.
        """
        ids = list(ids)
        if not ids:
            return self
        known = {plate.id.lower(): plate for plate in self.plates}
        unknown = [i for i in ids if i.lower() not in known and i.upper() not in CLAIMS]
        if unknown:
            raise FolderError(
                f"--only {' '.join(unknown)}: figures are {', '.join(p.id for p in self.plates)}; "
                f"claims are {CLAIMS[0]} to {CLAIMS[-1]}"
            )
        claims = {i.upper() for i in ids}
        plates = [p for p in self.plates if p.id.lower() in {i.lower() for i in ids} or claims & set(p.claims)]
        needed = {step for plate in plates for step in plate.steps}
        needed |= {step for claim in claims for step in BESIDE.get(claim, ())}
        if self.relation and any(p.id in ("fig12", "figS7", "figS8") for p in plates):
            needed |= {step.name for step in self.relation.branches}
        return replace(self, steps=tuple(s for s in self.steps if s.name in needed), plates=plates)

    def folders(self, root: Path) -> Mapping[str, Path]:
        """The folders of the steps that are done, by name."""
        return {step.name: step.folder(root) for step in self.steps if step.state(root) == "done"}

    def claims_of(self, step: Step) -> list[str]:
        """The claims that rest on a step."""
        resting = {c for plate in self.plates if step.name in plate.steps for c in plate.claims}
        resting |= {claim for claim, steps in BESIDE.items() if step.name in steps}
        if self.relation and step in self.relation.branches:
            resting.add("C16")
        return sorted(resting, key=lambda claim: int(claim[1:]))


def paper_plan(grid: str = FULL, cases: Path | None = None) -> Plan:
    """The whole paper, from the case files in ``cases`` (those of the package by default).

    The cheap steps come first, so that most figures are there early. The quick grid has fewer amplitudes,
    wavenumbers and sites and leaves out the in-phase branches; both laws and both readings stay.

    Raises
    ------
    FolderError
        If the case files are not there.
    """
    cases = cases or Path(__file__).parent / "cases"
    if not (cases / "scattering.toml").exists():
        raise FolderError(f"{cases}: holds no scattering.toml; the case files of the paper are needed")
    steps: list[Step] = []
    for name, cost in COSTS.items():
        kind = DesignStep if name == "design" else BranchStep if name in BRANCHES else SweepStep
        file = cases / f"{name.removesuffix('-calibrated')}.toml"
        changes = ("lattice.reading=calibrated", OUT_OF_PHASE) if name.endswith("-calibrated") else ()
        changes += COARSER.get(name, ()) if grid == QUICK else ()
        changes = (*RUNS, *changes) if kind is SweepStep else changes
        steps.append(kind(name, file, changes, cost))
    found = {step.name: step for step in steps}
    relation = Relation(found["interband"], tuple(found[name] for name in BRANCHES))
    return Plan(grid, tuple(steps), relation, note=COARSE if grid == QUICK else "")
