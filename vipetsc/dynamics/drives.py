"""Compiled drives: their records, the force at a time, the times at which it is not smooth.

Which piece of a waveform acts does not depend on the time alone: within a step a piece is continued beyond its end, so
that no kink lies inside. Engines end their steps on the ``breaks`` and select the pieces anew there.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from vipetsc.compiled import kernel
from vipetsc.lattice.drive import PIECE, Drive, Pieces, burst, burst_rate, piece_rate, piece_value

# Fraction of a time, and of a step, within which a piece that begins has begun.
ROUNDED = 1e-14

NUMBERS = "amplitude", "frequency", "cycles", "duration", "highest", "stiffness", "damping", "inverse"
DRIVE = np.dtype(
    [(name, np.int64) for name in ("number", "target", "first", "last", "piece")] + [(name, float) for name in NUMBERS]
)
"""A drive: its ``number`` in the model; ``target``, the component of the state that it acts on, and ``inverse``, 1/mass
there in 1/kg; its ``duration`` in s and its ``highest`` frequency in rad/s.

A tone burst has its ``amplitude`` in N, the factor before 1 - cos, its ``frequency`` in rad/s and its ``cycles``. Other
waveforms have the pieces ``first`` to ``last``, half open, of which ``piece`` is on, -1 if none is. ``stiffness`` in
N/m is that of the spring to a moving wall, 0 where the drive is a force, and ``damping`` in N s/m that of the dashpot
to one: its force is the derivative of the waveform.
"""

_burst = kernel(burst)
_burst_rate = kernel(burst_rate)
_piece_value = kernel(piece_value)
_piece_rate = kernel(piece_rate)


class Drives(NamedTuple):
    """Drives (drive,) of dtype ``DRIVE`` and the ``pieces`` of all of their waveforms, of dtype ``PIECE``, in N."""

    rows: np.ndarray
    pieces: np.ndarray


def create_drives(drives: Sequence[Drive], numbers: Sequence[int]) -> Drives:
    """Return the record of the ``drives`` with the ``numbers``, where -1 stands for no drive; all are off."""
    tables = [np.zeros(0, PIECE)]
    rows = np.zeros(len(numbers), DRIVE)
    for row, number in zip(rows, numbers, strict=True):
        row["number"] = number
        row["piece"] = -1
        row["first"] = sum(map(len, tables))
        row["last"] = 0
        if number < 0:
            continue

        drive = drives[number]
        wave = drive.waveform
        # A moving wall at the end of a spring acts as a force: its displacement times the spring's stiffness; at the
        # end of a dashpot its velocity times the constant, for which the kernel differentiates.
        factor = drive.scale
        row["duration"] = wave.duration
        row["highest"] = wave.highest
        row["stiffness"] = drive.stiffness
        row["damping"] = drive.damping
        if isinstance(wave, Pieces):
            tables.append(Pieces.of(factor, 1.0, np.inf, wave.table).table)
            row["last"] = row["first"] + len(wave.table)
        else:
            row["amplitude"] = wave.window_amplitude * factor
            row["frequency"] = wave.frequency
            row["cycles"] = wave.cycles
    return Drives(rows, np.concatenate(tables))


@kernel
def drive_force(drives: Drives, i: int, t: float) -> float:
    """Return the force in N of drive ``i`` at t in s: a burst's by the paper's Eq. (3), else that of its piece."""
    drive = drives.rows[i]
    if drive.damping != 0.0:
        return _waveform_rate(drives, i, t)
    if drive.first >= drive.last:
        if t <= 0.0 or t >= drive.duration:
            return 0.0
        return _burst(drive.amplitude, drive.frequency, drive.cycles, t)
    if drive.piece < 0:
        return 0.0
    return _piece_value(drives.pieces[drive.piece], t)


@kernel
def _waveform_rate(drives: Drives, i: int, t: float) -> float:
    """Return the derivative of what ``drive_force`` returns for a drive without dashpot."""
    drive = drives.rows[i]
    if drive.first >= drive.last:
        if t <= 0.0 or t >= drive.duration:
            return 0.0
        return _burst_rate(drive.amplitude, drive.frequency, drive.cycles, t)
    if drive.piece < 0:
        return 0.0
    return _piece_rate(drives.pieces[drive.piece], t)


@kernel
def select_piece(drives: Drives, i: int, t: float) -> float:
    """Turn on the latest piece of drive ``i`` at time t in s; returns the time in s at which that changes.

    It is the beginning of the next piece or the drive's end, inf if the drive is over.
    """
    drive = drives.rows[i]
    if t >= drive.duration:
        drive.piece = -1
        return np.inf
    # A burst has no pieces to turn on: its formula holds up to its end.
    if drive.first >= drive.last:
        drive.piece = -1
        return drive.duration

    # The first piece that begins after t, by bisection: a measured drive has as many pieces as samples.
    low, high = drive.first, drive.last
    while low < high:
        middle = (low + high) // 2
        if drives.pieces[middle].start <= t:
            low = middle + 1
        else:
            high = middle
    # The piece before it is on, if there is one.
    drive.piece = -1
    if low > drive.first:
        drive.piece = low - 1
    if low < drive.last:
        return drives.pieces[low].start
    return drive.duration


def select_pieces(drives: Drives, t: float) -> None:
    """Turn on the latest piece of every one of ``drives`` at time t in s."""
    for i in range(len(drives.rows)):
        select_piece(drives, i, t)


@kernel
def drive_end(drives: Drives, i: int, begin: float, interval: float, position: float) -> float:
    """Return the position in the step of ``interval`` s from ``begin`` on up to which drive ``i`` is smooth.

    For a drive that is over at the ``position`` it is a number below that. The piece that begins at the ``position``,
    to rounding, is turned on. A burst's end stays its end.
    """
    drive = drives.rows[i]
    if drive.first >= drive.last:
        return (drive.duration - begin) / interval
    t = begin + position * interval
    # A step that ends on a break reaches it to rounding only; without the margin the old piece would stay on.
    end = select_piece(drives, i, t + ROUNDED * (interval + abs(t)))
    # Without an end and without a piece that is on the drive is over; a last piece that is held has no end either.
    if end == np.inf and drive.piece < 0:
        return -1.0
    return (end - begin) / interval


@kernel
def wall_energy(drives: Drives, i: int, t: float, u: float) -> float:
    """Return energy in J of a wall's spring at time t in s, its mass at u in m, beyond that of one to a wall at rest.

    The wall's work is that of the force k U on the mass and this energy. It is 0 where drive ``i`` is a force.
    """
    stiffness = drives.rows[i].stiffness
    if stiffness == 0.0:
        return 0.0
    select_piece(drives, i, t)
    force = drive_force(drives, i, t)
    return 0.5 * force * force / stiffness - force * u


@kernel
def drive_power(drives: Drives, i: int, force: float, v: float) -> float:
    """Return the power in W of drive ``i`` whose ``force`` is in N, its mass at v in m/s.

    Through a dashpot a wall that moves by U does c (U' - v) U', of which c U' is the force; see ``wall_energy``.
    """
    damping = drives.rows[i].damping
    if damping == 0.0:
        return force * v
    return force * (force / damping - v)


@kernel
def lost_power(drives: Drives, i: int, force: float, v: float) -> float:
    """Return the power in W that a moving wall's dashpot dissipates beyond that of one to a wall at rest.

    It is c (U' - v)^2 - c v^2, and 0 where drive ``i`` is no dashpot; arguments are those of ``drive_power``.
    """
    damping = drives.rows[i].damping
    if damping == 0.0:
        return 0.0
    return force * (force / damping - 2.0 * v)


@kernel
def drive_forces(drives: Drives, times: np.ndarray) -> np.ndarray:
    """Return forces (drive, t) in N of all drives at the ``times`` (t,) in s."""
    forces = np.zeros((drives.rows.size, times.size))
    for i in range(drives.rows.size):
        for k in range(times.size):
            select_piece(drives, i, times[k])
            forces[i, k] = drive_force(drives, i, times[k])
    return forces
