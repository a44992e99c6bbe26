"""Two masses of which one meets a stop, forced and damped: the third example of NLvib (Krack and Gross 2019).

Masses 1 kg, springs 1 N/m from one to the other and from the second to the ground, dampers .03 of the springs, a stop
of 100 N/m for the first mass beyond 1 m on one side, .1 N cos(Om t) on the second. No case file has dampers of a
system of one's own, or a force on it, so that the equations of ``nfrc`` are given the compliance here; stops act on
both sides, of which an offset takes one out of reach.
M. Krack, J. Gross, Harmonic Balance for Nonlinear Vibration Problems, Springer 2019; github.com/maltekrack/NLvib.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from vipetsc.lattice import Contact
from vipetsc.modes.balance.harmonic_balance import HarmonicBalance
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.balance.hill import Hill
from vipetsc.modes.response.steady import ContinuationParameter, LinearMotion, SteadyEquations

K, STOP, GAP, FORCE, OFFSET, LAST = np.array([[1.0, -1.0], [-1.0, 2.0]]), 100.0, 1.0, 0.1, 10.0, 101
C = 0.03 * K


class Damped:
    """The compliance of the first mass, to the forces on both."""

    def at(self, omegas, column=0):
        dynamic = [K + 1j * omega * C - omega**2 * np.eye(2) for omega in np.atleast_1d(omegas)]
        return np.array([np.linalg.inv(d)[:1, column : column + 1] for d in dynamic])


class Example(SteadyEquations):
    """The steady states of the example over the frequency."""

    def __init__(self):
        self.compliance = Damped()
        forces = SiteForces([(Contact("bilinear", STOP), GAP + OFFSET)])
        balance = HarmonicBalance(self.compliance, forces, LAST, odd=False, cosines=False)
        over = ContinuationParameter("frequency", fixed=1.0, scale=0.15)
        super().__init__(balance, GAP, over, tolerance=1e-12, max_newton=12)

    def linear_motion(self, omega):
        z = np.zeros((1, LAST + 1), complex)
        z[0, :2] = OFFSET, FORCE * self.compliance.at(omega, 1)[0, 0, 0]
        return LinearMotion(z, None)


def flow(omega, state, shares=()):
    """State after a period, its derivative, states (4, shares) between: linear pieces, forces are continuous."""
    t, end, y, map_, touching = 0.0, 2 * np.pi / omega, state, np.eye(4), state[0] > GAP
    times, between = end * np.array(shares), np.zeros((4, len(shares)))
    while t < end:
        matrix = np.block([[np.zeros((2, 2)), np.eye(2)], [-K - np.diag([STOP * touching, 0]), -C]])
        push = np.array([0, 0, STOP * GAP * touching, 0])

        def change(t, y):
            return y[0] - GAP

        change.terminal, change.direction = True, -1 if touching else 1
        done = solve_ivp(lambda t, y, a=matrix, b=push: a @ y + b + [0, 0, 0, FORCE * np.cos(omega * t)], (t, end), y,
                         "DOP853", events=change, rtol=1e-12, atol=1e-13, dense_output=len(times) > 0)  # fmt: skip
        if len(times):
            inside = (times >= t) & (times <= done.t[-1])
            between[:, inside] = done.sol(times[inside])
        map_ = expm(matrix * (done.t[-1] - t)) @ map_
        t, y, touching = done.t[-1], done.y[:, -1], not touching
    return y, map_, between


def fundamentals(states, xi):
    """Harmonics of order 1 of the displacement of the two masses."""
    omega = states.drive(xi[-1])[0]
    force = -states.balance.series(xi[:-1], omega).forces[0, 1]
    return np.linalg.solve(K + 1j * omega * C - omega**2 * np.eye(2), [force, FORCE])


def shot(omega, state):
    """The periodic orbit near ``state`` and its multipliers, by Newton's method."""
    for _ in range(8):
        end, derivative, _ = flow(omega, state)
        step = np.linalg.solve(derivative - np.eye(4), end - state)
        state = state - step
        if np.abs(step).max() < 1e-11:
            return state, np.linalg.eigvals(derivative)
    pytest.fail(f"no orbit at {omega:g} rad/s")


@pytest.mark.slow
def test_both_ways_give_one_curve_and_the_published_stability():
    """Past the folds: stable at .635 rad/s; at .6 a pair grows, at .74, near resonance, a real negative multiplier."""
    states, state = Example(), np.array([-1.0, -1.0, 0.0, 0.0])
    for _ in range(80):
        state = flow(0.635, state)[0]
    first, grown = shot(0.635, state)[0], {}
    for way in (np.linspace(0.635, 0.6, 5), np.linspace(0.635, 0.74, 15)):
        state = first
        for omega in way:
            state, mu = shot(omega, state)
            if omega not in (0.6, 0.635, 0.74):
                continue
            spectrum = np.fft.rfft(flow(omega, state, np.arange(512) / 512)[2][:2]) / 256
            harmonics = spectrum[:1, : LAST + 1] + OFFSET * (np.arange(LAST + 1) == 0)
            harmonics[0, 0] -= spectrum[0, 0] / 2
            xi = states.at(np.append(states.balance.pack(harmonics), 0.0), omega / states.parameter.scale)
            assert fundamentals(states, xi) == pytest.approx(spectrum[:, 1], rel=1e-6)
            hill = Hill(states.compliance, omega, LAST, odd=False, finite=True)
            fastest = hill.fastest(states.balance.series(xi[:-1], omega))
            largest = mu[np.argmax(np.abs(mu))]
            assert (fastest == 0) == (np.abs(largest) < 1)
            if fastest:
                assert np.exp(2 * np.pi * fastest) == pytest.approx(complex(largest.real, abs(largest.imag)), rel=1e-5)
            grown[omega] = largest
    assert np.abs(grown[0.635]) < 1 < min(np.abs(grown[0.6]), -grown[0.74].real)
    assert abs(grown[0.6].imag) > 1 and grown[0.74].imag == 0
