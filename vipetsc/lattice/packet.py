"""Wave packets: that of a tone burst in an infinite lattice, its band and speeds; a Gaussian one, cell by cell."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from vipetsc.lattice.bands import bloch
from vipetsc.lattice.cell import UnitCell
from vipetsc.lattice.chain import Chain
from vipetsc.lattice.drive import Waveform

# Wavenumbers over which energies are summed: half as many change the speeds of a packet by 1e-5, twice as many by 1e-6.
WAVENUMBERS = np.linspace(0, np.pi, 8001)[1:-1]
# Of these, one in so many is enough for a sum: with 4 a fraction changes by 2e-4, with 16 by 4e-4.
COARSE = 8
# Fraction of a packet's energy that counts as slower than its slow speed, and fraction that counts as faster than its
# fast one.
BEYOND = 1e-3
# Weight of a wave, relative to the main one, below which it adds nothing to a sum in double precision.
NEGLIGIBLE = 1e-18


@lru_cache
def packet_speeds(cell: UnitCell, burst: Waveform, mass: int) -> tuple[int, float, float]:
    """Return band (from 0) that takes most of the energy, and the speeds in cells/s of its slow and of its fast waves.

    A force F on one ``mass`` (0-based) gives the Bloch wave of frequency w and mass-normalised vector u an energy in
    proportion to |F^(w)|^2 |u_mass|^2. All but the fraction ``BEYOND`` of the band's energy is faster than the slow
    speed, and all but the same fraction is slower than the fast one.
    """
    point = bloch(cell, WAVENUMBERS)
    weights = np.abs(burst.spectrum(point.frequency) * point.vectors[:, mass]) ** 2
    band = int(np.argmax(weights.sum(axis=0)))

    # Quantiles of the speed, weighted by energy.
    speed = np.abs(point.group_velocity[:, band])
    weight = weights[:, band]
    order = np.argsort(speed)
    slow, fast = np.interp([BEYOND, 1 - BEYOND], np.cumsum(weight[order]) / weight.sum(), speed[order])
    return band, float(slow), float(fast)


@lru_cache
def narrow_fraction(cell: UnitCell, waveform: Waveform, mass: int, width: float) -> float:
    """Return the fraction of the energy of waves by a force on one ``mass`` (0-based) that is in one band, and narrow.

    These are the waves of the band that takes most, at frequencies within the fraction ``width`` of the main one.
    """
    point = bloch(cell, WAVENUMBERS[::COARSE])
    weights = np.abs(waveform.spectrum(point.frequency) * point.vectors[:, mass]) ** 2
    band = int(np.argmax(weights.sum(axis=0)))
    is_near = np.abs(point.frequency[:, band] - waveform.frequency) <= width * waveform.frequency
    return float(weights[is_near, band].sum() / weights.sum())


class Packet(NamedTuple):
    """A packet whose envelope is largest, 1 m, at the ``centre`` cell (0-based).

    ``displacement`` and ``velocity`` (cell, dof) in m and m/s are of the cells from ``centre - len(velocity)//2`` on.
    ``energy`` in J is that of all waves together.
    """

    centre: int
    displacement: np.ndarray
    velocity: np.ndarray
    energy: float

    def on(self, chain: Chain, start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        """Return displacement and velocity (cell, dof) of cells ``start`` to ``stop``, none beyond an end."""
        first = self.centre - len(self.velocity) // 2
        cells = chain.topology.neighbour(first + np.arange(len(self.velocity)))
        inside = (cells >= start) & (cells < stop)
        # In a ring shorter than the packet, cells occur more than once.
        u, v = np.zeros((2, stop - start, chain.cell.dofs))
        np.add.at(u, cells[inside] - start, self.displacement[inside])
        np.add.at(v, cells[inside] - start, self.velocity[inside])
        return u, v


@lru_cache(maxsize=4)
def gaussian_packet(cell: UnitCell, band: int, kappa: float, centre: int, width: float, direction: int = 1) -> Packet:
    """Return waves of ``band`` (1-based) alone about ``kappa`` in (0, pi], in ``direction`` 1 (to higher cells) or -1.

    u = Re sum a_k phi_k exp(i (k x - Om_k t)), a_k ~ exp(-(k - kappa)^2 width^2/2), x in cells from ``centre``: the
    envelope is a Gaussian of standard deviation ``width``. Vectors phi_k are turned so that they are in phase with that
    at ``kappa``; a wave that stands counts as going to higher cells.
    """
    # At the far side of the ring, 16 standard deviations away, the envelope is below rounding. A power of two is fast
    # to transform.
    ring = 1 << max(int(np.ceil(np.log2(32 * width))), 7)
    k = 2 * np.pi * np.fft.fftfreq(ring, 1.0)
    backward = bloch(cell, kappa).group_velocity[band - 1] < 0
    main = -kappa * direction if backward else kappa * direction
    detuning = (k - main + np.pi) % (2 * np.pi) - np.pi
    weight = np.exp(-0.5 * (detuning * width) ** 2)
    waves = np.flatnonzero(weight > NEGLIGIBLE)

    point = bloch(cell, k[waves])
    # LAPACK leaves the phase of each vector open. Turned to that of the main wave, they make one envelope.
    vectors = point.vectors[:, :, band - 1]
    omega = point.frequency[:, band - 1]
    overlap = (vectors * np.asarray(cell.masses)) @ bloch(cell, main).vectors[:, band - 1].conj()
    amplitudes = np.zeros((2, ring, cell.dofs), complex)
    amplitudes[0, waves] = vectors * (weight[waves] * np.exp(-1j * np.angle(overlap)))[:, None]
    amplitudes[1, waves] = -1j * omega[:, None] * amplitudes[0, waves]

    fields = np.fft.fftshift(np.fft.ifft(amplitudes, axis=1), axes=1)
    peak = np.abs(fields[0]).max()
    u, v = fields.real / peak
    energy = float(np.sum((weight[waves] * omega) ** 2) / (2 * ring * peak**2))
    return Packet(centre=centre, displacement=u, velocity=v, energy=energy)
