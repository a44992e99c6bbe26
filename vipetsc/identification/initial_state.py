r"""Coordinates of an initial state that is estimated with the parameters.

The state of a lattice of n masses has 2n numbers. With the modes phi_k (mass-normalised) and frequencies W_k in rad/s
of the lattice without contacts they are written as

    u = sqrt(e) sum_k a_k phi_k/W_k,    u' = sqrt(e) sum_k b_k phi_k,

so that e(a_k^2 + b_k^2)/2 is the energy of mode k in J. The coordinates of the fit are the a_k, then the b_k. If they
were independent and normal with variance 1, the derivative of order r of u_i would have the mean square
e sum_k (phi_ki W_k^(r-1))^2. Each sensor thus has an e with which this is the mean square that it measured; the scale e
in J is the largest of them. Coordinates are then numbers of order one wherever in the lattice the energy is.

A few sensors may not determine all coordinates. A weak prior, normal with a standard deviation of ``WIDTH``, keeps the
others finite: no mode has more than some hundred times e, the energy of a mode that was measured.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

from vipetsc.case import Model

# Standard deviation of the prior of a coordinate. It has to be wide: with 1, 3 and 30 the parameters of a chain, from a
# record with 5 % noise, move by .05, .005 and .0005 standard errors.
WIDTH = 10.0
# Standard deviation while windows grow and data are few: that of modes with the energy that was measured.
NARROW = 1.0
# A mode without stiffness has W = 0, and 1/W is infinite. This fraction of the lowest elastic frequency takes the place
# of W: with the same coordinate the mode's displacement is ten times that of the slowest elastic mode.
SLOW = 0.1
# Frequencies below this fraction of the highest one are those of modes without stiffness. Squared frequencies are
# rounded at 1e-16 of the highest one's square: zero comes out as 1e-8 of the highest frequency.
RIGID = 1e-6


class InitialState(NamedTuple):
    """A state (2n,) that is estimated: ``matrix`` (2n, 2n) times its coordinates.

    Among all coordinates of the fit they have the indices from ``first`` on.
    """

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
    """The initial state of ``model`` in coordinates that have the indices from ``first`` on.

    A sensor is the mass (0-based), the order of the derivative of its displacement that is measured, and the root mean
    square of what was measured.
    """
    # Modes of the lattice without contacts.
    masses = model.chain.masses()
    stiffness = model.chain.stiffness_matrix().toarray()
    roots = np.sqrt(masses)
    squares, vectors = scipy.linalg.eigh(stiffness / np.outer(roots, roots))
    frequencies = np.sqrt(np.maximum(squares, 0.0))

    # Without any spring the drive sets the scale of the frequencies.
    elastic = frequencies > RIGID * frequencies[-1]
    lowest = model.drive.frequency
    if elastic.any():
        lowest = frequencies[elastic].min()
    frequencies = np.maximum(frequencies, SLOW * lowest)
    shapes = vectors / roots[:, None]

    # sqrt(e), the largest of the sensors'.
    scale = 0.0
    for mass, order, size in sensors:
        deviation = np.sqrt(np.sum((shapes[mass] * frequencies ** (order - 1)) ** 2))
        scale = max(scale, size / deviation)
    return InitialState(first, scale * scipy.linalg.block_diag(shapes / frequencies, shapes))
