"""The paper's flow: Newmark's average-acceleration rule with sensitivities, a fixed number of steps a period.

The sensitivities are the exact derivatives of the discrete flow (Peeters et al., Nonlinear normal modes, part II,
Mech. Syst. Signal Process. 23, 2009, App. A). Contacts are met at the ends of steps only, which is this method's error.
"""

import numpy as np

from vipetsc.compiled import njit
from vipetsc.modes.kernel import CompiledSystem, contact_force, elongation, spring_force
from vipetsc.modes.orbit import Arc, Flow, FlowError

STEPS = 2000


@njit
def _add(row: np.ndarray, pull: float, slope: float, force: np.ndarray, tangent: np.ndarray) -> None:
    for i in range(row.size):
        force[i] += row[i] * pull
        for j in range(row.size):
            tangent[i, j] += slope * row[i] * row[j]


@njit
def _forces(system: CompiledSystem, u: np.ndarray, force: np.ndarray, tangent: np.ndarray) -> None:
    """Restoring forces (n,) in N and tangent stiffness (n, n) in N/m at displacements ``u`` (n,) in m."""
    for i in range(u.size):
        force[i] = elongation(system.stiffness[i], u)
    tangent[:] = system.stiffness
    for c in range(system.contacts.size):
        w = elongation(system.rows[c], u)
        x = abs(w) - system.contacts[c].clearance
        if x > 0.0:
            pull, slope = contact_force(system, c, x)
            _add(system.rows[c], np.sign(w) * pull, slope, force, tangent)
    for s in range(system.springs.size):
        pull, slope = spring_force(system, s, elongation(system.spring_rows[s], u))
        _add(system.spring_rows[s], pull, slope, force, tangent)


@njit
def _linear_accelerations(system: CompiledSystem, tangent: np.ndarray, u: np.ndarray) -> np.ndarray:
    """-M^-1 tangent u (n, columns)."""
    n, columns = u.shape
    a = np.zeros((n, columns))
    for i in range(n):
        for j in range(columns):
            for k in range(n):
                a[i, j] -= system.inverse_mass[i] * tangent[i, k] * u[k, j]
    return a


@njit
def _matrix(system: CompiledSystem, tangent: np.ndarray, quarter: float) -> np.ndarray:
    """I + h^2/4 M^-1 tangent, with ``quarter`` = h^2/4."""
    n = tangent.shape[0]
    return quarter * tangent * system.inverse_mass.reshape(n, 1) + np.eye(n)


@njit
def _solve_step(
    system: CompiledSystem, guess: np.ndarray, a: np.ndarray, quarter: float, force: np.ndarray, tangent: np.ndarray
) -> bool:
    """Newton's method for the accelerations ``a`` (n,) at a step's end, where u = ``guess`` + h^2/4 a.

    Displacements as unknowns would lose digits to 4/h^2. Leaves the tangent there; returns whether it converged.
    """
    scale, shift = 0.0, a
    for _ in range(60):
        _forces(system, guess + quarter * a, force, tangent)
        shift = np.linalg.solve(_matrix(system, tangent, quarter), a + force * system.inverse_mass)
        a -= shift
        scale = max(scale, np.abs(a).max())
        if np.abs(shift).max() <= 1e-14 * scale:
            break
    _forces(system, guess + quarter * a, force, tangent)
    return np.abs(shift).max() <= 1e-11 * scale


@njit
def _newmark(system: CompiledSystem, y: np.ndarray, duration: float, steps: int, w: np.ndarray) -> bool:
    """Advance ``y`` (2n, 1 + m) in place; ``w`` (steps + 1, contacts) is filled; returns whether it converged."""
    n = y.shape[0] // 2
    h = duration / steps
    quarter = 0.25 * h * h
    force, tangent = np.empty(n), np.empty((n, n))
    u, v = y[:n].copy(), y[n:].copy()
    _forces(system, u[:, 0].copy(), force, tangent)
    a = _linear_accelerations(system, tangent, u)
    a[:, 0] = -force * system.inverse_mass
    for step in range(steps + 1):
        for c in range(w.shape[1]):
            w[step, c] = elongation(system.rows[c], u[:, 0])
        if step == steps:
            break
        guess = u + h * v + quarter * a
        orbit = a[:, 0].copy()
        if not _solve_step(system, guess[:, 0].copy(), orbit, quarter, force, tangent):
            return False
        matrix = _matrix(system, tangent, quarter)
        new = np.linalg.solve(matrix, _linear_accelerations(system, tangent, guess))
        new[:, 0] = orbit
        u = guess + quarter * new
        v += 0.5 * h * (a + new)
        a = new
    y[:n], y[n:] = u, v
    return True


class Newmark(Flow):
    """Average acceleration with the paper's 2000 steps a period."""

    name = "newmark"

    def arc(self, start: np.ndarray, duration: float, period: float) -> Arc:
        """See ``Flow.arc``; the times of contact changes are ends of steps."""
        count = max(round(STEPS * duration / period), 1)
        y = self.with_variations(start)
        w = np.empty((count + 1, len(self.system.contacts)))
        if not _newmark(self.compiled, y, duration, count, w):
            raise FlowError("Newmark's implicit step does not converge")
        side = np.sign(w) * (np.abs(w) > self.compiled.contacts["clearance"])
        events = []
        for i, c in zip(*np.nonzero(np.diff(side, axis=0)), strict=True):
            onset = side[i + 1, c] != 0
            time = (i + 1) * (duration / count)
            events.append((time, c, side[i + 1, c] if onset else side[i, c], 1 if onset else -1))
        closed = float(np.any(side[1:] != 0, axis=1).sum() * duration / count) if side.size else 0.0
        return self.finish(start, y, duration, np.array(events).reshape(-1, 4), closed, count)
