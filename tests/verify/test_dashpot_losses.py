"""The energy that dashpots dissipate in exact steps, against SciPy and the other engine."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import simpson

from tests.conftest import simulated, small_case
from tests.independent_lattice import ScipyLattice, Stop
from vipetsc.case import Case

DAMPING = {"mass": 10.0, "stiffness": 1e-5}
# Dashpots between masses and to the ground, in single cells and in two neighbouring ones.
PROFILES = {"springs[2].damping": {"cells": [7, 8, 15], "value": 0.4}, "grounding[1]": {"cells": [3, 6], "value": 0.7}}


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


LATTICES = {
    "fixed": {"lattice": {"cells": 80, "damping": DAMPING}},
    "free": {"lattice": {"ends": "free", "damping": DAMPING}},
    "short ring": {"lattice": {"ends": "periodic", "cells": 9, "damping": DAMPING}, "contacts": {"sites": [3, 6]}},
    "strong": {"lattice": {"damping": {"mass": 100.0, "stiffness": 1e-4}}, "contacts": {"clearance": 5e-5}},
    "profiles": {"lattice": {"profiles": PROFILES}, "contacts": {"clearance": 2e-5}},
    "absorbing": {
        "lattice": {"cells": 60, "absorbing": {"end": "both", "cells": 12, "strength": 2000.0}},
        "drive": {"cell": 20},
        "contacts": {"sites": [24, 30]},
    },
    "loss": {"lattice": {"damping": {"loss": {"1": 0.01, "2": 0.02}}}},
    "ground": {"lattice": {"damping": DAMPING}, "contacts": {"pair": [0, 2], "clearance": 1e-4}},
    "disorder": {"lattice": {"damping": DAMPING}, "disorder": {"seed": 3, "cells": {"masses[1]": {"relative": 0.05}}}},
}


def case_of(name: str, engine: str, **time) -> Case:
    """The case ``name`` of ``LATTICES`` by an ``engine``, with lossy contacts."""
    sections = {key: dict(value) for key, value in LATTICES[name].items()}
    sections["contacts"] = {"restitution": 0.8} | sections.get("contacts", {})
    return small_case(**sections, time={"engine": engine} | time)


@pytest.mark.parametrize("name", LATTICES)
def test_both_engines_dissipate_the_same(name):
    """What the balance leaves is what ``ts`` integrates, to 1e-9 of the work at every sample, and it never falls."""
    run, result = simulated(case_of(name, "propagator", rtol=1e-12))
    other, integrated = simulated(case_of(name, "ts", rtol=1e-12))
    statistics = result.statistics
    work = statistics["work"]

    assert statistics["engine"] == "propagator"
    assert statistics["episodes"] == integrated.statistics["episodes"] > 0
    lost = run["energy/dissipated_by_damping"].values
    assert lost[-1] > 0.01 * work
    np.testing.assert_allclose(lost, other["energy/dissipated_by_damping"].values, rtol=0, atol=1e-9 * work)
    # Falls and energy from nowhere count as the error of the balance.
    assert statistics["ledger_error"] < 1e-10
    assert statistics["damping_quadrature"] == pytest.approx(lost[-1], abs=3 * statistics["damping_quadrature_error"])
    assert statistics["damping_quadrature_error"] < 0.05 * lost[-1]
