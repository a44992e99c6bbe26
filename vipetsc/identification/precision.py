"""How precisely a fit over a window is solved: roughly while windows grow, to rounding at the end."""

from typing import NamedTuple

TOLERANCE = 1e-12  # relative change of cost or coordinates; a sum of a thousand squares is rounded at 1e-14
# The tolerance of a rough motion over the smallest noise, both relative to the size of a channel. Impacts amplify an
# error some hundred times, so that it ends at a hundredth of the noise.
OF_NOISE = 1e-4
# Largest tolerance of a rough motion. 1e-7 costs a tenth less, and its errors reach 2e-6 over 39 impacts.
ROUGHEST = 1e-8


class Tolerances(NamedTuple):
    """Errors allowed per step of an integration, over the largest motion and the largest derivative so far.

    After 39 impacts by Hertz's law the motion has errors of 2e-9 with 1e-11, and of 2e-7 with 1e-8; its derivatives
    have errors of 4e-6 with 1e-9, of 1e-5 with 1e-7 and of 5e-4 with 1e-5. All results of a fit are computed with the
    defaults.
    """

    motion: float = 1e-11
    derivatives: float = 1e-9


EXACT = Tolerances()


class Precision(NamedTuple):
    """How a fit ends, and how exact its motions are.

    It ends after so many ``steps`` (None: those of the case), or where the relative change of the ``cost`` or of the
    coordinates, ``step``, is less than these. ``has_prior``: a prior holds the coordinates near those at which the fit
    begins. ``derivatives`` is the tolerance of derivatives. ``is_rough``: motions are only as exact as the noise needs.
    """

    steps: int | None = None
    cost: float = TOLERANCE
    step: float = TOLERANCE
    has_prior: bool = False
    # However many steps it takes, a fit with a relative error e of its derivatives ends e/s standard errors away. With
    # columns of length 1, s is the smallest singular value of the Jacobian: 0.03 for two parameters of correlation
    # 0.999.
    derivatives: float = 1e-7
    is_rough: bool = False

    def tolerances(self, noise: float) -> Tolerances:
        """Tolerances of motions in a fit to data whose smallest ``noise`` is this fraction of its channel's size."""
        motion = EXACT.motion
        if self.is_rough:
            motion = min(max(OF_NOISE * noise, EXACT.motion), ROUGHEST)
        return Tolerances(motion, self.derivatives)


# While windows grow a fit only has to stay in its valley; the next window goes on from there.
GROWING = Precision(cost=1e-2, step=1e-3, has_prior=True, derivatives=1e-5, is_rough=True)
FINAL = Precision()
