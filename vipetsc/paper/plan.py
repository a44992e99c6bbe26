"""What the verb ``paper`` makes: steps, figures and claims, in full or on coarse grids."""

import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Self

import vipetsc
from vipetsc.case import DesignCase, NnmCase, Sweep
from vipetsc.io.folder import FolderError
from vipetsc.paper.claims import measure_claims
from vipetsc.paper.figures import PAPER_FIGURES, RELATED, PaperFigure
from vipetsc.paper.steps import DONE, Step, StepCase, fingerprint

FULL, QUICK = "full", "quick"
CLAIMS = tuple(f"C{number}" for number in range(1, 18))
COARSE = "quick: coarse grid"

# Steps that a claim is measured from besides those of the figures that show it.
FURTHER_STEPS = {"C8": ("scattering",), "C15": ("nnm-hertz", "nnm-bilinear"), "C16": RELATED}

KINDS: dict[str, type[StepCase]] = {"sweep": Sweep, "branches": NnmCase, "search": DesignCase}


@dataclass(frozen=True)
class Plan:
    """Steps in the order in which they are made, and the figures of the paper.

    ``grid`` is "full" or "quick"; ``note`` stands on every picture; ``measure`` gives the claims (dataclasses) from
    the folder of all steps.
    """

    grid: str
    steps: tuple[Step, ...]
    figures: Sequence[PaperFigure] = PAPER_FIGURES
    note: str = ""
    measure: Callable[[Path], Sequence[Any]] = measure_claims

    def only(self, ids: Iterable[str]) -> Self:
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

    def inputs(self, root: Path) -> dict[str, str]:
        """Hash of what each figure is drawn from, by id; of all steps under "claims"."""
        steps = {step.name: step.identity(root) for step in self.steps if step.state(root) == DONE}
        version = vipetsc.__version__, self.note
        inputs = {f.id: fingerprint(*version, *(n + steps[n] for n in f.steps if n in steps)) for f in self.figures}
        return inputs | {"claims": fingerprint(*version, *(name + identity for name, identity in steps.items()))}


def paper_plan(grid: str = FULL) -> Plan:
    """The whole paper, from ``plan.toml`` and the case files of the package.

    The quick grid has fewer amplitudes, wavenumbers and sites and leaves out the in-phase branches; both laws and both
    readings stay.
    """
    folder = files("vipetsc.paper")
    steps = []
    for name, row in tomllib.loads((folder / "plan.toml").read_text(encoding="utf-8")).items():
        file = Path(str(folder / "cases" / f"{row.get('case', name)}.toml"))
        changes = [*row.get("changes", ()), *(row.get("quick", ()) if grid == QUICK else ())]
        if row["kind"] == "sweep":  # the figures of the paper are drawn from all sweeps together
            changes.insert(0, "output.figures=false")
        steps.append(Step(name, KINDS[row["kind"]], file, tuple(changes), row["cost"]))
    return Plan(grid, tuple(steps), note=COARSE if grid == QUICK else "")
