"""Right-hand side, powers and ledger of lattices with dashpots and cells that differ."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import small_case
from tests.unit.test_inhomogeneity import CELLS, ENDS, varied
from vipetsc.case import Case
from vipetsc.contact.law import CLOSED
from vipetsc.dynamics import simulate
from vipetsc.dynamics.energies import EnergyMeter, measure
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.ts.integrator import Integrator
from vipetsc.io.store import RunMemory

DRIVEN = 3
SITE = 4


def damped_case(**sections) -> Case:
    """A small lattice of about 1 % damping."""
    lattice = {"damping": {"mass": 10.0, "stiffness": 1e-5}} | sections.pop("lattice", {})
    return small_case(lattice=lattice, **sections)


@pytest.mark.parametrize("ends", ENDS)
@pytest.mark.parametrize("dashpots", [True, False])
def test_rates_and_energies_are_those_of_the_equations(ends, dashpots):
    model = small_case(lattice={"cells": CELLS}, contacts={"sites": [SITE]}, drive={"cell": DRIVEN, "mass": 2}).model()
    bare = {} if dashpots else {"damping": np.zeros((CELLS, 4)), "grounding": np.zeros((CELLS, 4))}
    chain = replace(varied(ends, **bare), sites=(SITE - 1,), clearances=(1e-5,))
    if not dashpots:
        cell = replace(chain.cell, grounding=(), springs=tuple(replace(s, damping=0.0) for s in chain.cell.springs))
        chain = replace(chain, cell=cell)
    model = replace(model, chain=chain)
    layout = Layout(model, MPI.COMM_SELF, Integrator.dashpots)
    d = chain.cell.dofs
    engine = Integrator(model, layout)
    t = 0.3 * model.drive.duration
    (host, resonator) = (chain.cell.host, chain.cell.resonator)
    rng = np.random.default_rng(5)
    u = 1e-5 * rng.normal(size=(CELLS, d))
    v = 1e-2 * rng.normal(size=(CELLS, d))
    u[SITE - 1, [host, resonator]] = -2e-5, 1e-5  # indentation 2e-5 m
    sites = engine.lattice.contacts
    sites["mode"][0] = CLOSED
    sites["clearance"][0] = 1e-5
    sites["approach"][0] = 0.02
    lost = 1e-3 * rng.uniform(size=CELLS * dashpots)
    engine.state.array[:] = np.concatenate([u.T.ravel(), v.T.ravel(), lost, [0.25], [0.5]])
    f = engine.state.duplicate()
    engine.ts.computeRHSFunction(t, engine.state, f)

    k, c = (rows(0, CELLS).toarray() for rows in (chain.stiffness_rows, chain.damping_rows))
    force = -(k @ u.ravel() + c @ v.ravel()).reshape(CELLS, d)
    drive = float(model.drive.force(t))
    rate = float(v[SITE - 1, resonator] - v[SITE - 1, host])
    push = float(model.contact.force(3e-5, 1e-5, rate, 0.02))
    force[DRIVEN - 1, 1] += drive
    force[SITE - 1, host] += push
    force[SITE - 1, resonator] -= push
    acceleration = force / chain.variation.masses
    powers = f.array[2 * CELLS * d :][: CELLS * dashpots]
    scale = np.abs(acceleration).max()

    np.testing.assert_allclose(f.array[CELLS * d :][: CELLS * d], acceleration.T.ravel(), atol=1e-13 * scale)
    assert powers.sum() == pytest.approx(v.ravel() @ c @ v.ravel(), rel=1e-12)
    assert f.array[-2] == pytest.approx(drive * v[DRIVEN - 1, 1])

    motion = np.empty((1, 3))
    engine.observe(motion, t)
    assert motion[0, 2] == pytest.approx(acceleration[SITE - 1, resonator] - acceleration[SITE - 1, host], rel=1e-12)

    meter = EnergyMeter(model, layout)
    with engine.state.localForm() as local:
        energies = meter.total(measure(local.array, meter.lattice, meter.unit)[None], np.array([0.25]))
    assert energies.kinetic == pytest.approx(0.5 * np.sum(chain.variation.masses * v**2), rel=1e-12)
    assert energies.spring == pytest.approx(0.5 * u.ravel() @ k @ u.ravel(), rel=1e-12)
    assert (energies.dissipated[0], energies.dissipated_by_damping[0]) == (0.5, pytest.approx(lost.sum()))
    engine.destroy()


def test_cells_that_do_not_differ_give_the_bits_of_those_alike():
    model = small_case().model()
    values = model.chain.coefficients(0, 24)
    masses = values.masses.copy()
    masses[0, 0] *= 1 + 1e-15  # not a bit of the others, but tables of its own for each cell
    f = []
    for chain in (model.chain, replace(model.chain, variation=type(varied().variation)(masses))):
        engine = Integrator(replace(model, chain=chain), Layout(model, MPI.COMM_SELF))
        engine.state.array[:] = np.random.default_rng(1).normal(size=engine.state.size)
        f.append(engine.state.duplicate())
        engine.ts.computeRHSFunction(1e-3, engine.state, f[-1])
    rows = [part.array[: 2 * 4 * 24].reshape(8, 24)[:, 1:] for part in f]

    assert engine.lattice.stiffness.size > 0
    assert rows[0].tobytes() == rows[1].tobytes()


def test_the_ledger_closes_with_dashpots():
    memory = RunMemory(MPI.COMM_SELF)
    result = simulate(damped_case(), memory)
    run = memory.dataset
    statistics = result.statistics

    assert statistics["episodes"] > 0
    assert statistics["ledger_error"] < 1e-9

    lost = run["energy/dissipated_by_damping"].values
    assert np.all(np.diff(lost) >= 0)
    assert 0.05 < lost[-1] / statistics["work"] < 0.9
    assert statistics["dissipated_by_damping"] == lost[-1]

    plain = RunMemory(MPI.COMM_SELF)
    assert "dissipated_by_damping" not in simulate(small_case(time={"end": 1e-3}), plain).statistics
    assert "energy/dissipated_by_damping" not in plain.dataset
