"""The elongation at which a spring loses its force, which the sentence of a failed run names."""

from __future__ import annotations

import pytest

from vipetsc.dynamics.failing_place import _elongations_without_force
from vipetsc.lattice import Chain
from vipetsc.lattice.cell import Spring, UnitCell


@pytest.mark.parametrize(
    ("quadratic", "cubic", "limits"),
    [
        # z - 3 z^2 + 2 z^3 = z (1 - z)(1 - 2 z) vanishes first at 1/2, z - z^2 at 1, z + z^2 at -1, z - 4 z^3 at 1/2.
        (-3.0, 2.0, {0: 0.5}),
        (-1.0, 0.0, {0: 1.0}),
        (1.0, 0.0, {0: -1.0}),
        (0.0, -4.0, {0: 0.5}),
        (1.0, 2.0, {}),
        (0.0, 4.0, {}),
        (0.0, 0.0, {}),
    ],
)
def test_a_spring_loses_its_force_at_the_nearest_zero(quadratic, cubic, limits):
    spring = Spring(0, 0, 1.0, offset=1, quadratic=quadratic, cubic=cubic)
    chain = Chain(UnitCell(masses=(1.0,), springs=(spring,), host=0, resonator=0), 3)
    found = _elongations_without_force(chain, 1)
    assert {number: abs(z) if cubic < 0 else z for number, z in found.items()} == pytest.approx(limits)
