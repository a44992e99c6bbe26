"""Two masses of which one meets a stop, forced and damped: the third example of NLvib (Krack and Gross 2019).

The masses are 1 kg each. Springs of 1 N/m join the first to the second and the second to the ground, with dampers of
0.03 N s/m. The first mass meets a stop of 100 N/m beyond 1 m on one side; 0.1 N cos(Om t) acts on the second.
M. Krack, J. Gross, Harmonic Balance for Nonlinear Vibration Problems, Springer 2019; github.com/maltekrack/NLvib.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import vipetsc
from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes.response.steady import SteadyStates

EXAMPLE = Path(vipetsc.__file__).parent / "examples" / "nlvib.toml"
K = np.array([[1.0, -1.0], [-1.0, 2.0]])
STOP = 100.0
GAP = 1.0
FORCE = 0.1
# The highest harmonic: the forces of the stiff stop have many.
LAST = 101
C = 0.03 * K


def dynamic_stiffness(omega: float) -> np.ndarray:
    """The matrix K + i omega C - omega^2 M (2, 2) of the linear system."""
    return K + 1j * omega * C - omega**2 * np.eye(2)


def steady_states() -> SteadyStates:
    """The equations of the example's curve."""
    case = NfrcCase.load(EXAMPLE)
    options = case.nfrc.model_copy(update={"harmonics": LAST})
    return SteadyStates(case.model_copy(update={"nfrc": options}), restitution=1.0, fixed=FORCE)


class Arc(NamedTuple):
    """A motion over one period: its last state (4,), the derivative (4, 4) by the first one, states (4, instant)."""

    end: np.ndarray
    derivative: np.ndarray
    between: np.ndarray


def flow(omega: float, start: np.ndarray, instants: np.ndarray | None = None) -> Arc:
    """Integrate a period, whose linear pieces end where the stop is met or left.

    States between are those at ``instants``, given as fractions of the period. The force is continuous at the stop, so
    that the derivative of the end by the start is the product of the pieces' matrix exponentials.
    """
    period = 2 * np.pi / omega
    times = period * np.array([] if instants is None else instants)
    between = np.zeros((4, len(times)))
    derivative = np.eye(4)
    t = 0.0
    y = start
    touching = start[0] > GAP

    def gap(_, y):
        return y[0] - GAP

    gap.terminal = True
    while t < period:
        matrix = np.block([[np.zeros((2, 2)), np.eye(2)], [-K - np.diag([STOP * touching, 0]), -C]])
        push = np.array([0, 0, STOP * GAP * touching, 0])

        def rate(t, y, matrix=matrix, push=push):
            return matrix @ y + push + [0, 0, 0, FORCE * np.cos(omega * t)]

        gap.direction = -1 if touching else 1
        solved = solve_ivp(
            rate, (t, period), y, "DOP853", events=gap, rtol=1e-12, atol=1e-13, dense_output=len(times) > 0
        )
        inside = (times >= t) & (times <= solved.t[-1])
        if inside.any():
            between[:, inside] = solved.sol(times[inside])

        derivative = expm(matrix * (solved.t[-1] - t)) @ derivative
        t = solved.t[-1]
        y = solved.y[:, -1]
        touching = not touching
    return Arc(y, derivative, between)


def fundamentals(states: SteadyStates, xi: np.ndarray) -> np.ndarray:
    """The first harmonics (2,) of the displacements of the two masses, in m."""
    omega, _ = states.drive(xi[-1])
    stop = -states.balance.series(xi[:-1], omega).forces[0, 1]
    return np.linalg.solve(dynamic_stiffness(omega), [stop, FORCE])


def periodic_orbit(omega: float, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The periodic orbit near ``state`` and its multipliers, by Newton's method."""
    for _ in range(8):
        arc = flow(omega, state)
        step = np.linalg.solve(arc.derivative - np.eye(4), arc.end - state)
        state = state - step
        if np.abs(step).max() < 1e-11:
            return state, np.linalg.eigvals(arc.derivative)
    pytest.fail(f"no orbit at {omega:g} rad/s")


@pytest.fixture(scope="module")
def attractor() -> np.ndarray:
    """The state (4,) at phase 0 of the orbit at 0.635 rad/s to which motions settle."""
    state = np.array([-1.0, -1.0, 0.0, 0.0])
    # After 80 periods the damped motion is near enough to the orbit for Newton's method.
    for _ in range(80):
        state = flow(0.635, state).end
    return periodic_orbit(0.635, state)[0]


@pytest.mark.parametrize(
    ("omega", "steps", "stability"), [(0.635, 1, "stable"), (0.6, 5, "a pair grows"), (0.74, 15, "flips")]
)
def test_shooting_and_harmonic_balance_find_the_published_stability(attractor, omega, steps, stability):
    """Shooting and harmonic balance find the same orbits past the folds, with the same multipliers.

    The orbit is stable at 0.635 rad/s. At 0.6 a complex pair exceeds 1 in modulus; at 0.74 a multiplier is below -1.
    """
    state = attractor
    for frequency in np.linspace(0.635, omega, steps):
        state, multipliers = periodic_orbit(frequency, state)
    largest = multipliers[np.argmax(np.abs(multipliers))]
    if stability == "stable":
        assert np.abs(largest) < 1
    elif stability == "a pair grows":
        assert np.abs(largest) > 1
        assert abs(largest.imag) > 1
    else:
        assert -largest.real > 1
        assert largest.imag == 0

    # Harmonic balance begins with the harmonics of the orbit, and keeps the first ones up to its truncation.
    spectrum = np.fft.rfft(flow(omega, state, np.arange(512) / 512).between[:2]) / 256
    harmonics = spectrum[:1, : LAST + 1].copy()
    harmonics[0, 0] /= 2
    states = steady_states()
    xi = states.at(np.append(states.balance.pack(harmonics), 0.0), omega / states.parameter.scale)
    assert fundamentals(states, xi) == pytest.approx(spectrum[:, 1], rel=1e-6)

    hill, series = states.hill_at(xi)
    fastest = hill.fastest(series)
    assert (fastest == 0) == (stability == "stable")
    if fastest:
        # Hill's method gives the multiplier of a conjugate pair with the positive imaginary part.
        assert np.exp(2 * np.pi * fastest) == pytest.approx(complex(largest.real, abs(largest.imag)), rel=1e-5)
