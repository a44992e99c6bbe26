"""Stability of states with dissipation and many harmonics, next to states without contact at the same frequency."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from tests.models import force_of
from tests.steady_states import motion_at, nfrc_case
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state
from vipetsc.modes.stability import LEAST_OF_FINITE

pytestmark = pytest.mark.parallel(1)


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
            force -= self.pair * force_of(self.contact, w, self.clearance, self.pair @ v, approach)
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
