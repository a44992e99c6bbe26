"""The right-hand side, powers and energy ledger of lattices with dashpots and cells that differ."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import simulated, small_case
from tests.unit.test_inhomogeneity import CELLS, ENDS, scattered_chain
from vipetsc.case import Case
from vipetsc.contact.law import CLOSED
from vipetsc.dynamics.energies import EnergyMeter
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.ts.integrator import Integrator
from vipetsc.lattice import Variation

DRIVEN = 3
SITE = 4


def varied_model(ends: str, has_dashpots: bool):
    """A lattice whose cells all differ, with a contact in cell SITE and a force on the second mass of cell DRIVEN."""
    sections = {"lattice": {"cells": CELLS}, "contacts": {"sites": [SITE]}, "drive": {"cell": DRIVEN, "mass": 2}}
    chain = replace(scattered_chain(ends), sites=(SITE - 1,), clearances=(1e-5,))
    if not has_dashpots:
        springs = tuple(replace(spring, damping=0.0) for spring in chain.cell.springs)
        cell = replace(chain.cell, grounding=(), springs=springs)
        none = np.zeros((CELLS, 4))
        variation = replace(chain.variation, damping=none, grounding=none)
        chain = replace(chain, cell=cell, variation=variation)
    return replace(small_case(**sections).model(), chain=chain, gaps=((1e-5, 1e-5),))


@ENDS
@pytest.mark.parametrize("has_dashpots", [True, False])
def test_rates_and_energies_are_those_of_the_equations(ends, has_dashpots):
    """At a random state with a closed contact the engine computes M u'' = -K u - C u' + forces, powers and energies.

    The energies are the quadratic forms u'^T M u'/2 and u^T K u/2; the power lost in dashpots is u'^T C u'.
    """
    model = varied_model(ends, has_dashpots)
    chain = model.chain
    masses = chain.variation.masses
    host = chain.cell.host
    resonator = chain.cell.resonator
    half = CELLS * chain.cell.dofs
    rng = np.random.default_rng(5)
    u = 1e-5 * rng.normal(size=masses.shape)
    v = 1e-2 * rng.normal(size=masses.shape)
    # w = 3e-5 m indents the stop, whose clearance is 1e-5 m, by 2e-5 m.
    u[SITE - 1, host] = -2e-5
    u[SITE - 1, resonator] = 1e-5
    lost = 1e-3 * rng.uniform(size=CELLS * has_dashpots)

    layout = Layout(model, MPI.COMM_SELF, dashpots=True)
    engine = Integrator(model, layout)
    sites = engine.lattice.contacts
    sites["mode"][0] = CLOSED
    sites["clearance"][0] = 1e-5
    sites["approach"][0] = 0.02
    # The state holds displacements, velocities, energies lost in dashpots, the work, and the energy lost at the site.
    engine.state.array[:] = np.concatenate([u.T.ravel(), v.T.ravel(), lost, [0.25], [0.5]])
    rates = engine.state.duplicate()
    t = 0.3 * model.drive.duration
    engine.ts.computeRHSFunction(t, engine.state, rates)

    k = chain.stiffness_rows(0, CELLS).toarray()
    c = chain.damping_rows(0, CELLS).toarray()
    force = -(k @ u.ravel() + c @ v.ravel()).reshape(masses.shape)
    drive = float(model.drive.force(t))
    force[DRIVEN - 1, 1] += drive
    w_rate = float(v[SITE - 1, resonator] - v[SITE - 1, host])
    push = float(model.contact.force(3e-5, 1e-5, w_rate, 0.02))
    force[SITE - 1, host] += push
    force[SITE - 1, resonator] -= push
    acceleration = force / masses

    scale = np.abs(acceleration).max()
    np.testing.assert_allclose(rates.array[half : 2 * half], acceleration.T.ravel(), atol=1e-13 * scale)
    powers = rates.array[2 * half :][: CELLS * has_dashpots]
    assert powers.sum() == pytest.approx(v.ravel() @ c @ v.ravel(), rel=1e-12)
    assert rates.array[-2] == pytest.approx(drive * v[DRIVEN - 1, 1])

    motion = np.empty((1, 3))
    engine.observe(motion, t)
    w_acceleration = acceleration[SITE - 1, resonator] - acceleration[SITE - 1, host]
    assert motion[0, 2] == pytest.approx(w_acceleration, rel=1e-12)

    meter = EnergyMeter(model, layout, engine.lattice)
    with engine.state.localForm() as local:
        energies = meter.total(meter.sums(local.array)[None], np.array([0.25]))
    assert energies.kinetic == pytest.approx(0.5 * np.sum(masses * v**2), rel=1e-12)
    assert energies.spring == pytest.approx(0.5 * u.ravel() @ k @ u.ravel(), rel=1e-12)
    assert energies.dissipated[0] == 0.5
    assert energies.dissipated_by_damping[0] == pytest.approx(lost.sum())
    engine.destroy()


def test_cells_that_do_not_differ_give_the_bits_of_those_alike():
    """Equal cells have the same rates, to the last bit, whether or not coefficients are stored for each cell."""
    model = small_case().model()
    masses = model.chain.coefficients(0, 24).masses.copy()
    # One mass that differs by rounding makes the engine store coefficients for each cell.
    masses[0, 0] *= 1 + 1e-15
    differing = replace(model.chain, variation=Variation(masses))

    rates = []
    for chain in (model.chain, differing):
        engine = Integrator(replace(model, chain=chain), Layout(model, MPI.COMM_SELF))
        engine.state.array[:] = np.random.default_rng(1).normal(size=engine.state.size)
        rate = engine.state.duplicate()
        engine.ts.computeRHSFunction(1e-3, engine.state, rate)
        rates.append(rate.array[: 2 * 4 * 24].reshape(8, 24)[:, 1:].tobytes())

    assert engine.lattice.stiffness.size > 0
    assert rates[0] == rates[1]


def test_a_lattice_without_dashpots_has_no_loss_of_theirs():
    run, result = simulated(small_case(time={"end": 1e-3}))

    assert "dissipated_by_damping" not in result.statistics
    assert "energy/dissipated_by_damping" not in run


@pytest.mark.parametrize("ends", ["periodic", "free"])
def test_dashpots_that_a_profile_takes_away_change_nothing(ends):
    """A lattice all of whose dashpots have a damping of 0, unlike the cell's, moves as one that has none."""
    motions = []
    for damping in (0.5, 0.0):
        springs = [
            {"start": 1, "end": 1, "next_cell": True, "stiffness": 2e4, "damping": damping},
            {"start": 1, "end": 2, "stiffness": 6e3},
        ]
        cell = {"masses": [0.01, 0.004], "springs": springs, "contact": [1, 2]}
        profiles = {"springs[1].damping": [0.0] * 30} if damping else {}
        table = {
            "lattice": {"cells": 30, "ends": ends, "cell": cell, "profiles": profiles},
            "contacts": {"sites": [5], "clearance": 1e-5, "stiffness": 1e6},
            "drive": {"amplitude": 20.0, "cycles": 5, "frequency": 600.0},
            "time": {"end": 0.01, "engine": "propagator"},
        }
        run, result = simulated(Case.from_table(table))
        assert result.statistics["episodes"] > 0
        motions.append(run["impacts/onset"].values)

    np.testing.assert_allclose(*motions, rtol=0, atol=1e-9 * np.abs(motions[1]).max())
