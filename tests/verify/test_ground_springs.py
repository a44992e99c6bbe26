"""Springs to the ground and negative springs in both engines, against DOP853 on equations written from the case."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from vipetsc.case import Case
from vipetsc.case.section import CaseError
from vipetsc.dynamics import simulate

NEXT = {"start": 1, "end": 1, "stiffness": 900.0, "next_cell": True}
INSIDE = {"start": 1, "end": 2, "stiffness": 400.0}
GROUND = {"start": 0, "end": 2, "stiffness": 250.0}
NEGATIVE = {"start": 0, "end": 1, "stiffness": -60.0}
CUBIC = GROUND | {"quadratic": 3e3, "cubic": 4e6}
DAMPED = GROUND | {"damping": 0.3}
CELLS = 5


def table(springs, engine="ts", ends="fixed", **lattice):
    """Five cells of two masses, whose first mass is driven in the middle; there are no contacts."""
    return {
        "lattice": {"cells": CELLS, "ends": ends, "cell": {"masses": [0.1, 0.05], "springs": springs}} | lattice,
        "contacts": {"sites": []},
        "drive": {"amplitude": 1.5, "cycles": 3, "frequency": 60.0, "cell": 3},
        "time": {"end": 0.6, "engine": engine, "rtol": 1e-11},
    }


def acceleration(springs, ends, masses, u, v):
    """Accelerations (cell, mass) by the ``springs`` of a case, spring by spring; a wall and the ground do not move."""
    force = np.zeros((CELLS, 2))
    for spring in springs:
        start, end, ahead = spring["start"] - 1, spring["end"] - 1, spring.get("next_cell", False)
        for cell in range(-1 if ahead else 0, CELLS):
            here = (cell, start) if cell >= 0 and start >= 0 else None
            there = (cell + ahead, end) if cell + ahead < CELLS else None
            if ends == "periodic" and cell < 0:
                continue
            if ends == "periodic" and there is None:
                there = (0, end)
            if ends == "free" and ahead and (here is None or there is None):
                continue
            z = (u[there] if there else 0.0) - (u[here] if here else 0.0)
            rate = (v[there] if there else 0.0) - (v[here] if here else 0.0)
            pull = spring["stiffness"] * z + spring.get("quadratic", 0) * z**2 + spring.get("cubic", 0) * z**3
            pull += spring.get("damping", 0) * rate
            if here:
                force[here] += pull
            if there:
                force[there] -= pull
    return force / masses


@pytest.mark.parametrize("engine", ["ts", "propagator"])
@pytest.mark.parametrize(
    "springs, ends",
    [
        ([NEXT, INSIDE, GROUND], "fixed"),
        ([NEXT, INSIDE, GROUND], "free"),
        ([NEXT, INSIDE, DAMPED, NEGATIVE], "periodic"),
        ([NEXT, INSIDE, CUBIC], "fixed"),
        ([NEXT, INSIDE, CUBIC | {"damping": 0.2}, NEGATIVE], "free"),
    ],
)
def test_runs_agree_with_dop853(engine, springs, ends):
    """Compares displacements, and the energies of springs with those of the elongations."""
    case = Case.from_table(table(springs, engine, ends))
    run = simulate(case).dataset
    masses = np.array([0.1, 0.05])
    drive = case.model().drives[0].waveform

    def rate(t, y):
        u, v = y.reshape(2, CELLS, 2)
        a = acceleration(springs, ends, masses, u, v)
        a[2, 0] += drive.force(t) / 0.1
        return np.concatenate([v.ravel(), a.ravel()])

    times = run["time"].values
    exact = solve_ivp(rate, (0, times[-1]), np.zeros(4 * CELLS), "DOP853", times, rtol=1e-11, atol=1e-14)
    u = run["displacement"].values
    np.testing.assert_allclose(u.reshape(len(times), -1), exact.y[: 2 * CELLS].T, atol=2e-7 * np.abs(u).max())

    # Kinetic and spring energies and losses sum to the work.
    names = ("kinetic", "spring", "dissipated_by_damping")
    total = sum(run[f"energy/{name}"].values for name in names if f"energy/{name}" in run)
    np.testing.assert_allclose(total, run["energy/work"].values, atol=1e-6 * total.max())


CUT = [
    {"start": 2, "end": 1, "stiffness": 1000.0, "next_cell": True},
    INSIDE | {"stiffness": 10.0},
    {"start": 0, "end": 1, "stiffness": -50.0},
    {"start": 0, "end": 2, "stiffness": 100.0},
]


@pytest.mark.parametrize(
    "springs, lattice, key",
    [
        ([NEXT, INSIDE | {"stiffness": -400.0}], {}, r"springs\[2\]\.stiffness"),
        ([NEXT, INSIDE, NEGATIVE | {"stiffness": -5.0}], {}, r"springs\[3\]\.stiffness"),
        ([NEXT, INSIDE, GROUND | {"damping": -0.1}], {}, r"springs\[3\]\.damping"),
        ([NEXT, INSIDE, GROUND | {"stiffness": 0.0}], {}, r"springs\[3\]\.stiffness"),
        ([NEXT, INSIDE, GROUND | {"next_cell": True}], {}, r"springs\[3\]\.next_cell"),
        ([NEXT, INSIDE, {"start": 2, "end": 0, "stiffness": 3.0}], {}, r"springs\[3\]"),
        # Stable in a lattice with walls, but not where a spring to the next cell is cut.
        (CUT, {}, None),
        (CUT, {"ends": "free"}, r"springs\[3\]\.stiffness"),
        (
            [NEXT, INSIDE, GROUND, NEGATIVE],
            {"profiles": {"springs[1].stiffness": {"cells": [2], "value": 5.0}}},
            "profiles",
        ),
    ],
)
def test_unstable_springs_are_refused(springs, lattice, key):
    """Names the spring or the key."""
    if key is None:
        Case.from_table(table(springs, **lattice))
        return
    with pytest.raises(CaseError, match=key):
        Case.from_table(table(springs, **lattice))
