"""Energies of the linear modes by pass band, gap and wavenumber: exact at every instant, constant between impacts."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from vipetsc.lattice import Chain, Drive, Waveform, pass_bands
from vipetsc.lattice.modes import Modes, linear_modes
from vipetsc.spectra.band_energies import Parts
from vipetsc.spectra.pooling import blocks
from vipetsc.spectra.wavelet import BINS

Rows = Sequence[int] | np.ndarray
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
        modes, parts = linear_modes(chain), Parts.of(pass_bands(chain.cell))
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

    def energies(
        self, displacement: Any, velocity: Any, rows: Sequence[int] | np.ndarray, memory: float = np.inf
    ) -> np.ndarray:
        """Energies (part, bin, row) in J at the samples ``rows`` of fields (t, cell, dof) in m and m/s.

        Fields may be stored; no more than ``memory`` bytes of both are read at once.
        """
        parts = [np.zeros((len(self.parts.names), BINS, 0))]
        for some in blocks(len(rows), 16 * np.prod(velocity.shape[1:]), min(memory, 2**26)):
            u, v = (np.asarray(field[rows[some]]) for field in (displacement, velocity))
            parts.append(self.sums(0.5 * np.abs(self.modes.amplitudes(u, v)) ** 2))
        return np.concatenate(parts, axis=-1)

    def driven_change(self, state: np.ndarray, drives: Sequence[Drive], span: np.ndarray) -> np.ndarray:
        """What ``drives`` change in the energies (part) in J of a lattice without contacts within a ``span`` in s.

        ``state`` are the amplitudes (mode) at its begin. Exact.
        """
        begin, end = span
        later = self.modes.later(state, end - begin)
        for drive in drives:
            force = self.modes.force(drive.cell, drive.mass) * (drive.stiffness or 1.0)
            later += force * self.modes.driven(drive.waveform, begin, end)
        return np.asarray(self.sums(0.5 * (np.abs(later) ** 2 - np.abs(state) ** 2)[None]).sum(axis=(1, 2)))


def cluster_samples(
    onset: np.ndarray, separation: np.ndarray, time: np.ndarray, stride: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Contact episodes put together that touch between the same samples, by the times in s of all.

    Returns the numbers (cluster, 2) of the samples, of those that ``stride`` divides and the last one, between which
    each cluster lies, and the cluster (episode) of every episode, from 0. Episodes without an end (NaN) last.
    """
    first = np.maximum(np.searchsorted(time, onset, side="right") - 1, 0) // stride * stride
    stop = -(-np.searchsorted(time, separation) // stride) * stride
    stop = np.minimum(np.maximum(stop, first + stride), len(time) - 1)
    order = np.argsort(first, kind="stable")
    reach = np.maximum.accumulate(stop[order])
    begins = np.flatnonzero(np.append(True, first[order][1:] >= reach[:-1])[: len(order)])
    ends = np.append(begins[1:], len(order))[: len(begins)] - 1
    cluster = np.zeros(len(order), np.int64)
    cluster[order] = np.repeat(np.arange(len(begins)), ends - begins + 1)
    return np.column_stack([first[order][begins], reach[ends]]), cluster


def _index(edges: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    return np.clip(np.searchsorted(edges, frequency, side="right") - 1, 0, len(edges) - 2)


def upper_share(chain: Chain, drive: Waveform, displacement: np.ndarray, velocity: np.ndarray, work: float) -> float:
    """Energy of the pass bands above the driven one over the drive's ``work`` in J, at one instant.

    Fields (cell, dof) in m and m/s are of all cells. NaN if there is no such band, or no work.
    """
    parts = ModalParts.of(chain)
    above = parts.parts.above(drive.frequency)
    if not above.any() or work == 0:
        return float("nan")
    return float(parts.energies(displacement[None], velocity[None], [0])[above].sum() / work)
