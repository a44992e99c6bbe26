"""Newton's method of PETSc's SNES for n equations in n + 1 unknowns, bordered by one linear row."""

from abc import ABC, abstractmethod
from typing import Generic, Protocol, TypeVar

from petsc4py import PETSc

import numpy as np

from vipetsc.modes.problem import Attempt, FlowError

# A Newton step below this, in unknowns of order one, is rounding.
STEP_TOLERANCE = 1e-14


class Equations(Protocol):
    """n equations in the n + 1 unknowns xi."""

    def residual(self, xi: np.ndarray) -> np.ndarray:
        """What should vanish (n,)."""


class DenseEquations(Equations, Protocol):
    """Equations with a matrix for a derivative."""

    def jacobian(self, xi: np.ndarray) -> np.ndarray:
        """Derivative (n, n + 1) of the residual."""


E = TypeVar("E", bound=Equations)


class BorderedNewton(ABC, Generic[E]):
    """Solves residual(xi) = 0 (size - 1,) and row . xi = value; a subclass chooses matrices and vectors.

    It ends at a residual of ``tolerance``, after a step below ``STEP_TOLERANCE``, where rounding allows no more, or
    after ``max_newton`` steps. Options of PETSc have the prefix ``nnm_``. What the equations raise passes, but
    FlowError, which makes the attempt one that has not converged.
    """

    def __init__(self, size: int, max_newton: int = 7) -> None:
        self._xi, jacobian = self._allocate(size)
        self._snes = snes = PETSc.SNES().create(self._xi.comm)
        snes.setOptionsPrefix("nnm_")
        snes.setFunction(self._evaluate, self._xi.duplicate())
        snes.setJacobian(self._differentiate, jacobian)
        snes.setTolerances(max_it=max_newton)
        snes.setConvergenceTest(self._test)
        self._configure(snes.getKSP())

        options = PETSc.Options("nnm_")
        if not options.hasName("snes_linesearch_type"):
            # A line search would change which arc a step ends on; step control is the continuation's business.
            options["snes_linesearch_type"] = "basic"
        snes.setFromOptions()

        # What a solution is asked of, from one call of ``solve`` to its end.
        self._equations: E
        self._row: tuple[np.ndarray, float]
        self._tolerance = 0.0
        self._history: list[float] = []

    def solve(self, equations: E, guess: np.ndarray, row: np.ndarray, value: float, tolerance: float) -> Attempt:
        """Newton's method from ``guess`` (size,) to a residual of ``tolerance`` on the plane row . xi = value."""
        self._equations = equations
        self._row = row, value
        self._tolerance = tolerance
        self._history = []
        self._xi.setArray(self._local(guess))
        try:
            self._snes.solve(None, self._xi)
        except FlowError as error:
            return Attempt(False, str(error), self._history, guess, left_domain=True)

        reason = self._snes.getConvergedReason()
        xi = self._whole(self._xi).copy()
        return Attempt(reason > 0, _REASONS.get(reason, str(reason)), self._history, xi)

    @abstractmethod
    def _allocate(self, size: int) -> tuple[PETSc.Vec, PETSc.Mat]:
        """The vector of unknowns, and the matrix for the derivative."""

    @abstractmethod
    def _configure(self, ksp: PETSc.KSP) -> None:
        """Choose the linear solver, before the options are looked at."""

    @abstractmethod
    def _local(self, array: np.ndarray) -> np.ndarray:
        """What of an ``array`` (size,) belongs into this rank's part of a vector."""

    @abstractmethod
    def _whole(self, vector: PETSc.Vec) -> np.ndarray:
        """All of a vector."""

    @abstractmethod
    def _differentiate(self, snes: PETSc.SNES, x: PETSc.Vec, matrix: PETSc.Mat, _: PETSc.Mat) -> None:
        """Make ``matrix`` the bordered derivative at ``x``."""

    def _evaluate(self, snes: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        xi = self._whole(x)
        row, value = self._row
        f.setArray(self._local(np.append(self._equations.residual(xi), row @ xi - value)))

    def _test(self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]) -> int | bool:
        _, step, residual = norms
        self._history.append(residual)
        reasons = PETSc.SNES.ConvergedReason
        if not np.isfinite(residual):
            return reasons.DIVERGED_FNORM_NAN
        if residual <= self._tolerance:
            return reasons.CONVERGED_FNORM_ABS
        if iteration and step <= STEP_TOLERANCE:
            return reasons.CONVERGED_SNORM_RELATIVE
        if residual > 1e3 * max(self._history[0], 1e-3):
            return reasons.DIVERGED_DTOL
        return reasons.ITERATING


class DenseNewton(BorderedNewton[DenseEquations]):
    """Newton's method with a dense matrix, on one rank."""

    def _allocate(self, size: int) -> tuple[PETSc.Vec, PETSc.Mat]:
        dense = PETSc.Mat().createDense((size, size), comm=PETSc.COMM_SELF)
        dense.setUp()
        return PETSc.Vec().createSeq(size, comm=PETSc.COMM_SELF), dense

    def _configure(self, ksp: PETSc.KSP) -> None:
        ksp.setType("preonly")
        ksp.getPC().setType("lu")

    def _local(self, array: np.ndarray) -> np.ndarray:
        return array

    def _whole(self, vector: PETSc.Vec) -> np.ndarray:
        return np.asarray(vector.getArray(readonly=True))

    def _differentiate(self, snes: PETSc.SNES, x: PETSc.Vec, matrix: PETSc.Mat, _: PETSc.Mat) -> None:
        xi = x.getArray(readonly=True)
        matrix.getDenseArray()[:] = np.vstack([self._equations.jacobian(xi), self._row[0]])
        matrix.assemble()


_REASONS = {
    value: name.lower().replace("_", " ")
    for name, value in vars(PETSc.SNES.ConvergedReason).items()
    if name.startswith(("CONVERGED", "DIVERGED"))
}
