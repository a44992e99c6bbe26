"""Energies of the Bloch waves of an infinite lattice by band and direction, exact at an instant.

A state of a ring, or one that vanishes beyond some cells, is a sum of Bloch waves: with the Fourier transforms over the
cells of the displacements, u^(kappa), and of the velocities, v^(kappa), and mass-normalised Bloch vectors e_b, their
amplitudes are q = e_b* M u^ and p = e_b* M v^, of which

    a_b(kappa) = omega_b q + i p

is 2 omega_b times the part of q that goes as exp(-i omega_b t). The part that goes as exp(i omega_b t) is that of a
wave with the wavenumber -kappa. A wave travels to higher or to lower cells by the sign of its group velocity
d omega_b/d kappa, with the energy |a_b|^2/(2 N) in J for N cells. The sum over all waves is the kinetic and spring
energy of the lattice (Parseval), and each term is constant as long as no contact is closed. So directions are told
apart even where waves overlap.
"""

from functools import lru_cache

import numpy as np

from vipetsc.lattice import UnitCell, bloch
from vipetsc.lattice.bands import BlochPoint


def wave_energies(cell: UnitCell, displacement: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return energies in J of the waves on a ring, and their group velocities in cells/s, each (wavenumber, band).

    ``displacement`` in m and ``velocity`` in m/s are (cell, dof); wavenumbers are in the order of ``fftfreq``.
    """
    cells = len(displacement)
    # A copy: the array is kept between calls.
    speed = _waves(cell, cells).group_velocity.copy()
    # The wavenumbers 0 and pi are their own opposites, so that their waves stand.
    speed[0] = 0.0
    if cells % 2 == 0:
        speed[cells // 2] = 0.0
    return np.abs(_amplitudes(cell, displacement, velocity)) ** 2 / (2 * cells), speed


def band_envelopes(cell: UnitCell, displacement: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return energies (band, cell) in J of the envelopes of bands' waves, which sum over cells to the bands' own.

    ``displacement`` in m and ``velocity`` in m/s are (cell, dof). The inverse transform of m^(1/2) a_b e_b is a complex
    field of the masses, psi_b(x). A cell has the energy |psi_b|^2/2, summed over its masses: it does not oscillate
    within a period as kinetic and spring energy do.
    """
    point = _waves(cell, len(displacement))
    masses = np.asarray(cell.masses)
    parts = _amplitudes(cell, displacement, velocity)[:, None] * point.vectors * np.sqrt(masses)[:, None]
    return np.asarray(0.5 * (np.abs(np.fft.ifft(parts, axis=0)) ** 2).sum(axis=1).T)


@lru_cache(maxsize=4)
def _waves(cell: UnitCell, cells: int) -> BlochPoint:
    """Return the Bloch waves on a ring of ``cells``, in the order of ``fftfreq``."""
    return bloch(cell, 2 * np.pi * np.fft.fftfreq(cells, 1.0))


def _amplitudes(cell: UnitCell, displacement: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return the amplitudes a_b(kappa), (wavenumber, band), of fields (cell, dof)."""
    point = _waves(cell, len(displacement))
    masses = np.asarray(cell.masses)
    q = np.einsum("kdb,kd->kb", point.vectors.conj(), np.fft.fft(displacement, axis=0) * masses)
    p = np.einsum("kdb,kd->kb", point.vectors.conj(), np.fft.fft(velocity, axis=0) * masses)
    return np.asarray(point.frequency * q + 1j * p)


def by_direction(energy: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Return the energy (band, direction) in J of the waves (wavenumber, band) that go to higher and to lower cells.

    A standing wave goes half to either side.
    """
    sign = np.sign(speed)
    return np.stack([(energy * (1 + side * sign) / 2).sum(axis=0) for side in (1, -1)], axis=1)
