"""Hill's method on condensed unknowns: multipliers against Floquet's, from the whole lattice's motion."""

from __future__ import annotations

import logging

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest

from tests.unit.test_floquet import case
from vipetsc.case import CaseError, NnmCase
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.lattice import floquet

CONDENSED = {"system": "condensed", "points": 1, "truncation": 1e-7}


@pytest.mark.slow
def test_multipliers_of_a_breather_are_those_of_floquet(tmp_path):
    """A pair off the real axis; its harmonics left out, 1e-7, and Hill's eliminated ones change it by less than 1e-6.

    In the 14 cells other pairs of 1.05 and less lie near the circle, whose zeros and poles are .01 of a strip apart.
    """
    (branch,) = follow_all(case(**CONDENSED, multipliers=2), tmp_path, MPI.COMM_SELF)
    stored = read_branch(tmp_path / "branch-breather-1600.h5")
    for point, other in zip(stored.points, branch.points, strict=True):
        assert np.array_equal(point.multipliers, other.multipliers)
        mu, largest = point.multipliers[0, 0], np.abs(point.multipliers[:, 0]).max()
        assert abs(mu.imag) > 0.1 and largest > 1.4
        assert point.multiplier == other.multiplier == pytest.approx(largest, rel=1e-6)
    assert "multiplier_max" in (tmp_path / "branch-breather-1600.csv").read_text().splitlines()[0]


@pytest.mark.slow
def test_where_slepc_fails_the_branch_goes_on_without_multipliers(tmp_path, monkeypatch, caplog):
    def fails(*_):
        raise PETSc.Error(73)

    def runs_out(*_):
        raise PETSc.Error(55)

    monkeypatch.setattr(floquet, "_krylov_basis", fails)
    with caplog.at_level(logging.WARNING):
        (branch,) = follow_all(case(multipliers=2), tmp_path, MPI.COMM_SELF)
    assert branch.ending.startswith("2 points reached") and len(branch.points) == 3
    assert np.isnan([p.multiplier for p in branch.points]).all()
    assert caplog.text.count("has no multipliers: SLEPc") == 3
    monkeypatch.setattr(floquet, "_krylov_basis", runs_out)
    with pytest.raises(PETSc.Error):  # maybe of one rank alone, which others wait for
        follow_all(case(multipliers=2), tmp_path, MPI.COMM_SELF)


def test_multipliers_of_the_whole_of_a_long_lattice_are_refused():
    table = case(**CONDENSED).model_dump(by_alias=True, exclude_none=True)
    table["lattice"] |= {"cells": 10_001}
    NnmCase.from_table(table)
    table["nnm"] |= {"multipliers": 2}
    with pytest.raises(CaseError, match=r"nnm\.multipliers.*multiplier_max needs the sites alone"):
        NnmCase.from_table(table)
