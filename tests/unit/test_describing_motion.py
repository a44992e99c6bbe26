"""The amplitude at which a breather begins, by the first harmonic of the force at its place."""

from __future__ import annotations

import pytest

from vipetsc.lattice.cell import Spring
from vipetsc.modes.balance.conservative import PairCompliance, describing_motion
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.problem import ContinuationError


def test_a_spring_without_a_cubic_part_begins_no_breather():
    forces = SiteForces([], [Spring(0, 1, 1e4, quadratic=1e6)])
    with pytest.raises(ContinuationError, match="without a cubic part"):
        describing_motion(forces, 0, PairCompliance(1e-4, -1e-4), 1e3)


def test_the_amplitude_on_a_cubic_spring_is_that_of_its_first_harmonic():
    """The force c (a cos theta)^3 has the first harmonic 3/4 c a^3, and the balance a = -g 3/4 c a^3 yields a."""
    g, cubic = -1e-4, 1e9
    forces = SiteForces([], [Spring(0, 1, 1e4, cubic=cubic)])
    expected = (-4 / (3 * g * cubic)) ** 0.5
    assert describing_motion(forces, 0, PairCompliance(1e-4, g), 1e3).amplitude == pytest.approx(expected, rel=1e-9)
