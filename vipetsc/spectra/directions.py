"""Energies of the Bloch waves of an infinite lattice by band and direction, exact at an instant.

A state of a ring, or one that vanishes beyond some cells, is a sum of Bloch waves: with the Fourier transforms over the
cells of the displacements, u^(kappa), and of the velocities, v^(kappa), and mass-normalised Bloch vectors e_b, their
amplitudes are q = e_b* M u^ and p = e_b* M v^, of which

    a_b(kappa) = omega_b q + i p

is the part that goes as exp(-i omega t); the other part belongs to -kappa. The wave travels as its group velocity
d omega_b/d kappa says, with the energy |a_b|^2/(2 N). The sum over all waves is the kinetic and spring energy of the
lattice (Parseval), and each term is constant as long as no contact is closed. So directions are told apart while waves
still overlap.
"""

import numpy as np

from vipetsc.lattice import UnitCell, bloch


def wave_energies(cell: UnitCell, displacement: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Energies in J of the waves on a ring, and their group velocities in cells/s, each (wavenumber, band).

    ``displacement`` in m and ``velocity`` in m/s are (cell, dof).
    """
    cells = len(displacement)
    point, masses = bloch(cell, 2 * np.pi * np.fft.fftfreq(cells, 1.0)), np.asarray(cell.masses)
    q, p = (
        np.einsum("kdb,kd->kb", point.vectors.conj(), np.fft.fft(field, axis=0) * masses)
        for field in (displacement, velocity)
    )
    speed = point.group_velocity.copy()
    speed[[0, cells // 2] if cells % 2 == 0 else [0]] = 0.0  # standing waves
    return np.abs(point.frequency * q + 1j * p) ** 2 / (2 * cells), speed


def by_direction(energy: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Energy (band, direction) in J of the waves (wavenumber, band) that go to higher and to lower cells.

    A standing wave goes half each way.
    """
    sign = np.sign(speed)
    return np.stack([(energy * (1 + side * sign) / 2).sum(axis=0) for side in (1, -1)], axis=1)
