"""The first state of a curve that leaves another one at a special point: where a period doubles, a symmetry breaks.

At a branch point or a period doubling a second curve crosses. Its states have harmonics that those of the first curve
lack: of half the frequency at a period doubling, even ones where a symmetry is lost. The equations with these harmonics
(``crossing_case``) have the first curve's states as solutions, too, and at the special point a derivative with a second
null vector. The first state of the other curve lies at a small distance s along it (``continuation.crossing``).

A period doubling is located where the perturbation grows at the rate up to which states count as stable, not where it
begins to grow. The second null vector is then one nearly, and Newton's method moves the parameter by what is left.
"""

from typing import TypeVar

import numpy as np

from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes.continuation.crossing import crossing_row, step_across
from vipetsc.modes.problem import ContinuationError
from vipetsc.modes.response.equations import SteadyEquations, SteadyFrame
from vipetsc.modes.response.stability_changes import PERIOD_DOUBLING
from vipetsc.modes.response.state import Response

# First steps that are tried, over the size of the motion.
FRACTIONS = np.array([3e-2, 1e-2, 3e-3, 1e-3])

E = TypeVar("E", bound=SteadyEquations)


def crossing_case(case: NfrcCase, kind: str) -> NfrcCase:
    """Return the ``case`` of the curves that cross its curves at special points of a ``kind``: their harmonics."""
    doubled = 1 + (kind == PERIOD_DOUBLING)
    nfrc = case.nfrc
    update = {"symmetric": False, "subharmonic": doubled * nfrc.subharmonic, "harmonics": doubled * nfrc.harmonics}
    table = case.table
    if table is not None:
        table = table | {"nfrc": table["nfrc"] | update}
    return case.model_copy(update={"nfrc": nfrc.model_copy(update=update), "table": table})


def first_crossing(old: SteadyEquations, point: Response, new: E, side: int) -> tuple[E, Response]:
    """Return the equations ``new`` and a first state, with its tangent, on the curve that crosses the one of ``old``.

    ``side`` is 1 or -1, of the two directions in which the curve leaves. Raises ContinuationError without a state.
    """
    begin = _with_harmonics(old, new, point.xi)
    along = _with_harmonics(old, new, point.tangent)
    frame = SteadyFrame(new, begin, along / np.linalg.norm(along))
    # The null vectors of n equations in n + 1 unknowns belong to the one that always vanishes and to the smallest
    # singular value.
    directions = np.linalg.svd(frame.jacobian(begin))[2]
    row = side * crossing_row(directions[-2:], along)

    attempt, step = step_across(frame.solve, begin, row, FRACTIONS * np.linalg.norm(begin[:-1]))
    if not attempt.converged:
        value = point.xi[-1] * old.parameter.scale
        raise ContinuationError(
            f"no state of a curve that crosses is found at the {point.kind}, {old.parameter.over} = {value:.8g} "
            f"({attempt.reason}; residuals {attempt.residuals}); increase nfrc.harmonics or nfrc.max_newton"
        )
    tangent = SteadyFrame(new, attempt.xi, row).tangent_at(attempt.xi)
    return new, Response(xi=attempt.xi, tangent=tangent, next_step=float(step))


def _with_harmonics(old: SteadyEquations, new: SteadyEquations, xi: np.ndarray) -> np.ndarray:
    """Return the unknowns (n + 1,) of ``new``, with further harmonics or the doubled period, of a state of ``old``."""
    z = old.balance.unpack(xi[:-1])
    more = np.zeros((len(z), new.balance.order + 1), complex)
    every = new.periods // old.periods
    more[:, : every * z.shape[1] : every] = z
    return np.append(new.balance.pack(more) * (old.clearance / new.clearance), xi[-1])
