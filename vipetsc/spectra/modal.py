"""Energies of the linear modes by pass band, gap and wavenumber: exact at every instant, constant between impacts."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from vipetsc.lattice import Chain, ToneBurst, pass_bands
from vipetsc.lattice.modes import Modes, modes_of
from vipetsc.spectra.bands import Parts
from vipetsc.spectra.pooling import blocks
from vipetsc.spectra.wavelet import BINS

EDGE = 1e-9  # modes nearer to a pass band than this share of the top one's edge are in it


@dataclass(frozen=True, eq=False)
class ModalParts:
    """The modes of a lattice, to which of ``parts`` (bands, gaps, above) and which of ``BINS`` wavenumber bins, from 0.

    Modes in a gap are those of the lattice's ends. ``part`` and ``bin`` (mode).
    """

    modes: Modes
    parts: Parts
    part: np.ndarray
    bin: np.ndarray

    @classmethod
    def of(cls, chain: Chain) -> Self:
        """Those of ``chain`` without its sites; the modes are computed once."""
        modes, parts = modes_of(chain), Parts.of(pass_bands(chain.cell))
        is_band, near = np.array([bool(inside) for inside in parts.bands]), EDGE * parts.edges[-2]
        part, below, above = (_index(parts.edges, modes.frequency + shift) for shift in (0.0, -near, near))
        for other in (below, above):
            part = np.where(is_band[other] & ~is_band[part], other, part)
        number = np.minimum((np.abs(modes.wavenumber) * (BINS / np.pi)).astype(int), BINS - 1)
        return cls(modes, parts, part, number)

    def sums(self, energies: np.ndarray) -> np.ndarray:
        """``energies`` (t, mode) as sums (part, bin, t)."""
        shape = len(self.parts.names), BINS
        index = self.part * BINS + self.bin
        rows = [np.bincount(index, row, shape[0] * BINS).reshape(shape) for row in energies]
        return np.stack(rows, axis=-1) if rows else np.zeros((*shape, 0))

    def energies(self, displacement: Any, velocity: Any, rows: Sequence[int], memory: float = np.inf) -> np.ndarray:
        """Energies (part, bin, row) in J at the samples ``rows`` of fields (t, cell, dof) in m and m/s.

        Fields may be stored; no more than ``memory`` bytes of both are read at once.
        """
        parts = [np.zeros((len(self.parts.names), BINS, 0))]
        for some in blocks(len(rows), 16 * np.prod(velocity.shape[1:]), min(memory, 2**26)):
            u, v = (np.asarray(field[rows[some]]) for field in (displacement, velocity))
            parts.append(self.sums(0.5 * np.abs(self.modes.amplitudes(u, v)) ** 2))
        return np.concatenate(parts, axis=-1)


def _index(edges: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    return np.clip(np.searchsorted(edges, frequency, side="right") - 1, 0, len(edges) - 2)


def upper_share(chain: Chain, drive: ToneBurst, displacement: np.ndarray, velocity: np.ndarray, work: float) -> float:
    """Energy of the pass bands above the driven one over the drive's ``work`` in J, at one instant.

    Fields (cell, dof) in m and m/s are of all cells. NaN if there is no such band, or no work.
    """
    parts = ModalParts.of(chain)
    above = parts.parts.above(drive.frequency)
    if not above.any() or work == 0:
        return float("nan")
    return float(parts.energies(displacement[None], velocity[None], [0])[above].sum() / work)
