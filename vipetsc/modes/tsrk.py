"""The flow by PETSc's explicit Runge-Kutta methods (TSRK), landing on contact changes.

TSEvent is not used: it loses short contacts and error control. Steps are taken one by one with the set of closed
contacts frozen; a change found on a step's interpolant is landed on from a copy of the state.
"""

from petsc4py import PETSc

import numpy as np

from vipetsc.modes import kernel
from vipetsc.modes.changes import EXTREMUM, MOST_ATTEMPTS, NONE, correct
from vipetsc.modes.orbit import Arc, Flow, FlowError
from vipetsc.modes.system import System


class Tsrk(Flow):
    """PETSc TSRK of type 8vr; options begin with ``-nnm_basic_`` for steps, with ``-nnm_none_`` for landings.

    8vr restarts every step; an FSAL type such as 5dp is restarted after each change, or its stale stage would spoil
    the sensitivities.
    """

    name = "tsrk"
    rtol_sensitivity = 1e-10

    def __init__(self, system: System) -> None:
        super().__init__(system)
        tolerances = kernel.Tolerances(self.rtol, self.rtol_sensitivity, self.omega)
        self._stepper = kernel.create_stepper(self.compiled, tolerances, 1 + 2 * system.dofs)
        self._y = PETSc.Vec().createSeq(self._stepper.end.size, comm=PETSc.COMM_SELF)
        self._adaptive, self._fixed = self._solver("basic"), self._solver("none")

    def arc(self, start: np.ndarray, duration: float, period: float) -> Arc:
        """See ``Flow.arc``."""
        y, stepper, side = self.with_variations(start), self._stepper, self._stepper.side
        kernel.closed_sides(stepper.system, y, side)
        self._tolerances(start, period)
        t, h, closed, steps, events = 0.0, 0.05 / self.omega, 0.0, 0, []
        while t < duration:
            length, state, h = self._step(self._adaptive, y, min(h, 1 / self.omega, duration - t))
            steps += 1
            if length < kernel.SMALLEST_STEP * duration and length < duration - t:
                raise FlowError(f"TSRK's step became too small at {t:.6g} s of {duration:.6g} s")
            self._observe(y, stepper.start_motion)
            self._observe(state, stepper.end_motion)
            change = kernel.first_change(stepper, length)
            changed = False
            if change.outcome != NONE:
                length, state, changed = self._land(y, length, change)
            closed += length if np.any(side) else 0.0
            t = duration if duration - t - length <= 1e-16 * duration else t + length
            y = state
            if changed:
                onset = side[change.contact] == 0
                events.append((t, change.contact, change.side, 1 if onset else -1))
                side[change.contact] = change.side if onset else 0
                self._adaptive.restartStep()
        return self.finish(start, y, duration, np.array(events).reshape(-1, 4), closed, steps)

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

    def _tolerances(self, start: np.ndarray, period: float) -> None:
        """Absolute tolerances from the orbit's size; velocities count as displacements over a radian."""
        n = self.system.dofs
        omega = self.omega_ref(period)
        size = max(np.abs(start[:n]).max(), np.abs(start[n:]).max() / omega)
        unit = np.repeat([1.0, omega], n)
        absolute = np.empty(self._stepper.end.shape)
        absolute[:, 0] = self.rtol * size * unit
        absolute[:, 1:] = self.rtol_sensitivity * unit[:, None] / unit[None, :]
        relative = np.full(absolute.shape, self.rtol_sensitivity)
        relative[:, 0] = self.rtol
        rtol, atol = (PETSc.Vec().createWithArray(a.ravel(), comm=PETSc.COMM_SELF) for a in (relative, absolute))
        self._adaptive.setTolerances(rtol=rtol, atol=atol)

    def _rates(self, ts: PETSc.TS, t: float, y: PETSc.Vec, dy: PETSc.Vec) -> None:
        shape = self._stepper.end.shape
        state = np.array(y.getArray(readonly=True)).reshape(shape)
        kernel.rates(self._stepper.system, self._stepper.side, state, dy.getArray().reshape(shape))

    def _step(self, ts: PETSc.TS, y: np.ndarray, h: float) -> tuple[float, np.ndarray, float]:
        """One step from ``y``, of at most ``h``: its length, the new state, the next step's length."""
        self._y.setArray(y.ravel())
        ts.setSolution(self._y)
        ts.setTime(0.0)
        ts.setTimeStep(h)
        ts.step()
        return ts.getTime(), self._y.getArray().reshape(y.shape).copy(), ts.getTimeStep()

    def _observe(self, y: np.ndarray, motion: np.ndarray) -> None:
        """(w, w', w'') of every contact into ``motion`` (contacts, 3)."""
        stepper = self._stepper
        kernel.rates(stepper.system, stepper.side, y, stepper.end_rates)
        kernel.relative_motion(stepper.system, y, stepper.end_rates, motion)

    def _land(self, y: np.ndarray, h: float, change: kernel.Change) -> tuple[float, np.ndarray, bool]:
        """Step from ``y`` exactly onto a change found in a step of length ``h``: length, state, whether it is one."""
        landing = kernel.begin_landing(self._stepper, change, h)
        for _ in range(MOST_ATTEMPTS):
            length = landing.length
            _, state, _ = self._step(self._fixed, y, length)
            self._observe(state, self._stepper.end_motion)
            landing, outcome = correct(landing, self._stepper.end_motion[change.contact], 2e-16 * h)
            if outcome != NONE:
                return length, state, outcome != EXTREMUM
        raise FlowError(f"TSRK does not land on the change of contact {change.contact + 1}")
