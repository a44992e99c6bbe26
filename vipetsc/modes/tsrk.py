"""The flow by PETSc's explicit Runge-Kutta methods (TSRK, 8vr), landing on contact changes.

TSEvent is not used: it loses short contacts and error control. Steps are taken one by one with the active
contacts frozen; a change found on the step's Hermite interpolant is landed on from a copy of the state.
"""

from __future__ import annotations

from petsc4py import PETSc

import numpy as np

from vipetsc.modes import interpolant, kernel
from vipetsc.modes.orbit import Arc, Flow, FlowError, kernel_arrays


class Tsrk(Flow):
    """PETSc TSRK of type ``method``; tolerances as in ``Dop853Flow``.

    8vr restarts every step; an FSAL type such as 5dp is restarted after each change, or its stale stage would spoil
    the sensitivities.
    """

    name = "tsrk"

    def __init__(self, system, method: str = "8vr", rtol: float = 1e-13, loose: float = 1e-10) -> None:
        super().__init__(system)
        self.rtol, self.loose = rtol, loose
        self._arrays = kernel_arrays(system)
        self._pace = float(system.linear_modes()[0][-1])
        n = system.dofs
        self._shape = (2 * n, 1 + 2 * n)
        size = self._shape[0] * self._shape[1]
        self._y = PETSc.Vec().createSeq(size, comm=PETSc.COMM_SELF)
        self._side = np.zeros(len(system.contacts), np.int64)
        self._adaptive = self._solver(method, "basic")
        self._fixed = self._solver(method, "none")

    def arc(self, start: np.ndarray, duration: float, period: float) -> Arc:
        """See ``Flow.arc``."""
        n = self.system.dofs
        y = np.ascontiguousarray(np.hstack([np.asarray(start, float)[:, None], np.eye(2 * n)]))
        rows, law = self._arrays[2], self._arrays[3]
        w = rows @ start[:n]
        self._side[:] = np.sign(w) * (np.abs(w) > law[:, 0])
        self._tolerances(start, period)
        t, h, closed, steps, events = 0.0, 0.05 / self._pace, 0.0, 0, []
        while t < duration:
            h = min(h, 1 / self._pace, duration - t)
            taken, later, h = self._step(self._adaptive, y, h)
            steps += 1
            if taken < kernel.SMALLEST_STEP * duration and taken < duration - t:
                raise FlowError(f"TSRK's step became too small at {t:.6g} s of {duration:.6g} s")
            place, verdict, which, sense = self._first_change(y, later, taken)
            if verdict:
                taken, later, crossed = self._land(y, place * taken, taken, verdict, which, sense)
            closed += taken if np.any(self._side) else 0.0
            t = duration if duration - t - taken <= 1e-16 * duration else t + taken
            y = later
            if verdict and crossed:
                onset = self._side[which] == 0
                events.append((t, which, sense, 1 if onset else -1))
                self._side[which] = sense if onset else 0
                self._adaptive.restartStep()
        return self.finish(
            start, y[:, 0].copy(), y[:, 1:].copy(), duration, np.array(events).reshape(-1, 4), closed, steps
        )

    def _solver(self, method: str, adapt: str) -> PETSc.TS:
        ts = PETSc.TS().create(PETSc.COMM_SELF)
        ts.setProblemType(PETSc.TS.ProblemType.NONLINEAR)
        ts.setType("rk")
        ts.setRKType(method)
        ts.setRHSFunction(self._rates, self._y.duplicate())
        ts.setExactFinalTime(PETSc.TS.ExactFinalTime.STEPOVER)
        ts.setMaxTime(1e300)
        ts.setMaxSteps(2**31 - 1)
        ts.setMaxStepRejections(-1)
        options = PETSc.Options()
        for key, value in (("ts_adapt_type", adapt), ("ts_adapt_wnormtype", "infinity")):
            options[f"nnm_{adapt}_{key}"] = value
        ts.setOptionsPrefix(f"nnm_{adapt}_")
        ts.setFromOptions()
        return ts

    def _tolerances(self, start: np.ndarray, period: float) -> None:
        n = self.system.dofs
        pace = max(self._pace, 2 * np.pi / period)
        size = max(np.abs(start[:n]).max(), np.abs(start[n:]).max() / pace)
        unit = np.repeat([1.0, pace], n)  # velocities count as displacements over a radian
        absolute = np.empty(self._shape)
        absolute[:, 0] = self.rtol * size * unit
        absolute[:, 1:] = self.loose * unit[:, None] / unit[None, :]
        relative = np.full(self._shape, self.loose)
        relative[:, 0] = self.rtol
        atol, rtol = self._y.duplicate(), self._y.duplicate()
        atol.setArray(absolute.ravel())
        rtol.setArray(relative.ravel())
        self._adaptive.setTolerances(rtol=rtol, atol=atol)

    def _rates(self, ts: PETSc.TS, t: float, y: PETSc.Vec, dy: PETSc.Vec) -> None:
        state = y.getArray(readonly=True).reshape(self._shape)
        out = dy.getArray().reshape(self._shape)
        kernel.rates(np.array(state), out, *self._arrays, self._side)

    def _step(self, ts: PETSc.TS, y: np.ndarray, h: float) -> tuple[float, np.ndarray, float]:
        """One step from ``y``, of at most ``h``: its length, the new state, the next step's length."""
        self._y.setArray(y.ravel())
        ts.setSolution(self._y)
        ts.setTime(0.0)
        ts.setTimeStep(h)
        ts.step()
        return ts.getTime(), self._y.getArray().reshape(self._shape).copy(), ts.getTimeStep()

    def _relative(self, y: np.ndarray, which: int) -> np.ndarray:
        n = self.system.dofs
        dy = np.empty_like(y)
        kernel.rates(y, dy, *self._arrays, self._side)
        row = self._arrays[2][which]
        return np.array([row @ y[:n, 0], row @ y[n:, 0], row @ dy[n:, 0]])

    def _first_change(self, y: np.ndarray, later: np.ndarray, h: float) -> tuple[float, int, int, int]:
        place, verdict, which, sense = 1.0, 0, -1, 0
        coefficients = np.empty(6)
        for c in range(len(self._side)):
            a, b = self._relative(y, c), self._relative(later, c)
            for s in (-1, 1):
                if self._side[c] not in (0, s):
                    continue
                sign, offset = self._gap(c, s)
                interpolant.hermite(a, b, h, sign, offset, coefficients)
                x, found = interpolant.first_upcrossing(coefficients)
                if found and x < place:
                    place, verdict, which, sense = x, found, c, s
        return place, verdict, which, sense

    def _gap(self, contact: int, sense: int) -> tuple[float, float]:
        """(sign, offset) of the quantity sign w - offset whose rise through zero changes the contact."""
        clearance = float(self._arrays[3][contact, 0])
        return (float(sense), clearance) if self._side[contact] == 0 else (-float(sense), -clearance)

    def _land(
        self, y: np.ndarray, target: float, longest: float, verdict: int, which: int, sense: int
    ) -> tuple[float, np.ndarray, bool]:
        """Step from ``y`` exactly onto the change (or a near miss): the step, the state, whether it crossed."""
        sign, offset = self._gap(which, sense)
        low, high = 0.0, longest
        order = 1 if verdict == 2 else 0  # 2: find the extremum first, and see whether it crosses
        for _ in range(120):
            _, state, _ = self._step(self._fixed, y, target)
            w = self._relative(state, which)
            if order:
                value, rate = -sign * w[1], -sign * w[2]
            else:
                value, rate = sign * w[0] - offset, sign * w[1]
            low, high = (low, target) if value > 0 else (target, high)
            shift = -value / rate if rate > 0 else np.inf
            if abs(shift) <= 2e-16 * longest or high - low <= 2e-16 * longest:
                if not order:
                    return target, state, True
                if sign * w[0] - offset <= 0:
                    return target, state, False
                order, low, high, target = 0, 0.0, target, 0.5 * target
                continue
            target = target + shift if low < target + shift < high else 0.5 * (low + high)
        raise FlowError(f"TSRK does not land on the change of contact {which + 1}")
