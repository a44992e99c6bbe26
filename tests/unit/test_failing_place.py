"""The elongation at which a spring loses its force, which the sentence of a failed run names."""

from __future__ import annotations

import numpy as np
import pytest

from vipetsc.lattice import Spring


@pytest.mark.parametrize(
    ("quadratic", "cubic", "elongation"),
    [
        # z - 3 z^2 + 2 z^3 = z (1 - z)(1 - 2 z) vanishes first at 1/2, z - z^2 at 1, z + z^2 at -1, z - 4 z^3 at 1/2.
        (-3.0, 2.0, 0.5),
        (-1.0, 0.0, 1.0),
        (1.0, 0.0, -1.0),
        (0.0, -4.0, 0.5),
        (1.0, 2.0, np.inf),
        (0.0, 4.0, np.inf),
        (0.0, 0.0, np.inf),
    ],
)
def test_a_spring_loses_its_force_at_the_nearest_zero(quadratic, cubic, elongation):
    found = Spring(0, 0, 1.0, offset=1, quadratic=quadratic, cubic=cubic).without_force
    if cubic < 0:
        found = abs(found)
    assert found == pytest.approx(elongation)
