"""Struck masses move as theory says, in both engines, and such runs have measures."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import eigh

from tests.conftest import simulated
from vipetsc.case import Case
from vipetsc.studies.analysis import analyse

pytestmark = pytest.mark.parallel(1)


@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_a_struck_chain_moves_as_its_modes(engine):
    """A struck lattice without contacts moves as the sum of its modes, phi_j (phi_j^T M v0) sin(w_j t)/w_j."""
    springs = [
        {"start": 1, "end": 1, "stiffness": 2.0e4, "next_cell": True},
        {"start": 1, "end": 2, "stiffness": 6.0e3},
    ]
    case = Case(
        lattice={"cells": 12, "cell": {"masses": [0.01, 0.004], "springs": springs}},
        initial={
            "kind": "velocity", "cell": 2, "velocity": 1.0, "more": [{"cell": 12, "mass": 2, "velocity": -0.3}]
        },
        time={"end": 0.02, "engine": engine, "rtol": 1e-12},
    )  # fmt: skip
    data, _ = simulated(case)

    chain = case.model().chain
    masses = chain.masses()
    squares, shapes = eigh(chain.stiffness_matrix().toarray(), np.diag(masses))
    omega = np.sqrt(squares)
    velocity = np.zeros(24)
    velocity[2] = 1.0
    velocity[23] = -0.3
    parts = shapes.T @ (masses * velocity)
    exact = np.sin(np.outer(data["time"].values, omega)) * (parts / omega) @ shapes.T
    assert data["displacement"].values.reshape(-1, 24) == pytest.approx(exact, abs=1e-9 * np.abs(exact).max())


@pytest.mark.filterwarnings("error")
def test_cells_that_the_motion_has_not_reached_have_no_fractions():
    """Of cells that are at rest in the whole record the energy has no fractions, and no warning says so."""
    case = Case(
        lattice={"cells": 24},
        contacts={"sites": [], "clearance": 1e-5},
        initial={"kind": "velocity", "cell": 1, "velocity": 0.5},
        time={"end": 4e-4, "engine": "propagator"},
        output={"window": [23, 24]},
    )
    data, _ = simulated(case)
    assert not data["velocity"].values.any()
    assert np.isnan(analyse(data)["bands/share"].values).all()
