"""A measure of a user's module is the objective of a search, and a column of its table of designs."""

from __future__ import annotations

import csv

from mpi4py import MPI

import pytest

from tests.conftest import datasets, search_table
from vipetsc.case.optimise import OptimiseCase
from vipetsc.io.export import write_curves
from vipetsc.studies.optimum_search import run_search

MODULE = """
from vipetsc import register

@register.measure("lost_fraction", unit="1", text="energy lost in contacts over the work of the drive")
def lost_fraction(record):
    return float(record.run["energy/dissipated"][-1] / record.run["energy/work"][-1])
"""


def test_a_search_has_a_registered_measure_as_its_objective(tmp_path):
    """Its value is the fraction that the search itself measures as dissipated."""
    (tmp_path / "lost.py").write_text(MODULE)
    search = {"objective": [{"measure": "lost_fraction", "goal": "minimise"}]}
    plugins = {"modules": [str(tmp_path / "lost.py")]}
    table = search_table(16, [4, 9], optimise=search, contacts={"restitution": 0.7}, plugins=plugins)
    run_search(OptimiseCase.from_table(table), tmp_path / "out", MPI.COMM_SELF)

    found = datasets(tmp_path / "out" / "optimum.h5")
    assert found["value"][:, 0] == pytest.approx(found["dissipated"], rel=1e-12)
    assert found["dissipated"].min() < 0.9 * found["dissipated"][0]
    write_curves(tmp_path / "out" / "optimum.h5")
    with (tmp_path / "out" / "curves" / "optimum-design.csv").open(newline="") as file:
        rows = [*csv.DictReader(file)]
    assert [float(row["1: lost_fraction"]) for row in rows] == found["value"][:, 0].tolist()
