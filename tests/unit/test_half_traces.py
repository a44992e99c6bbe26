"""Half-traces of Floquet multipliers: those that may cross a level between two points of a branch."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from vipetsc.modes.stability import HalfTraceAbove, real_half_traces

pytestmark = pytest.mark.parallel(1)


def point(*half_traces: complex) -> SimpleNamespace:
    return SimpleNamespace(half_traces=np.array(half_traces))


def test_all_real_half_traces_may_cross_a_level():
    """Half-traces that are real at both points may cross a level: all of them are looked at."""
    assert real_half_traces(point(-0.2, 0.9), point(-0.1, 1.1)) == [0, 1]


def test_a_pair_that_stays_complex_crosses_none():
    """Two conjugate half-traces whose real part passes 1 cross no level: none of their four multipliers is real."""
    before = point(-0.5, 0.9 - 0.2j, 0.9 + 0.2j)
    after = point(-0.5, 1.1 - 0.2j, 1.1 + 0.2j)
    assert real_half_traces(before, after) == [0]


def test_a_pair_that_collides_within_the_step_may_cross():
    """A pair that is complex at one point and real at the next may cross a level."""
    assert real_half_traces(point(0.9 - 0.1j, 0.9 + 0.1j), point(0.95, 1.1)) == [0, 1]


def test_a_half_trace_is_measured_from_its_level_by_its_real_part():
    """The distance of a half-trace from a level is that of its real part."""
    assert HalfTraceAbove(1, -1.0)(point(0.3, -0.75 + 0.1j)) == pytest.approx(0.25)


def test_a_half_trace_that_is_complex_at_its_level_is_not_accepted():
    crossing = HalfTraceAbove(1, -1.0)
    assert crossing.is_real(point(-1.3, -1.0, 0.2))
    assert not crossing.is_real(point(-1.3, -1.0 - 0.5j, -1.0 + 0.5j))
