"""How precisely a fit over a window is solved: roughly while windows grow, to rounding at the end."""

from typing import NamedTuple

TOLERANCE = 1e-12  # relative, near rounding


class Precision(NamedTuple):
    """How a fit ends: after so many ``steps`` (None: those of the case), or where cost or coordinates change less.

    ``cost`` and ``step`` are relative changes. ``has_prior`` holds the coordinates near those at which the fit begins.
    """

    steps: int | None = None
    cost: float = TOLERANCE
    step: float = TOLERANCE
    has_prior: bool = False


GROWING = Precision(cost=1e-2, step=1e-3, has_prior=True)
FINAL = Precision()
