"""The flow of a lattice and its linearisation, against linear theory, differences and the symplectic form."""

from __future__ import annotations

from typing import NamedTuple

from mpi4py import MPI

import numpy as np
import pytest
from scipy.linalg import eigh

from tests.breathers import BREATHER_CELLS as CELLS
from tests.breathers import BREATHER_FREQUENCY, breather_chain
from tests.conftest import StopAt
from tests.models import CLEARANCE, four_band_contact
from vipetsc.dynamics.engine import StalledError
from vipetsc.dynamics.propagator.tangent import TangentPropagator
from vipetsc.lattice import Chain, Contact, four_band
from vipetsc.lattice.chain import Pair
from vipetsc.modes.balance.stops import Stops
from vipetsc.modes.flow import ArcLimits
from vipetsc.modes.lattice.lattice_flow import LatticeFlow
from vipetsc.modes.problem import FlowError
from vipetsc.parallel import StoppedError

DOFS = 4
PERIOD = 2 * np.pi / BREATHER_FREQUENCY
STIFFNESS = {"hertz": four_band_contact("hertz").stiffness, "bilinear": 2e4}
# Changes of 1e-3 m and 1 m/s have comparable energies at the lattice's frequencies of about 1e3 rad/s.
UNITS = np.repeat([1e-3, 1.0], DOFS)[:, None]


def lattice_flow(sites: tuple[int, ...], contact: Contact, ends: str = "fixed") -> LatticeFlow:
    """The flow of a four-band lattice with stops on both sides at ``sites``, on one process."""
    stops = [Stops.both(contact, CLEARANCE)] * len(sites)
    return LatticeFlow(breather_chain(ends, sites), stops, MPI.COMM_SELF)


def irregular_motion(sites: tuple[int, ...], w: float = 1.6e-3, speed: float = 1.0) -> np.ndarray:
    """A state (2 dof, cell) of irregular small motion, with ``w`` in m and w' = ``speed`` in m/s at the ``sites``.

    By default the sites are about to touch, at 1.8 mm.
    """
    state = 1e-5 * np.random.default_rng(1).standard_normal((2 * DOFS, CELLS))
    state[DOFS:] *= 1e3
    for site in sites:
        state[2, site] = state[1, site] + w
        state[DOFS + 2, site] = state[DOFS + 1, site] + speed
    return state


class Linearised(NamedTuple):
    """The change (2 dof, cell) of an arc's end with its start, by the linearisation and by differences."""

    moved: np.ndarray
    difference: np.ndarray

    def largest_error(self) -> float:
        """The largest error, relative to the largest displacement or velocity."""
        largest = np.abs(self.moved).reshape(2, -1).max(axis=1)
        scale = np.repeat(largest, DOFS)[:, None]
        return float(np.max(np.abs(self.moved - self.difference) / scale))


def linearise(flow: LatticeFlow, start: np.ndarray, change: np.ndarray) -> Linearised:
    """The change of an arc's end along ``change`` (2 dof, cell), by the linearisation and by a central difference."""
    # With this step the errors of rounding and of the third derivative are both about 1e-8.
    step = 1e-6
    ahead = flow.arc(start + step * change, PERIOD).end
    behind = flow.arc(start - step * change, PERIOD).end
    moved = flow.arc(start, PERIOD).move(change[None])[0]
    return Linearised(moved=moved, difference=(ahead - behind) / (2 * step))


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
def test_without_contact_the_multipliers_are_those_of_the_linear_modes(ends):
    """The linearisation over a time T without contact has the multipliers exp(+-i omega_j T) of all modes j."""
    flow = lattice_flow((5,), four_band_contact(), ends)
    arc = flow.arc(irregular_motion((5,), w=0.0, speed=0.0), PERIOD)
    assert arc.episodes == 0
    assert arc.closed == 0.0

    map_ = flow.gather(arc.move(flow.scatter(np.eye(2 * CELLS * DOFS)))).T
    found = np.linalg.eigvals(map_)
    squared = eigh(flow.chain.stiffness_matrix().toarray(), np.diag(flow.chain.masses()), eigvals_only=True)
    turned = np.sqrt(np.maximum(squared, 0)) * PERIOD
    expected = np.exp(1j * np.outer([1, -1], turned)).ravel()
    # The rigid motion of free ends is a double eigenvalue 1 with one eigenvector: it errs by the root of rounding.
    tolerance = 1e-12 if ends == "fixed" else 1e-6
    assert np.abs(found[:, None] - expected[None]).min(axis=0).max() < tolerance


def test_gathering_and_scattering_leave_a_state_as_it_is():
    flow = lattice_flow((5,), four_band_contact())
    state = irregular_motion((5,))
    np.testing.assert_array_equal(flow.scatter(flow.gather(state)), state)


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
def test_the_linearisation_agrees_with_differences(kind, law, sites):
    """The linearisation of the flow is its central difference, for one site and for a cluster of two with one apart.

    The force of a dissipative contact depends on the approach velocity, and thereby on the shift of the onset.
    """
    flow = lattice_flow(sites, Contact(law, STIFFNESS[law], **CONTACTS[kind]))
    start = irregular_motion(sites)
    assert flow.arc(start, PERIOD).episodes >= len(sites)

    change = np.random.default_rng(2).standard_normal((2 * DOFS, CELLS)) * UNITS
    found = linearise(flow, start, change)

    for half in np.split(np.abs(found.moved - found.difference) / np.abs(found.moved), 2):
        assert np.median(half) < 1e-6
    assert found.largest_error() < 1e-7


@pytest.mark.parametrize("restitution", [1.0, 0.7])
def test_the_linearisation_of_contacts_between_cells_and_with_ground_agrees_with_differences(restitution):
    """The linearisation is the central difference for contacts in a cell, with the ground and across a ring's joint."""
    pairs = (Pair(-1, 2), Pair(0, 3), Pair(3, 0, next_cell=True))
    sites = (4, 4, CELLS - 1)
    chain = Chain(four_band("calibrated"), CELLS, "periodic", sites, (CLEARANCE,) * 3, pairs=pairs)
    law = Contact("hertz", STIFFNESS["hertz"], restitution)
    flow = LatticeFlow(chain, [Stops.both(law, CLEARANCE)] * len(sites), MPI.COMM_SELF)
    random = np.random.default_rng(1)
    start = 1e-2 * random.standard_normal((2 * DOFS, CELLS)) * UNITS
    for pair, site in zip(pairs, sites, strict=True):
        cell = (site + pair.next_cell) % CELLS
        start[pair.resonator, cell] = 1.7e-3
        start[DOFS + pair.resonator, cell] = 4.0
    assert flow.arc(start, PERIOD).episodes >= 3

    change = random.standard_normal((2 * DOFS, CELLS)) * UNITS
    assert linearise(flow, start, change).largest_error() < 1e-7


def test_the_approach_velocity_enters_the_linearisation():
    """The force's derivative by the approach velocity changes the linearised end by more than a thousandth."""
    flow = lattice_flow((5,), Contact("hertz", STIFFNESS["hertz"], 0.7))
    arc = flow.arc(irregular_motion((5,)), PERIOD)
    change = np.random.default_rng(2).standard_normal((1, 2 * DOFS, CELLS)) * UNITS
    moved = arc.move(change)

    arc.engine._forces.clusters.tape.rows["onset"] = 0
    # The engine computes its matrices again, from the changed tape.
    arc.engine._linearisation = None
    arc.engine._release()
    assert np.abs(arc.move(change) - moved).max() > 1e-3 * np.abs(moved).max()


def test_substeps_of_a_pressed_contact_are_those_in_which_it_is_closed():
    """The substeps of a pressed contact that opens are counted only where it is closed, and fill the closed time."""
    depth = 1e-5
    stops = Stops(Contact("hertz", STIFFNESS["hertz"]), -depth, np.inf)
    flow = LatticeFlow(breather_chain("fixed", (5,)), [stops], MPI.COMM_SELF)

    arc = flow.arc(irregular_motion((5,), w=0.0, speed=-3.0), PERIOD)

    assert arc.episodes > 0
    assert 0.0 < arc.closed < 0.9 * arc.duration
    # The drive has a cluster of its own, without a site.
    substeps = [part for part in arc.engine.closed_substeps() if part.site.size]
    assert len(substeps) == 1
    assert (substeps[0].w > -depth).all()
    assert substeps[0].weights.sum() == pytest.approx(arc.closed, rel=1e-12)


def test_an_arc_in_pieces_has_the_bits_of_the_whole_and_can_be_left():
    """An arc in which requests to stop are looked at after each step has the same bits; a request ends it.

    A longer arc than an attempt of Newton's method may take is refused.
    """
    flow = lattice_flow((5,), Contact("hertz", STIFFNESS["hertz"]))
    start = irregular_motion((5,))
    whole = flow.arc(start, PERIOD)
    assert whole.episodes > 0
    flow.limits = ArcLimits(every=1)
    looks = StopAt(10**6)
    with flow.limits.stopped_by(looks), flow.limits.attempt():
        parts = flow.arc(start, PERIOD)
    assert looks.left == 10**6 - whole.steps
    assert parts.steps == whole.steps
    np.testing.assert_array_equal(parts.end, whole.end)
    np.testing.assert_array_equal(parts.departures, whole.departures)
    np.testing.assert_array_equal(parts.move(start[None]), whole.move(start[None]))

    with flow.limits.stopped_by(StopAt(whole.steps // 2)), flow.limits.attempt(), pytest.raises(StoppedError):
        flow.arc(start, PERIOD)
    with flow.limits.attempt(longest=whole.steps):
        assert flow.arc(start, PERIOD).steps == whole.steps
        # Before its first step, after which the request would be looked at.
        with flow.limits.stopped_by(StopAt(0)), pytest.raises(FlowError, match=f"more than {whole.steps} steps"):
            flow.arc(start, 2 * PERIOD)


def test_an_orbit_without_a_tape_has_no_variations():
    """An engine without a tape refuses to move variations: they would silently lack the contacts."""
    flow = lattice_flow((5,), Contact("hertz", STIFFNESS["hertz"]))
    engine = TangentPropagator(flow._model(PERIOD, 1), flow.layout, tape_rows=0)
    with pytest.raises(ValueError, match="tape_rows is 0"):
        engine.move(np.zeros((1, 2 * DOFS, CELLS)))


def engine_of(flow: LatticeFlow) -> TangentPropagator:
    """An engine that integrates one orbit over a period, as one sample."""
    return TangentPropagator(flow._model(PERIOD, 1), flow.layout)


def test_an_engine_has_one_orbit_and_moves_variations_only_along_it():
    """An engine runs one orbit, and moves variations only after it.

    Variations along a second orbit would be moved by the matrices of the first.
    """
    flow = lattice_flow((5,), Contact("hertz", STIFFNESS["hertz"]))
    engine = engine_of(flow)
    start = irregular_motion((5,))
    with pytest.raises(RuntimeError, match="call run before move"):
        engine.move(start[None])
    # Without a state the orbit would be that of the lattice at rest.
    with pytest.raises(RuntimeError, match="call place before run"):
        engine.run(1)

    engine.place(start, 1.0)
    end = engine.run(1)
    moved = engine.move(start[None])
    with pytest.raises(RuntimeError, match="run another one in another engine"):
        engine.run(2)
    with pytest.raises(RuntimeError, match="place a state before"):
        engine.place(start, 1.0)

    # The orbit begins with the state that was placed last.
    other = engine_of(flow)
    other.place(irregular_motion((5,), w=4e-3, speed=-2.0), 3.0)
    other.place(start, 1.0)
    np.testing.assert_array_equal(other.run(1), end)
    np.testing.assert_array_equal(other.move(start[None]), moved)


@pytest.mark.parametrize(("look", "sample"), [(None, 4), (list, 1)])
def test_an_orbit_with_more_rows_than_its_tape_is_refused_and_moves_nothing(look, sample):
    """An orbit that needs more rows than its tape has is refused, with the rows needed up to the sample reached.

    A part of an orbit moves no variations.
    """
    flow = lattice_flow((5,), Contact("hertz", STIFFNESS["hertz"]))
    engine = TangentPropagator(flow._model(PERIOD, 4), flow.layout, tape_rows=2)
    start = irregular_motion((5,))
    engine.place(start, 1.0)

    with pytest.raises(StalledError, match=rf"has 2 rows \(tape_rows\), and \d+ are needed up to sample {sample} of 4"):
        engine.run(4, look)

    with pytest.raises(RuntimeError, match="has not reached the orbit's end"):
        engine.move(start[None])
    with pytest.raises(RuntimeError, match="run another one in another engine"):
        engine.run(4)


def test_no_variations_are_moved_to_none():
    flow = lattice_flow((5,), Contact("hertz", STIFFNESS["hertz"]))
    arc = flow.arc(irregular_motion((5,)), PERIOD)
    assert arc.move(np.zeros((0, 2 * DOFS, CELLS))).shape == (0, 2 * DOFS, CELLS)


def test_cells_that_are_not_exchanged_are_no_state(monkeypatch):
    """An error of PETSc in exchanging cells raises an exception when a state is placed."""
    flow = lattice_flow((5,), Contact("hertz", STIFFNESS["hertz"]))
    monkeypatch.setattr("vipetsc.dynamics.propagator.tangent.exchange", lambda *_: 77)
    with pytest.raises(RuntimeError, match="could not exchange cells: error 77"):
        engine_of(flow).place(irregular_motion((5,)), 1.0)


@pytest.mark.parametrize("look", [None, list])
def test_an_orbit_has_at_least_one_sample(look):
    flow = lattice_flow((5,), Contact("hertz", STIFFNESS["hertz"]))
    engine = TangentPropagator(flow._model(PERIOD, 1), flow.layout, tape_rows=0)
    with pytest.raises(ValueError, match="samples is 0"):
        engine.run(0, look)


@pytest.mark.parametrize("law", ["hertz", "bilinear"])
def test_the_conservative_flow_is_symplectic_and_conserves_the_energy(law):
    """The conservative flow keeps the energy, and its linearisation P satisfies P^T J P = J in canonical variables.

    The arc starts within a contact and passes the next one on the other side.
    """
    contact = Contact(law, STIFFNESS[law])
    flow = lattice_flow((5,), contact)
    start = irregular_motion((5,), w=4e-3, speed=0.0)
    arc = flow.arc(start, 2 * PERIOD)
    assert arc.episodes >= 2

    masses = flow.chain.masses()
    stiffness = flow.chain.stiffness_matrix()

    def energy(state: np.ndarray) -> float:
        u, v = np.split(flow.gather(state), 2)
        w = u[5 * DOFS + 2] - u[5 * DOFS + 1]
        return 0.5 * masses @ v**2 + 0.5 * u @ (stiffness @ u) + contact.potential(w, CLEARANCE)

    assert energy(arc.end) == pytest.approx(energy(start), rel=1e-13)

    # Canonical variables in one unit: sqrt(m) Om u and sqrt(m) u'.
    n = CELLS * DOFS
    scale = np.append(np.sqrt(masses) * BREATHER_FREQUENCY, np.sqrt(masses))
    map_ = scale[:, None] * flow.gather(arc.move(flow.scatter(np.eye(2 * n)))).T / scale
    form = np.kron([[0, 1], [-1, 0]], np.eye(n))
    np.testing.assert_allclose(map_.T @ form @ map_, form, atol=1e-9)


def test_a_dissipative_contact_cannot_be_closed_at_the_start():
    flow = lattice_flow((5,), Contact("hertz", STIFFNESS["hertz"], 0.7))
    with pytest.raises(FlowError, match="dissipates is closed"):
        flow.arc(irregular_motion((5,), w=2.2e-3, speed=0.0), PERIOD)


@pytest.mark.parametrize("w", [0.0, -0.5e-5, -2e-5])
def test_a_dissipative_contact_that_is_pressed_at_rest_is_refused_wherever_it_begins(w):
    """A dissipative contact that is pressed at rest is refused at rest, partly unloaded and open.

    It has no approach velocity in any of these states.
    """
    stops = Stops(Contact("hertz", STIFFNESS["hertz"], 0.7), -1e-5, np.inf)
    flow = LatticeFlow(breather_chain("fixed", (5,)), [stops], MPI.COMM_SELF)
    with pytest.raises(FlowError, match="pressed at rest dissipate"):
        flow.arc(irregular_motion((5,), w=w, speed=0.0), PERIOD)


@pytest.mark.parametrize("side", [1, -1])
def test_a_dissipative_contact_is_closed_on_the_side_of_its_displacement(side):
    """A dissipative contact is closed just beyond the stop on the side of w and open just before that stop.

    The stop on the other side has another clearance.
    """
    clearance = {1: CLEARANCE, -1: 1.5 * CLEARANCE}
    stops = Stops(Contact("hertz", STIFFNESS["hertz"], 0.7), plus=clearance[1], minus=clearance[-1])
    flow = LatticeFlow(breather_chain("fixed", (5,)), [stops], MPI.COMM_SELF)
    with pytest.raises(FlowError, match="dissipates is closed"):
        flow.arc(irregular_motion((5,), w=side * 1.001 * clearance[side], speed=0.0), PERIOD)
    flow.arc(irregular_motion((5,), w=side * 0.999 * clearance[side], speed=0.0), PERIOD / 1000)


def test_contacts_that_touch_at_rest_are_refused():
    chain = Chain(four_band("calibrated"), CELLS, "fixed", (5,), (0.0,), pairs=(Pair(0, 0, next_cell=True),))
    flow = LatticeFlow(chain, [Stops.both(Contact("hertz", 1e6), gap) for gap in chain.clearances], MPI.COMM_SELF)
    with pytest.raises(FlowError, match="touch at rest"):
        flow.arc(np.zeros((2 * DOFS, CELLS)), PERIOD)


def test_a_lattice_shorter_than_the_reach_of_a_step_is_refused():
    chain = Chain(four_band("calibrated"), 2, "fixed", (1,), (CLEARANCE,))
    flow = LatticeFlow(chain, [Stops.both(four_band_contact(), CLEARANCE)], MPI.COMM_SELF)
    with pytest.raises(FlowError, match="the lattice has 2 cells, fewer"):
        flow.arc(np.zeros((2 * DOFS, 2)), PERIOD)
