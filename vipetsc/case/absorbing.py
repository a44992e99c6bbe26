"""Absorbing ends: the fraction of a drive's energy that they reflect, and the first end that satisfies a bound."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from vipetsc.case.inhomogeneity_sections import AbsorbingTable
from vipetsc.lattice import Drive, ToneBurst, UnitCell, Waveform, waves_at
from vipetsc.lattice.chain import Ends
from vipetsc.lattice.ends import EndSection, absorbing_section, reflection
from vipetsc.lattice.sent import Source

# Lengths that are tried, in cells. Each is twice the one before, and absorbs waves of lower group velocities as well.
LENGTHS = (10, 20, 40, 80, 160, 320, 640)
# Logarithms of the loss of a wave's energy on its way through the end and back. They leave 3e-4, 5e-5, 2e-6 and 4e-8 of
# the energy if the end is so long that its gradient reflects less; in the built-in case 40 cells leave up to 1.3 times
# as much.
LOSSES = (8.0, 10.0, 13.0, 17.0)


def sources_of(drives: Sequence[Drive], cell: UnitCell, ends: Ends, cells: int) -> list[Source]:
    """Return the ``drives`` of a lattice as sources of waves; a wall attached to several springs is a single source."""
    loads: dict[tuple[Waveform, int], np.ndarray] = {}
    for drive in with_unit_amplitude(drives):
        # The waves of springs at one wall interfere, so that their energies do not add: they are one source.
        load = loads.setdefault((drive.waveform, drive.cell), np.zeros(cell.dofs))
        # A wall's motion is a force of that motion times the spring's stiffness.
        # That of a dashpot is out of phase, and is left out: it is small beside that of the spring.
        if not drive.damping:
            load[drive.mass] += drive.scale
    sources = []
    for (waveform, place), load in loads.items():
        sources.append(Source(cell, ends, cells=cells, place=place, load=load, waveform=waveform))
    return sources


def with_unit_amplitude(drives: Sequence[Drive]) -> tuple[Drive, ...]:
    """Return the ``drives``, where a burst that is the only one has the amplitude 1.

    Fractions of its energy do not depend on its amplitude, so that ``_first_end`` designs one end for all amplitudes.
    """
    unit = []
    for drive in drives:
        waveform = drive.waveform
        # An amplitude is 0 if the lattice begins in motion: its waves are those of a burst of that frequency.
        if isinstance(waveform, ToneBurst) and (len(drives) == 1 or not waveform.amplitude):
            waveform = replace(waveform, amplitude=1.0)
        unit.append(replace(drive, waveform=waveform))
    return tuple(unit)


def sections_of(table: AbsorbingTable, cell: UnitCell, ends: Ends, cells: int, strength: float) -> list[EndSection]:
    """Return the absorbing sections, of ``cells`` cells each, with dashpots of a ``strength`` in 1/s."""
    sections = []
    if table.end != "right":
        sections.append(absorbing_section(cell, ends, cells, strength, "left"))
    if table.end != "left":
        sections.append(absorbing_section(cell, ends, cells, strength, "right"))
    return sections


def reflected_at(omega: float, sections: Sequence[EndSection]) -> float:
    """Return the largest share of a wave's energy at ``omega`` (rad/s) that a section reflects; NaN in a gap."""
    return max(reflection(chain, omega, cells, end) for chain, cells, end in sections)


def reflected(sources: Sequence[Source], sections: Sequence[EndSection]) -> float:
    """Return the share of the energy from ``sources`` that ``sections`` reflect, each sine at its frequency.

    NaN if nothing arrives.
    """
    # A sine without end has one frequency and no energy; all pulses together have one energy.
    endless = [source.waveform.frequency for source in sources if source.waveform.repeats]
    fractions = [reflected_at(omega, sections) for omega in endless]
    energies = [source.energies(sections) for source in sources if not source.waveform.repeats]
    if energies:
        arriving, back = np.sum(energies, axis=0)
        if arriving > 0:
            fractions.append(back / arriving)
    # The worst one counts: what the end reflects of a weak sine must not hide behind a strong pulse.
    finite = [fraction for fraction in fractions if np.isfinite(fraction)]
    return float(max(finite, default=np.nan))


def designed_end(
    table: AbsorbingTable, cell: UnitCell, ends: Ends, drives: Sequence[Drive], cells: int
) -> AbsorbingTable:
    """Return ``table`` with the length and the strength that it does not give, for a lattice of ``cells`` cells.

    A length is at most a third of the lattice. Raises ValueError if no end that is tried reflects, of the waves of all
    ``drives``, at most ``table.reflection``.
    """
    waves = [wave for drive in drives for wave in waves_at(cell, drive.waveform.frequency)]
    if not waves:
        raise ValueError("the drive frequency is in a gap: no wave reaches the end")

    lengths = lengths_tried(table, cells)
    if not lengths:
        raise ValueError(
            f"an end has {LENGTHS[0]} cells or more, and at most a third of the lattice, which has {cells} cells;"
            " lengthen the lattice, or give lattice.absorbing.cells"
        )

    # The fastest wave passes the dashpots in the shortest time and loses least.
    speed = max(wave[2] for wave in waves)
    end = _first_end(table, cell, ends, with_unit_amplitude(drives), cells, speed)
    if end.cells:
        return table.model_copy(update={"cells": end.cells, "strength": end.strength})
    raise ValueError(
        f"no end of up to {max(lengths)} cells satisfies it: {end.back:.2g} is reflected, mostly slow waves at band"
        f" edges;"
        " allow more reflection, lengthen the lattice, increase the cycles, or drive farther from the band edges"
    )


def lengths_tried(table: AbsorbingTable, cells: int) -> list[int]:
    """Return the lengths in cells of the ends that ``table`` tries, in ``cells`` cells; [] if these are too few."""
    if table.cells:
        return [table.cells]
    # Two such ends leave a third of the lattice between them, or more.
    return [length for length in LENGTHS if length <= cells // 3]


class TriedEnd(NamedTuple):
    """An end with ``cells`` cells and a ``strength``, which reflects the fraction ``back``.

    If no tried end satisfies the bound, ``cells`` is 0 and ``back`` is the smallest reflected fraction.
    """

    cells: int
    strength: float
    back: float


# Cached: each verb that reads a case resolves it, and so does each member of a sweep over amplitudes; each end that is
# tried costs hundreds of reflections.
@lru_cache
def _first_end(
    table: AbsorbingTable, cell: UnitCell, ends: Ends, drives: tuple[Drive, ...], cells: int, speed: float
) -> TriedEnd:
    """Return the first end that satisfies the bound of ``table``, for waves with a ``speed`` in cells/s."""
    sources = sources_of(drives, cell, ends, cells)
    # Ends are tried from the shortest on, which costs fewest cells, and those of one length from the weakest on, whose
    # gradient reflects least.
    best = np.inf
    for length in lengths_tried(table, cells):
        # The dashpots leave exp(-loss) of a wave's energy, the integral of strength x^3 through the end and back.
        strengths = [2 * speed * loss / length for loss in LOSSES]
        if table.strength:
            strengths = [table.strength]
        for strength in strengths:
            sections = sections_of(table, cell, ends, length, strength)
            back = reflected(sources, sections)
            best = min(best, back)
            if back <= table.reflection:
                return TriedEnd(cells=length, strength=strength, back=back)
    return TriedEnd(cells=0, strength=0.0, back=best)
