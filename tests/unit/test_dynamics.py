"""The engine's rates, motion of sites and energies against assembled matrices; sums of PETSc's stages."""

from __future__ import annotations

import sys
from types import SimpleNamespace

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest

from tests.assembly import assembled_stiffness
from tests.conftest import small_case
from vipetsc.case import Case, CaseError, Model
from vipetsc.contact.law import CLOSED
from vipetsc.dynamics import energies, run
from vipetsc.dynamics.energies import ENERGY_SUMS, LARGEST, Energies, EnergyMeter, add_energy
from vipetsc.dynamics.lattice_record import create_record
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.memory import check_scalars
from vipetsc.dynamics.ts.integrator import Integrator
from vipetsc.dynamics.ts.sums import register_sums
from vipetsc.io.store import RunMemory

CELLS = 7
# Counted from 1.
DRIVEN_CELL = 3
CONTACT_CELLS = (3, 7)


def energies_of(model: Model, layout: Layout, state: PETSc.Vec) -> Energies:
    """Return the energies of one state."""
    meter = EnergyMeter(model, layout, create_record(model, layout))
    with state.localForm() as local:
        work = local.array[meter.lattice.shape.work]
        return meter.total(meter.sums(local.array)[None], np.array([work]))


class ClosedContact:
    """A Runge-Kutta engine at one instant, in a random state whose first contact is closed and second one free."""

    # The clearance in m and the approach velocity in m/s: at w = 3e-5 m the indentation is 2e-5 m.
    clearance = 1e-5
    approach = 0.02
    work = 0.25
    losses = (0.5, 0.125)

    def __init__(self, ends: str) -> None:
        self.case: Case = small_case(
            lattice={"cells": CELLS, "ends": ends},
            contacts={"law": "hertz", "sites": list(CONTACT_CELLS), "clearance": 1e-5, "restitution": 0.7},
            drive={"cell": DRIVEN_CELL, "mass": 2},
        )
        self.model = self.case.model()
        self.chain = self.model.chain
        self.pair = [self.chain.cell.host, self.chain.cell.resonator]
        self.time = 0.3 * self.model.drive.duration

        rng = np.random.default_rng(5)
        self.u = 1e-5 * rng.normal(size=(CELLS, self.chain.cell.dofs))
        self.v = 1e-2 * rng.normal(size=(CELLS, self.chain.cell.dofs))
        self.u[CONTACT_CELLS[0] - 1, self.pair] = -2e-5, 1e-5
        self.u[CONTACT_CELLS[1] - 1, self.pair] = 1e-6, 2e-6

        self.layout = Layout(self.model, MPI.COMM_SELF)
        self.engine = Integrator(self.model, self.layout)
        sites = self.engine.lattice.contacts
        sites["mode"][0] = CLOSED
        sites["clearance"][0] = self.clearance
        sites["approach"][0] = self.approach
        ledger = [self.work, *self.losses]
        self.engine.state.array[:] = np.concatenate([self.u.T.ravel(), self.v.T.ravel(), ledger])
        # On a ring the rank is its own neighbour.
        self.engine.state.ghostUpdate()

    def contact_force(self, dissipates: bool = True) -> float:
        """Return the force of the closed contact in N, or its elastic part."""
        site = CONTACT_CELLS[0] - 1
        w = float(np.diff(self.u[site, self.pair])[0])
        rate = float(np.diff(self.v[site, self.pair])[0])
        if dissipates:
            return float(self.model.contact.force(w, self.clearance, rate, self.approach))
        return float(self.model.contact.force(w, self.clearance))

    def accelerations(self) -> np.ndarray:
        """Return accelerations (cell, dof) in m/s^2 by springs, the drive and the closed contact."""
        force = -(assembled_stiffness(self.chain) @ self.u.ravel()).reshape(self.u.shape)
        force[DRIVEN_CELL - 1, 1] += float(self.model.drive.force(self.time))
        site = CONTACT_CELLS[0] - 1
        force[site, self.pair[0]] += self.contact_force()
        force[site, self.pair[1]] -= self.contact_force()
        return force / np.array(self.chain.cell.masses)


@pytest.fixture(params=["fixed", "free", "periodic"])
def lattice(request):
    lattice = ClosedContact(request.param)
    yield lattice
    lattice.engine.destroy()


def test_rates_are_those_of_the_equations(lattice):
    """The rates are velocities, M^-1 (-K u + drive + contact force), the drive's power and the dissipated power."""
    rates = lattice.engine.state.duplicate()
    lattice.engine.ts.computeRHSFunction(lattice.time, lattice.engine.state, rates)
    half = CELLS * lattice.chain.cell.dofs
    velocities, accelerations, ledger = np.split(rates.array, [half, 2 * half])

    expected = lattice.accelerations()
    np.testing.assert_array_equal(velocities, lattice.v.T.ravel())
    np.testing.assert_allclose(accelerations, expected.T.ravel(), atol=1e-13 * np.abs(expected).max())

    drive = float(lattice.model.drive.force(lattice.time))
    rate = float(np.diff(lattice.v[CONTACT_CELLS[0] - 1, lattice.pair])[0])
    lost = (lattice.contact_force() - lattice.contact_force(dissipates=False)) * rate
    assert ledger == pytest.approx([drive * lattice.v[DRIVEN_CELL - 1, 1], lost, 0.0])


def test_the_motion_of_sites_is_that_of_the_equations(lattice):
    """The motion (w, w', w'') of the sites has the accelerations of the equations."""
    motion = np.empty((2, 3))
    lattice.engine.observe(motion, lattice.time)
    for row, cell in zip(motion, CONTACT_CELLS, strict=True):
        fields = (lattice.u, lattice.v, lattice.accelerations())
        expected = [np.diff(field[cell - 1, lattice.pair])[0] for field in fields]
        np.testing.assert_allclose(row, expected, rtol=1e-12)


def test_energies_are_those_of_the_state_and_of_its_ledger(lattice):
    """Energies are m v^2/2, u^T K u/2 and that of the contact; work and losses are those of the ledger."""
    energies = energies_of(lattice.model, lattice.layout, lattice.engine.state)
    u = lattice.u.ravel()
    kinetic = 0.5 * np.sum(np.array(lattice.chain.cell.masses) * lattice.v**2)
    contact = float(lattice.model.contact.potential(3e-5, lattice.clearance))
    assert energies.kinetic == pytest.approx(kinetic, rel=1e-12)
    assert energies.spring == pytest.approx(0.5 * u @ assembled_stiffness(lattice.chain) @ u, rel=1e-12)
    # Energies are summed in whole units, and the contact's energy is a small number of them.
    assert energies.contact == pytest.approx(contact, rel=1e-10)
    assert energies.work[0] == lattice.work
    assert energies.dissipated[0] == sum(lattice.losses)


def test_energies_below_the_unit_of_the_sums_add_up():
    """Energies of 0.4 units a cell are not rounded to zero one by one: their sum is exact."""
    model = small_case().model()
    layout = Layout(model, MPI.COMM_SELF)
    unit = EnergyMeter(model, layout, create_record(model, layout)).unit
    state = layout.create_vector()
    first = layout.dofs * layout.owned
    state.array[first : first + layout.owned] = np.sqrt(2 * 0.4 * unit / model.chain.cell.masses[0])
    assert energies_of(model, layout, state).kinetic == pytest.approx(0.4 * unit * layout.owned, rel=1e-10)


def test_energies_beyond_all_scales_saturate_the_sums():
    """Energies that are NaN or beyond the largest count as ``LARGEST`` in the sum."""
    sums = np.zeros((ENERGY_SUMS, 2), np.int64)
    for energy in (np.nan, np.inf, 1e300):
        add_energy(sums, energy, 1.0)
    assert sums[1].tolist() == [3 * int(LARGEST), 0]


def test_a_long_lattice_that_is_nowhere_finite_is_beyond_the_sums():
    """Sums of energies that are cut off at ``LARGEST`` saturate; 2^14 of them would add up to 2^64, 0 in 64 bits."""
    model = small_case(lattice={"cells": 2**14, "damping": {"mass": 1.0}}).model()
    layout = Layout(model, MPI.COMM_SELF, dashpots=True)
    sums = EnergyMeter(model, layout, create_record(model, layout)).sums(np.full(layout.size, np.nan))
    kinetic, spring, _, _, damping = sums[:, 0] >= LARGEST
    assert kinetic
    assert spring
    assert damping

    sums[:] = 0
    for _ in range(2**14):
        add_energy(sums, np.nan, 1.0)
    assert sums[1, 0] >= LARGEST


@pytest.mark.parametrize("size", [1, 31, 77, 640])
@pytest.mark.parametrize("count", [1, 4, 7, 13])
def test_stages_are_added_as_petsc_adds_them(size, count):
    """The compiled sum of stages has the bits of PETSc's VecMAXPY, for any number of stages and any size."""
    rng = np.random.default_rng(size + count)
    by_petsc = PETSc.Vec().createMPI(size, comm=MPI.COMM_SELF)
    registered = by_petsc.duplicate()
    register_sums(registered)
    # TSRK's vectors are duplicates.
    compiled = registered.duplicate()
    stages = [compiled.duplicate() for _ in range(count)]
    for vector in stages:
        vector.array[:] = rng.normal(size=size)
    # Some stages have no weight.
    factors = rng.normal(size=count) * (np.arange(count) % 3 != 1)
    start = rng.normal(size=size)
    by_petsc.array[:] = start
    compiled.array[:] = start

    by_petsc.maxpy(factors, stages)
    compiled.maxpy(factors, stages)

    assert compiled.array.tobytes() == by_petsc.array.tobytes()
    assert compiled.array.tobytes() != start.tobytes()

    # A stage without weight is left out, hence its NaN, too; PETSc's own sum would be NaN.
    stages[0].set(np.nan)
    compiled.maxpy([0.0, 1.0], [stages[0], registered])
    assert np.isfinite(compiled.array).all()
    for vector in (by_petsc, compiled, registered, *stages):
        vector.destroy()


@pytest.mark.parametrize(
    ("ranks", "hook", "expected"), [(1, sys.__excepthook__, 0), (2, sys.__excepthook__, 1), (2, print, 0)]
)
def test_a_simulation_on_several_ranks_lets_a_rank_that_raises_end_all(monkeypatch, ranks, hook, expected):
    """``simulate`` installs the hook at its call, on several ranks, and keeps a hook that is not Python's own."""
    installed = []
    monkeypatch.setattr(run, "install_abort_hook", lambda: installed.append(1))
    monkeypatch.setattr(run, "MPI", SimpleNamespace(COMM_WORLD=SimpleNamespace(size=ranks)))
    monkeypatch.setattr(sys, "excepthook", hook)
    with pytest.raises(ValueError, match="cannot be resumed"):
        run.simulate(small_case(), RunMemory(), resume=True)
    assert len(installed) == expected


def test_remainders_are_carried_so_that_those_of_many_cells_do_not_overflow():
    """The sum of remainders of nearly half a unit stays below a unit: those of 2^12 cells would add up to 2^63."""
    energy = 0.5 - 2.0**-40
    sums = np.zeros((ENERGY_SUMS, 2), np.int64)
    for _ in range(3):
        add_energy(sums, energy, 1.0)
    whole, fine = sums[1].tolist()
    assert 0 <= fine < 2**52
    assert whole + fine / 2**52 == pytest.approx(3 * energy, rel=1e-15)


@pytest.mark.parametrize("ranks", [3, 2**14])
def test_the_sum_over_ranks_does_not_depend_on_their_order_nor_number(ranks):
    """The largest remainders of 2^14 ranks, whose sum has more than the 53 bits of a float, add up exactly."""
    sums = np.zeros((ranks, ENERGY_SUMS, 2), np.int64)
    rng = np.random.default_rng(2)
    sums[:, :, 0] = rng.integers(0, 2**45, (ranks, ENERGY_SUMS))
    sums[:, :, 1] = 2**52 - 1 - rng.integers(0, 7, (ranks, ENERGY_SUMS))
    expected = [sum((whole << 52) + fine for whole, fine in of_rank) for of_rank in sums.swapaxes(0, 1).tolist()]

    found = []
    for order in (slice(None), slice(None, None, -1)):
        total = np.zeros((4 * ENERGY_SUMS, 1))
        for of_rank in sums[order]:
            total += energies.parts(of_rank[None])
        found.append(energies.joined(total)[:, 0])
    # All of them on one rank, which carries whole units out of the remainders as it adds.
    alone = np.array([[divmod(number, 2**52) for number in expected]], np.int64)
    found.append(energies.joined(energies.parts(alone))[:, 0])

    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])
    np.testing.assert_allclose(found[0], [number / 2**52 for number in expected], rtol=3e-16)


@pytest.mark.parametrize("scalar", [np.complex128, np.float32])
def test_a_petsc_of_other_numbers_is_refused_before_it_runs(scalar):
    """Compiled code reads the states of PETSc as real doubles."""
    with pytest.raises(CaseError, match="double precision"):
        check_scalars(scalar)
