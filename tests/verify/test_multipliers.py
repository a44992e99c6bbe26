"""Orbits of whole lattices, shot without dense matrices, and their largest multipliers by Floquet and by Hill."""

from __future__ import annotations

import logging
from dataclasses import replace

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest

from tests.breathers import BREATHER_FREQUENCY, breather_case, breather_chain
from tests.models import CLEARANCE, four_band_contact
from vipetsc.case import NnmCase
from vipetsc.modes.balance.stops import Stops
from vipetsc.modes.branches import condensed
from vipetsc.modes.branches.condensed import CondensedMethod
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.flow import MAPS, Dop853Flow
from vipetsc.modes.lattice import floquet
from vipetsc.modes.lattice.floquet import largest_multipliers
from vipetsc.modes.lattice.krylov import LatticeShooting
from vipetsc.modes.problem import ContinuationError
from vipetsc.modes.shooting import Shooting, linear_start
from vipetsc.modes.system import System

STOPS = [Stops.both(four_band_contact(), CLEARANCE)]


def lattice_shooting() -> LatticeShooting:
    """The shooting problem of a lattice with one contact site, by quarter periods and without dense matrices."""
    chain = breather_chain()
    system = System.from_chain(chain, STOPS, dense=False)
    return LatticeShooting(system, chain, MAPS["quarter"], MPI.COMM_SELF, tolerance=1e-12, max_newton=10)


@pytest.fixture(scope="module")
def breather():
    """The shooting problem and its breather at 1600 rad/s."""
    problem = lattice_shooting()
    return problem, problem.breather(BREATHER_FREQUENCY)


def test_the_breather_is_the_one_that_few_harmonics_give(breather):
    """Amplitude and energy are those of an earlier computation with 8 to 16 harmonics; the motion is periodic."""
    problem, point = breather
    w = problem.system.contact_rows @ point.x
    assert abs(w[0]) / CLEARANCE == pytest.approx(1.286, abs=5e-4)
    assert point.energy == pytest.approx(0.0203, abs=5e-5)
    assert point.residual < 1e-12
    assert point.episodes == 1

    start = np.append(point.x, 0 * point.x)
    flow = problem.flow
    end = flow.gather(flow.arc(flow.scatter(start), point.period).end)
    assert np.abs((end - start)[: len(point.x)]).max() < 1e-8 * np.abs(point.x).max()


def test_the_largest_multipliers_are_those_of_the_dense_map(breather):
    """The largest multipliers, found without matrices, are eigenvalues of the dense map of a period."""
    problem, point = breather
    flow = problem.flow
    # By symmetry both halves of the period have the same map, whose square is that of the period.
    half = flow.arc(flow.scatter(np.append(point.x, 0 * point.x)), point.period / 2)
    map_ = flow.gather(half.move(flow.scatter(np.eye(2 * problem.system.dofs)))).T
    dense = np.linalg.eigvals(map_) ** 2

    found = largest_multipliers(flow, problem.system, odd=True, u=point.x, period=point.period, wanted=4)

    assert len(found) >= 2
    assert found[:, 1].real.max() < 1e-8
    for value in found[:, 0]:
        assert np.abs(dense - value).min() < 1e-7
    largest = np.abs(found[0, 0])
    assert largest == pytest.approx(np.abs(dense).max(), rel=1e-8)
    # The breather is unstable; all multipliers of a stable one would have the modulus 1.
    assert largest > 1.3


def test_the_product_is_the_derivative_of_the_residual(breather):
    """The product of the Jacobian with a vector is the central difference of the residual along that vector."""
    problem, point = breather
    frame = problem.frame(point)
    change = np.random.default_rng(4).standard_normal(len(point.x) + 1)
    product = frame.product(frame.xi, change)
    ahead = frame.residual(frame.xi + 1e-6 * change)
    behind = frame.residual(frame.xi - 1e-6 * change)
    np.testing.assert_allclose(product, (ahead - behind) / 2e-6, atol=1e-6 * np.abs(product).max())


def test_a_tangent_that_gmres_does_not_find_is_none(breather):
    """A point whose null vector GMRES has not found has no tangent: a step to it fails, and no branch begins there."""
    problem, point = breather
    frame = problem.frame(replace(point, tangent=problem.first_tangent(point, 1)))
    before = frame.tangent_at(frame.xi)
    ksp = problem.newton._snes.getKSP()
    _, _, _, products = ksp.getTolerances()
    try:
        ksp.setTolerances(max_it=2)
        with pytest.raises(np.linalg.LinAlgError, match="GMRES ends with a residual of"):
            frame.tangent_at(frame.xi)
        with pytest.raises(ContinuationError, match="no unique tangent: GMRES"):
            problem.first_tangent(point, 1)
    finally:
        ksp.setTolerances(max_it=products)
    assert frame.tangent_at(frame.xi).tolist() == before.tolist()


def test_a_linear_mode_is_continued_as_by_the_dense_method():
    """The first orbit on a linear mode is that of shooting with dense matrices."""
    dense = Shooting(Dop853Flow(System.from_chain(breather_chain(), STOPS)), MAPS["quarter"])
    point = linear_start(lattice_shooting(), 3, 1e-6)
    expected = linear_start(dense, 3, 1e-6)
    assert point.period == pytest.approx(expected.period, rel=1e-12)
    np.testing.assert_allclose(point.x, expected.x, atol=1e-11 * np.abs(expected.x).max())


@pytest.mark.slow
def test_a_branch_is_stored_with_its_multipliers_and_resumed(tmp_path):
    short = tmp_path / "short"
    whole = tmp_path / "whole"
    short.mkdir()
    whole.mkdir()
    (branch,) = follow_all(breather_case(multipliers=2), short, MPI.COMM_SELF)
    assert branch.name == "breather-1600"
    assert branch.ended.sentence.startswith("2 points reached")

    stored = read_branch(short / "branch-breather-1600.h5")
    assert [point.multiplier for point in stored.points] == [point.multiplier for point in branch.points]
    np.testing.assert_array_equal(stored.points[0].multipliers, branch.points[0].multipliers)
    assert min(point.multiplier for point in stored.points) > 1.3

    longer = breather_case(multipliers=2, points=3)
    (resumed,) = follow_all(longer, short, MPI.COMM_SELF, resume=True)
    (once,) = follow_all(longer, whole, MPI.COMM_SELF)
    energies = [point.energy for point in once.points]
    assert [point.energy for point in resumed.points] == energies
    assert np.all(np.diff(energies) > 0)


def test_a_frequency_without_breather_fails_and_names_the_key(tmp_path):
    # Newton's method does not converge at this frequency, which lies in a pass band.
    case = breather_case(start_frequency=[700.0], max_newton=2)
    (branch,) = follow_all(case, tmp_path, MPI.COMM_SELF)
    assert branch.ended.sentence.startswith("failed: no ")
    assert "nnm.start_frequency" in branch.ended.sentence


@pytest.mark.slow
def test_hills_multipliers_of_a_breather_are_those_of_floquet(tmp_path):
    """The largest multiplier by Hill's method is complex and agrees to 1e-6 with that of the whole lattice's motion.

    The harmonics that are left out change it by 1e-7, and the unknowns that Hill's method eliminates by less than 1e-6.
    The 14 cells have further pairs of modulus 1.05 and less, near the unit circle. Zeros and poles of Hill's
    determinant are only 0.01 of a strip's width apart there.
    """
    case = breather_case(system="condensed", points=1, truncation=1e-7, multipliers=2)
    (branch,) = follow_all(case, tmp_path, MPI.COMM_SELF)
    stored = read_branch(tmp_path / "branch-breather-1600.h5")
    for point, other in zip(stored.points, branch.points, strict=True):
        assert np.array_equal(point.multipliers, other.multipliers)
        assert abs(point.multipliers[0, 0].imag) > 0.1
        largest = np.abs(point.multipliers[:, 0]).max()
        assert largest > 1.4
        assert point.multiplier == other.multiplier == pytest.approx(largest, rel=1e-6)
    header = (tmp_path / "branch-breather-1600.csv").read_text().splitlines()[0]
    assert "multiplier_max" in header


def raise_petsc_error(number: int):
    """A function that raises the PETSc error ``number`` for any arguments."""

    def raise_error(*arguments):
        raise PETSc.Error(number)

    return raise_error


@pytest.mark.slow
def test_where_slepc_fails_the_branch_continues_without_multipliers(tmp_path, monkeypatch, caplog):
    # PETSc's error 73 is an object in the wrong state, as after a search that has not converged.
    monkeypatch.setattr(floquet, "_krylov_basis", raise_petsc_error(73))
    with caplog.at_level(logging.WARNING):
        (branch,) = follow_all(breather_case(multipliers=2), tmp_path, MPI.COMM_SELF)
    assert branch.ended.sentence.startswith("2 points reached")
    assert len(branch.points) == 3
    assert np.isnan([point.multiplier for point in branch.points]).all()
    assert caplog.text.count("has no multipliers: SLEPc") == 3


@pytest.mark.slow
def test_where_memory_runs_out_the_branch_does_not_continue(tmp_path, monkeypatch):
    # PETSc's error 55 is a lack of memory, perhaps on one rank alone, for which the others would wait.
    monkeypatch.setattr(floquet, "_krylov_basis", raise_petsc_error(55))
    with pytest.raises(PETSc.Error):
        follow_all(breather_case(multipliers=2), tmp_path, MPI.COMM_SELF)


@pytest.mark.parametrize("sites", [[1], [1, -2]])
def test_sensitivities_of_all_masses_and_hills_determinant_agree(monkeypatch, sites):
    """Multipliers by sensitivities of all masses and by Hill's determinant agree, in a lattice of cubic springs.

    A breather of one site is stable, and one of two sites that move against each other is unstable.
    """
    springs = [
        {"start": 1, "end": 1, "stiffness": 1e4, "next_cell": True},
        {"start": 1, "end": 2, "stiffness": 5e3, "cubic": 1e9},
    ]
    table = {
        "lattice": {"cells": 3, "cell": {"masses": [4e-3, 2e-3], "springs": springs}},
        "contacts": {"law": "hertz", "stiffness": 1e7, "sites": [1, 2], "clearance": 1e-4},
        "nnm": {"system": "condensed", "start_frequency": [6000.0], "start_sites": sites, "truncation": 1e-5},
    }
    method = CondensedMethod(NnmCase.from_table(table), MPI.COMM_SELF)
    point = method.start(method.motions, 0)
    assert method.motions.forces.pairs > condensed.MOST_OF_HILL
    by_orbit = method.assess(method.motions, point).multiplier
    monkeypatch.setattr(condensed, "MOST_OF_HILL", method.motions.forces.pairs)
    by_hill = method.assess(method.motions, point).multiplier

    assert (by_orbit > 1.5) == (len(sites) == 2)
    assert by_orbit == pytest.approx(by_hill, rel=1e-6)


def test_a_slow_motion_with_few_harmonics_has_the_multiplier_of_its_orbit():
    """Where harmonics end below the highest mode, which decides nothing by Hill's method, the orbit of all masses does.

    A chain of 25 masses moves in its lowest mode with 15 harmonics, at a sixteenth of the highest frequency.
    """
    masses = 25
    springs = [{"start": i, "end": i + 1, "stiffness": 1.0} for i in range(masses)]
    system = {"masses": [1.0] * masses, "springs": springs, "smooth": [{"start": 0, "end": 1, "cubic": 0.5}]}
    options = {"system": "own", "method": "condensed", "start_energy": 1e-3, "own": system}
    method = CondensedMethod(NnmCase.from_table({"nnm": options}), MPI.COMM_SELF)
    point = method.start(method.motions, 0)
    assert point.order * 2 * np.pi / point.period < method.motions.compliance.highest
    assert method.assess(method.motions, point).multiplier == pytest.approx(1.0, abs=1e-6)
