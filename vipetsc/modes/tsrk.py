"""The flow by PETSc's explicit Runge-Kutta methods (TSRK), landing on contact changes.

TSEvent is not used: it loses short contacts and error control. Steps are taken one by one with the set of closed
contacts frozen; a change found on a step's interpolant is landed on from a copy of the state.
"""

from petsc4py import PETSc

import numpy as np

from vipetsc.modes import flow
from vipetsc.modes.changes import EXTREMUM, MOST_ATTEMPTS, NONE, Change, correct
from vipetsc.modes.flow import Flow, FlowError
from vipetsc.modes.system import System

# Errors allowed per step, relative to the size of the orbit and of each variation.
RTOL, RTOL_SENSITIVITY = 1e-13, 1e-10


class Tsrk(Flow):
    """PETSc TSRK of type 8vr; options begin with ``-nnm_basic_`` for steps, with ``-nnm_none_`` for landings.

    8vr restarts every step; an FSAL type such as 5dp is restarted after each change, or its stale stage would spoil
    the sensitivities.
    """

    name = "tsrk"

    def __init__(self, system: System) -> None:
        super().__init__(system)
        self._shape = 2 * system.dofs, 1 + 2 * system.dofs
        self._y = PETSc.Vec().createSeq(self._shape[0] * self._shape[1], comm=PETSc.COMM_SELF)
        self._adaptive, self._fixed = self._solver("basic"), self._solver("none")
        self._record: flow.Step

    def _advance(self, y: np.ndarray, duration: float, period: float) -> tuple[np.ndarray, np.ndarray, float]:
        step = self._record = flow.begin(self.compiled, y)
        self._set_tolerances(y[:, 0], period)
        t, h, closed, events, dy = 0.0, 0.05 / self.omega, 0.0, [], np.empty(self._shape)
        while t < duration:
            length, state, h = self._step(self._adaptive, y, min(h, 1 / self.omega, duration - t))
            if length < flow.SMALLEST_STEP * duration and length < duration - t:
                raise FlowError(f"TSRK's step became too small at {t:.6g} s of {duration:.6g} s")
            flow.observe(step, y, dy, step.start)
            flow.observe(step, state, dy, step.end)
            change = flow.first_change(step, length)
            changed = change.contact >= 0
            if changed:
                length, state, changed = self._land(y, length, change)
            closed += length if np.any(step.side) else 0.0
            t = duration if duration - t - length <= 1e-16 * duration else t + length
            y = state
            if changed:
                events.append((t, change.contact, change.side, flow.switch(step, change)))
                self._adaptive.restartStep()
        return y, np.array(events).reshape(-1, 4), closed

    def _solver(self, adapt: str) -> PETSc.TS:
        ts = PETSc.TS().create(PETSc.COMM_SELF)
        ts.setProblemType(PETSc.TS.ProblemType.NONLINEAR)
        ts.setType("rk")
        ts.setRKType("8vr")
        ts.setRHSFunction(self._rates, self._y.duplicate())
        ts.setExactFinalTime(PETSc.TS.ExactFinalTime.STEPOVER)
        ts.setMaxTime(1e300)
        ts.setMaxSteps(2**31 - 1)
        ts.setMaxStepRejections(-1)
        options = PETSc.Options(f"nnm_{adapt}_")
        options["ts_adapt_type"], options["ts_adapt_wnormtype"] = adapt, "infinity"
        ts.setOptionsPrefix(f"nnm_{adapt}_")
        ts.setFromOptions()
        return ts

    def _set_tolerances(self, start: np.ndarray, period: float) -> None:
        """Absolute tolerances from the orbit's size; velocities count as displacements over a radian."""
        n = self.system.dofs
        omega = self.omega_ref(period)
        size = max(np.abs(start[:n]).max(), np.abs(start[n:]).max() / omega)
        unit = np.repeat([1.0, omega], n)
        absolute, relative = np.empty(self._shape), np.full(self._shape, RTOL_SENSITIVITY)
        absolute[:, 0], relative[:, 0] = RTOL * size * unit, RTOL
        absolute[:, 1:] = RTOL_SENSITIVITY * unit[:, None] / unit[None, :]
        rtol, atol = (PETSc.Vec().createWithArray(a.ravel(), comm=PETSc.COMM_SELF) for a in (relative, absolute))
        self._adaptive.setTolerances(rtol=rtol, atol=atol)

    def _rates(self, ts: PETSc.TS, t: float, y: PETSc.Vec, dy: PETSc.Vec) -> None:
        state = np.array(y.getArray(readonly=True)).reshape(self._shape)
        flow.rates(self.compiled, self._record.side, state, dy.getArray().reshape(self._shape))

    def _step(self, ts: PETSc.TS, y: np.ndarray, h: float) -> tuple[float, np.ndarray, float]:
        """One step from ``y``, of at most ``h``: its length, the new state, the next step's length."""
        self._y.setArray(y.ravel())
        ts.setSolution(self._y)
        ts.setTime(0.0)
        ts.setTimeStep(h)
        ts.step()
        return ts.getTime(), self._y.getArray().reshape(y.shape).copy(), ts.getTimeStep()

    def _land(self, y: np.ndarray, h: float, change: Change) -> tuple[float, np.ndarray, bool]:
        """Step from ``y`` exactly onto a change found in a step of length ``h``: length, state, whether it is one."""
        step, dy = self._record, np.empty(self._shape)
        for _ in range(MOST_ATTEMPTS):
            length = change.length
            _, state, _ = self._step(self._fixed, y, length)
            flow.observe(step, state, dy, step.end)
            change, outcome = correct(change, step.end[change.contact], 2e-16 * h)
            if outcome != NONE:
                return length, state, outcome != EXTREMUM
        raise FlowError(f"TSRK does not land on the change of contact {change.contact + 1}")
