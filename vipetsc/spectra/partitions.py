"""Kinetic energies of the twelve wavenumber partitions, and how much of the whole their sum leaves out."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft

from vipetsc.spectra.wavelet import BINS, VOICES, Normalisation, filter_bank

CHUNK = 16


@dataclass(frozen=True)
class Partition:
    """Kinetic energies in J of the parts v_b of a velocity field.

    ``energy`` (bin, t) summed over the lattice, ``field`` (bin, t, cell) or None, ``kinetic`` (t) of the velocities
    themselves, ``reconstructed`` (t): KE_rec = 1/2 sum m (sum_b v_b)^2.
    """

    energy: np.ndarray
    field: np.ndarray | None
    kinetic: np.ndarray
    reconstructed: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """e (t) = |KE_rec - KE| / KE (the paper's Eq. (A8)), 0 at rest."""
        return _share(np.abs(self.reconstructed - self.kinetic), self.kinetic)

    @property
    def cross_share(self) -> np.ndarray:
        """1 - sum_b KE_b / KE (t): the energy in products of different parts, 0 at rest."""
        return _share(self.kinetic - self.energy.sum(axis=0), self.kinetic)


def _share(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    return np.divide(part, whole, out=np.zeros_like(whole), where=whole > 0)


def partition(
    velocity: np.ndarray,
    masses: ArrayLike,
    kc: float = 6.0,
    normalisation: Normalisation = "analytic",
    *,
    bins: int = BINS,
    voices: float = VOICES,
    fields: bool = False,
) -> Partition:
    """Partition the kinetic energy of ``velocity``, (t, cell) or (t, cell, dof) in m/s, by wavenumber bins.

    ``masses`` in kg, (dof) or a scalar. A few snapshots at a time are held, so ``velocity`` may be an HDF5
    dataset. With ``fields`` the energies in space-time are kept too.
    """
    mass_list = np.atleast_1d(np.asarray(masses, dtype=float))
    nt, cells = velocity.shape[:2]
    if mass_list.shape != (velocity.shape[2:] or (1,)):
        raise ValueError(f"masses: {len(mass_list)} given for velocities of shape {velocity.shape}")
    bank = filter_bank(cells, kc, normalisation, bins=bins, voices=voices)
    energy, kinetic, reconstructed = np.zeros((bins, nt)), np.zeros(nt), np.zeros(nt)
    field = np.zeros((bins, nt, cells)) if fields else None
    for first in range(0, nt, CHUNK):
        rows = slice(first, min(first + CHUNK, nt))
        block = np.asarray(velocity[rows], dtype=float).reshape(-1, cells, len(mass_list))
        for j, mass in enumerate(mass_list):
            of_mass = np.ascontiguousarray(block[..., j])
            spectrum = fft.rfft(of_mass, bank.length)
            kinetic[rows] += 0.5 * mass * np.einsum("tc,tc->t", of_mass, of_mass)
            whole = np.zeros_like(of_mass)
            for b, transfer in enumerate(bank.transfer):
                part = fft.irfft(transfer * spectrum, bank.length)[:, :cells]
                whole += part
                energy[b, rows] += 0.5 * mass * np.einsum("tc,tc->t", part, part)
                if field is not None:
                    field[b, rows] += 0.5 * mass * part**2
            reconstructed[rows] += 0.5 * mass * np.einsum("tc,tc->t", whole, whole)
    return Partition(energy, field, kinetic, reconstructed)
