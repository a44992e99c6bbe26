"""Studies with registered copies of Hertz's law and of the paper's dissipation factor have the originals' results.

The cases with the originals name the module as well, so that a search may use its measure as the objective. Only the
names of law and factor differ.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import datasets, search_table
from tests.one_site import law_case
from vipetsc.case.optimise import OptimiseCase
from vipetsc.io.export import write_curves
from vipetsc.studies.one_site import make_law
from vipetsc.studies.optimum_search import run_search

COPIES = """
from vipetsc import register


def force(x, k):
    return k * x**1.5


def slope(x, k):
    return 1.5 * k * x**0.5


def energy(x, k):
    return k * x**2.5 / 2.5


register.elastic_law("hertz-copy", force, slope, energy, onset_exponent=1.5)


@register.dissipation_factor("paper-copy")
def damping(restitution):
    return 1.5 * (1 - restitution)


@register.measure("lost_fraction", unit="1", text="energy lost in contacts over the work of the drive")
def lost_fraction(record):
    return float(record.run["energy/dissipated"][-1] / record.run["energy/work"][-1])
"""
LAWS = {"shipped": ("hertz", "paper"), "registered": ("hertz-copy", "paper-copy")}
# A search that looks for the smallest value of the registered measure.
SEARCH = {"objective": [{"measure": "lost_fraction", "goal": "minimise"}]}


def law(folder: Path, **sections: dict[str, Any]) -> Path:
    """Compute the scattering law of one site; returns its file."""
    make_law(law_case(**sections), folder, MPI.COMM_SELF)
    return folder / "law.h5"


def search(folder: Path, **sections: dict[str, Any]) -> Path:
    """Search for the clearances of two sites; returns the search's file."""
    run_search(OptimiseCase.from_table(search_table(16, [4, 9], optimise=SEARCH, **sections)), folder, MPI.COMM_SELF)
    return folder / "optimum.h5"


def results(study: Callable[..., Path], folder: Path) -> list[Path]:
    """The two files of a ``study``, with the shipped and with the registered law."""
    (folder / "copies.py").write_text(COPIES)
    files = []
    for name, (elastic, factor) in LAWS.items():
        contacts = {"law": elastic, "damping": factor, "restitution": 0.7}
        modules = {"modules": [str(folder / "copies.py")]}
        files.append(study(folder / name, contacts=contacts, plugins=modules))
    return files


def assert_same_to_rounding(shipped: Path, registered: Path) -> None:
    """Assert that all numbers of two files agree to rounding, which later contacts magnify to at most 1e-9."""
    first = datasets(shipped)
    second = datasets(registered)
    assert first.keys() == second.keys()
    for name, values in first.items():
        if values.dtype != object:
            scale = np.nanmax(np.abs(values), initial=1e-300)
            assert second[name] == pytest.approx(values, rel=1e-9, abs=1e-9 * scale, nan_ok=True), name


def test_a_registered_law_has_the_response_of_the_shipped_one(tmp_path):
    """The scattering law of one site is the same with registered copies as with the originals."""
    shipped, registered = results(law, tmp_path)
    assert_same_to_rounding(shipped, registered)
    assert datasets(registered)["dissipated"].max() > 0.01


def test_a_search_has_a_registered_measure_as_its_objective(tmp_path):
    """A registered measure of the lost fraction has the value that the search itself measures as dissipated.

    The CSV file of the designs has a column for it.
    """
    shipped, registered = results(search, tmp_path)
    assert_same_to_rounding(shipped, registered)

    found = datasets(registered)
    assert found["value"][:, 0] == pytest.approx(found["dissipated"], rel=1e-12)
    assert found["dissipated"].min() < 0.9 * found["dissipated"][0]

    write_curves(registered)
    with (registered.parent / "curves/optimum-design.csv").open(newline="") as file:
        rows = [*csv.DictReader(file)]
    assert [float(row["1: lost_fraction"]) for row in rows] == found["value"][:, 0].tolist()
    assert [float(row["clearance 2 (m)"]) for row in rows] == found["parameter"][:, 1].tolist()
