"""Compiled drives: the records of what acts on a lattice, the force at a time, the times at which it is not smooth.

Which piece of a waveform is on is no function of time alone: within a step it is continued beyond its end, so that no
kink lies inside; engines end their steps on the ``breaks`` and select the pieces anew.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.lattice.drive import PIECE, Drive, Pieces

# Shares of a time, and of a step, to which the beginning of a piece is met.
ROUNDED = 1e-14

DRIVE = np.dtype(
    [(name, np.int64) for name in ("number", "target", "first", "last", "piece")]
    + [(name, float) for name in ("amplitude", "frequency", "cycles", "duration", "highest", "stiffness", "inverse")]
)
"""A drive: its number in the model; the component of the state that it acts on, by 1/mass (1/kg); its rows of the
pieces, half open, none of a burst, and the one that is on, -1 of none; a burst's factor before 1 - cos in N, frequency
in rad/s and cycles; its end in s, highest frequency in rad/s; of a wall the stiffness of its spring in N/m, else 0."""


class Drives(NamedTuple):
    """Drives (drive,) of dtype ``DRIVE`` and the ``pieces`` of all of their waveforms, of dtype ``PIECE``, in N."""

    rows: np.ndarray
    pieces: np.ndarray


def create_drives(drives: Sequence[Drive], numbers: Sequence[int]) -> Drives:
    """The record of those of ``drives`` with the ``numbers``, -1 of one that there is not; all are off."""
    tables, rows = [np.zeros(0, PIECE)], np.zeros(len(numbers), DRIVE)
    for row, number in zip(rows, numbers, strict=True):
        row["number"], row["piece"], row["first"], row["last"] = number, -1, sum(map(len, tables)), 0
        if number < 0:
            continue
        wave, factor = drives[number].waveform, drives[number].stiffness or 1.0
        row["duration"], row["highest"], row["stiffness"] = wave.duration, wave.highest, drives[number].stiffness
        if isinstance(wave, Pieces):
            tables.append(Pieces.of(factor, 1.0, np.inf, wave.table).table)
            row["last"] = row["first"] + len(wave.table)
        else:
            row["amplitude"], row["frequency"], row["cycles"] = (
                wave.window_amplitude * factor,
                wave.frequency,
                wave.cycles,
            )
    return Drives(rows, np.concatenate(tables))


@kernel
def drive_force(drives: Drives, i: int, t: float) -> float:
    """Force in N of drive ``i`` at time t in s: of the burst by Eq. (3), else of the piece that is on."""
    drive = drives.rows[i]
    if drive.first >= drive.last:
        if t <= 0.0 or t >= drive.duration:
            return 0.0
        phase = drive.frequency * t
        return drive.amplitude * (1.0 - np.cos(phase / drive.cycles)) * np.sin(phase)
    if drive.piece < 0:
        return 0.0
    piece = drives.pieces[drive.piece]
    x = t - piece.start
    value = ((((piece.c5 * x + piece.c4) * x + piece.c3) * x + piece.c2) * x + piece.c1) * x + piece.c0
    return value * np.sin(piece.phase + x * (piece.frequency + 0.5 * piece.rate * x))


@kernel
def select_piece(drives: Drives, i: int, t: float) -> float:
    """Turn on the piece of drive ``i`` that begins last until the time t in s; when the next one begins, or its end."""
    drive = drives.rows[i]
    if drive.first >= drive.last or t >= drive.duration:
        drive.piece = -1
        return drive.duration if t < drive.duration else np.inf
    low, high = drive.first, drive.last
    while low < high:
        middle = (low + high) // 2
        if drives.pieces[middle].start <= t:
            low = middle + 1
        else:
            high = middle
    drive.piece = low - 1 if low > drive.first else -1
    return drives.pieces[low].start if low < drive.last else drive.duration


@kernel
def drive_end(drives: Drives, i: int, begin: float, interval: float, position: float) -> float:
    """Share of the step of ``interval`` s from ``begin`` on to which drive ``i`` is smooth; -1 if it is over.

    The piece that begins at the ``position``, a share to rounding, is turned on. A burst's end stays its end.
    """
    drive = drives.rows[i]
    if drive.first >= drive.last:
        return (drive.duration - begin) / interval
    t = begin + position * interval
    end = select_piece(drives, i, t + ROUNDED * (interval + abs(t)))
    return (end - begin) / interval if end < np.inf or drive.piece >= 0 else -1.0


@kernel
def wall_energy(drives: Drives, i: int, t: float, u: float) -> float:
    """Energy in J of a wall's spring at time t in s, its mass at u in m, beyond that of one to a wall at rest.

    It is the work of the wall beyond that of the force k U on the mass, too; 0 of a force.
    """
    stiffness = drives.rows[i].stiffness
    if stiffness == 0.0:
        return 0.0
    select_piece(drives, i, t)
    force = drive_force(drives, i, t)
    return 0.5 * force * force / stiffness - force * u
