"""Flows to compare the compiled one with: PETSc's Runge-Kutta methods, Newmark's rule, central differences.

Users choose them by the keys ``nnm.flow``, ``nnm.compare`` and ``nnm.jacobian``; the paper's comparisons use them, too.

TSRK lands on contact changes as the compiled flow does, with steps taken one by one: TSEvent loses short contacts and
error control. Newmark's rule is the paper's flow: a fixed number of steps a period, and the exact derivatives of the
discrete flow as sensitivities (Peeters et al., Nonlinear normal modes, part II, Mech. Syst. Signal Process. 23, 2009,
App. A). It meets contacts at the ends of steps only, which is its error.
"""

from petsc4py import PETSc

import numpy as np

from vipetsc.compiled import allocating, kernel
from vipetsc.dynamics.propagator.linear_system import solve_in_place
from vipetsc.modes.problem import FlowError
from vipetsc.modes.shooting import flow
from vipetsc.modes.shooting.flow import Advance, CompiledSystem, Flow, close, restore
from vipetsc.modes.shooting.landing import EXTREMUM, MOST_ATTEMPTS, NONE, Change, correct
from vipetsc.modes.system import System

# Errors that TSRK allows per step, relative to the size of the orbit and of each variation.
RTOL = 1e-13
RTOL_SENSITIVITY = 1e-10
# Steps a period of Newmark's rule: as many as the paper takes.
STEPS = 2000


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
        pause = self.limits.check(steps)
        while t < duration:
            if steps == pause:
                pause = self.limits.check(steps)
            steps += 1
            length, state, h = self._step(self._adaptive, y, min(h, 1 / self.omega, duration - t))
            if length < flow.SMALLEST_STEP * duration and length < duration - t:
                raise FlowError(f"TSRK's step became too small at {t:.6g} s of {duration:.6g} s")

            flow.observe(step, y, dy, step.start)
            flow.observe(step, state, dy, step.end)
            change = flow.first_change(step, length)
            changed = change.contact >= 0
            if changed:
                length, state, changed = self._land(y, length, change)

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
        self.limits.check(steps)
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

    def _land(self, y: np.ndarray, h: float, change: Change) -> tuple[float, np.ndarray, bool]:
        """Step from ``y`` exactly onto a change found in a step of length ``h``: length, state, whether it is one."""
        step = self._record
        dy = np.empty(self._shape)
        for _ in range(MOST_ATTEMPTS):
            length = change.length
            _, state, _ = self._step(self._fixed, y, length)
            flow.observe(step, state, dy, step.end)
            change, outcome = correct(change, step.end[change.contact], 2e-16 * h)
            if outcome != NONE:
                return length, state, outcome != EXTREMUM
        raise FlowError(f"TSRK does not land on the change of contact {change.contact + 1}")


@allocating
def _forces(system: CompiledSystem, u: np.ndarray, tangent: np.ndarray, a: np.ndarray) -> None:
    """Fill the ``tangent`` stiffness (n, n) in N/m and the accelerations ``a`` (n,) at displacements ``u`` (n,).

    Here and below are loops, which are compiled in a quarter of the time that expressions of arrays take.
    """
    n = u.size
    side = np.empty(system.contacts.size, np.int64)
    # The displacements and a variation by each of them: what pulls the variations back is the tangent stiffness.
    columns = np.zeros((n, 1 + n))
    pull = np.empty((n, 1 + n))
    for i in range(n):
        columns[i, 0] = u[i]
        columns[i, 1 + i] = 1.0
    close(system, columns, side)
    restore(system, side, columns, pull, (0, n, 1 + n))
    for i in range(n):
        a[i] = pull[i, 0] * system.inverse_mass[i]
        for j in range(n):
            tangent[i, j] = -pull[i, 1 + j]


@kernel
def _solve(system: CompiledSystem, tangent: np.ndarray, quarter: float, matrix: np.ndarray, right: np.ndarray) -> None:
    """Solve (I + h^2/4 M^-1 tangent) x = ``right`` (n, columns), with ``quarter`` = h^2/4, for x, which replaces it.

    ``matrix`` (n, n) is room for the one in brackets.
    """
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            matrix[i, j] = quarter * tangent[i, j] * system.inverse_mass[i]
        matrix[i, i] += 1.0
    solve_in_place(matrix, right)


@kernel
def _accelerate(system: CompiledSystem, tangent: np.ndarray, u: np.ndarray, a: np.ndarray) -> None:
    """Put -M^-1 tangent u (n, columns) into ``a``; rows of ``u`` after the first n are not read."""
    n = tangent.shape[0]
    for i in range(n):
        for j in range(u.shape[1]):
            a[i, j] = 0.0
            for k in range(n):
                a[i, j] -= system.inverse_mass[i] * tangent[i, k] * u[k, j]


@allocating
def _solve_step(system: CompiledSystem, guess: np.ndarray, a: np.ndarray, quarter: float, tangent: np.ndarray) -> bool:
    """Newton's method for the accelerations ``a`` (n,) at a step's end, where u = ``guess`` + h^2/4 a.

    Displacements as unknowns would lose digits to 4/h^2. Returns whether it converged, and puts the stiffness (n, n)
    there into ``tangent``.
    """
    n = guess.size
    u = np.empty(n)
    forced = np.empty(n)
    matrix = np.empty((n, n))
    shift = np.empty((n, 1))
    scale = 0.0
    largest = 0.0
    for _ in range(60):
        for i in range(n):
            u[i] = guess[i] + quarter * a[i]
        _forces(system, u, tangent, forced)
        for i in range(n):
            shift[i, 0] = a[i] - forced[i]
        _solve(system, tangent, quarter, matrix, shift)

        largest = 0.0
        for i in range(n):
            a[i] -= shift[i, 0]
            # A singular matrix, or a motion that has overflowed.
            if not abs(shift[i, 0]) < np.inf:
                return False
            scale = max(scale, abs(a[i]))
            largest = max(largest, abs(shift[i, 0]))
        if largest <= 1e-14 * scale:
            break

    for i in range(n):
        u[i] = guess[i] + quarter * a[i]
    _forces(system, u, tangent, forced)
    return largest <= 1e-11 * scale


@allocating
def _newmark(system: CompiledSystem, y: np.ndarray, h: float, path: np.ndarray) -> bool:
    """Advance ``y`` (2n, 1 + m) in place along the ``path`` (steps + 1, n) in steps of ``h``; whether it converged."""
    n = path.shape[1]
    columns = y.shape[1]
    quarter = 0.25 * h * h
    tangent = np.empty((n, n))
    a = np.empty((n, columns))
    orbit = np.empty(n)
    start = np.empty(n)
    guess = np.empty((n, columns))
    new = np.empty((n, columns))
    matrix = np.empty((n, n))

    for i in range(n):
        start[i] = y[i, 0]
        path[0, i] = y[i, 0]
    _forces(system, start, tangent, orbit)
    _accelerate(system, tangent, y, a)
    for i in range(n):
        a[i, 0] = orbit[i]

    for step in range(1, path.shape[0]):
        for i in range(n):
            for j in range(columns):
                guess[i, j] = y[i, j] + h * y[n + i, j] + quarter * a[i, j]
            start[i] = guess[i, 0]
            orbit[i] = a[i, 0]
        if not _solve_step(system, start, orbit, quarter, tangent):
            return False

        _accelerate(system, tangent, guess, new)
        _solve(system, tangent, quarter, matrix, new)
        for i in range(n):
            new[i, 0] = orbit[i]
            for j in range(columns):
                y[i, j] = guess[i, j] + quarter * new[i, j]
                y[n + i, j] += 0.5 * h * (a[i, j] + new[i, j])
                a[i, j] = new[i, j]
            path[step, i] = y[i, 0]
    return True


class Newmark(Flow):
    """Average acceleration with the paper's 2000 steps a period."""

    name = "newmark"

    def _advance(self, y: np.ndarray, duration: float, period: float) -> Advance:
        count = max(round(STEPS * duration / period), 1)
        h = duration / count
        path = np.empty((count + 1, self.system.dofs))
        if not _newmark(self.compiled, y, h, path):
            raise FlowError("Newmark's implicit step does not converge")

        # The side (steps + 1, contacts) on which each contact is closed at the ends of steps, 0 for an open one.
        sides = self.system.sides_at(path @ self.system.contact_rows.T) * (self.system.gaps(path) > 0)
        before = sides[:-1]
        after = sides[1:]
        events = []
        for i, c in zip(*np.nonzero(before != after), strict=True):
            side = after[i, c]
            kind = flow.ONSET
            if side == 0:
                side = before[i, c]
                kind = flow.SEPARATION
            events.append(((i + 1) * h, c, side, kind))
        closed = float(np.any(after != 0, axis=1).sum() * duration / count)
        return Advance(state=y, events=np.array(events).reshape(-1, 4), closed=closed, steps=count)


class FiniteDifferences(Flow):
    """Another flow with its sensitivities replaced by central differences, the paper's choice in region III.

    ``step`` is relative to the orbit's size; velocities count as displacements over a radian of the period.
    """

    def __init__(self, flow: Flow, step: float = 1e-6) -> None:
        super().__init__(flow.system)
        self.flow = flow
        self.limits = flow.limits
        self.step = step

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
