"""A paper that takes seconds: ``python -m tests.cli.tiny_paper DIR [ID ...]``, with or without mpirun."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from vipetsc.paper.plan import QUICK, Plan, paper_plan

ONE_READING = 'sweep.lattice.reading=["calibrated"]'
SHORT = ("drive.cycles=5", "time.rtol=1e-7", "contacts.clearance=1e-4", ONE_READING)
DIATOMIC = (*SHORT, "lattice.cells=40")
FOUR_BAND = (*SHORT, "lattice.cells=30")
AMPLITUDES = "sweep.drive.amplitude={ log = [0.2, 50.0], count = 6 }"
BRANCH = ("nnm.energy=[0.0, 30.0]",)
PREDICTED = (*FOUR_BAND[:3], "lattice.cells=30", "contacts.sites=2", "predict.amplitudes=[2.0]")
# Changes of each step, by its name; a step that checks another one by the second engine has the changes of that one.
CHANGES = {
    "scattering-amplitudes": (*DIATOMIC, "contacts.sites=2"),
    "interband-amplitudes": (*FOUR_BAND, "output.window=[5, 15]", "output.every=10"),
    "interband-one-site": (*FOUR_BAND, "output.window=[10, 10]", "sweep.drive.amplitude=[2.0, 40.0]"),
    "interband-scatter": (
        *FOUR_BAND, 'sweep.contacts.law=["hertz", "bilinear"]', "sweep.contacts.sites=[5, 1]",
        "sweep.drive.amplitude=[5.0, 5.0]"
    ),
    "prediction-hertz": PREDICTED,
    "prediction-bilinear": PREDICTED,
    "design": ("design.lambda.count=3", "design.eta.count=3", "design.wavenumbers=11"),
    "nnm-hertz": BRANCH,
    "nnm-bilinear": BRANCH,
    "nnm-hertz-calibrated": BRANCH,
    "nnm-bilinear-calibrated": BRANCH,
    "interband": (*SHORT[1:], "lattice.cells=30", AMPLITUDES.replace("50.0", "15.0")),
    "scattering-neighbours": (
        *DIATOMIC, "time.samples=201", "contacts.sites.first=10", "sweep.contacts.sites.count=[1, 2]", AMPLITUDES
    ),
    "scattering": (*DIATOMIC, "time.samples=201", "sweep.contacts.sites=[1, 2]", AMPLITUDES),
}  # fmt: skip
# Figures that take little time to draw; of figS3 only the maps are drawn. The results suffice for all others too.
DRAWN = ("fig01", "fig09", "fig10", "figS3")


def tiny_plan() -> Plan:
    """Return the quick plan with shortened steps, and with claims that are sums over the results."""
    plan = paper_plan(QUICK)
    steps = []
    for step in plan.steps:
        # One check by the second engine is enough.
        if step.checks in ("", "interband"):
            steps.append(replace(step, changes=(*step.changes, *CHANGES[step.checks or step.name])))
    return replace(plan, steps=tuple(steps), measure=measure_claims)


def drawing(plan: Plan) -> Plan:
    """Return the plan with the figures ``DRAWN`` only; of figS3 its maps alone."""
    figures = []
    for figure in plan.figures:
        if figure.id == "figS3":
            figure = replace(figure, parts=tuple(part for part in figure.parts if part.figure == "cost_maps"))
        if figure.id in DRAWN:
            figures.append(figure)
    return replace(plan, figures=tuple(figures))


def measure_claims(root: Path, unusable: Mapping[str, str]) -> list[dict]:
    """Return rows of claims whose values are sums over the results of two steps: they show any bit that differs."""
    found = []
    for name, key, step, data in (
        ("C7", "entropy", "scattering", "entropy/energy_weighted"),
        ("C11", "transfer", "interband", "ibtet"),
    ):
        path = root / step / "ensemble.h5"
        value = {}
        # A part of the paper may lack one of the steps; a step whose members all failed has no measures.
        if path.exists() and step not in unusable:
            with h5py.File(path) as file:
                if data in file:
                    value = {"total": float(np.nansum(file[data][...]))}

        verdict = "holds" if value else "not measured"
        for reading in ("calibrated", "printed"):
            row = {
                "id": name,
                "reading": reading,
                "claim": f"the {key} of the small lattice adds up",
                "value": value,
                "uncertainty": {},
                "threshold": "total > 0",
                "verdict": verdict,
                "reason": "",
                "figure": "",
                "files": [f"{step}/ensemble.h5"],
            }
            found.append(row)
    return found


def main() -> int:
    """Make the tiny paper and print what was done."""
    # These imports are not at the top, because tests import this module into processes that have PETSc already.
    import petsc4py

    petsc4py.init(["tiny", "-no_signal_handler"])
    from mpi4py import MPI

    from vipetsc.paper.make import make_paper
    from vipetsc.parallel import install_abort_hook

    install_abort_hook()
    result = make_paper(drawing(tiny_plan()), sys.argv[1], only=sys.argv[2:])
    if MPI.COMM_WORLD.rank == 0:
        print(json.dumps({"made": result.new_steps, "drawn": len(result.drawn), "complete": result.complete}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
