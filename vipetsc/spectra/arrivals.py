"""When a wave reaches a place: its front, and its peak.

The **front** is there at the first sample at which the kinetic energy of the cell exceeds 1 % of its largest value. The
energies of pass bands are averaged from the front at the first site on, since the paper averages its transfer over the
time "after the front reaches the first site".

The **peak** is there at the sample with the largest velocity of the host. Entropies are averaged from the peak of the
linear wave at the first site on, the paper's t_hat: before, the cells are still filled by the wave that arrives.

Half the burst lies between the two. In the built-in lattice with five sites the front comes at 0.194 s and the peak at
0.269 s; averaged from the peak on, the largest transfer would be 0.360, from the front on it is 0.323.
"""

import numpy as np

FRONT = 0.01  # fraction of a cell's largest kinetic energy


def front_arrival(energy: np.ndarray) -> int:
    """Return the sample at which the front of a wave reaches a cell with the kinetic ``energy`` (t,) in J."""
    return int(np.argmax(energy > FRONT * energy.max()))


def peak_arrival(velocity: np.ndarray) -> np.ndarray:
    """Return the sample (...) at which the peak of a wave reaches a host with the ``velocity`` (t, ...) in m/s."""
    return np.argmax(np.abs(velocity), axis=0)


def estimated_peak(duration: float, distance: float, speed: float) -> float:
    """Return the time in s at which the middle of a burst arrives from a ``distance`` in cells.

    The burst has the ``duration`` in s, and its wave the group velocity ``speed`` in cells/s. Cells that contacts alone
    join have no waves, and the speed 0: no time to travel is known, and none is added.
    """
    return float(0.5 * duration + distance / (speed or np.inf))
