"""Hill's method on condensed unknowns: multipliers against Floquet's, from the whole lattice's motion."""

from __future__ import annotations

import logging

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.unit.test_floquet import case
from tests.verify.test_nfrc import case as forced
from tests.verify.test_nfrc import start_of
from vipetsc.case import CaseError, NnmCase
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.lattice import floquet
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state

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


def one_period(of, omega, force, state, start):
    """Displacement and velocity after a period from the phase ``start``: contacts dissipate, one at a time."""
    model, contact = of.model(), of.contact(0.7)
    chain, site, d = model.chain, model.chain.sites[0], model.chain.clearances[0]
    stiffness, masses, n = chain.stiffness_matrix().toarray(), chain.masses(), chain.cells * chain.cell.dofs
    pair = np.zeros(n)
    pair[[site * chain.cell.dofs + chain.cell.resonator, site * chain.cell.dofs + chain.cell.host]] = 1, -1
    drive = np.eye(n)[model.drive_cell * chain.cell.dofs + model.drive_mass] * force
    side, approach, t, y = 0.0, 1.0, start / omega, state
    end = t + 2 * np.pi / omega

    def rate(t, y):
        f = -stiffness @ y[:n] + drive * np.cos(omega * t)
        if side:
            f -= pair * contact.force(side * max(side * pair @ y[:n], d), d, pair @ y[n:], approach)
        return np.concatenate([y[n:], f / masses])

    def change(t, y):
        return (side * (pair @ y[:n]) - d) if side else abs(pair @ y[:n]) - d

    while t < end:
        change.terminal, change.direction = True, -1 if side else 1
        done = solve_ivp(rate, (t, end), y, "DOP853", events=change, rtol=1e-11, atol=1e-14, max_step=2e-4)
        t, y = done.t[-1], done.y[:, -1]
        side, approach = (0.0 if side else float(np.sign(pair @ y[:n]))), pair @ y[n:]
    return y


@pytest.mark.slow
def test_multipliers_of_a_dissipative_state_are_those_of_its_period_map():
    """r = .7, two cells under a force: the map's derivative by differences."""
    omega, force = 1700.0, 19.5
    of = forced({"cells": 2}, {"sites": [1], "restitution": 0.7}, source="force", infinite=False, harmonics=61,
                range=[force, 20.0], fixed=[omega], largest_step=0.5)  # fmt: skip
    states = SteadyStates(of, 0.7, omega)
    xi = first_state(states).xi
    measures, z = states.measured(xi), states.balance.unpack(xi[:-1] * states.clearance)[0]
    phases = np.linspace(0, np.pi, 2001)
    w = (z * np.exp(1j * np.arange(len(z)) * phases[:, None])).sum(axis=1).real
    phase = phases[np.argmin(np.abs(w))]  # open
    start = np.concatenate([part.ravel() for part in start_of(states, xi, np.arange(2), phase)])
    scale = 1e-5 * states.clearance * np.repeat([1, omega], 8)
    assert np.abs((one_period(of, omega, force, start, phase) - start) / scale).max() < 0.1
    ends = [[one_period(of, omega, force, start + s * e, phase) for s in (1, -1)] for e in np.diag(scale)]
    derivative = np.array([(after - before) / 2 / step for (after, before), step in zip(ends, scale, strict=True)]).T
    largest = np.abs(np.linalg.eigvals(derivative)).max()
    assert largest > 1.2
    assert np.exp(2 * np.pi * measures.growth) == pytest.approx(largest, rel=1e-4)


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
