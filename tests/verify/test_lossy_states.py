"""x"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.conftest import StopAt
from tests.independent_lattice import ScipyLattice, Stop
from tests.models import TWO_MASS_CELL
from tests.steady_states import motion_at, nfrc_case, refined
from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes.response import steps
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state
from vipetsc.modes.stability import LEAST_OF_FINITE
from vipetsc.parallel import StoppedError

CLEARANCE = 1e-4
RESTITUTION = 0.7
PHASE = 1.5  # rad, at which no contact is closed


def states_from(omega: float, touches: float, **nfrc: Any) -> SteadyStates:
    """Steady states of three cells with a stiff lossy stop in the second, at ``omega`` (rad/s).

    The range begins at ``touches`` times the force at which the linear motion touches the stop.
    """

    def states(low: float) -> SteadyStates:
        case = NfrcCase.from_table(
            {
                "name": "x",
                "lattice": {"cells": 3, "cell": TWO_MASS_CELL},
                "contacts": {"stiffness": 1e7, "sites": [2], "clearance": CLEARANCE, "restitution": RESTITUTION},
                "drive": {"frequency": omega, "cell": 1, "amplitude": 1.0, "cycles": 3},
                "nfrc": {"source": "force", "infinite": False, "harmonics": 21, "range": [low, 1e4]} | nfrc,
            }
        )
        return SteadyStates(case, RESTITUTION, omega)

    return states(touches * states(1e-3).parameter.scale)


def after_a_period(states: SteadyStates, omega: float, amplitude: float, start: np.ndarray) -> np.ndarray:
    """Displacements and velocities (2, n) a period after ``start`` (2, n) at the phase ``PHASE``, by SciPy."""
    chain = states.case.model().chain
    n = len(chain.masses())
    stops = tuple(
        Stop(resonator=3, host=2, gap=CLEARANCE, stiffness=1e7, exponent=1.5, restitution=RESTITUTION, side=side)
        for side in (1, -1)
    )
    push = np.zeros(n)
    push[0] = amplitude
    lattice = ScipyLattice(
        masses=chain.masses(),
        stiffness=chain.stiffness_matrix().toarray(),
        damping=np.zeros((n, n)),
        stops=stops,
        force=lambda t: push * np.cos(omega * t),
    )
    # The integrator begins with open stops, hence at a phase without contact.
    times = (PHASE + np.array([0.0, 2 * np.pi])) / omega
    motion, impacts = lattice.motion(times, *start, start=float(times[0]))
    # The state sought has one impact on either side.
    assert impacts == 2
    return motion[:2, -1]


@pytest.fixture
def by_weights(monkeypatch) -> list[Any]:
    """The calls of the path by growing weights of the contact forces, one entry for each."""
    asked: list[Any] = []
    lead = steps._by_weights

    def recorded(*given: Any) -> np.ndarray:
        asked.append(given)
        return lead(*given)

    monkeypatch.setattr(steps, "_by_weights", recorded)
    return asked


def test_a_range_begins_where_growing_amplitudes_do_not_lead(by_weights):
    """At 3 times the touching force a state is found by growing weights, and SciPy returns it after a period.

    Growing amplitudes end at 2.4 times that force, where one episode of contact becomes two.
    """
    omega = 1000.0
    few = states_from(omega, 3.0)
    first = first_state(few)
    # Growing amplitudes alone would not have led there.
    assert len(by_weights) == 1

    # With 101 harmonics the error of truncation is below the tolerance of the comparison.
    many = states_from(omega, 3.0, harmonics=101)
    xi = refined(few, many, first.xi)
    _, amplitude = many.drive(xi[-1])
    start = np.stack([part.ravel() for part in motion_at(many, xi, np.arange(3), PHASE)])
    end = after_a_period(many, omega, amplitude, start)
    change = np.abs(end - start).max(axis=1) / np.abs(start).max(axis=1)
    assert (change < 3e-4).all(), change


def test_growing_weights_lead_to_the_state_of_growing_amplitudes(monkeypatch, by_weights):
    """Where there is only one state, growing weights find the one that growing amplitudes find.

    Growing weights take over when growing amplitudes reach their limit of steps.
    """
    omega = 1700.0
    states = states_from(omega, 1.5)
    expected = first_state(states).xi
    assert states.measured(expected).episodes == 2
    assert not by_weights

    # A low limit ends growing amplitudes early, so that growing weights are used.
    monkeypatch.setattr(steps, "MOST_RAMP", 5)
    monkeypatch.setattr(steps, "LONGEST_RAMP", 0.5)
    assert first_state(states).xi == pytest.approx(expected, abs=1e-9)
    assert by_weights


def test_a_request_to_stop_ends_the_way_to_the_first_state(monkeypatch, by_weights):
    """Neither growing amplitudes nor growing weights go on after a request to stop."""
    states = states_from(1000.0, 3.0)
    with pytest.raises(StoppedError, match="before the first point"):
        first_state(states, StopAt(0))
    assert not by_weights

    # After a single step of growing amplitudes, growing weights take over.
    monkeypatch.setattr(steps, "MOST_RAMP", 1)
    monkeypatch.setattr(steps, "LONGEST_RAMP", 0.0)
    with pytest.raises(StoppedError, match="before the first point"):
        first_state(states, StopAt(3))
    assert len(by_weights) == 1


class ForcedCell:
    """A lattice with one dissipative contact under a harmonic force, integrated from phase to phase of the force."""

    def __init__(self, states: SteadyStates, omega: float, force: float) -> None:
        model = states.case.model()
        chain = model.chain
        dofs = chain.cell.dofs
        first = chain.sites[0].cell * dofs
        self.contact = states.forces.contacts[0].law
        self.clearance = chain.sites[0].clearance
        self.masses = chain.masses()
        self.stiffness = chain.stiffness_matrix().toarray()
        self.pair = np.zeros(len(self.masses))
        self.pair[first + chain.cell.resonator] = 1
        self.pair[first + chain.cell.host] = -1
        self.load = np.zeros(len(self.masses))
        self.load[model.drive_cell * dofs + model.drive_mass] = force
        self.omega = omega

    def rate(self, t, y, side, approach):
        """The time derivative of the state ``y`` (displacements, velocities), in contact on ``side`` (0: open)."""
        u, v = y.reshape(2, -1)
        force = self.load * np.cos(self.omega * t) - self.stiffness @ u
        if side:
            # Rounding may put w just outside the stop while the contact is closed.
            w = side * max(side * self.pair @ u, self.clearance)
            force -= self.pair * self.contact.force(w, self.clearance, self.pair @ v, approach)
        return np.concatenate([v, force / self.masses])

    def gap(self, t, y, side, approach):
        """The indentation in m on ``side``, or on either side of an open contact; zero where contact begins or ends."""
        w = self.pair @ y[: len(self.masses)]
        return side * w - self.clearance if side else abs(w) - self.clearance

    def half_a_period(self, state, phase):
        """The negative of the state half a period after the ``phase`` (rad), at which the contact is open.

        The stops are alike on both sides, and the force changes its sign after half a period. A symmetric steady state
        is thus mapped to itself, and the map applied twice is the map of a period.
        """
        t = phase / self.omega
        end = t + np.pi / self.omega
        y = state
        side = 0.0
        approach = 1.0

        def change(*arguments):
            return self.gap(*arguments)

        change.terminal = True
        while t < end:
            change.direction = -1 if side else 1
            done = solve_ivp(self.rate, (t, end), y, "DOP853", events=change, args=(side, approach), rtol=1e-9,
                             atol=1e-13, max_step=2e-4)  # fmt: skip
            t = done.t[-1]
            y = done.y[:, -1]
            u, v = y.reshape(2, -1)
            side = 0.0 if side else float(np.sign(self.pair @ u))
            approach = self.pair @ v
        return -y

    def multipliers(self, state, scale, phase):
        """The Floquet multipliers of a period: squares of the eigenvalues of the half period map's derivative.

        The derivative is taken by central differences with the step ``scale`` of each component.
        """
        columns = []
        for step, change in zip(scale, np.diag(scale), strict=True):
            after = self.half_a_period(state + change, phase)
            before = self.half_a_period(state - change, phase)
            columns.append((after - before) / (2 * step))
        return np.linalg.eigvals(np.array(columns).T) ** 2


@pytest.mark.parametrize(("force", "last"), [(19.5, 61)])
def test_stability_of_a_dissipative_state_is_that_of_its_period_map(force, last):
    """A steady state is unstable where a Floquet multiplier of its period map exceeds 1, and has its growth rate.

    Restitution is 0.7. Of two cells one state is unstable and one stable; each is judged after a state without contact
    at the same frequency, so that nothing is carried over from one to the next.
    """
    omega = 1700.0
    of = nfrc_case({"cells": 2}, {"sites": [1], "restitution": 0.7}, source="force", infinite=False, harmonics=last,
              range=[force, 26.0], fixed=[omega], largest_step=0.5)  # fmt: skip
    states = SteadyStates(of, 0.7, omega)
    xi = first_state(states).xi

    # This state is the motion of the linear lattice under a force too small for contact.
    linear = 0.5 * states.parameter.scale * states.linear_motion(omega).harmonics
    free = np.append(states.balance.pack(linear) / states.clearance, 0.5)
    assert states.measured(free).unstable == 0
    measures = states.measured(xi)
    assert measures.episodes > 0

    # The period begins at a phase at which the contact is open.
    phases = np.linspace(0, np.pi, 2001)
    z = measures.harmonics[0]
    w = (z * np.exp(1j * np.arange(len(z)) * phases[:, None])).sum(axis=1).real
    phase = phases[np.argmin(np.abs(w))]

    motion = ForcedCell(states, omega, force)
    start = np.concatenate([part.ravel() for part in motion_at(states, xi, np.arange(2), phase)])
    scale = 1e-5 * states.clearance * np.repeat([1, omega], len(start) // 2)
    # The force of a lossy contact jumps at its onset. The harmonics that are left out move the state, half a period
    # later, by up to 6e-5 clearances.
    assert np.abs((motion.half_a_period(start, phase) - start) / scale).max() < 10
    sizes = np.abs(motion.multipliers(start, scale, phase))
    assert measures.unstable == np.count_nonzero(sizes > np.exp(2 * np.pi * LEAST_OF_FINITE))
    assert (measures.unstable > 0) == (force < 20)
    if measures.unstable:
        assert np.exp(2 * np.pi * measures.growth) == pytest.approx(sizes.max(), rel=1e-4)
