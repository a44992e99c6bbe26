"""The step after the onset of a contact, over the contact's duration."""

from collections.abc import Sequence
from typing import NamedTuple

from vipetsc.lattice import Contact


class _OnsetStep(NamedTuple):
    """The ``fraction`` of the contact's duration at a tolerance of 1e-10, and the ``order`` of the step's error."""

    fraction: float
    order: float


# Where all forces begin linearly, and else. Hertz's force begins as (t - onset)^(3/2): the step after the onset goes as
# the root of time, those after it do not, and their errors in velocity go as h^(5/2) where h is beyond their distance
# from the onset. The fractions are those that the controller settles at. Of the fractions 1/200, 1/50 and 1/20 for
# Hertz's law, two cells with 220 contacts take 6,600, 6,490 and 6,540 steps and reject 2,310, 2,530 and 2,540; their
# ledger is the same.
_LINEAR = _OnsetStep(fraction=1 / 20, order=8)
_OTHER = _OnsetStep(fraction=1 / 200, order=2.5)
# Most of the duration, which loose tolerances reach. Not sharp: at 1e-5 and 1e-6 half and twice as much change the
# trials of a small lattice by 1 to 8 % and the error of its ledger by a factor of 3.4 at most.
_LONGEST = 0.1


def onset_fraction(laws: Sequence[Contact], rtol: float) -> float:
    """Return the step after an onset over the contact's duration, for contacts of ``laws`` at tolerance ``rtol``."""
    step = _OTHER
    if all(law.onset_exponent == 1 for law in laws):
        step = _LINEAR
    return min(step.fraction * (rtol / 1e-10) ** (1 / step.order), _LONGEST)
