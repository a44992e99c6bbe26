"""The compiled force of a nonlinear spring, beyond its linear part: formulas of ``lattice.cell``, for records."""

from collections.abc import Sequence

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.lattice import Spring, cell

SPRING_LAW = np.dtype([("quadratic", np.float64), ("cubic", np.float64)])
"""Parameters of a spring's force q z^2 + c z^3 at the elongation z: q in N/m^2 and c in N/m^3."""

nonlinear_force = kernel(cell.nonlinear_force)
nonlinear_slope = kernel(cell.nonlinear_slope)
nonlinear_energy = kernel(cell.nonlinear_energy)


def spring_laws(springs: Sequence[Spring]) -> np.ndarray:
    """Return parameters (spring,) of dtype ``SPRING_LAW`` of ``springs``."""
    return np.array([(spring.quadratic, spring.cubic) for spring in springs], SPRING_LAW)
