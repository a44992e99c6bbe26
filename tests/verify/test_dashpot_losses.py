"""The energy that dashpots dissipate in exact steps, against SciPy and the other engine."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import simpson

from tests.conftest import simulated, small_case
from tests.independent_lattice import ScipyLattice, Stop

DAMPING = {"mass": 10.0, "stiffness": 1e-5}


@pytest.mark.parametrize("sample_interval", [2e-4, 8e-4])
def test_the_loss_of_a_driven_lattice_with_stops_is_that_of_scipy(sample_interval):
    """The loss is the integral of v^T C v along SciPy's trajectory, with lossless Hertz stops in two adjacent cells."""
    case = small_case(
        lattice={"cells": 10, "damping": DAMPING},
        contacts={"sites": [4, 5], "restitution": 1.0, "clearance": 1e-4},
        time={"end": 0.016, "engine": "propagator", "sample_interval": sample_interval},
    )
    run, result = simulated(case)
    model = case.model()
    chain = model.chain
    d = chain.cell.dofs
    damping = chain.damping_rows(0, 10).toarray()
    stops = tuple(
        Stop(
            resonator=site * d + chain.cell.resonator,
            host=site * d + chain.cell.host,
            gap=1e-4,
            stiffness=model.contact.stiffness,
            exponent=1.5,
            restitution=1.0,
            side=side,
        )
        for site in chain.sites
        for side in (1, -1)
    )

    def force(t: float) -> np.ndarray:
        total = np.zeros(10 * d)
        total[model.drives[0].mass] = float(model.drives[0].waveform.force(t))
        return total

    lattice = ScipyLattice(chain.masses(), chain.stiffness_rows(0, 10).toarray(), damping, stops, force)
    end = float(run["time"][-1])
    # The error of Simpson's rule is 1e-9 of the integral at this spacing.
    times = np.linspace(0.0, end, 20_001)
    motion, impacts = lattice.motion(times, np.zeros(10 * d), np.zeros(10 * d), 0.0)
    expected = simpson(np.einsum("ti,ij,tj->t", motion[1], damping, motion[1]), x=times)

    assert result.statistics["engine"] == "propagator"
    assert result.statistics["episodes"] == impacts > 3
    assert result.statistics["dissipated_by_damping"] == pytest.approx(expected, rel=1e-8, abs=0)
