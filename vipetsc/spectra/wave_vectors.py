"""Energies of the waves of the plane at one instant, by wave vector and branch.

With u(k) the sum of u exp(-i k . (i, j)) over the N cells, a wave A exp(i k . (i, j) - i omega t) has the amplitude
b = e^H M^(1/2) u(k) on its branch e. In a real field the wave of -k has a part in b too; omega b + i b' is omega A
alone, and the energy of the wave is |omega b + i b'|^2/(2 N). On a torus the sum over wave vectors and branches is the
linear energy.
"""

import numpy as np

from vipetsc.lattice.plane import PlaneCell


def wave_vector_energies(plane: PlaneCell, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the energy (k1, k2, branch) in J of each wave, in the order of ``numpy.fft.fftfreq``.

    ``u`` and ``v`` (cell along, cell across, dof) are displacements in m and velocities in m/s.
    """
    n1, n2, _ = u.shape
    k1, k2 = np.meshgrid(2 * np.pi * np.fft.fftfreq(n1, 1.0), 2 * np.pi * np.fft.fftfreq(n2, 1.0), indexing="ij")
    frequency, shapes = plane.waves(k1, k2)
    amplitude, rate = (
        np.einsum("xymb,xym->xyb", shapes.conj(), np.fft.fft2(field * plane.roots, axes=(0, 1))) for field in (u, v)
    )
    return np.asarray(np.abs(frequency * amplitude + 1j * rate) ** 2 / (2 * n1 * n2))
