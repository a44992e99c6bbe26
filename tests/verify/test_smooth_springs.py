"""Springs with quadratic and cubic parts: against another integrator, closed forms, the engine that refuses them."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import brentq

from vipetsc.case import Case, CaseError
from vipetsc.dynamics import simulate
from vipetsc.io.store import RunMemory

CELL = {
    "masses": [0.01, 0.02],
    "springs": [
        {"start": 1, "end": 1, "stiffness": 4e3, "next_cell": True, "cubic": 3e9, "quadratic": -2e6},
        {"start": 1, "end": 2, "stiffness": 2e3, "cubic": 4e8, "quadratic": 5e5},
    ],
    "contact": [1, 2],
}


def case_of(cells: int, ends: str = "fixed", springs: Any = None, **sections: Any) -> Case:
    cell = CELL | ({"springs": springs} if springs else {})
    table = {
        "lattice": {"cell": cell, "cells": cells, "ends": ends},
        "contacts": {"sites": []},
        "drive": {"amplitude": 2.0, "cycles": 3, "frequency": 500.0},
        "time": {"end": 0.06, "engine": "auto", "sample_interval": 2e-4, "rtol": 1e-12},
    }
    return Case.from_table(table | sections)


def run(case: Case):
    memory = RunMemory(MPI.COMM_SELF)
    result = simulate(case, memory)
    assert result.complete, result.sentence
    return memory.dataset, result


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
def test_against_another_integrator(ends):
    case = case_of(3, ends)
    chain, drive = case.model().chain, case.model().drive
    k, masses, n = chain.stiffness_matrix().toarray(), chain.masses(), 6

    def rate(t, y):
        u = y[:n]
        force = -k @ u
        force[0] += float(drive.force(t))
        for spring in chain.cell.springs:
            for c in range(-1, 3):
                a, b = 2 * c + spring.start, 2 * (c + spring.next_cell) + spring.end
                if ends == "periodic" and c >= 0:
                    a, b = a % n, b % n
                inside = [0 <= x < n for x in (a, b)]
                if not any(inside) or (c < 0 and (ends == "periodic" or not spring.next_cell)):
                    continue
                if ends == "free" and not all(inside):
                    continue
                z = (u[b] if inside[1] else 0.0) - (u[a] if inside[0] else 0.0)
                f = spring.quadratic * z**2 + spring.cubic * z**3
                force[a if inside[0] else b] += f if inside[0] else 0.0
                force[b if inside[1] else a] -= f if inside[1] else 0.0
        return np.concatenate([y[n:], force / masses])

    data, result = run(case)
    assert result.statistics["engine"] == "ts"
    assert "quadratic or cubic" in result.statistics["engine_note"]
    time, cut = data["time"].values, drive.duration
    tight = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-18}
    first = solve_ivp(rate, (0, cut), np.zeros(2 * n), t_eval=np.append(time[time < cut], cut), **tight)
    last = solve_ivp(rate, (cut, time[-1]), first.y[:, -1], t_eval=time[time >= cut], **tight)
    u = np.concatenate([first.y[:n, :-1], last.y[:n]], axis=1).T
    assert np.abs(data["displacement"].values.reshape(len(time), -1) - u).max() < 1e-8 * np.abs(u).max()
    plain = [{k: v for k, v in spring.items() if k not in ("cubic", "quadratic")} for spring in CELL["springs"]]
    linear, _ = run(case_of(3, ends, plain))
    assert np.abs(data["displacement"] - linear["displacement"]).max() > 0.1 * np.abs(u).max()
    assert result.statistics["ledger_error"] < 1e-9


def test_the_frequency_depends_on_the_amplitude_as_the_closed_form():
    """Two equal cells of a ring in opposite motion: one oscillator, whose period is an elliptic integral."""
    springs = [CELL["springs"][0] | {"quadratic": 0.0}, {"start": 1, "end": 2, "stiffness": 1e-7}]
    case = case_of(2, "periodic", springs, initial={"kind": "mode", "number": 4, "amplitude": 1e-3},
                   drive={"amplitude": 0.0}, time={"end": 0.02, "sample_interval": 1e-5, "rtol": 1e-12})  # fmt: skip
    data, _ = run(case)
    u, v = (data[name].values[:, 0, 0] for name in ("displacement", "velocity"))
    a, k, c, m = abs(u[0]), 8 * springs[0]["stiffness"] / 2, 16 * springs[0]["cubic"], CELL["masses"][0]
    # m u'' = -2 k_s (2 u) - 2 c_s (2 u)^3; with u = a sin(x) the period is a smooth integral.
    expected = 4 * quad(lambda x: np.sqrt(m / (k + c * a**2 / 2 * (1 + np.sin(x) ** 2))), 0, np.pi / 2)[0]
    time = data["time"].values
    down = np.flatnonzero((u[:-1] * u[0] > 0) & (u[1:] * u[0] <= 0))
    at = [brentq(CubicHermiteSpline(time, u, v), time[j], time[j + 1], xtol=1e-16) for j in down]
    assert np.diff(at).mean() == pytest.approx(expected, rel=1e-8)
    assert expected < 0.8 * 2 * np.pi * np.sqrt(m / k)


def test_verbs_of_linear_springs_say_so():
    from vipetsc.case.law import LawCase

    with pytest.raises(CaseError, match=r"lattice\.cell\.springs.*linear springs"):
        LawCase.from_table({"lattice": {"cell": CELL}, "law": {}, "drive": {"frequency": 500.0}})
