"""What the verb ``paper`` makes: steps, figures and claims, in full or on coarse grids."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

from vipetsc.io.folder import FolderError
from vipetsc.paper.figures import PAPER_FIGURES, RELATED, TRANSFER
from vipetsc.paper.pictures import PaperFigure
from vipetsc.paper.steps import BRANCHES, DONE, SEARCH, SWEEP, Step, StepKind

FULL, QUICK = "full", "quick"
CLAIMS = tuple(f"C{number}" for number in range(1, 18))
COARSE = "quick: coarse grid"

# Steps that a claim is measured from besides those of the figures that show it.
FURTHER_STEPS = {"C8": ("scattering",), "C15": ("nnm-hertz", "nnm-bilinear"), "C16": RELATED}

OUT_OF_PHASE = "nnm.modes=[2]"

# Kind of each step and its CPU time in s: of a member of a sweep, else of the whole step. The cheap ones come first,
# so that most figures are there early.
STEPS: dict[str, tuple[StepKind, float]] = {
    "scattering-amplitudes": (SWEEP, 4.0),
    "interband-amplitudes": (SWEEP, 5.0),
    "interband-one-site": (SWEEP, 4.0),
    "design": (SEARCH, 15.0),
    "nnm-hertz": (BRANCHES, 45.0),
    "nnm-bilinear": (BRANCHES, 45.0),
    "nnm-hertz-calibrated": (BRANCHES, 20.0),
    "nnm-bilinear-calibrated": (BRANCHES, 20.0),
    TRANSFER: (SWEEP, 1.2),
    "scattering-neighbours": (SWEEP, 0.4),
    "scattering": (SWEEP, 0.4),
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
    """Steps in the order in which they are made, and the figures of the paper.

    ``grid`` is "full" or "quick"; ``note`` stands on every picture; ``claims`` names the module that measures
    (``measure_claims``, ``write_claims``).
    """

    grid: str
    steps: tuple[Step, ...]
    figures: Sequence[PaperFigure] = PAPER_FIGURES
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
        names = {figure.id.lower() for figure in self.figures}
        unknown = [i for i in ids if i.lower() not in names and i.upper() not in CLAIMS]
        if unknown:
            raise FolderError(
                f"--only {' '.join(unknown)}: figures are {', '.join(f.id for f in self.figures)}; "
                f"claims are {CLAIMS[0]} to {CLAIMS[-1]}"
            )
        claims, wanted = {i.upper() for i in ids}, {i.lower() for i in ids}
        figures = [f for f in self.figures if f.id.lower() in wanted or claims & set(f.claims)]
        needed = {step for figure in figures for step in figure.needs}
        needed |= {step for claim in claims for step in FURTHER_STEPS.get(claim, ())}
        return replace(self, steps=tuple(s for s in self.steps if s.name in needed), figures=figures)

    def folders(self, root: Path) -> Mapping[str, Path]:
        """The folders of the steps that are done, by name."""
        return {step.name: step.folder(root) for step in self.steps if step.state(root) == DONE}

    def claims_of(self, step: Step) -> list[str]:
        """The claims that rest on a step."""
        claims = {claim for figure in self.figures if step.name in figure.steps for claim in figure.claims}
        claims |= {claim for claim, steps in FURTHER_STEPS.items() if step.name in steps}
        return sorted(claims, key=CLAIMS.index)


def paper_plan(grid: str = FULL) -> Plan:
    """The whole paper, from the case files of the package.

    The quick grid has fewer amplitudes, wavenumbers and sites and leaves out the in-phase branches; both laws and both
    readings stay.
    """
    steps = []
    for name, (kind, cost) in STEPS.items():
        changes: tuple[str, ...] = RUNS if kind is SWEEP else ()
        if name.endswith("-calibrated"):
            changes += ("lattice.reading=calibrated", OUT_OF_PHASE)
        changes += COARSER.get(name, ()) if grid == QUICK else ()
        steps.append(Step(name, kind, case_file(name), changes, cost))
    return Plan(grid, tuple(steps), note=COARSE if grid == QUICK else "")


def case_file(step: str) -> Path:
    """The case file of a step, shipped with the package; that of the printed reading serves both."""
    return Path(str(files("vipetsc.paper") / "cases" / f"{step.removesuffix('-calibrated')}.toml"))
