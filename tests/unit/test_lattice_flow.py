"""The flow of a lattice and the variations beside it: linear theory, differences, the symplectic form."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scipy.linalg import eigh

from vipetsc.lattice import Chain, Contact, contact_stiffness
from vipetsc.lattice.cell import four_band
from vipetsc.lattice.chain import Pair
from vipetsc.modes.lattice.lattice_flow import LatticeFlow
from vipetsc.modes.problem import FlowError

CELLS, DOFS, CLEARANCE, PERIOD = 14, 4, 10**-2.75, 2 * np.pi / 1600
STIFFNESS = {"hertz": contact_stiffness(1e8, 0.005, 0.3), "bilinear": 2e4}


def lattice_flow(sites: tuple[int, ...], contact: Contact, ends: str = "fixed") -> LatticeFlow:
    chain = Chain(four_band("calibrated"), CELLS, ends, sites, (CLEARANCE,) * len(sites))
    return LatticeFlow(chain, contact, MPI.COMM_SELF)


def towards(sites: tuple[int, ...], w: float = 1.6e-3, speed: float = 1.0) -> np.ndarray:
    """A state of irregular small motion in which the sites are about to touch."""
    state = 1e-5 * np.random.default_rng(1).standard_normal((2 * DOFS, CELLS))
    state[DOFS:] *= 1e3
    for site in sites:
        state[2, site], state[DOFS + 2, site] = state[1, site] + w, state[DOFS + 1, site] + speed
    return state


def differences(flow: LatticeFlow, start: np.ndarray, duration: float, change: np.ndarray) -> tuple[np.ndarray, ...]:
    """How the end moves with the start along a ``change``, by the linearisation and by central differences."""
    step = 1e-6
    later, earlier = (flow.arc(start + way * step * change, duration).end for way in (1, -1))
    return flow.arc(start, duration).move(change[None])[0], (later - earlier) / (2 * step)


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
def test_without_contact_the_multipliers_are_those_of_the_linear_modes(ends):
    flow = lattice_flow((5,), Contact("hertz", STIFFNESS["hertz"]), ends)
    n = CELLS * DOFS
    arc = flow.arc(towards((5,), 0.0, 0.0), PERIOD)
    map_ = flow.gather(arc.move(flow.scatter(np.eye(2 * n)))).T
    squared = eigh(flow.chain.stiffness_matrix().toarray(), np.diag(flow.chain.masses()), eigvals_only=True)
    phases = np.exp(1j * np.outer([1, -1], np.sqrt(np.maximum(squared, 0)) * PERIOD)).ravel()
    found = np.linalg.eigvals(map_)
    # The rigid motion of free ends is a double eigenvalue 1 with one eigenvector.
    near = 1e-6 if ends != "fixed" else 1e-12
    assert np.abs(found[:, None] - phases[None]).min(axis=0).max() < near
    assert (arc.episodes, arc.closed) == (0, 0.0)
    np.testing.assert_allclose(flow.scatter(flow.gather(arc.end)), arc.end, rtol=0, atol=0)


CONTACTS = {
    "elastic": {},
    "dissipative": {"restitution": 0.7},
    "clipped": {"restitution": 0.3, "adhesion": "clip"},
    "floored": {"restitution": 0.7, "approach_floor": 2.0},
}


@pytest.mark.slow
@pytest.mark.parametrize("sites", [(5,), (5, 6, 11)])
@pytest.mark.parametrize("law", ["hertz", "bilinear"])
@pytest.mark.parametrize("kind", CONTACTS)
def test_variations_agree_with_differences(kind, law, sites):
    """Two sites of a cluster and one apart; the onset's shift enters the force through the approach velocity."""
    flow = lattice_flow(sites, Contact(law, STIFFNESS[law], **CONTACTS[kind]))
    change = np.random.default_rng(2).standard_normal((2 * DOFS, CELLS)) * np.repeat([1e-3, 1.0], DOFS)[:, None]
    arc = flow.arc(towards(sites), PERIOD)
    assert arc.episodes >= len(sites)
    moved, difference = differences(flow, towards(sites), PERIOD, change)
    for half in np.split(np.abs(moved - difference) / np.abs(moved), 2):
        assert np.median(half) < 1e-6
    scale = np.repeat(np.abs(moved).reshape(2, -1).max(axis=1), DOFS)[:, None]
    assert np.max(np.abs(moved - difference) / scale) < 1e-7


@pytest.mark.parametrize("restitution", [1.0, 0.7])
def test_variations_of_contacts_between_cells_and_with_ground_agree_with_differences(restitution):
    """On a ring: two contacts of one cell, one of them with ground, and one across its joint."""
    pairs, sites = (Pair(-1, 2), Pair(0, 3), Pair(3, 0, True)), (4, 4, CELLS - 1)
    contact, size = Contact("hertz", STIFFNESS["hertz"], restitution), (2 * DOFS, CELLS)
    chain = Chain(four_band("calibrated"), CELLS, "periodic", sites, (CLEARANCE,) * 3, None, pairs)
    flow, random = LatticeFlow(chain, contact, MPI.COMM_SELF), np.random.default_rng(1)
    start = random.standard_normal(size) * np.repeat([1e-5, 1e-2], DOFS)[:, None]
    for pair, site in zip(pairs, sites, strict=True):
        cell = (site + pair.next_cell) % CELLS
        start[[pair.resonator, DOFS + pair.resonator], cell] = 1.7e-3, 4.0
    assert flow.arc(start, PERIOD).episodes >= 3
    change = random.standard_normal(size) * np.repeat([1e-3, 1.0], DOFS)[:, None]
    moved, difference = differences(flow, start, PERIOD, change)
    scale = np.repeat(np.abs(moved).reshape(2, -1).max(axis=1), DOFS)[:, None]
    assert np.max(np.abs(moved - difference) / scale) < 1e-7


def test_contacts_that_always_act_are_refused():
    chain = Chain(four_band("calibrated"), CELLS, "fixed", (5,), (0.0,), None, (Pair(0, 0, True),))
    with pytest.raises(FlowError, match="touch or are pressed"):
        LatticeFlow(chain, Contact("hertz", 1e6), MPI.COMM_SELF).arc(np.zeros((2 * DOFS, CELLS)), PERIOD)


def test_the_approach_velocity_counts():
    """Without its variation the differences would not agree: the derivative of the force is not small."""
    sites = (5,)
    flow = lattice_flow(sites, Contact("hertz", STIFFNESS["hertz"], 0.7))
    arc = flow.arc(towards(sites), PERIOD)
    change = np.random.default_rng(2).standard_normal((1, 2 * DOFS, CELLS)) * np.repeat([1e-3, 1.0], DOFS)[:, None]
    moved = arc.move(change)
    arc.engine._forces.clusters.tape.rows["onset"] = 0
    arc.engine._linear = None
    arc.engine._release()
    assert np.abs(arc.move(change) - moved).max() > 1e-3 * np.abs(moved).max()


@pytest.mark.parametrize("law", ["hertz", "bilinear"])
def test_the_conservative_flow_is_symplectic_and_keeps_the_energy(law):
    """A start within a contact, through its end and the next one on the other side."""
    sites, contact = (5,), Contact(law, STIFFNESS[law])
    flow, n = lattice_flow(sites, contact), CELLS * DOFS
    start = towards(sites, 4e-3, 0.0)
    arc = flow.arc(start, 2 * PERIOD)
    assert arc.episodes >= 2
    masses, stiffness = flow.chain.masses(), flow.chain.stiffness_matrix()

    def energy(block):
        u, v = np.split(flow.gather(block), 2)
        w = u[5 * DOFS + 2] - u[5 * DOFS + 1]
        return 0.5 * masses @ v**2 + 0.5 * u @ (stiffness @ u) + contact.potential(w, CLEARANCE)

    assert energy(arc.end) == pytest.approx(energy(start), rel=1e-13)
    scale = np.append(np.sqrt(masses) * 1600, np.sqrt(masses))  # momentum and displacement in one unit
    map_ = scale[:, None] * flow.gather(arc.move(flow.scatter(np.eye(2 * n)))).T / scale
    form = np.kron([[0, 1], [-1, 0]], np.eye(n))
    np.testing.assert_allclose(map_.T @ form @ map_, form, atol=1e-9)


def test_a_dissipative_contact_cannot_be_closed_at_the_start():
    flow = lattice_flow((5,), Contact("hertz", STIFFNESS["hertz"], 0.7))
    with pytest.raises(FlowError, match="dissipates is closed"):
        flow.arc(towards((5,), 2.2e-3, 0.0), PERIOD)


def test_a_lattice_shorter_than_the_step_reaches_is_refused():
    chain = Chain(four_band("calibrated"), 2, "fixed", (1,), (CLEARANCE,))
    flow = LatticeFlow(chain, Contact("hertz", STIFFNESS["hertz"]), MPI.COMM_SELF)
    with pytest.raises(FlowError, match="2 cells are fewer"):
        flow.arc(np.zeros((8, 2)), PERIOD)
