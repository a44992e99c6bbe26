"""Springs with quadratic and cubic parts: against another integrator, closed forms, the engine that refuses them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import brentq

from tests.conftest import run_of, simulated
from vipetsc.case import Case, CaseError, LawCase
from vipetsc.lattice import Chain

CELL = {
    "masses": [0.01, 0.02],
    "springs": [
        {"start": 1, "end": 1, "stiffness": 4e3, "next_cell": True, "cubic": 3e9, "quadratic": -2e6},
        {"start": 1, "end": 2, "stiffness": 2e3, "cubic": 4e8, "quadratic": 5e5},
    ],
    "contact": [1, 2],
}


def case_of(cells: int, ends: str = "fixed", springs: Any = None, **sections: Any) -> Case:
    """A chain of ``cells`` without contacts, from rest under a burst unless ``sections`` say otherwise."""
    cell = CELL | ({"springs": springs} if springs else {})
    table = {
        "lattice": {"cell": cell, "cells": cells, "ends": ends},
        "contacts": {"sites": []},
        "drive": {"amplitude": 2.0, "cycles": 3, "frequency": 500.0},
        "time": {"end": 0.06, "engine": "auto", "sample_interval": 2e-4, "rtol": 1e-12},
    }
    return Case.from_table(table | sections)


def spring_ends(chain: Chain, ends: str):
    """Each spring with the two DoFs that it joins, where None is a wall."""
    n = chain.cells * chain.cell.dofs
    for spring in chain.cell.springs:
        for cell in range(-1, chain.cells):
            start = chain.cell.dofs * cell + spring.start
            end = chain.cell.dofs * (cell + spring.next_cell) + spring.end
            if not spring.next_cell:
                if cell >= 0:
                    yield spring, start, end
            elif ends == "periodic":
                if cell >= 0:
                    yield spring, start, end % n
            elif start >= 0 and end < n:
                yield spring, start, end
            elif ends == "fixed":
                # The first and the last spring between cells hold to a wall.
                yield spring, start if start >= 0 else None, end if end < n else None


@pytest.mark.slow
@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
def test_against_another_integrator(ends):
    """Displacements are those of SciPy's DOP853 with forces a z^2 + b z^3 in the springs; the engine is the stepper."""
    case = case_of(3, ends)
    chain = case.model().chain
    drive = case.model().drive
    k = chain.stiffness_matrix().toarray()
    masses = chain.masses()
    n = len(masses)
    springs = list(spring_ends(chain, ends))

    def rate(t, y):
        u = y[:n]
        force = -k @ u
        force[0] += float(drive.force(t))
        for spring, start, end in springs:
            elongation = (0.0 if end is None else u[end]) - (0.0 if start is None else u[start])
            tension = spring.quadratic * elongation**2 + spring.cubic * elongation**3
            if start is not None:
                force[start] += tension
            if end is not None:
                force[end] -= tension
        return np.concatenate([y[n:], force / masses])

    data, result = simulated(case)
    assert result.statistics["engine"] == "ts"
    assert "quadratic or cubic" in result.statistics["engine_note"]
    assert result.statistics["ledger_error"] < 1e-9

    # The end of the burst is a kink, which no step may cross.
    time = data["time"].values
    kink = drive.duration
    tight = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-18}
    first = solve_ivp(rate, (0, kink), np.zeros(2 * n), t_eval=np.append(time[time < kink], kink), **tight)
    last = solve_ivp(rate, (kink, time[-1]), first.y[:, -1], t_eval=time[time >= kink], **tight)
    expected = np.concatenate([first.y[:n, :-1], last.y[:n]], axis=1).T
    u = data["displacement"].values.reshape(len(time), -1)
    assert np.abs(u - expected).max() < 1e-8 * np.abs(expected).max()

    # The nonlinear parts do much in this run.
    plain = [spring | {"cubic": 0.0, "quadratic": 0.0} for spring in CELL["springs"]]
    linear = run_of(case_of(3, ends, plain))["displacement"].values.reshape(len(time), -1)
    assert np.abs(u - linear).max() > 0.1 * np.abs(expected).max()


def test_the_frequency_depends_on_the_amplitude_as_the_closed_form():
    """Two equal cells of a ring in opposite motion are one oscillator, whose period is an elliptic integral."""
    springs = [CELL["springs"][0] | {"quadratic": 0.0}, {"start": 1, "end": 2, "stiffness": 1e-7}]
    case = case_of(
        2,
        "periodic",
        springs,
        initial={"kind": "mode", "number": 4, "amplitude": 1e-3},
        drive={"amplitude": 0.0},
        time={"end": 0.02, "sample_interval": 1e-5, "rtol": 1e-12},
    )
    data = run_of(case)
    time = data["time"].values
    u = data["displacement"].values[:, 0, 0]
    v = data["velocity"].values[:, 0, 0]

    # m u'' = -2 k_s (2 u) - 2 c_s (2 u)^3; with u = a sin(x) the period is a smooth integral.
    a = abs(u[0])
    k = 8 * springs[0]["stiffness"] / 2
    c = 16 * springs[0]["cubic"]
    m = CELL["masses"][0]
    quarter, _ = quad(lambda x: np.sqrt(m / (k + c * a**2 / 2 * (1 + np.sin(x) ** 2))), 0, np.pi / 2)
    period = 4 * quarter
    assert period < 0.8 * 2 * np.pi * np.sqrt(m / k)

    # Zeros between samples, by the cubic that has the values and the rates of both.
    spline = CubicHermiteSpline(time, u, v)
    downwards = np.flatnonzero((u[:-1] * u[0] > 0) & (u[1:] * u[0] <= 0))
    zeros = [brentq(spline, time[number], time[number + 1], xtol=1e-16) for number in downwards]
    assert np.diff(zeros).mean() == pytest.approx(period, rel=1e-8)


def test_a_scattering_law_refuses_springs_that_are_not_linear():
    with pytest.raises(CaseError, match=r"lattice\.cell\.springs: waves in springs that are not linear"):
        LawCase.from_table({"lattice": {"cell": CELL}, "law": {}, "drive": {"frequency": 500.0}})
