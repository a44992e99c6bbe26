"""Newton's method, by PETSc's SNES, for n equations in n + 1 unknowns xi and one more linear row.

With the equations H(xi) = 0 and the plane row . xi = value, which a step of a branch or a chosen parameter gives, each
step solves

    [dH/dxi; row] d = -[H(xi); row . xi - value],    xi <- xi + d.

**Exceptions of callbacks** (``CallbackErrors``). An exception that passes through PETSc's own functions leaves vectors
locked behind. With some versions of PETSc it arrives unchanged, with others as "error code -1" or "error code 101". A
callback that fails therefore returns NaN, on which the solver gives up, and the exception is raised when the solver has
returned.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

from petsc4py import PETSc

import numpy as np

from vipetsc.dynamics.options import set_from_options
from vipetsc.modes.problem import Attempt, FlowError


class CallbackErrors:
    """The first exception of a solver's callbacks, raised when the solver has returned."""

    def __init__(self) -> None:
        self._first: BaseException | None = None

    def __bool__(self) -> bool:
        """Return whether a callback has failed in the present solve."""
        return self._first is not None

    def keep(self, callback: Callable[..., None]) -> Callable[..., None]:
        """Return the function to give to PETSc in place of ``callback(solver, x, result, ...)``.

        After the first failure the callback is not called again, since its arguments would follow from NaN; the results
        are NaN.
        """

        def call(solver: object, x: PETSc.Vec, result: PETSc.Vec | PETSc.Mat, *others: object) -> None:
            if not self:
                try:
                    return callback(solver, x, result, *others)
                except BaseException as error:
                    self._first = error
            if isinstance(result, PETSc.Vec):
                result.set(np.nan)
            else:
                # Whatever a matrix holds, the next residual is NaN; unassembled it would be an error of its own.
                result.assemble()
            return None

        return call

    @contextmanager
    def raised_after(self) -> Iterator[None]:
        """Raise what the callbacks of the solve in the body have raised, in place of what PETSc concludes from NaN."""
        self._first = None
        try:
            yield
        except PETSc.Error:
            if not self:
                raise
        error, self._first = self._first, None
        if error is not None:
            raise error


# A Newton step below the first number, in unknowns of order one, is rounding: the residual cannot be made smaller. It
# counts as a solution's up to the second number: near an unstable equilibrium, where an orbit stays for a long time, a
# small step says nothing about the residual.
STEP_TOLERANCE = 1e-14
LARGEST_RESIDUAL = 1e-9
# A Newton step from a residual within rounding that leaves more than this fraction of it cannot make it smaller: but
# for rounding, a step from so small a residual would leave its square.
STAGNANT = 0.25
# PETSc's number of the error that a dense matrix has no factors.
SINGULAR_MATRIX = 71
# PETSc's reason for a residual that is not finite; 3.25 has renamed it.
NOT_FINITE = next(
    value
    for name, value in vars(PETSc.SNES.ConvergedReason).items()
    if name in ("DIVERGED_FUNCTION_NANORINF", "DIVERGED_FNORM_NAN")
)


class DenseEquations(Protocol):
    """n equations in the n + 1 unknowns xi."""

    def residual(self, xi: np.ndarray) -> np.ndarray:
        """Return the residual (n,), which vanishes at a solution."""

    def jacobian(self, xi: np.ndarray) -> np.ndarray:
        """Return the derivative (n, n + 1) of the residual."""


class DenseNewton:
    """Solves residual(xi) = 0 (size - 1,) and row . xi = value with a dense matrix, on one rank.

    It ends at a residual of ``tolerance``, or of ``LARGEST_RESIDUAL`` after a step below ``STEP_TOLERANCE``, where the
    residual stagnates within its ``rounding``, or after ``max_newton`` steps. Options of PETSc have the prefix
    ``nnm_``. An exception of the equations passes through, except FlowError: the attempt has then not converged.
    """

    def __init__(self, size: int, max_newton: int = 7) -> None:
        self.max_newton = max_newton
        self._errors = CallbackErrors()
        # A branch is followed by one rank alone while the others follow theirs: nothing here may be collective.
        self._xi = PETSc.Vec().createSeq(size, comm=PETSc.COMM_SELF)
        jacobian = PETSc.Mat().createDense((size, size), comm=PETSc.COMM_SELF)
        jacobian.setUp()

        self._snes = snes = PETSc.SNES().create(PETSc.COMM_SELF)
        snes.setOptionsPrefix("nnm_")
        snes.setFunction(self._errors.keep(self._evaluate), self._xi.duplicate())
        snes.setJacobian(self._errors.keep(self._differentiate), jacobian)
        snes.setTolerances(max_it=max_newton)
        # PETSc's own test would also accept a residual that has fallen by 1e-8, whatever the tolerance of the problem.
        snes.setConvergenceTest(self._test)
        # Options of PETSc, which are read afterwards, may replace the linear solver.
        snes.getKSP().setType("preonly")
        snes.getKSP().getPC().setType("lu")

        # A line search would change which arc a step ends on; step control is the continuation's business.
        set_from_options(snes, "nnm_snes_linesearch_type", "basic")

        # Data of one call of ``solve``: PETSc passes vectors and matrices alone to the callbacks.
        self._equations: DenseEquations
        self._row: tuple[np.ndarray, float]
        self._tolerance = 0.0
        self._rounding = 0.0
        self._history: list[float] = []

    def solve(
        self,
        equations: DenseEquations,
        guess: np.ndarray,
        row: np.ndarray,
        value: float,
        tolerance: float,
        rounding: float = 0.0,
    ) -> Attempt:
        """Solve by Newton's method from ``guess`` (size,), to ``tolerance``, on the plane row . xi = value.

        ``rounding`` is the largest norm that rounding may leave of the residual at a solution.
        """
        self._equations = equations
        self._row = row, value
        self._tolerance = tolerance
        self._rounding = rounding
        self._history = []
        self._xi.setArray(guess)
        try:
            with self._errors.raised_after():
                self._snes.solve(None, self._xi)
        except FlowError as error:
            return Attempt(False, str(error), self._history, guess, left_domain=True)
        except PETSc.Error as error:
            if error.ierr != SINGULAR_MATRIX:
                raise
            return Attempt(False, "the derivative is singular", self._history, guess)

        reason = self._snes.getConvergedReason()
        # The array is a view of the vector, which the next call overwrites.
        xi = np.array(self._xi.getArray(readonly=True))
        return Attempt(reason > 0, _REASONS.get(reason, str(reason)), self._history, xi)

    def _evaluate(self, snes: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        xi = x.getArray(readonly=True)
        row, value = self._row
        f.setArray(np.append(self._equations.residual(xi), row @ xi - value))

    def _differentiate(self, snes: PETSc.SNES, x: PETSc.Vec, matrix: PETSc.Mat, _: PETSc.Mat) -> None:
        xi = x.getArray(readonly=True)
        matrix.getDenseArray()[:] = np.vstack([self._equations.jacobian(xi), self._row[0]])
        matrix.assemble()

    def _test(self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]) -> int | bool:
        _, step, residual = norms
        self._history.append(residual)
        reasons = PETSc.SNES.ConvergedReason
        if not np.isfinite(residual):
            return NOT_FINITE
        if residual <= self._tolerance:
            return reasons.CONVERGED_FNORM_ABS
        # Before the first step PETSc gives 0 for its norm.
        if iteration and step <= STEP_TOLERANCE and residual <= LARGEST_RESIDUAL:
            return reasons.CONVERGED_SNORM_RELATIVE
        if iteration and STAGNANT * self._history[-2] < residual <= self._rounding:
            return reasons.CONVERGED_FNORM_RELATIVE
        # The floor is for a guess that is almost exact, whose residual the first step may multiply by more than 1e3.
        if residual > 1e3 * max(self._history[0], 1e-3):
            return reasons.DIVERGED_DTOL
        return reasons.ITERATING


# petsc4py names the reasons as attributes of a class; messages need the name of a number.
_REASONS = {
    value: name.lower().replace("_", " ")
    for name, value in vars(PETSc.SNES.ConvergedReason).items()
    if name.startswith(("CONVERGED", "DIVERGED"))
}
