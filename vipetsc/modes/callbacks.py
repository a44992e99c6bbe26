"""Exceptions of Python functions that PETSc calls, as its solvers for equations do.

An exception that crosses PETSc's own frames leaves locked vectors behind, and comes out as itself, as "error code -1"
or as "error code 101", by PETSc's version. So PETSc is given NaN, on which its solvers give up, where all ranks of the
solver give it. What may be one rank's own, while others wait in the same callback, has to leave at once; the program
ends then.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from petsc4py import PETSc

import numpy as np

from vipetsc.modes.problem import FlowError


class CallbackErrors:
    """The first exception of a solver's callbacks, raised when the solver has returned."""

    def __init__(self) -> None:
        self._first: BaseException | None = None

    def __bool__(self) -> bool:
        """Whether a callback has failed in the present solve."""
        return self._first is not None

    def keep(self, callback: Callable[..., None]) -> Callable[..., None]:
        """The ``callback(solver, x, result, ...)`` as PETSc is given it; FlowError is raised by all ranks or none.

        After a failure the result is NaN, that of all later callbacks too: they would be evaluated at what follows from
        NaN.
        """

        def call(solver: object, x: PETSc.Vec, result: PETSc.Vec | PETSc.Mat, *others: object) -> None:
            if not self:
                try:
                    return callback(solver, x, result, *others)
                except BaseException as error:
                    self._first = error
                    if x.comm.size > 1 and not isinstance(error, FlowError):
                        raise
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
