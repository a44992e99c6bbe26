"""The compiled force of a nonlinear spring, beyond its linear part: the twin of ``vipetsc.lattice.Spring``.

Time stepping, energies and normal modes ask these kernels. A further term of the force has its parameter and formulas
in these two files, and its keys in the sections of cases.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.lattice import Spring

SPRING_LAW = np.dtype([("quadratic", np.float64), ("cubic", np.float64)])
"""Parameters of a spring's force q z^2 + c z^3 at the elongation z: q in N/m^2 and c in N/m^3."""


def spring_laws(springs: Sequence[Spring]) -> np.ndarray:
    """Return parameters (spring,) of dtype ``SPRING_LAW`` of ``springs``."""
    return np.array([(spring.quadratic, spring.cubic) for spring in springs], SPRING_LAW)


@kernel
def nonlinear_force(law: Any, z: float) -> float:
    """Return the force in N at the elongation z in m of a spring with a ``law`` of dtype ``SPRING_LAW``."""
    return z * z * (law.quadratic + law.cubic * z)


@kernel
def nonlinear_slope(law: Any, z: float) -> float:
    """Return the derivative in N/m of ``nonlinear_force`` by the elongation z in m."""
    return (2.0 * law.quadratic + 3.0 * law.cubic * z) * z


@kernel
def nonlinear_energy(law: Any, z: float) -> float:
    """Return the integral in J of ``nonlinear_force`` from 0 to the elongation z in m."""
    return z * z * z * (law.quadratic / 3.0 + 0.25 * law.cubic * z)
