"""Result files with prescribed contents from which the paper's claims are measured in tests."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np

from tests.conftest import put_members
from vipetsc.case import Case, Sweep
from vipetsc.lattice import pass_bands
from vipetsc.paper.claims.evidence import Evidence
from vipetsc.paper.claims.measure import measure_claim
from vipetsc.spectra import Parts
from vipetsc.studies.linear_run import MEASURES


def measure(claim: str, root: Path, reading: str = "calibrated") -> SimpleNamespace:
    """Return the fields of the row of a claim, such as ``"C7"``, as measured from the files in ``root``."""
    with Evidence(root) as evidence:
        return SimpleNamespace(**measure_claim(claim, reading, evidence))


def put_analysis(home: Path, case: Case, row: dict[str, Any]) -> None:
    """Write the analysis of a member, with the measures of ``row``, into its folder."""
    home.mkdir(parents=True, exist_ok=True)
    with h5py.File(home / "analysis.h5", "w") as file:
        file.attrs["case"] = case.to_toml()
        for name, value in row.items():
            file[name] = value
        if "bands/energy" in row:
            parts = Parts.of(pass_bands(case.lattice.unit_cell()))
            file["bands/energy"].attrs["parts"] = list(parts.names)


def put_sweep(
    folder: Path,
    table: dict[str, Any],
    content: Callable[[Case], dict[str, Any]],
    episodes: Callable[[Case], int],
    analyses: bool = True,
) -> None:
    """Write a finished sweep: ``content(case)`` is each member's analysis, ``episodes(case)`` counts its contacts.

    Without ``analyses`` members have no file of their own, for claims that read ``ensemble.h5`` alone.
    """
    plan = Sweep.from_table(table)
    names = plan.ids()

    def outcome(number: int, case: Case) -> dict[str, Any]:
        row = content(case)
        if analyses:
            put_analysis(folder / names[number], case, row)

        statistics = {
            "episodes": episodes(case),
            "work": case.drive.amplitude**2,
            "dissipated": 0.0,
            "ledger_error": 0.0,
            "engine": "ts",
        }
        measures = {name: np.asarray(value).tolist() for name, value in row.items() if name in MEASURES}
        return {"statistics": statistics, "measures": measures}

    put_members(folder, plan, outcome)
