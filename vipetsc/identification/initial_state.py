r"""Coordinates of an initial state that is estimated with the parameters.

A lattice of n masses has 2n numbers in its state. With the modes phi_k (mass-normalised) and frequencies W_k of the
lattice without contacts,

    u = sqrt(e) sum_k a_k phi_k/W_k,    u' = sqrt(e) sum_k b_k phi_k,

e(a_k^2 + b_k^2)/2 is the energy of mode k. With a_k and b_k normal of variance 1, a sensor of the derivative of order
r of u_i has the mean square e sum_k (phi_ki W_k^(r-1))^2. The scale e in J is the largest for which a sensor's mean
square is the measured one, so that coordinates are numbers of order one wherever in the lattice the energy is.

A few sensors may not determine all coordinates. A weak prior, normal with a standard deviation of ``WIDTH``, keeps the
others finite: no mode has more than some hundred times the energy that was measured.
"""

from collections.abc import Sequence
from typing import NamedTuple

from mpi4py import MPI

import numpy as np
import scipy

from vipetsc.case import Model
from vipetsc.dynamics.initial import initial_fields
from vipetsc.identification.motion import MotionCoefficients

# Standard deviation of the prior of a coordinate.
WIDTH = 10.0
# ... and while windows grow, when data are few: modes as lively as the liveliest sensor.
NARROW = 1.0
# A mode without stiffness has an infinite 1/W: this fraction of the lowest elastic frequency takes the place of W. Its
# displacement may then be ten times that of the slowest elastic mode.
SLOW = 0.1
# Frequencies below this fraction of the highest one are those of modes without stiffness: rounding of squared
# frequencies, 1e-16, leaves them 1e-8.
RIGID = 1e-6


class InitialState(NamedTuple):
    """The state is ``matrix`` (2n, 2n) times the coordinates, of which the first has the index ``first``."""

    first: int
    matrix: np.ndarray

    @property
    def stop(self) -> int:
        """The index behind the last coordinate."""
        return self.first + len(self.matrix)

    @property
    def indices(self) -> range:
        """The indices of the coordinates."""
        return range(self.first, self.stop)


def initial_state(model: Model, first: int, sensors: Sequence[tuple[int, int, float]]) -> InitialState:
    """Coordinates from index ``first`` on of the initial state of ``model``.

    ``sensors`` are the mass (0-based), the order of the derivative of its displacement that is measured, and the root
    mean square of what was measured.
    """
    # Modes of the lattice whose contacts are open.
    coefficients = MotionCoefficients.of(model)
    n = len(coefficients.masses)
    rows = np.repeat(np.arange(n), np.diff(coefficients.first))
    stiffness = np.zeros((n, n))
    stiffness[rows, coefficients.columns] = coefficients.stiffness
    roots = np.sqrt(coefficients.masses)
    squares, vectors = scipy.linalg.eigh(stiffness / np.outer(roots, roots))
    frequencies = np.sqrt(np.maximum(squares, 0.0))

    elastic = frequencies > RIGID * frequencies[-1]
    slowest = SLOW * (frequencies[elastic].min() if elastic.any() else model.drive.frequency)
    frequencies = np.maximum(frequencies, slowest)
    shapes = vectors / roots[:, None]

    # sqrt(e), from the sensor that needs the largest.
    scale = 0.0
    for mass, order, size in sensors:
        deviation = np.sqrt(np.sum((shapes[mass] * frequencies ** (order - 1)) ** 2))
        scale = max(scale, size / deviation)
    return InitialState(first, scale * scipy.linalg.block_diag(shapes / frequencies, shapes))


def state_of(model: Model) -> np.ndarray:
    """The state (2n,) in m and m/s in which ``model`` begins, that of rest without an initial motion."""
    chain = model.chain
    if model.initial is None:
        return np.zeros(2 * chain.cells * chain.cell.dofs)
    fields = initial_fields(model, range(chain.cells), MPI.COMM_SELF)
    return np.concatenate([field.ravel() for field in fields])
