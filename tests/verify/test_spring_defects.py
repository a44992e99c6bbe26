"""Nonlinear springs in single cells: motion against SciPy, energy, and agreement with lattices of equal cells."""

from __future__ import annotations

import re
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import run_of
from vipetsc.case import Case, NnmCase
from vipetsc.dynamics import simulate
from vipetsc.io.store import RunMemory
from vipetsc.lattice import linear_modes, nonlinear_springs, spring_laws
from vipetsc.modes.system import System

pytestmark = pytest.mark.parallel(1)

CELLS = 12
MASSES = (4e-3, 2e-3)
STIFFNESS = (1e4, 5e3)
# Quadratic and cubic coefficients by the spring's cell and number: one in a cell, one between cells, one to a wall.
TERMS = {(6, 2): (3e6, 4e9), (9, 1): (-2e6, 1e10), (CELLS, 1): (2e6, 5e9)}
SPRINGS = [
    {"start": 1, "end": 1, "stiffness": STIFFNESS[0], "next_cell": True},
    {"start": 1, "end": 2, "stiffness": STIFFNESS[1]},
]
TABLE: dict[str, Any] = {
    "name": "defects",
    "lattice": {
        "cells": CELLS,
        "cell": {"masses": list(MASSES), "springs": SPRINGS},
        "profiles": {
            "springs[2].quadratic": {"cells": [6], "value": 3e6},
            "springs[2].cubic": {"cells": [6], "value": 4e9},
            "springs[1].quadratic": [0.0] * 8 + [-2e6, 0.0, 0.0, 2e6],
            "springs[1].cubic": [0.0] * 8 + [1e10, 0.0, 0.0, 5e9],
        },
    },
    "contacts": {"sites": []},
    "drive": {"amplitude": 0.0},
    # The struck cell is near two of the three springs; the waves reach the third, at the wall, within the run.
    "initial": {"kind": "velocity", "cell": 7, "velocity": 3.0},
    # Tolerances are far below those of the comparisons, which therefore measure the equations and not the steps.
    "time": {"end": 0.02, "sample_interval": 2e-4, "engine": "ts", "rtol": 1e-12, "atol": 1e-14},
    "output": {"figures": False, "points": [{"name": "near", "cell": 6, "mass": 2}, {"name": "last", "cell": CELLS}]},
}
RING: dict[str, Any] = {"ends": "periodic", "profiles": None}


def changed(*, lattice: dict[str, Any] | None = None, **sections: Any) -> Case:
    """The case of ``TABLE`` with replaced ``sections`` and keys of its ``lattice``, in which None removes a key."""
    merged = {key: value for key, value in (TABLE["lattice"] | (lattice or {})).items() if value is not None}
    return Case.from_table(TABLE | sections | {"lattice": merged})


def forces_and_energy(u: np.ndarray) -> tuple[np.ndarray, float]:
    """Forces (mass,) in N of all springs and their energy in J at displacements ``u`` (mass,) in m, between two walls.

    A spring with the elongation z pulls with k z + q z^2 + c z^3.
    """
    forces = np.zeros(len(u))
    energy = 0.0
    for cell in range(CELLS + 1):
        # Cell 0 is the left wall, whose only spring is the one to the first cell.
        springs = [(1, 2 * cell - 2, 2 * cell)]
        if cell:
            springs.append((2, 2 * cell - 2, 2 * cell - 1))
        for number, start, end in springs:
            q, c = TERMS.get((cell, number), (0.0, 0.0))
            k = STIFFNESS[number - 1]
            # Walls do not move.
            z = (u[end] if end < len(u) else 0.0) - (u[start] if start >= 0 else 0.0)
            pull = k * z + q * z**2 + c * z**3
            energy += k * z**2 / 2 + q * z**3 / 3 + c * z**4 / 4
            if start >= 0:
                forces[start] += pull
            if end < len(u):
                forces[end] -= pull
    return forces, energy


@pytest.mark.parametrize("term", ["quadratic", "cubic"])
def test_equal_lists_are_the_lattice_of_equal_cells(term):
    """Equal coefficients in a list give the bits of equal cells, and zeros in all cells but one those of one spring."""
    values = {"quadratic": 2e6, "cubic": 4e9}
    springs = [spring | {term: values[term]} for spring in SPRINGS]
    lists = {f"springs[{number}].{term}": [values[term]] * CELLS for number in (1, 2)}
    few = {f"springs[{number}].{term}": {"cells": [9], "value": values[term]} for number in (1, 2)}
    others = [cell for cell in range(1, CELLS + 1) if cell != 9]
    zeros = {f"springs[{number}].{term}": {"cells": others, "value": 0.0} for number in (1, 2)}
    cell = {"masses": list(MASSES), "springs": springs}

    # The lattice is a ring. With walls a list has the spring to the right wall only, and a cell those to both walls.
    equal = [run_of(changed(lattice=RING | lattice)) for lattice in ({"cell": cell}, {"profiles": lists})]
    alone = [
        run_of(changed(lattice=RING | lattice)) for lattice in ({"cell": cell, "profiles": zeros}, {"profiles": few})
    ]
    for first, second in (equal, alone):
        for name in ("displacement", "velocity", "energy/kinetic", "energy/spring"):
            assert first[name].values.tobytes() == second[name].values.tobytes()
    # The terms have an effect: the two lattices differ.
    assert not np.array_equal(equal[0]["displacement"], alone[0]["displacement"])


def test_places_are_those_of_the_profile():
    chain = changed().model().chain
    springs = nonlinear_springs(chain)
    assert [*zip(springs.cell + 1, springs.number + 1, strict=True)] == sorted(TERMS)
    assert [(law.quadratic, law.cubic) for law in spring_laws(chain)] == [TERMS[key] for key in sorted(TERMS)]
    assert springs.mass_pairs() == [(10, 11), (16, 18), (22, -1)]
    assert not chain.is_linear
    # With quadratic terms the force is not an odd function.
    assert not chain.is_odd


def test_what_is_linear_is_that_of_equal_cells():
    """Modes and the mean cell of a lattice with nonlinear springs are those of its linear parts."""
    chain = changed().model().chain
    plain = changed(lattice={"profiles": None}).model().chain
    assert chain.linearised() == plain
    assert plain.is_linear and plain.linearised() is plain
    # Lattices with equal linear parts share one object of modes.
    assert linear_modes(chain) is linear_modes(plain)
    assert chain.mean_cell(0, CELLS) == plain.cell
    assert np.flatnonzero(chain.differs).tolist() == [5, 8, CELLS - 1]


def test_the_system_of_normal_modes_has_the_springs():
    """The forces and the energy of the system for normal modes are those of all springs."""
    nnm = {"system": "chain", "modes": [1], "energy": [0.0, 1.0]}
    table = {key: TABLE[key] for key in ("name", "lattice", "contacts")}
    system = System.from_case(NnmCase.from_table(table | {"nnm": nnm}))
    u = 1e-3 * np.random.default_rng(1).standard_normal(2 * CELLS)
    forces, energy = forces_and_energy(u)
    # The system's forces stand on the left side of the equations of motion.
    np.testing.assert_allclose(system.forces(u), -forces, rtol=1e-10, atol=1e-10 * np.abs(forces).max())
    assert system.energy(u, 0 * u) == pytest.approx(energy, rel=1e-12)
    assert not system.odd


@pytest.mark.parametrize(
    ("cell", "number", "name", "initial"),
    [
        (6, 2, "quadratic", 7),
        (9, 1, "cubic", 9),
        # A motion towards the right wall compresses the spring to it, on the side where its force falls off.
        (CELLS, 1, "quadratic", CELLS),
    ],
)
def test_a_run_that_tears_a_spring_off_names_it(cell, number, name, initial):
    """A run stops and names the spring when a softening one passes z = -k/q, or |z| = (k/|c|)^(1/2) for a cubic one.

    Beyond that elongation the spring's force has the wrong sign and drives its masses apart for ever.
    """
    k = STIFFNESS[number - 1]
    value = {"quadratic": -1e4 * k, "cubic": -1e8 * k}[name]
    if initial == CELLS:
        value = -value
    profile = {f"springs[{number}].{name}": {"cells": [cell], "value": value}}
    case = changed(
        lattice={"profiles": profile},
        initial={"kind": "velocity", "cell": initial, "velocity": 10.0},
        time={"end": 0.02, "sample_interval": 2e-4, "engine": "ts"},
    )

    result = simulate(case, RunMemory(MPI.COMM_SELF))

    assert not result.complete
    # Both limits are 1e-4 m here.
    assert f"(cell {cell}; its spring {number} no longer pulls back" in result.sentence
    assert re.search(r"elongation of -?0\.0001 m", result.sentence)
