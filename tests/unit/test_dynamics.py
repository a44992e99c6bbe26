"""The right-hand side, the sites' motion and the energies of a lattice, against matrices assembled here."""

from __future__ import annotations

import sys
from types import SimpleNamespace

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest

from tests.conftest import small_case
from vipetsc.contact.law import CLOSED
from vipetsc.dynamics import run
from vipetsc.dynamics.energies import ENERGY_SUMS, LARGEST, Energies, EnergyMeter, add_energy, measure
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.ts.integrator import Integrator
from vipetsc.dynamics.ts.sums import register_sums
from vipetsc.io.store import RunMemory

CELLS, DRIVEN, SITES = 7, 3, (3, 7)


def stiffness_matrix(chain):
    """(cells * dofs) squared, in N/m; a wall holds the other end of a spring that leaves a fixed lattice."""
    n, d = chain.cells, chain.cell.dofs
    k = np.zeros((n * d, n * d))
    for s in chain.cell.springs:
        for cell in range(-1, n) if s.next_cell else range(n):
            ends = [(cell, s.start), (cell + s.next_cell, s.end)]
            if chain.ends == "periodic":
                if cell < 0:
                    continue
                ends = [(c % n, mass) for c, mass in ends]
            inside = [c * d + mass for c, mass in ends if 0 <= c < n]
            if len(inside) < 2 and chain.ends == "free":
                continue
            stretch = np.zeros(n * d)
            stretch[inside] = [1, -1][: len(inside)]
            k += s.stiffness * np.outer(stretch, stretch)
    return k


def energies_of(model, layout: Layout, state) -> Energies:
    """Energies of one state."""
    meter = EnergyMeter(model, layout)
    with state.localForm() as local:
        work = local.array[meter.lattice.shape.work]
        return meter.total(measure(local.array, meter.lattice, meter.unit)[None], np.array([work]))


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
def test_rates_motion_and_energies_are_those_of_the_equations(ends):
    case = small_case(
        lattice={"cells": CELLS, "ends": ends},
        contacts={"law": "hertz", "sites": list(SITES), "clearance": 1e-5, "restitution": 0.7},
        drive={"cell": DRIVEN, "mass": 2},
    )
    model = case.model()
    layout = Layout(model, MPI.COMM_SELF)
    engine = Integrator(model, layout)
    chain, d, t = model.chain, layout.dofs, 0.3 * model.drive.duration
    host, resonator = chain.cell.host, chain.cell.resonator
    rng = np.random.default_rng(5)
    u, v = 1e-5 * rng.normal(size=(CELLS, d)), 1e-2 * rng.normal(size=(CELLS, d))
    u[SITES[0] - 1, [host, resonator]] = -2e-5, 1e-5  # indentation 2e-5 m at the first site
    u[SITES[1] - 1, [host, resonator]] = 1e-6, 2e-6
    sites = engine.lattice.contacts
    sites["mode"][0], sites["clearance"][0], sites["approach"][0] = CLOSED, 1e-5, 0.02
    work, lost = 0.25, np.array([0.5, 0.125])
    engine.state.array[:] = np.concatenate([u.T.ravel(), v.T.ravel(), [work], lost])
    f = engine.state.duplicate()
    engine.ts.computeRHSFunction(t, engine.state, f)

    masses = np.tile(chain.cell.masses, (CELLS, 1))
    springs = stiffness_matrix(chain)
    force = -(springs @ u.ravel()).reshape(CELLS, d)
    drive = float(model.drive.force(t))
    force[DRIVEN - 1, 1] += drive
    site, rate = SITES[0] - 1, float(np.diff(v[SITES[0] - 1, [host, resonator]])[0])
    push = float(model.contact.force(3e-5, 1e-5, rate, 0.02))
    elastic = float(model.contact.force(3e-5, 1e-5))
    force[site, host] += push
    force[site, resonator] -= push
    acceleration = force / masses
    scale = np.abs(acceleration).max()
    np.testing.assert_array_equal(f.array[: CELLS * d], v.T.ravel())
    np.testing.assert_allclose(f.array[CELLS * d : 2 * CELLS * d], acceleration.T.ravel(), atol=1e-13 * scale)
    assert f.array[2 * CELLS * d] == pytest.approx(drive * v[DRIVEN - 1, 1])
    assert f.array[2 * CELLS * d + 1] == pytest.approx((push - elastic) * rate)
    assert f.array[2 * CELLS * d + 2] == 0.0

    motion = np.empty((2, 3))
    engine.observe(motion, t)
    rows = [x[SITES[i] - 1, resonator] - x[SITES[i] - 1, host] for i in range(2) for x in (u, v, acceleration)]
    np.testing.assert_allclose(motion.ravel(), rows, rtol=1e-12)

    energies = energies_of(model, layout, engine.state)
    assert energies.kinetic == pytest.approx(0.5 * np.sum(masses * v**2), rel=1e-12)
    assert energies.spring == pytest.approx(0.5 * u.ravel() @ springs @ u.ravel(), rel=1e-12)
    assert energies.contact == pytest.approx(float(model.contact.potential(3e-5, 1e-5)), rel=1e-10)
    assert (energies.work[0], energies.dissipated[0]) == (work, lost.sum())
    engine.destroy()


def test_energies_below_the_unit_of_the_sums_add_up():
    model = small_case().model()
    layout = Layout(model, MPI.COMM_SELF)
    unit, state = EnergyMeter(model, layout).unit, layout.create_vector()
    first = layout.dofs * layout.owned
    state.array[first : first + layout.owned] = np.sqrt(2 * 0.4 * unit / model.chain.cell.masses[0])
    assert energies_of(model, layout, state).kinetic == pytest.approx(0.4 * unit * layout.owned, rel=1e-10)


def test_energies_beyond_all_scales_saturate_the_sums():
    sums = np.zeros((ENERGY_SUMS, 2), np.int64)
    for energy in (np.nan, np.inf, 1e300):
        add_energy(sums, energy, 1.0)
    assert sums[1].tolist() == [3 * int(LARGEST), 0]


@pytest.mark.parametrize("size", [1, 31, 77, 640])
@pytest.mark.parametrize("count", [1, 4, 7, 13])
def test_stages_are_added_as_petsc_adds_them(size, count):
    rng = np.random.default_rng(size + count)
    plain = PETSc.Vec().createMPI(size, comm=MPI.COMM_SELF)
    ours = plain.duplicate()
    register_sums(ours)
    ours, first = ours.duplicate(), ours  # TSRK's vectors are duplicates
    stages = [ours.duplicate() for _ in range(count)]
    for vector in stages:
        vector.array[:] = rng.normal(size=size)
    factors = rng.normal(size=count) * (np.arange(count) % 3 != 1)
    plain.array[:] = ours.array[:] = rng.normal(size=size)
    before = ours.array.copy()
    plain.maxpy(factors, stages)
    ours.maxpy(factors, stages)
    assert ours.array.tobytes() == plain.array.tobytes() != before.tobytes()
    stages[0].set(np.nan)
    ours.maxpy([0.0, 1.0], [stages[0], first])  # PETSc's own sum would not leave out NaN times zero
    assert np.isfinite(ours.array).all()
    for vector in (plain, ours, first, *stages):
        vector.destroy()


def test_a_simulation_on_several_ranks_lets_a_rank_that_raises_end_all(monkeypatch):
    """At its call, not at its import; a hook that is not Python's own stays."""
    installed = []
    monkeypatch.setattr(run, "install_abort_hook", lambda: installed.append(1))
    for size, hook, expected in ((1, sys.__excepthook__, 0), (2, sys.__excepthook__, 1), (2, print, 1)):
        monkeypatch.setattr(run, "MPI", SimpleNamespace(COMM_WORLD=SimpleNamespace(size=size)))
        monkeypatch.setattr(sys, "excepthook", hook)
        with pytest.raises(ValueError, match="cannot be resumed"):
            run.simulate(small_case(), RunMemory(), resume=True)
        assert len(installed) == expected
