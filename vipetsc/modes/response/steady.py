r"""Steady answers of a lattice's sites to a harmonic force or to an incident Bloch wave, followed over a parameter.

With the contacts condensed (``condensed``) the harmonics Z of the relative displacements obey

    Z_k + G(k Om) F_k(Z) = a delta_k1 w(Om),

w being what the force (1 N) or the wave (1 clearance of the first site) alone would make at the sites. Unknowns are Z
over that clearance and the parameter, the amplitude a or the frequency Om over a scale; a curve of solutions is
followed by pseudo-arclength (Keller 1977, see the package), folds in the parameter are located on it.

**Energy.** A wave of the flux P a^2 comes in. What leaves at Om on the side that it goes to is transmitted (T), on the
other reflected (R); what leaves at k Om, k > 1, is U; contacts lose L. T + R + U + L = 1 for any number of harmonics,
as the loss is that of the harmonics kept. A force gives what it gives: shares are over that, T to higher cells.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vipetsc.case.nfrc import NfrcCase
from vipetsc.lattice import IncidentWave, WaveCompliance
from vipetsc.modes.balance.harmonic_balance import Balance
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.balance.hill import Hill
from vipetsc.modes.newton import Attempt, BorderedNewton
from vipetsc.modes.problem import ContinuationError, FlowError

TURN, CORRECTION = 0.25, 0.1  # largest angle in rad between tangents, and correction over the step
SLOPE = 1e-6  # relative step of a difference in frequency
FOLD = 1e-11  # of the arclength, to which a fold is located


@dataclass(frozen=True, eq=False)
class SteadyPoint:
    """A steady state: unknowns ``xi``, unit ``tangent``, the next ``step``; ``kind`` is "regular" or "fold"."""

    xi: np.ndarray
    tangent: np.ndarray
    step: float
    kind: str = "regular"
    measures: dict[str, Any] = field(default_factory=dict)


class SteadyStates:
    """Of the sites of a case with the ``restitution`` and the other parameter ``fixed`` (see ``NfrcTable``)."""

    def __init__(self, case: NfrcCase, restitution: float, fixed: float) -> None:
        self.case, self.restitution, self.fixed = case, restitution, fixed
        model, self.options = case.model(), case.nfrc
        options, point = self.options, (model.drive_cell, model.drive_mass)
        self.wave = options.source == "wave"
        self.compliance = WaveCompliance(model.chain, options.infinite, () if self.wave else (point,))
        self.clearance, self.point, last = model.chain.clearances[0], point, options.harmonics
        contact = case.contact(restitution)
        self.forces = SiteForces([(contact, clearance) for clearance in model.chain.clearances])
        self.balance = Balance(self.compliance, self.forces, last, options.symmetric, cosines=False)
        self.count, self.hill = self.balance.size, self._hill(0.0)
        self._known: dict[float, tuple[np.ndarray, IncidentWave | None]] = {}
        low, high = options.range
        self.scale = 1.0 if self.wave else float(self.clearance / np.abs(self.linear(case.frequency)[:, 1]).max())
        if options.over == "frequency":
            self.scale = (high - low) / 2
        self.newton = BorderedNewton(self.residual, self.matrix, self.count + 1, options.tolerance, options.max_newton)

    def parameters(self, p: float) -> tuple[float, float]:
        """Frequency (rad/s) and amplitude at the scaled parameter ``p``."""
        return (self.fixed, p * self.scale) if self.options.over == "amplitude" else (p * self.scale, self.fixed)

    def linear(self, omega: float) -> np.ndarray:
        """Harmonics (pairs, K + 1) in m of the linear lattice, for the amplitude 1; FlowError outside a wave's band."""
        if omega not in self._known:
            self._known = dict(list(self._known.items())[-8:])
            z, pairs = np.zeros((self.forces.pairs, self.options.harmonics + 1), complex), self.forces.pairs
            wave = None
            if self.wave:
                try:
                    wave = self.compliance.incident(omega, self.options.band or 0, self.options.towards)
                except ValueError as error:
                    raise FlowError(str(error)) from None
                z[:, 1] = wave.relative * self.clearance
            else:
                z[:, 1] = self.compliance.response(omega)[0, :, pairs]
            self._known[omega] = z, wave
        return self._known[omega][0]

    def residual(self, xi: np.ndarray) -> np.ndarray:
        """What is to be zero (count,), over the clearance."""
        omega, amplitude = self.parameters(xi[-1])
        if not omega > 0:
            raise FlowError("the frequency is not positive")
        x = xi[:-1] * self.clearance
        return self.balance.residual(x, omega, amplitude * self.linear(omega)) / self.clearance

    def matrix(self, xi: np.ndarray) -> np.ndarray:
        """The derivative (count, count + 1) of the ``residual``."""
        omega, amplitude = self.parameters(xi[-1])
        jacobian, rate = self.balance.derivative(xi[:-1] * self.clearance, omega)
        if self.options.over == "amplitude":
            column = self.balance.residual(np.zeros(self.count), omega, self.linear(omega))
        else:
            ends = [omega * (1 + sign * SLOPE) for sign in (1, -1)]
            after, before = (self.balance.residual(np.zeros(self.count), w, amplitude * self.linear(w)) for w in ends)
            column = rate + (after - before) / (ends[0] - ends[1])
        return np.column_stack([jacobian, column * self.scale / self.clearance])

    def tangent(self, xi: np.ndarray, near: np.ndarray) -> np.ndarray:
        """The unit tangent at a solution, on the side of ``near``."""
        right = np.zeros(len(xi))
        right[-1] = 1
        direction = np.linalg.solve(np.vstack([self.matrix(xi), near]), right)
        return np.asarray(direction / np.linalg.norm(direction))

    def solve(self, guess: np.ndarray, row: np.ndarray, value: float) -> Attempt:
        """Newton's method with the row; what cannot be evaluated has not converged."""
        try:
            return self.newton.solve(guess, row, value)
        except ArithmeticError as error:
            return Attempt(False, str(error), [], guess, left_domain=True)

    def at(self, guess: np.ndarray, p: float) -> np.ndarray:
        """The solution at the scaled parameter ``p`` near ``guess``; raises ContinuationError."""
        row = np.eye(self.count + 1)[-1]
        attempt = self.solve(np.append(guess[:-1], p), row, p)
        if not attempt.converged:
            value = self.parameters(p)[self.options.over == "amplitude"]
            raise ContinuationError(f"no solution at {self.options.over} {value:.6g}: {attempt.reason}")
        return attempt.xi

    def measured(self, xi: np.ndarray) -> dict[str, Any]:
        """What the file holds of a solution (``LAYOUT`` of ``nfrc``)."""
        omega, amplitude = self.parameters(xi[-1])
        x = xi[:-1] * self.clearance
        z, series = self.balance.unpack(x), self.balance.series(x, omega)
        padded = np.pad(z, ((0, 0), (0, 7 * z.shape[1]))) * np.where(np.arange(8 * z.shape[1]), 0.5, 1)
        moved = np.fft.irfft(padded, axis=1, norm="forward")
        if self.hill.omega != omega:
            self.hill = self._hill(omega)
        unstable = self.hill.unstable(series)
        fastest = self.hill.fastest(series) if unstable else 0j
        shares = self._shares(omega, amplitude, series.forces[:, : z.shape[1]], float(series.loss.sum()))
        return {
            "frequency": omega, "amplitude": amplitude, "harmonics": z.real, "harmonics_imaginary": z.imag,
            "largest": np.abs(moved).max(axis=1),
            "unstable": unstable, "growth": np.nan if fastest is None else fastest.real, "share": shares,
            "closed": series.closed, "episodes": len(series.episodes), "truncation": self.balance.truncation(x, omega),
        }  # fmt: skip

    def _hill(self, omega: float) -> Hill:
        options = self.options
        return Hill(self.compliance, omega, options.harmonics, options.symmetric, finite=not options.infinite)

    def _shares(self, omega: float, amplitude: float, forces: np.ndarray, loss: float) -> np.ndarray:
        """T, R, U and L over what comes in (4,); what leaves is not told of a finite lattice."""
        first, shares = forces[:, 1], np.full(4, 0.0 if self.options.infinite else np.nan)
        loss *= omega / (2 * np.pi)
        wave = self._known[omega][1] if self.wave else None
        if wave is not None:
            amplitude, given = amplitude * self.clearance, (amplitude * self.clearance) ** 2 * wave.flux
        else:
            first = np.append(first, amplitude)
            moved = self.compliance.field(omega, first, [self.point[0]])[0, self.point[1]]
            given = 0.5 * amplitude * float((1j * omega * moved).real)
            given *= given > 1e-12 * amplitude * omega * abs(moved)  # nothing but rounding if nothing leaves or is lost
        if self.options.infinite:
            out = self.compliance.outgoing(omega, first, wave, amplitude).sum(axis=1)
            shares[:2] = out if self.options.towards > 0 else out[::-1]
            for k in range(2, forces.shape[1]):
                if np.any(forces[:, k]):
                    shares[2] += self.compliance.outgoing(k * omega, forces[:, k]).sum()
        shares[3] = loss
        return shares / given if given > 0 else np.full(4, np.nan)


class Steady:
    """Iterates over the points of a curve from a first point on, folds among them; ``ending`` tells how it ended.

    Raises ContinuationError if steps fall below the smallest: the message says where, why and which key to turn.
    """

    def __init__(self, states: SteadyStates, start: SteadyPoint, points: int) -> None:
        self.states, self.point, self.points = states, start, points
        self.ending, self.finished = "not finished", False

    def __iter__(self) -> Iterator[SteadyPoint]:
        low, high = (bound / self.states.scale for bound in self.states.options.range)
        for _ in range(self.points):
            last = self.point
            point = self._next(last)
            if last.tangent[-1] * point.tangent[-1] < 0:
                yield self._fold(last, point)
            if not low <= point.xi[-1] <= high:
                bound = low if point.xi[-1] < low else high
                xi = self.states.at(point.xi, bound)
                point = SteadyPoint(xi, self.states.tangent(xi, point.tangent), point.step)
                self.finished, self.ending = True, f"reached the end of nfrc.range, {bound * self.states.scale:g}"
            self.point = point
            yield point
            if self.finished:
                return
        self.ending = f"{self.points} points reached: raise nfrc.points and resume to go on"

    def _next(self, last: SteadyPoint) -> SteadyPoint:
        """The next point behind ``last``; raises ContinuationError."""
        states, step, why = self.states, last.step, ""
        states.balance.shift(states.parameters(last.xi[-1])[0])
        while step >= states.options.smallest_step:
            guess = last.xi + step * last.tangent
            attempt = states.solve(guess, last.tangent, last.tangent @ guess)
            why = f"Newton's method ended with {attempt.reason} (residuals {attempt.residuals or 'none'})"
            if attempt.converged:
                tangent = states.tangent(attempt.xi, last.tangent)
                angle = np.arccos(np.clip(tangent @ last.tangent, -1, 1))
                far = np.linalg.norm(attempt.xi - guess) / step
                if angle <= TURN and far <= CORRECTION:
                    growth = min(1.6, 0.5 * TURN / max(angle, 1e-9))
                    ahead = min(step * max(growth, 0.5), states.options.largest_step)
                    return SteadyPoint(attempt.xi, tangent, ahead)
                why = f"the curve turns too sharply ({angle:.2g} rad)"
            step /= 2
        omega, amplitude = states.parameters(last.xi[-1])
        knob = "raise nfrc.harmonics or nfrc.max_newton, or lower nfrc.smallest_step"
        raise ContinuationError(
            f"no step from the last good point, {omega:.8g} rad/s at amplitude {amplitude:.6g}: {why}; {knob}"
        )

    def _fold(self, last: SteadyPoint, point: SteadyPoint) -> SteadyPoint:
        """The point between two at which the parameter is largest or smallest, by the secant of the tangent's part."""
        states = self.states
        low, high = 0.0, float(last.tangent @ (point.xi - last.xi))
        values, xi, tangent = [last.tangent[-1], point.tangent[-1]], point.xi, point.tangent
        a, b = low, high
        for _ in range(60):
            step = a + (b - a) * values[0] / (values[0] - values[1])
            attempt = states.solve(last.xi + step * last.tangent, last.tangent, last.tangent @ last.xi + step)
            if not attempt.converged:
                break
            xi, tangent = attempt.xi, states.tangent(attempt.xi, last.tangent)
            if abs(tangent[-1]) < FOLD or b - a < FOLD * high:
                break
            side = 0 if tangent[-1] * values[0] > 0 else 1
            values[1 - side] *= 0.5  # Illinois
            values[side] = tangent[-1]
            a, b = (step, b) if side == 0 else (a, step)
        return SteadyPoint(xi, tangent, point.step, "fold")
