"""The paper's flow: Newmark's average-acceleration rule with sensitivities, a fixed number of steps a period.

Peeters et al. (2009), App. A: the sensitivities are the exact derivatives of the discrete flow. Contacts are met
at the ends of steps only, which is this method's known error.
"""

from __future__ import annotations

import numpy as np

from vipetsc.compiled import njit
from vipetsc.modes.orbit import Arc, Flow, FlowError, kernel_arrays


@njit("void(f8[::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[:,::1])", cache=True)
def _forces(u, stiffness, rows, law, spring_rows, springs, force, tangent):
    """Restoring forces and tangent stiffness at displacements ``u``."""
    n = len(u)
    for i in range(n):
        force[i] = 0.0
        for j in range(n):
            force[i] += stiffness[i, j] * u[j]
            tangent[i, j] = stiffness[i, j]
    for c in range(rows.shape[0] + spring_rows.shape[0]):
        row = rows[c] if c < rows.shape[0] else spring_rows[c - rows.shape[0]]
        z = 0.0
        for k in range(n):
            z += row[k] * u[k]
        if c < rows.shape[0]:
            x = abs(z) - law[c, 0]
            if x <= 0.0:
                continue
            slope = law[c, 1] * law[c, 2] * x ** (law[c, 2] - 1.0)
            pull = np.sign(z) * slope * x / law[c, 2]
        else:
            s = c - rows.shape[0]
            pull = (springs[s, 0] + springs[s, 1] * z) * z * z
            slope = (2.0 * springs[s, 0] + 3.0 * springs[s, 1] * z) * z
        for i in range(n):
            force[i] += row[i] * pull
            for j in range(n):
                tangent[i, j] += slope * row[i] * row[j]


@njit("i8(f8[:,::1], f8, i8, f8[::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1], f8[:,::1])", cache=True)
def _newmark(y, duration, steps, inverse_mass, stiffness, rows, law, spring_rows, springs, gaps):
    """Advance ``y`` (2n, 1 + m) in place; ``gaps`` (steps + 1, contacts) takes w; returns 0 if it converged."""
    n, columns = y.shape[0] // 2, y.shape[1]
    h = duration / steps
    force, tangent = np.empty(n), np.empty((n, n))
    u, v = y[:n].copy(), y[n:].copy()
    a = np.zeros((n, columns))
    _forces(u[:, 0].copy(), stiffness, rows, law, spring_rows, springs, force, tangent)
    for i in range(n):
        a[i, 0] = -force[i] * inverse_mass[i]
        for j in range(1, columns):
            for k in range(n):
                a[i, j] -= inverse_mass[i] * tangent[i, k] * u[k, j]
    system, load = np.empty((n, n)), np.empty((n, columns))
    quarter = 0.25 * h * h
    for c in range(rows.shape[0]):
        gaps[0, c] = (rows[c] * u[:, 0]).sum()
    for step in range(steps):
        # the accelerations are the unknowns: displacements would lose digits to 4/h^2
        guess = u + h * v + quarter * a
        later = a[:, 0].copy()
        scale = 0.0
        converged = False
        for _ in range(60):
            x = guess[:, 0] + quarter * later
            _forces(x, stiffness, rows, law, spring_rows, springs, force, tangent)
            for i in range(n):
                force[i] = later[i] + force[i] * inverse_mass[i]
                for k in range(n):
                    system[i, k] = quarter * tangent[i, k] * inverse_mass[i]
                system[i, i] += 1.0
            shift = np.linalg.solve(system, force)
            later = later - shift
            scale = max(scale, np.abs(later).max())
            if np.abs(shift).max() <= 1e-14 * scale:
                converged = True
                break
        if not converged and not np.abs(shift).max() <= 1e-11 * scale:
            return 1
        _forces(guess[:, 0] + quarter * later, stiffness, rows, law, spring_rows, springs, force, tangent)
        for i in range(n):
            for j in range(columns):
                load[i, j] = 0.0
                for k in range(n):
                    load[i, j] -= inverse_mass[i] * tangent[i, k] * guess[k, j]
            for k in range(n):
                system[i, k] = quarter * tangent[i, k] * inverse_mass[i]
            system[i, i] += 1.0
        new = np.linalg.solve(system, load)
        new[:, 0] = later
        for i in range(n):
            for j in range(columns):
                u[i, j] = guess[i, j] + quarter * new[i, j]
                v[i, j] += 0.5 * h * (a[i, j] + new[i, j])
                a[i, j] = new[i, j]
        for c in range(rows.shape[0]):
            gaps[step + 1, c] = (rows[c] * u[:, 0]).sum()
    y[:n], y[n:] = u, v
    return 0


class Newmark(Flow):
    """Average acceleration with ``steps`` steps a period (2000 in the paper)."""

    name = "newmark"

    def __init__(self, system, steps: int = 2000) -> None:
        super().__init__(system)
        self.steps = steps
        self._arrays = kernel_arrays(system)

    def arc(self, start: np.ndarray, duration: float, period: float) -> Arc:
        """See ``Flow.arc``; the times of contact changes are ends of steps."""
        n = self.system.dofs
        count = max(round(self.steps * duration / period), 1)
        y = np.hstack([np.asarray(start, float)[:, None], np.eye(2 * n)])
        w = np.empty((count + 1, len(self.system.contacts)))
        if _newmark(y, duration, count, *self._arrays, w):
            raise FlowError("Newmark's implicit step does not converge: raise the number of steps")
        clearance = np.array([p.clearance for p in self.system.contacts]).reshape(-1)
        side = np.sign(w) * (np.abs(w) > clearance)
        times = np.arange(count + 1) * (duration / count)
        events = []
        for i, c in zip(*np.nonzero(np.diff(side, axis=0)), strict=True):
            onset = side[i + 1, c] != 0
            events.append((times[i + 1], c, side[i + 1, c] if onset else side[i, c], 1 if onset else -1))
        closed = float(np.any(side[1:] != 0, axis=1).sum() * duration / count) if side.size else 0.0
        return self.finish(
            start, y[:, 0].copy(), y[:, 1:].copy(), duration, np.array(events).reshape(-1, 4), closed, count
        )
