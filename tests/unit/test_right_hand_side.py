"""The right-hand side of a lattice with every kind of force, against sums over its springs, contacts and drives."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest

from tests.conftest import small_case
from vipetsc.case import Model
from vipetsc.contact.law import CLOSED, FREE
from vipetsc.dynamics.lattice_record import LatticeRecord, create_record
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.ts.right_hand_side import find_change, register, site_motion_at, site_motion_by_rates
from vipetsc.lattice import Chain, Contact, Drive, Spring, UnitCell
from vipetsc.lattice.sites import Pair, sites_at

CELLS = 7
SITES = (0, 3, 4, 6)
CLEARANCE = 1e-5
# Static loads in N of the contacts, of which the third one is pressed.
PRELOADS = (0.0, 0.0, 0.125, 0.0)
# Springs that harden and soften, within the cell and between cells: a wrong end or sign shows in the sums.
SPRINGS = (
    Spring(0, 0, 3e4, offset=1, damping=0.4, quadratic=2e7, cubic=5e11),
    Spring(0, 1, 2e4, damping=0.2),
    Spring(1, 2, 1e4, damping=0.1, quadratic=-3e7, cubic=4e11),
)
CELL = UnitCell((0.02, 0.01, 0.005), SPRINGS, host=1, resonator=2, grounding=(0.3, 0.2, 0.1))
LAW = Contact("hertz", 5e6, 0.7)
ENDS = pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])


class Motion(NamedTuple):
    """Displacements and velocities (cell, dof) of a whole lattice in m and m/s, and the time in s."""

    u: np.ndarray
    v: np.ndarray
    t: float

    def at(self, cell: int, mass: int) -> np.ndarray:
        """Return displacement and velocity of a mass; those of the ground, mass -1, are zero."""
        if mass < 0:
            return np.zeros(2)
        cell = cell % CELLS
        return np.array([self.u[cell, mass], self.v[cell, mass]])


def lattice(ends: str, pairs: Pair | tuple[Pair, ...] = CELL.pair) -> Model:
    """Return a short lattice with dashpots, nonlinear springs, four contacts and three drives."""
    model = small_case(lattice={"cells": 24}, contacts={"sites": [1]}).model()
    chain = Chain(CELL, CELLS, ends, sites_at(SITES, pairs, LAW, clearances=CLEARANCE))
    wave = model.drives[0].waveform
    # The first drive acts on the host of the second site, the others on masses near it that are not in contact.
    targets = [(SITES[1], CELL.host), (SITES[1], 0), (SITES[1] - 1, CELL.resonator)]
    factors = (1.0, 0.5, 2.0)
    drives = [
        Drive(replace(wave, amplitude=factor * wave.amplitude), cell=cell, mass=mass)
        for (cell, mass), factor in zip(targets, factors, strict=True)
    ]
    return replace(model, chain=chain, drives=tuple(drives))


def random_motion(model: Model) -> Motion:
    rng = np.random.default_rng(5)
    shape = (CELLS, CELL.dofs)
    return Motion(u=2e-5 * rng.normal(size=shape), v=1e-2 * rng.normal(size=shape), t=0.3 * model.drive.duration)


def set_contacts(lattice: LatticeRecord) -> None:
    """Close the first site on its side +, the second on its side -, and press the third; the last one stays free."""
    contacts = lattice.contacts
    contacts["mode"] = [CLOSED, -CLOSED, CLOSED, FREE]
    contacts["approach"] = [0.02, -0.03, 0.05, 0.01]
    contacts["preload"] = PRELOADS


def contact_forces(chain: Chain, motion: Motion) -> tuple[list[float], list[float]]:
    """Return forces in N on the hosts and dissipated powers in W of the sites, in the modes of ``set_contacts``."""
    sides = [1.0, -1.0, 1.0]
    approaches = [0.02, 0.03, 0.05]
    forces = [0.0] * len(SITES)
    powers = [0.0] * len(SITES)
    for i, (side, approach) in enumerate(zip(sides, approaches, strict=True)):
        pair = chain.sites[i].pair
        host = motion.at(SITES[i], pair.host)
        resonator = motion.at(SITES[i] + pair.offset, pair.resonator)
        w, rate = side * (resonator - host)
        x = w - CLEARANCE
        # The force of a closed site is continued to x < 0, until a step ends on the change of mode.
        elastic = LAW.stiffness * np.sign(x) * abs(x) ** 1.5
        factor = 1.0 + LAW.damping * rate / approach
        forces[i] = side * elastic * factor
        powers[i] = elastic * (factor - 1.0) * rate
    return forces, powers


def accelerations(model: Model, motion: Motion) -> np.ndarray:
    """Return accelerations (cell, dof) by springs, dashpots, contacts and drives, in m/s^2."""
    chain = model.chain
    u = motion.u.ravel()
    v = motion.v.ravel()
    force = -(chain.stiffness_matrix() @ u + chain.damping_rows(0, CELLS) @ v).reshape(motion.u.shape)

    for spring in chain.cell.springs:
        for left in range(-1, CELLS):
            right = left + spring.offset
            if chain.ends == "periodic":
                right = right % CELLS
            # Cell -1 stands for the wall on the left, which holds springs to the next cell only.
            if left < 0 and not (spring.offset and chain.ends == "fixed"):
                continue
            if right == CELLS and chain.ends == "free":
                continue
            start = motion.u[left, spring.start] if left >= 0 else 0.0
            end = motion.u[right, spring.end] if right < CELLS else 0.0
            z = end - start
            pull = spring.quadratic * z**2 + spring.cubic * z**3
            if left >= 0:
                force[left, spring.start] += pull
            if right < CELLS:
                force[right, spring.end] -= pull

    forces, _ = contact_forces(chain, motion)
    for i, pair in enumerate(chain.sites.pairs[:3]):
        push = forces[i] - PRELOADS[i]
        if pair.host >= 0:
            force[SITES[i], pair.host] += push
        force[(SITES[i] + pair.offset) % CELLS, pair.resonator] -= push

    for drive in model.drives:
        force[drive.cell, drive.mass] += float(drive.waveform.force(motion.t))
    return force / np.array(chain.cell.masses)


class Evaluated(NamedTuple):
    """A layout, its record, the state, its array ``y`` with ghosts, and its rates, also with ghosts."""

    layout: Layout
    lattice: LatticeRecord
    state: PETSc.Vec
    y: np.ndarray
    rates: np.ndarray


def rates_of(lattice: LatticeRecord, time: float, state: PETSc.Vec) -> PETSc.Vec:
    """Return the rates of a state as PETSc gets them; entries that are not written stay NaN."""
    rates = state.duplicate()
    rates.array[:] = np.nan
    ts = PETSc.TS().create(MPI.COMM_SELF)
    register(ts, lattice)
    ts.computeRHSFunction(time, state, rates)
    return rates


def evaluate(model: Model, motion: Motion) -> Evaluated:
    """Evaluate the right-hand side in a motion, with the sites in the modes of ``set_contacts``."""
    layout = Layout(model, MPI.COMM_SELF)
    record = create_record(model, layout)
    set_contacts(record)

    state = layout.create_vector()
    layout.place(np.hstack([motion.u, motion.v]), 0.0, state.array)
    state.ghostUpdate()
    with state.localForm() as local:
        y = local.array.copy()

    rates = rates_of(record, motion.t, state)
    rates.ghostUpdate()
    with rates.localForm() as local:
        return Evaluated(layout, record, state, y, local.array.copy())


PAIRS = {
    "the cell's pair": CELL.pair,
    # The pairs are to ground, to the next cell, and within the cell.
    "any pair": (Pair(-1, 0), Pair(2, 1, offset=1), Pair(0, 2), Pair(1, 2)),
}


@pytest.mark.parametrize("pairs", PAIRS)
@ENDS
def test_the_rates_are_those_of_all_forces(ends, pairs):
    """The rates are velocities, M^-1 times all forces, drives' powers and losses of sites and dashpots."""
    model = lattice(ends, PAIRS[pairs])
    motion = random_motion(model)
    found = evaluate(model, motion)
    half = CELLS * CELL.dofs
    layout = found.layout
    shape = found.lattice.shape

    expected = accelerations(model, motion)
    np.testing.assert_array_equal(found.rates[:half], motion.v.T.ravel())
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found.rates[half : 2 * half], expected.T.ravel(), atol=1e-13 * scale)

    works = [float(drive.waveform.force(motion.t)) * motion.v[drive.cell, drive.mass] for drive in model.drives]
    _, powers = contact_forces(model.chain, motion)
    assert found.rates[shape.work : shape.work + 3] == pytest.approx(works)
    assert found.rates[layout.dissipated : layout.size] == pytest.approx(powers)

    # Every dashpot's power stands in one cell's ledger.
    v = motion.v.ravel()
    dissipated = v @ model.chain.damping_rows(0, CELLS) @ v
    ledger = found.rates[shape.damping : shape.damping + CELLS]
    assert ledger.sum() == pytest.approx(dissipated)
    assert ledger.min() > 0


@ENDS
def test_the_sites_motion_is_that_of_the_rates(ends):
    """The motion (w, w', w'') of the sites is that of the rates.

    It is computed site by site for the cell's pair, and from the rates of all masses for other pairs.
    """
    for name, pairs in PAIRS.items():
        model = lattice(ends, pairs)
        motion = random_motion(model)
        found = evaluate(model, motion)
        expected = np.zeros((len(SITES), 3))
        acceleration = accelerations(model, motion)
        for i, pair in enumerate(model.chain.sites.pairs):
            right = (SITES[i] + pair.offset) % CELLS
            host = motion.at(SITES[i], pair.host)
            expected[i, :2] = motion.at(right, pair.resonator) - host
            expected[i, 2] = acceleration[right, pair.resonator]
            if pair.host >= 0:
                expected[i, 2] -= acceleration[SITES[i], pair.host]

        seen = np.full((len(SITES), 3), np.nan)
        if model.chain.has_own_pairs:
            site_motion_by_rates(found.y, found.rates, found.lattice, seen)
        else:
            # As the engine calls it, by the address of what PETSc gets.
            ts = PETSc.TS().create(MPI.COMM_SELF)
            context = register(ts, found.lattice)
            site_motion_at(motion.t, found.y, context.ctypes.data, seen)
        np.testing.assert_allclose(seen, expected, rtol=1e-11, err_msg=name)


def test_the_first_change_of_the_sites_is_found_by_the_address_of_their_lattice():
    model = lattice("free")
    record = create_record(model, Layout(model, MPI.COMM_SELF))
    start = np.zeros((len(SITES), 3))
    end = np.zeros((len(SITES), 3))
    # Free sites that rise to both stops: the third one is first.
    h = 1e-3
    for site, depth in ((1, 2.0), (2, -3.0)):
        end[site, 0] = depth * CLEARANCE
        start[site, 1] = end[site, 1] = end[site, 0] / h

    ts = PETSc.TS().create(MPI.COMM_SELF)
    context = register(ts, record)
    found = np.full(2, -7)
    position = find_change(context.ctypes.data, start, end, h, found)
    # It meets its stop on the side -, of which the function has the number 1, after a third of its way.
    assert found.tolist() == [2, 1]
    assert position == pytest.approx(1 / 3, rel=1e-12)
    # No change at all.
    assert find_change(context.ctypes.data, start, start, h, found) == 2.0


def test_a_rank_writes_only_to_what_it_owns():
    """A site of which this rank owns one mass acts on that mass alone; a ledger of another rank is not written."""
    model = lattice("fixed", PAIRS["any pair"])
    motion = random_motion(model)
    whole = evaluate(model, motion)
    n = CELLS
    d = CELL.dofs

    layout, record, state, _, _ = evaluate(model, motion)
    # Another rank owns the host of the pressed site (masses 1 and 3), the resonator of the second site, and the
    # ledger of the last one.
    record.site_dofs["host"]["cell"][2] = -1
    record.site_dofs["resonator"]["cell"][1] = -1
    record.site_dofs["ledger"][3] = -1
    rates = rates_of(record, motion.t, state).array

    forces, _ = contact_forces(model.chain, motion)
    expected = whole.rates[: layout.size].copy()
    expected[d * n + SITES[2]] -= (forces[2] - PRELOADS[2]) / CELL.masses[0]
    expected[(d + 1) * n + SITES[1] + 1] += forces[1] / CELL.masses[1]
    expected[layout.dissipated + 3] = np.nan
    np.testing.assert_allclose(rates, expected, rtol=1e-12)
