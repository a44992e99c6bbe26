"""Springs that count as torn off, by the zeros of their force."""

from __future__ import annotations

import numpy as np
import pytest

from vipetsc.dynamics.torn_spring import _worst
from vipetsc.lattice import Chain
from vipetsc.lattice.cell import Spring, UnitCell


@pytest.mark.parametrize(
    ("elongation", "limit"),
    [(0.4, None), (0.75, 0.5), (-3.0, None), (2.0, None), (np.nan, None), (np.inf, None), (0.0, None)],
)
def test_a_spring_is_torn_between_the_zeros_of_its_force(elongation, limit):
    """A spring is torn where its force has the wrong sign.

    The force z - 3 z^2 + 2 z^3 = z (1 - z)(1 - 2 z) pushes the masses apart for 1/2 < z < 1, and restores elsewhere.
    """
    spring = Spring(0, 0, 1.0, next_cell=True, quadratic=-3.0, cubic=2.0)
    chain = Chain(UnitCell(masses=(1.0,), springs=(spring,), host=0, resonator=0), 3)

    torn = _worst(chain, np.array([[1, 0]]), np.array([elongation]))

    found = None
    if torn is not None:
        found = torn.limit
    assert found == pytest.approx(limit)


def test_the_spring_farthest_beyond_its_limit_is_named():
    """The spring with the largest elongation over its limit is named; the force z - z^2 has the limit 1."""
    spring = Spring(0, 0, 1.0, next_cell=True, quadratic=-1.0)
    chain = Chain(UnitCell(masses=(1.0,), springs=(spring,), host=0, resonator=0), 4)

    torn = _worst(chain, np.array([[0, 0], [1, 0], [2, 0]]), np.array([1.5, 4.0, 2.0]))

    assert torn is not None
    assert (torn.cell, torn.ratio) == (1, 4.0)
