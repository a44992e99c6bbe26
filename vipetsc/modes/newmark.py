"""The paper's flow: Newmark's average-acceleration rule with sensitivities, a fixed number of steps a period.

The sensitivities are the exact derivatives of the discrete flow (Peeters et al., Nonlinear normal modes, part II,
Mech. Syst. Signal Process. 23, 2009, App. A). Contacts are met at the ends of steps only, which is this method's error.
"""

import numpy as np

from vipetsc.compiled import njit
from vipetsc.modes.flow import CompiledSystem, Flow, FlowError, close, restore

STEPS = 2000


@njit
def _forces(system: CompiledSystem, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Restoring forces (n,) in N and tangent stiffness (n, n) in N/m at displacements ``u`` (n,) in m."""
    side, columns = np.empty(system.contacts.size, np.int64), np.hstack((u.reshape(-1, 1), np.eye(u.size)))
    close(system, u, side)
    pull = np.empty_like(columns)
    restore(system, side, columns, pull)
    return -pull[:, 0], -pull[:, 1:]


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
def _solve_step(system: CompiledSystem, guess: np.ndarray, a: np.ndarray, quarter: float) -> tuple[np.ndarray, bool]:
    """Newton's method for the accelerations ``a`` (n,) at a step's end, where u = ``guess`` + h^2/4 a.

    Displacements as unknowns would lose digits to 4/h^2. Returns the tangent stiffness there, and whether it converged.
    """
    scale, shift = 0.0, a
    for _ in range(60):
        force, tangent = _forces(system, guess + quarter * a)
        shift = np.linalg.solve(_matrix(system, tangent, quarter), a + force * system.inverse_mass)
        a -= shift
        scale = max(scale, np.abs(a).max())
        if np.abs(shift).max() <= 1e-14 * scale:
            break
    return _forces(system, guess + quarter * a)[1], np.abs(shift).max() <= 1e-11 * scale


@njit
def _newmark(system: CompiledSystem, y: np.ndarray, h: float, path: np.ndarray) -> bool:
    """Advance ``y`` (2n, 1 + m) in place along the ``path`` (steps + 1, n) in steps of ``h``; whether it converged."""
    steps, n = path.shape[0] - 1, path.shape[1]
    quarter = 0.25 * h * h
    u, v = y[:n].copy(), y[n:].copy()
    force, tangent = _forces(system, u[:, 0].copy())
    a = _linear_accelerations(system, tangent, u)
    a[:, 0] = -force * system.inverse_mass
    for step in range(steps + 1):
        path[step] = u[:, 0]
        if step == steps:
            break
        guess = u + h * v + quarter * a
        orbit = a[:, 0].copy()
        tangent, converged = _solve_step(system, guess[:, 0].copy(), orbit, quarter)
        if not converged:
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

    def _advance(self, y: np.ndarray, duration: float, period: float) -> tuple[np.ndarray, np.ndarray, float]:
        count = max(round(STEPS * duration / period), 1)
        h, path = duration / count, np.empty((count + 1, self.system.dofs))
        if not _newmark(self.compiled, y, h, path):
            raise FlowError("Newmark's implicit step does not converge")
        side = np.sign(path @ self.system.contact_rows.T) * (self.system.gaps(path) > 0)
        before, after = side[:-1], side[1:]
        events = [
            ((i + 1) * h, c, after[i, c] or before[i, c], 1 if after[i, c] else -1)
            for i, c in zip(*np.nonzero(before != after), strict=True)
        ]
        closed = float(np.any(after != 0, axis=1).sum() * duration / count)
        return y, np.array(events).reshape(-1, 4), closed
