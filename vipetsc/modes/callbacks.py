"""Exceptions of Python functions that PETSc calls, as its solvers for equations do.

An exception that passes through PETSc's own functions leaves vectors locked behind. With some versions of PETSc it
arrives unchanged, with others as "error code -1" or "error code 101". A callback that fails therefore returns NaN, on
which the solver gives up, and the exception is raised when the solver has returned.

This is safe only if the callback fails on all ranks of the solver. An exception of one rank alone, while the others
wait in a collective call of the same callback, is raised at once; it ends the program on all ranks.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from petsc4py import PETSc

import numpy as np

from vipetsc.modes.problem import FlowError
from vipetsc.parallel import StoppedError

# Errors that all ranks of a solver raise, or none.
OF_ALL_RANKS = FlowError, StoppedError


class CallbackErrors:
    """The first exception of a solver's callbacks, raised when the solver has returned."""

    def __init__(self) -> None:
        self._first: BaseException | None = None

    def __bool__(self) -> bool:
        """Whether a callback has failed in the present solve."""
        return self._first is not None

    def keep(self, callback: Callable[..., None]) -> Callable[..., None]:
        """The function to give to PETSc in place of ``callback(solver, x, result, ...)``.

        All ranks or none must raise a FlowError or a StoppedError in the callback; any other exception may be one
        rank's own. After the first failure the callback is not called again, since its arguments would follow from NaN;
        the results are NaN.
        """

        def call(solver: object, x: PETSc.Vec, result: PETSc.Vec | PETSc.Mat, *others: object) -> None:
            if not self:
                try:
                    return callback(solver, x, result, *others)
                except BaseException as error:
                    self._first = error
                    if x.comm.size > 1 and not isinstance(error, OF_ALL_RANKS):
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
