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
# Modes nearer to a pass band than this fraction of the top one's edge are in it. Those at an edge of the built-in
# lattice come out up to 1e-15 outside, those in its gaps lie 0.06 outside.
EDGE = 1e-9
BLOCK = 2**26  # bytes of fields that are transformed together; from a 16th to four times of it the time is the same


@dataclass(frozen=True, eq=False)
class ModalParts:
    """Modes of a lattice, sorted into ``parts`` (bands, gaps, above) and ``BINS`` wavenumber bins.

    ``part`` and ``bin`` (mode) are the numbers, from 0, of the part and the bin in which each mode lies. Modes in a gap
    are localised at the lattice's ends.
    """

    modes: Modes
    parts: Parts
    part: np.ndarray
    bin: np.ndarray

    @classmethod
    def of(cls, chain: Chain) -> Self:
        """Return the modes of ``chain`` without its sites, sorted; they are computed once."""
        modes = linear_modes(chain)
        parts = Parts.of(pass_bands(chain.cell))
        is_band = np.array([bool(numbers) for numbers in parts.bands])

        # Rounding may put a mode at a band's edge into the gap.
        near = EDGE * parts.edges[-2]
        part = _index(parts.edges, modes.frequency)
        for shift in (-near, near):
            neighbour = _index(parts.edges, modes.frequency + shift)
            part = np.where(is_band[neighbour] & ~is_band[part], neighbour, part)

        wavenumber_bin = np.minimum((np.abs(modes.wavenumber) * (BINS / np.pi)).astype(int), BINS - 1)
        return cls(modes=modes, parts=parts, part=part, bin=wavenumber_bin)

    def sums(self, energies: np.ndarray) -> np.ndarray:
        """Return sums (part, bin, t) of ``energies`` (t, mode)."""
        parts = len(self.parts.names)
        index = self.part * BINS + self.bin
        sums = np.zeros((parts, BINS, len(energies)))
        for t, row in enumerate(energies):
            sums[:, :, t] = np.bincount(index, row, parts * BINS).reshape(parts, BINS)
        return sums

    def energies(self, displacement: Any, velocity: Any, rows: Rows, memory: float = np.inf) -> np.ndarray:
        """Return energies (part, bin, row) in J at the samples ``rows`` of fields (t, cell, dof) in m and m/s.

        Fields may be datasets of a file; no more than ``memory`` bytes of both are read at once.
        """
        energies = [np.zeros((len(self.parts.names), BINS, 0))]
        for block in blocks(len(rows), 16 * np.prod(velocity.shape[1:]), min(memory, BLOCK)):
            u = np.asarray(displacement[rows[block]])
            v = np.asarray(velocity[rows[block]])
            energies.append(self.sums(0.5 * np.abs(self.modes.amplitudes(u, v)) ** 2))
        return np.concatenate(energies, axis=-1)

    def driven_change(self, state: np.ndarray, drives: Sequence[Drive], span: np.ndarray) -> np.ndarray:
        """Return the change, by ``drives``, of energies (part) in J without contacts within a ``span`` (2,) in s.

        ``state`` (mode,) are the amplitudes at the beginning of the span. The result is exact.
        """
        begin, end = span
        later = state * np.exp(1j * self.modes.frequency * (end - begin))
        for drive in drives:
            force = self.modes.force(drive.cell, drive.mass) * drive.scale
            later += force * drive.response(self.modes.frequency, begin, end)
        change = 0.5 * (np.abs(later) ** 2 - np.abs(state) ** 2)
        return np.asarray(self.sums(change[None]).sum(axis=(1, 2)))


def cluster_samples(
    onset: np.ndarray, separation: np.ndarray, time: np.ndarray, stride: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Return clusters of contact episodes that overlap between samples, by ``onset`` and ``separation`` (episode) in s.

    Returns the numbers (cluster, 2) of the samples between which each cluster lies, and the number (episode,), from 0,
    of the cluster that each episode is in. Samples are those at ``time`` whose number is a multiple of ``stride``, and
    the last one. An episode without an end (NaN) lasts to the last sample.
    """
    # Rounded down to the sample before and up to the one after: the cluster must enclose its episodes.
    first = np.maximum(np.searchsorted(time, onset, side="right") - 1, 0) // stride * stride
    stop = -(-np.searchsorted(time, separation) // stride) * stride
    # An episode between two neighbouring samples is bounded by both.
    stop = np.minimum(np.maximum(stop, first + stride), len(time) - 1)

    # In the order of their beginnings, a cluster begins where all earlier episodes have ended. (Slices to the number of
    # episodes make empty arrays of those with one element where there is no episode.)
    order = np.argsort(first, kind="stable")
    reach = np.maximum.accumulate(stop[order])
    begins = np.flatnonzero(np.append(True, first[order][1:] >= reach[:-1])[: len(order)])
    ends = np.append(begins[1:], len(order))[: len(begins)] - 1
    cluster = np.zeros(len(order), np.int64)
    cluster[order] = np.repeat(np.arange(len(begins)), ends - begins + 1)

    return np.column_stack([first[order][begins], reach[ends]]), cluster


def _index(edges: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    """Return numbers (mode,), from 0, of the parts in whose ``edges`` (part + 1) each ``frequency`` (mode,) lies."""
    return np.clip(np.searchsorted(edges, frequency, side="right") - 1, 0, len(edges) - 2)


def upper_fraction(chain: Chain, drive: Waveform, displacement: np.ndarray, velocity: np.ndarray, work: float) -> float:
    """Return the energy of the pass bands above the driven one over the drive's ``work`` in J, at one instant.

    After the last impact it is the same at every instant. ``displacement`` in m and ``velocity`` in m/s are (cell, dof)
    of all cells. NaN if there is no such band, or no work.
    """
    parts = ModalParts.of(chain)
    above = parts.parts.above(drive.frequency)
    if not above.any() or work == 0:
        return float("nan")
    return float(parts.energies(displacement[None], velocity[None], [0])[above].sum() / work)
