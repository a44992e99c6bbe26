"""Whole lattices shot without dense matrices, and their largest multipliers, against dense ones."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from vipetsc.case import CaseError
from vipetsc.case.nnm import NnmCase
from vipetsc.lattice import Chain, Contact, contact_stiffness
from vipetsc.lattice.cell import four_band
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.lattice.krylov import LatticeShooting
from vipetsc.modes.shooting.dop853 import Dop853Flow
from vipetsc.modes.shooting.maps import MAPS
from vipetsc.modes.shooting.shooting import Shooting
from vipetsc.modes.shooting.start import linear_start
from vipetsc.modes.system import System

CELLS, SITE = 14, 5
LAW = Contact("hertz", contact_stiffness(1e8, 0.005, 0.3))
CHAIN = Chain(four_band("calibrated"), CELLS, "fixed", (SITE,), (10**-2.75,))


def shooting() -> LatticeShooting:
    system = System.from_chain(CHAIN, LAW, dense=False)
    return LatticeShooting(system, CHAIN, MAPS["quarter"], MPI.COMM_SELF, 1e-12, 10)


@pytest.fixture(scope="module")
def breather():
    problem = shooting()
    return problem, problem.breather(1600.0)


def test_the_breather_is_the_one_of_the_specification(breather):
    """Amplitude and energy of SPEC, sec. 15, and the return after one period."""
    problem, point = breather
    w = problem.system.contact_rows @ point.x
    assert abs(w[0]) / CHAIN.clearances[0] == pytest.approx(1.286, abs=5e-4)
    assert point.energy == pytest.approx(0.0203, abs=5e-5)
    assert (point.residual < 1e-12, point.episodes) == (True, 1)
    start = np.append(point.x, 0 * point.x)
    flow = problem.flow
    end = flow.gather(flow.arc(flow.scatter(start), point.period).end)
    assert np.abs((end - start)[: len(point.x)]).max() < 1e-8 * np.abs(point.x).max()


def test_the_largest_multipliers_are_those_of_the_dense_map(breather):
    from vipetsc.modes.lattice.floquet import largest_multipliers

    problem, point = breather
    flow, n = problem.flow, problem.system.dofs
    half = flow.arc(flow.scatter(np.append(point.x, 0 * point.x)), point.period / 2)
    map_ = flow.gather(half.move(flow.scatter(np.eye(2 * n)))).T
    all_of_them = np.linalg.eigvals(map_) ** 2
    found = largest_multipliers(flow, problem.system, True, point.x, point.period, 4)
    assert len(found) >= 2
    assert found[:, 1].real.max() < 1e-8
    for value in found[:, 0]:
        assert np.abs(all_of_them - value).min() < 1e-7
    assert np.abs(found[0, 0]) == pytest.approx(np.abs(all_of_them).max(), rel=1e-8)
    assert np.abs(found[0, 0]) > 1.3


def test_the_product_is_the_derivative(breather):
    problem, point = breather
    frame = problem.frame(point)
    change = np.random.default_rng(4).standard_normal(len(point.x) + 1)
    product = frame.product(frame.xi, change)
    later, earlier = (frame.residual(frame.xi + sign * 1e-6 * change) for sign in (1, -1))
    np.testing.assert_allclose(product, (later - earlier) / 2e-6, atol=1e-6 * np.abs(product).max())


def test_a_linear_mode_is_continued_as_by_the_dense_method():
    problem = shooting()
    dense = Shooting(Dop853Flow(System.from_chain(CHAIN, LAW)), MAPS["quarter"])
    ours, theirs = (linear_start(p, 3, 1e-6) for p in (problem, dense))
    assert ours.period == pytest.approx(theirs.period, rel=1e-12)
    np.testing.assert_allclose(ours.x, theirs.x, atol=1e-11 * np.abs(theirs.x).max())


def case(**nnm) -> NnmCase:
    table = {
        "name": "cells",
        "lattice": {"preset": "four-band", "reading": "calibrated", "cells": CELLS},
        "contacts": {"law": "hertz", "sites": [SITE + 1], "clearance": 10**-2.75},
        "nnm": {"system": "chain", "start_frequency": [1600.0], "tolerance": 1e-12, "points": 2} | nnm,
    }
    return NnmCase.from_table(table)


@pytest.mark.slow
def test_a_branch_is_stored_with_its_multipliers_and_gone_on_with(tmp_path):
    short, whole = tmp_path / "short", tmp_path / "whole"
    for folder in (short, whole):
        folder.mkdir()
    (branch,) = follow_all(case(multipliers=2), short, MPI.COMM_SELF)
    assert branch.name == "breather-1600"
    assert branch.ending.startswith("2 points reached")
    stored = read_branch(short / "branch-breather-1600.h5")
    assert [p.multiplier for p in stored.points] == [p.multiplier for p in branch.points]
    np.testing.assert_array_equal(stored.points[0].multipliers, branch.points[0].multipliers)
    assert min(p.multiplier for p in stored.points) > 1.3
    (resumed,) = follow_all(case(multipliers=2, points=3), short, MPI.COMM_SELF, resume=True)
    (once,) = follow_all(case(multipliers=2, points=3), whole, MPI.COMM_SELF)
    assert [p.energy for p in resumed.points] == [p.energy for p in once.points]
    assert np.all(np.diff([p.energy for p in once.points]) > 0)


def test_what_has_no_breather_says_so_and_keeps_what_there_is(tmp_path):
    (branch,) = follow_all(case(start_frequency=[700.0], max_newton=2), tmp_path, MPI.COMM_SELF)
    assert branch.ending.startswith("failed: no ")
    assert "nnm.start_frequency" in branch.ending


@pytest.mark.parametrize(
    ("nnm", "message"),
    [
        ({"shooting": "dense"}, "needs nnm.shooting"),
        ({"compare": ["newmark"]}, "needs dense matrices"),
        ({"system": "reduced", "start_frequency": [], "multipliers": 3}, 'is for "chain"'),
        ({"shooting": "newton"}, "nnm.shooting"),
    ],
)
def test_options_that_do_not_go_together_are_refused(nnm, message):
    with pytest.raises(CaseError, match=message):
        case(**nnm)
