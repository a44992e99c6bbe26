"""The step after the onset of a contact, over the contact's duration."""

from collections.abc import Sequence
from typing import NamedTuple

from vipetsc.lattice import Contact


class _OnsetStep(NamedTuple):
    """The ``fraction`` of the contact's duration at a tolerance of 1e-10, and the ``order`` of the step's error."""

    fraction: float
    order: float


# Where all forces begin linearly, and else. Hertz's force begins as (t - onset)^(3/2), which no step of high order
# resolves: the velocity's error goes as h^(5/2). The fractions are those that the controller settles at. Half of them
# saves every fourth rejected trial of the built-in case, 3 % of all, twice as much costs 2 %; the error is the same.
_LINEAR = _OnsetStep(fraction=1 / 20, order=8)
_OTHER = _OnsetStep(fraction=1 / 200, order=2.5)
_LONGEST = 0.1


def onset_fraction(laws: Sequence[Contact], rtol: float) -> float:
    """The step after an onset over the contact's duration, for contacts of these ``laws`` at a tolerance ``rtol``."""
    step = _OTHER
    if all(law.onset_exponent == 1 for law in laws):
        step = _LINEAR
    return min(step.fraction * (rtol / 1e-10) ** (1 / step.order), _LONGEST)
