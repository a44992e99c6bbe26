"""The energy that dashpots dissipate in exact steps, against matrix exponentials, SciPy and the energy balance."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from scipy.integrate import simpson
from scipy.linalg import expm

from tests.conftest import simulated, small_case
from tests.independent_lattice import ScipyLattice, Stop
from tests.unit.test_inhomogeneity import ENDS, scattered_chain
from vipetsc.case import Case
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.propagator.engine import Propagator
from vipetsc.dynamics.propagator.unrecorded import unrecorded_samples
from vipetsc.lattice import Chain, Variation

DAMPING = {"mass": 10.0, "stiffness": 1e-5}
CELLS = 18
EXAMPLES = Path(__file__).parents[2] / "runs" / "examples"
# Dashpots between masses and to the ground, in single cells and in two neighbouring ones.
PROFILES = {"springs[2].damping": {"cells": [7, 8, 15], "value": 0.4}, "grounding[1]": {"cells": [3, 6], "value": 0.7}}


def long_chain(ends: str) -> Chain:
    """A damped four-band lattice of CELLS cells, all of whose masses, springs and dashpots differ."""
    # Three short scattered lattices stand in a row, so that no two cells are equal.
    parts = [scattered_chain(ends, seed).variation for seed in (1, 2, 3)]
    arrays = {name: np.concatenate([dict(part.items())[name] for part in parts]) for name, _ in parts[0].items()}
    return replace(scattered_chain(ends), cells=CELLS, variation=Variation(**arrays))


@ENDS
def test_the_loss_of_free_motion_is_that_of_matrix_exponentials(ends):
    """Over one sample interval from a random state, dashpots take the integral of v^T C v.

    The velocities v(t) are given by the exponential of the whole lattice's matrix.
    """
    model = small_case(lattice={"cells": CELLS}, contacts={"sites": []}, drive={"amplitude": 1e-9}).model()
    model = replace(model, chain=long_chain(ends))
    layout = Layout(model, MPI.COMM_SELF, dashpots=True)
    engine = Propagator(model, layout)
    masses = model.chain.masses()
    n = len(masses)
    k = model.chain.stiffness_rows(0, CELLS).toarray()
    c = model.chain.damping_rows(0, CELLS).toarray()

    rng = np.random.default_rng(4)
    # Velocities are 1000/s times the displacements, as in a wave of 1 krad/s, so that both matter to the loss.
    u = 1e-5 * rng.normal(size=n)
    v = 1e-2 * rng.normal(size=n)
    cells = np.hstack([u.reshape(CELLS, -1), v.reshape(CELLS, -1)])
    engine.begin(cells, np.zeros((0, 2)), 0.0)
    # A goal of 1 lets the engine advance by one sample interval.
    engine.fill(unrecorded_samples(model, layout, goal=1))
    lost = engine.state.array[2 * n : 2 * n + CELLS].sum()
    engine.destroy()

    a = np.block([[np.zeros((n, n)), np.eye(n)], [-k / masses[:, None], -c / masses[:, None]]])
    # Gauss's rule with 16 nodes is exact for polynomials up to degree 31, far more than the motion in it needs.
    nodes, weights = leggauss(16)
    expected = 0.0
    for x, weight in zip(nodes, weights, strict=True):
        rates = (expm(a * model.sample_interval * (1 + x) / 2) @ np.concatenate([u, v]))[n:]
        expected += weight * model.sample_interval / 2 * (rates @ c @ rates)
    assert lost == pytest.approx(expected, rel=1e-11, abs=0)


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


@pytest.mark.parametrize("sample_interval", [2e-4, 8e-4])
@pytest.mark.parametrize("name", LATTICES)
def test_the_energy_balance_closes_by_terms_computed_apart(name, sample_interval):
    """The work is the sum of stored and dissipated energies, each computed by itself, also with lossy contacts.

    The longer interval has steps within which waves travel from one contact site to another.
    """
    sections = {key: dict(value) for key, value in LATTICES[name].items()}
    sections["contacts"] = {"restitution": 0.8} | sections.get("contacts", {})
    sections["time"] = {"engine": "propagator", "sample_interval": sample_interval}
    run, result = simulated(small_case(**sections))
    statistics = result.statistics

    assert statistics["engine"] == "propagator"
    assert statistics["episodes"] > 0
    # A loss far below the work would close the balance even if it were wrong.
    assert statistics["dissipated_by_damping"] > 0.01 * statistics["work"]
    assert statistics["ledger_error"] < 1e-10
    lost = run["energy/dissipated_by_damping"].values
    # A dashpot never returns energy: negative differences are rounding errors.
    assert np.diff(lost).min() > -1e-15 * statistics["work"]


def test_a_cell_with_an_odd_number_of_masses_counts_each_once():
    """The loss of each of a cell's three masses is counted once.

    The losses of most of the 80 cells are summed by vector operations that take masses in pairs.
    """
    changes = ["lattice.cells=80", "lattice.damping={mass=10.0, stiffness=1e-5}", "contacts.sites=[6, 12]"]
    changes += ["contacts.clearance=1e-4", "time.engine='propagator'", "time.end=0.05"]
    _, result = simulated(Case.load(EXAMPLES / "three-mass.toml", changes))
    assert result.statistics["engine"] == "propagator"
    assert result.statistics["dissipated_by_damping"] > 0.01 * result.statistics["work"]
    assert result.statistics["ledger_error"] < 1e-10
