"""How precisely a fit over a window is solved: roughly while windows grow, to rounding at the end."""

from typing import NamedTuple

TOLERANCE = 1e-12  # relative; a sum of a thousand squares is rounded at 1e-14
# Of the smallest noise over the size of its channel, this fraction is the tolerance of a rough motion: impacts amplify
# an error some hundred times, and what is left is a hundredth of the noise.
OF_NOISE = 1e-4
# Rough motions have a tolerance of this at most. 1e-7 costs a tenth less, and its errors reach 2e-6 over 39 impacts.
ROUGHEST = 1e-8


class Tolerances(NamedTuple):
    """Errors allowed per step of an integration, over the largest motion and the largest derivative so far.

    Over 39 impacts by Hertz's law, 1e-11 leaves 2e-9 of the motion and 1e-8 leaves 2e-7; derivatives have 4e-6 with
    1e-9, 1e-5 with 1e-7 and 5e-4 with 1e-5. The defaults are those of all that is stated of a fit.
    """

    motion: float = 1e-11
    derivatives: float = 1e-9


EXACT = Tolerances()


class Precision(NamedTuple):
    """How a fit ends: after so many ``steps`` (None: those of the case), or where cost or coordinates change less.

    ``cost`` and ``step`` are relative changes. ``has_prior`` holds the coordinates near those at which the fit begins.
    ``derivatives`` is the tolerance of derivatives; a fit ``is_rough`` whose motions are as exact as the noise needs.
    """

    steps: int | None = None
    cost: float = TOLERANCE
    step: float = TOLERANCE
    has_prior: bool = False
    # A relative error e of the derivatives moves the end of a fit, whatever its steps, by e/s standard errors. s is the
    # smallest singular value of the Jacobian with columns of length 1: 0.03 for two parameters of correlation 0.999.
    derivatives: float = 1e-7
    is_rough: bool = False

    def tolerances(self, noise: float) -> Tolerances:
        """Tolerances of motions in a fit to data whose smallest ``noise`` is that fraction of its channel's size."""
        motion = EXACT.motion
        if self.is_rough:
            motion = min(max(OF_NOISE * noise, EXACT.motion), ROUGHEST)
        return Tolerances(motion, self.derivatives)


GROWING = Precision(cost=1e-2, step=1e-3, has_prior=True, derivatives=1e-5, is_rough=True)
FINAL = Precision()
