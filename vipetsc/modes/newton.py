"""Newton's method of PETSc's SNES for n equations in n + 1 unknowns, bordered by one linear row."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from petsc4py import PETSc

import numpy as np

from vipetsc.modes.problem import FlowError

# A Newton step below this, in unknowns of order one, is rounding.
STEP_TOLERANCE = 1e-14


@dataclass(eq=False)
class Attempt:
    """What Newton's method did: ``history`` of residual norms, ``reason`` why it stopped, last ``xi`` and its ``arc``.

    The ``arc`` is what was evaluated there: an arc of an orbit, or harmonics; none if Newton's method ``left_domain``.
    """

    converged: bool
    reason: str
    history: list[float]
    xi: np.ndarray
    arc: Any = None
    left_domain: bool = False

    @property
    def residuals(self) -> str:
        """The history as text."""
        return " ".join(f"{r:.1e}" for r in self.history)


class BorderedNewton:
    """Solves ``function`` (xi) = 0 (size - 1,), with the derivative ``matrix`` (xi), and row . xi = value.

    It ends at a residual of ``tolerance``, after a step below ``STEP_TOLERANCE``, where rounding allows no more, or
    after ``max_newton`` steps. Options of PETSc have the prefix ``nnm_``. What the functions raise passes, but
    FlowError, which makes the attempt one that has not converged.
    """

    def __init__(
        self,
        function: Callable[[np.ndarray], np.ndarray],
        matrix: Callable[[np.ndarray], np.ndarray],
        size: int,
        tolerance: float = 1e-13,
        max_newton: int = 7,
    ) -> None:
        self.function, self.matrix, self.tolerance = function, matrix, tolerance
        self._xi, jacobian = self._allocate(size)
        self._snes = snes = PETSc.SNES().create(self._xi.comm)
        snes.setOptionsPrefix("nnm_")
        snes.setFunction(self._function, self._xi.duplicate())
        snes.setJacobian(self._jacobian, jacobian)
        snes.setTolerances(max_it=max_newton)
        snes.setConvergenceTest(self._test)
        self._configure(snes.getKSP())
        options = PETSc.Options("nnm_")
        if not options.hasName("snes_linesearch_type"):
            options["snes_linesearch_type"] = "basic"  # step control is the continuation's business
        snes.setFromOptions()
        self._row: tuple[np.ndarray, float]
        self._history: list[float] = []

    def solve(self, guess: np.ndarray, row: np.ndarray, value: float) -> Attempt:
        """Newton's method from ``guess`` (size,)."""
        self._row, self._history = (row, value), []
        self._xi.setArray(self._local(guess))
        try:
            self._snes.solve(None, self._xi)
        except FlowError as error:
            return Attempt(False, str(error), self._history, guess, left_domain=True)
        reason = self._snes.getConvergedReason()
        return Attempt(reason > 0, _REASONS.get(reason, str(reason)), self._history, self._whole(self._xi).copy())

    def _allocate(self, size: int) -> tuple[PETSc.Vec, PETSc.Mat]:
        """The vector of unknowns, and the matrix for the derivative."""
        dense = PETSc.Mat().createDense((size, size), comm=PETSc.COMM_SELF)
        dense.setUp()
        return PETSc.Vec().createSeq(size, comm=PETSc.COMM_SELF), dense

    def _configure(self, ksp: PETSc.KSP) -> None:
        """Choose the linear solver, before the options are looked at."""
        ksp.setType("preonly")
        ksp.getPC().setType("lu")

    def _local(self, array: np.ndarray) -> np.ndarray:
        """What of an ``array`` (size,) belongs into this rank's part of a vector."""
        return array

    def _whole(self, vector: PETSc.Vec) -> np.ndarray:
        """All of a vector."""
        return np.asarray(vector.getArray(readonly=True))

    def _function(self, snes: PETSc.SNES, x: PETSc.Vec, f: PETSc.Vec) -> None:
        xi, (row, value) = self._whole(x), self._row
        f.setArray(self._local(np.append(self.function(xi), row @ xi - value)))

    def _jacobian(self, snes: PETSc.SNES, x: PETSc.Vec, matrix: PETSc.Mat, _: PETSc.Mat) -> None:
        matrix.getDenseArray()[:] = np.vstack([self.matrix(x.getArray(readonly=True)), self._row[0]])
        matrix.assemble()

    def _test(self, snes: PETSc.SNES, iteration: int, norms: tuple[float, float, float]) -> int | bool:
        _, step, residual = norms
        self._history.append(residual)
        reasons = PETSc.SNES.ConvergedReason
        if not np.isfinite(residual):
            return reasons.DIVERGED_FNORM_NAN
        if residual <= self.tolerance:
            return reasons.CONVERGED_FNORM_ABS
        if iteration and step <= STEP_TOLERANCE:
            return reasons.CONVERGED_SNORM_RELATIVE
        if residual > 1e3 * max(self._history[0], 1e-3):
            return reasons.DIVERGED_DTOL
        return reasons.ITERATING


_REASONS = {
    value: name.lower().replace("_", " ")
    for name, value in vars(PETSc.SNES.ConvergedReason).items()
    if name.startswith(("CONVERGED", "DIVERGED"))
}
