"""How precisely a fit over a window is solved: roughly while windows grow, to rounding at the end."""

from typing import NamedTuple

TOLERANCE = 1e-12  # relative change of cost or coordinates; a sum of a thousand squares is rounded at 1e-14


class Precision(NamedTuple):
    """How a fit ends.

    It ends after so many ``steps`` (None: those of the case), or where the relative change of the ``cost`` or of the
    coordinates, ``step``, is less than these. ``has_prior``: a prior holds the coordinates near those at which the fit
    begins. ``is_rough``: derivatives are one-sided differences.
    """

    steps: int | None = None
    cost: float = TOLERANCE
    step: float = TOLERANCE
    has_prior: bool = False
    is_rough: bool = False


# While windows grow a fit only has to stay in its valley; the next window goes on from there.
GROWING = Precision(cost=1e-2, step=1e-3, has_prior=True, is_rough=True)
FINAL = Precision()
