"""Flows to compare the compiled one with: PETSc's Runge-Kutta methods, and central differences.

TSRK lands on contact changes as the compiled flow does, with steps taken one by one: TSEvent loses short contacts and
error control.
"""

from contextlib import AbstractContextManager

from petsc4py import PETSc

import numpy as np

from vipetsc.contact.search import LANDED, MISSED, SEARCH, Landing, correct
from vipetsc.modes import flow
from vipetsc.modes.flow import EXACT, Advance, Change, Flow
from vipetsc.modes.problem import FlowError
from vipetsc.modes.system import System
from vipetsc.parallel import StopRequest

# Errors that TSRK allows per step, relative to the size of the orbit and of each variation.
RTOL = 1e-13
RTOL_SENSITIVITY = 1e-10


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
        self._adaptive = self._solver("basic")
        self._fixed = self._solver("none")
        # The closed contacts for ``_rates``, which PETSc calls with the state alone; set at the beginning of an arc.
        self._record: flow.FlowStep

    def _advance(self, y: np.ndarray, duration: float, period: float) -> Advance:
        step = self._record = flow.begin(self.compiled, y)
        self._set_tolerances(y[:, 0], period)
        dy = np.empty(self._shape)
        events: list[tuple[float, int, int, int]] = []
        closed = 0.0
        t = 0.0
        h = 0.05 / self.omega
        steps = 0
        pause = 0
        size = max(np.abs(y[: len(y) // 2, 0]).max(), np.abs(y[len(y) // 2 :, 0]).max() / self.omega_ref(period))
        while t < duration:
            if steps == pause:
                pause = self.check(steps)
            steps += 1
            length, state, h = self._step(self._adaptive, y, min(h, 1 / self.omega, duration - t))
            if length < flow.SMALLEST_STEP * duration and length < duration - t:
                raise FlowError(f"TSRK's step became too small at {t:.6g} s of {duration:.6g} s")

            flow.observe(step, y, dy, step.start)
            flow.observe(step, state, dy, step.end)
            change = flow.first_change(step, length, size)
            if change.position == flow.UNDECIDED:
                h = length / 2
                continue
            changed = change.contact >= 0
            if changed:
                length, state = self._land(y, length, change)

            if np.any(step.side):
                closed += length
            # A remainder that is rounding is no step.
            if duration - t - length <= 1e-16 * duration:
                t = duration
            else:
                t += length
            y = state
            if changed:
                events.append((t, change.contact, change.side, flow.switch(step, change)))
                self._adaptive.restartStep()
        return Advance(state=y, events=np.array(events).reshape(-1, 4), closed=closed, steps=steps)

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
        options["ts_adapt_type"] = adapt
        options["ts_adapt_wnormtype"] = "infinity"
        ts.setOptionsPrefix(f"nnm_{adapt}_")
        ts.setFromOptions()
        return ts

    def _set_tolerances(self, start: np.ndarray, period: float) -> None:
        """Absolute tolerances from the orbit's size; velocities count as displacements over a radian."""
        n = self.system.dofs
        omega = self.omega_ref(period)
        size = max(np.abs(start[:n]).max(), np.abs(start[n:]).max() / omega)
        unit = np.repeat([1.0, omega], n)
        relative = np.full(self._shape, RTOL_SENSITIVITY)
        relative[:, 0] = RTOL
        absolute = np.empty(self._shape)
        absolute[:, 0] = RTOL * size * unit
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

    def _land(self, y: np.ndarray, h: float, change: Change) -> tuple[float, np.ndarray]:
        """Step from ``y`` exactly onto a change found in a step of length ``h``: length and state."""
        step = self._record
        dy = np.empty(self._shape)
        landing = Landing(change.position * h, h, np.inf, 0)
        state = y
        while landing.length > 0:
            length = landing.length
            _, state, _ = self._step(self._fixed, y, length)
            flow.observe(step, state, dy, step.end)
            gap = change.sign * step.end[change.contact, 0] - change.offset
            rate = change.sign * step.end[change.contact, 1]
            landing, outcome = correct(landing, gap, rate, change.tolerance, EXACT * change.tolerance)
            if outcome == LANDED:
                return length, state
            if outcome in (SEARCH, MISSED):
                raise FlowError(f"TSRK does not land on the change of contact {change.contact + 1}")
        return 0.0, state


class FiniteDifferences(Flow):
    """Another flow with its sensitivities replaced by central differences.

    ``step`` is relative to the orbit's size; velocities count as displacements over a radian of the period.
    """

    def __init__(self, flow: Flow, step: float = 1e-6) -> None:
        super().__init__(flow.system)
        self.flow = flow
        self.step = step

    def limited(self, longest: int, stop: StopRequest | None) -> AbstractContextManager[None]:
        """Limit the arcs of the other flow, several of which make one of these."""
        return self.flow.limited(longest, stop)

    def _advance(self, y: np.ndarray, duration: float, period: float) -> Advance:
        n = self.system.dofs
        rate = 2 * np.pi / period
        start = y[:, 0]
        size = max(np.abs(start[:n]).max(), np.abs(start[n:]).max() / rate)
        columns = []
        for move in np.diag(self.step * size * np.repeat([1.0, rate], n)):
            beyond = self.flow.arc(start + move, duration, period).end
            before = self.flow.arc(start - move, duration, period).end
            columns.append((beyond - before) / (2 * move.max()))
        arc = self.flow.arc(start, duration, period)
        state = np.column_stack([arc.end, *columns])
        return Advance(state=state, events=arc.events, closed=arc.closed, steps=arc.steps)
