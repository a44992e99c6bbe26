"""The section ``[drive]``: waveforms and the places where they act, their checks, and the resulting drives."""

from collections.abc import Iterator
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np

from vipetsc.case.case_file import Valid
from vipetsc.case.reading import Table
from vipetsc.case.registered import check_parameters
from vipetsc.case.samples import SamplesTable
from vipetsc.case.schema import LatticeTable, TimeTable
from vipetsc.case.section import Problem, described
from vipetsc.case.waveforms import DEFAULT, OneDrive, waveform_of
from vipetsc.lattice import Chain, Drive, UnitCell, bloch, fastest_speed, max_group_velocity, wave_bands, waves_at

# A wave with less than this fraction of the cell's largest group velocity counts as standing: it would cross the
# lattice in a million times the usual time. A rounded wavenumber or frequency at a band's edge leaves up to 1e-8.
STANDING = 1e-6
WAVE_REMEDY = 'give one of: frequency; wavenumber and band; band and at = "max-group-velocity"'


class DriveTable(OneDrive):
    """A drive, and ``more`` drives.

    In a lattice that begins in motion its ``amplitude`` may be 0: then ``frequency`` and ``cell`` are by default those
    of the motion.
    """

    more: list[OneDrive] | None = described("further drives, `[[drive.more]]`, with the same keys", None)

    @property
    def every(self) -> list[tuple[str, OneDrive]]:
        """Pairs of the path of a drive's keys and the drive; the first drive comes first."""
        others = [(f"drive.more[{i}]", drive) for i, drive in enumerate(self.more or [], 1)]
        return [("drive", self), *others]

    @property
    def ratios(self) -> list[tuple[OneDrive, float]]:
        """Pairs of a drive and the ratio of its amplitude to that of the first drive, which must not be zero."""
        return [(drive, drive.amplitude / self.amplitude) for _, drive in self.every]


AnyDrive = TypeVar("AnyDrive", bound=OneDrive)


def check_drives(
    drives: DriveTable, lattice: LatticeTable, cell: UnitCell | None, length: int | None, valid: Valid
) -> Iterator[Problem]:
    """Yield problems with the keys of each drive: those of its waveform, its frequency, and the place where it acts.

    ``cell`` and ``length``, the number of cells, are None for an invalid lattice.
    """
    for path, drive in drives.every:
        yield from _check_place(drive, path, lattice, cell, length)
        if not valid("drive"):
            continue

        yield from _check_keys(drive, path)
        # A lattice that begins in motion may have a first drive of amplitude 0, which stands for none; a waveform that
        # is named asks for a drive.
        may_be_none = drive is drives and drive.kind == DEFAULT
        if drive.amplitude == 0 and not may_be_none:
            yield Problem(f"{path}.amplitude", 0.0, "must not be zero")
        yield from _check_frequency(drive, path, cell)
        if drive.samples is not None and drive.kind == "samples":
            yield from _check_samples(drive, drive.samples, path)


def _check_keys(drive: OneDrive, path: str) -> Iterator[Problem]:
    """Yield problems with keys of other waveforms, keys that are missing, and a ramp that is too long."""
    given = drive.model_dump(exclude_none=True, exclude_defaults=True)
    for key in sorted(drive.foreign & given.keys()):
        yield Problem(f"{path}.{key}", None, f"does not apply to the waveform {drive.kind!r}")
    for key in drive.record.needs:
        if key not in given:
            yield Problem(f"{path}.{key}", None, f"missing; needed for the waveform {drive.kind!r}")
    if drive.record.parameters:
        owner = f'the waveform "{drive.kind}"'
        yield from check_parameters(f"{path}.parameters", drive.parameters or {}, drive.record.parameters, owner)

    if drive.duration and drive.ramp and drive.ramp > drive.duration / 2 and "ramp" in drive.record.keys:
        yield Problem(f"{path}.ramp", drive.ramp, f"at most half the duration of {drive.duration:g} s")


def _check_frequency(drive: OneDrive, path: str, cell: UnitCell | None) -> Iterator[Problem]:
    """Yield problems with a wave that is given by several choices or by none, and with a band that the cell lacks."""
    choices = drive.wave_choices
    needs_band = drive.wavenumber is not None or drive.at is not None
    if len(choices) > 1 or (not choices and drive.amplitude != 0 and drive.is_sine):
        yield Problem(f"{path}.frequency", drive.frequency, WAVE_REMEDY)
    elif needs_band != (drive.band is not None):
        yield Problem(f"{path}.band", drive.band, WAVE_REMEDY)
    if cell and drive.band is not None and drive.band > cell.dofs:
        yield Problem(f"{path}.band", drive.band, f"the cell has {cell.dofs} bands")


def _check_samples(drive: OneDrive, samples: SamplesTable, path: str) -> Iterator[Problem]:
    """Yield problems with samples: their number, times that do not grow, a wall that is not at rest first."""
    times = np.array(samples.time)
    values = np.array(samples.value)
    if len(times) != len(values) or len(times) < 2:
        remedy = f"give two or more, and as many values ({len(values)})"
        yield Problem(f"{path}.samples.time", len(times), remedy)
    elif times[0] < 0 or not (np.diff(times) > 0).all():
        yield Problem(f"{path}.samples.time", None, "must increase from sample to sample and start at 0 s or later")
    elif not values.any():
        yield Problem(f"{path}.samples.value", None, "are all zero")
    elif samples.derivative and drive.end is None:
        remedy = "only a wall that moves is measured by it; give drive.end, or the force"
        yield Problem(f"{path}.samples.quantity", samples.quantity, remedy)
    elif drive.end and values[0] != 0 and not samples.derivative:
        yield Problem(f"{path}.samples.value", float(values[0]), "an end starts at rest: the first value must be 0")


def _check_place(
    drive: OneDrive, path: str, lattice: LatticeTable, cell: UnitCell | None, length: int | None
) -> Iterator[Problem]:
    """Yield problems with a driven mass outside the lattice, and with a wall that is missing or on no linear spring."""
    if drive.end is None:
        if length is not None and drive.cell > length:
            yield Problem(f"{path}.cell", drive.cell, f"outside the lattice; cells are numbered from 1 to {length}")
        if cell and drive.mass > cell.dofs:
            yield Problem(f"{path}.mass", drive.mass, f"the cell has {cell.dofs} masses")
        return

    if lattice.ends != "fixed":
        remedy = f'only a fixed end has a wall that can be moved, and lattice.ends = "{lattice.ends}" has none'
        yield Problem(f"{path}.end", drive.end, remedy)
    if lattice.cell and (lattice.cell.from_matrices or lattice.cell.moves_in_plane):
        remedy = "a wall moves all degrees of freedom of its cell alike, which rotations and motion along x and y do"
        remedy += " not; give drive.cell and mass"
        yield Problem(f"{path}.end", drive.end, remedy)
    if cell and not all(spring.is_linear for spring in cell.springs if spring.offset):
        yield Problem(f"{path}.end", drive.end, "a wall can only move a linear spring: remove quadratic and cubic")
    if cell and not cell.joins_cells:
        remedy = "a wall moves the springs from cell to cell that end at it, but the cell has none"
        yield Problem(f"{path}.end", drive.end, remedy)
    elif cell and length:
        place = _place_at_wall(cell, drive.end, length)
        for key in sorted(place.keys() & drive.model_fields_set):
            if getattr(drive, key) != place[key]:
                remedy = f"remove it: the wall acts on mass {place['mass']} of cell {place['cell']}"
                yield Problem(f"{path}.{key}", getattr(drive, key), remedy)


def _end_masses(cell: UnitCell, end: str) -> list[tuple[int, int]]:
    """Return pairs of a mass (0-based) of an ``end``'s cell that a spring ties to the wall, and that spring."""
    masses = []
    for number, spring in enumerate(cell.springs):
        if spring.offset:
            # On the left the wall takes the place of the cell before, in which such a spring starts.
            mass = {"left": spring.end, "right": spring.start}[end]
            masses.append((mass, number))
    return masses


def _place_at_wall(cell: UnitCell, end: str, cells: int) -> Table:
    """Return the keys ``cell`` and ``mass`` (from 1) of the first mass on which the wall at an ``end`` acts."""
    mass, _ = _end_masses(cell, end)[0]
    return {"cell": {"left": 1, "right": cells}[end], "mass": mass + 1}


def frequency_of(cell: UnitCell, drive: OneDrive) -> float:
    """Return the frequency in rad/s of a valid ``drive``: as given, otherwise that of its samples or its half sine.

    For half a sine that is shorter than the lattice can follow, it is the top band's edge, if the cell has bands.
    """
    if drive.wave_choices or drive.record.frequency is None:
        return driven_wave(cell, drive)[0]
    bands = wave_bands(cell)
    highest = np.inf  # contacts can follow any frequency
    if bands:
        highest = bands[-1].high
    return drive.record.frequency(drive, highest)


def driven_wave(cell: UnitCell, drive: OneDrive) -> tuple[float, float]:
    """Return the frequency in rad/s and |group velocity| in cells/s of the wave that a valid ``drive`` sends out."""
    return _wave(cell, drive.frequency, drive.wavenumber, drive.band)


@lru_cache
def _wave(cell: UnitCell, frequency: float | None, wavenumber: float | None, band: int | None) -> tuple[float, float]:
    """Return wave of ``driven_wave``, by its frequency in rad/s, its wavenumber in a band, or a band's fastest wave."""
    if wavenumber is not None and band is not None:
        point = bloch(cell, wavenumber)
        return float(point.frequency[band - 1]), float(abs(point.group_velocity[band - 1]))
    frequency = frequency or max_group_velocity(cell, band or 1)[1]
    return frequency, wave_speed(cell, frequency)


def packet_speed(cell: UnitCell, drive: OneDrive) -> float:
    """Return speed in cells/s of the wave of a resolved ``drive``; without a sine, the speed of the fastest wave."""
    return wave_speed(cell, packet_frequency(drive))


def packet_frequency(drive: OneDrive) -> float:
    """Return the frequency in rad/s of the wave of a resolved ``drive`` that arrives first; infinite without a sine."""
    # A pulse has waves of all frequencies, of which the fastest arrive first.
    if drive.is_sine and drive.frequency:
        return drive.frequency
    return np.inf


@lru_cache  # members of a sweep send the same waves
def wave_speed(cell: UnitCell, frequency: float) -> float:
    """Return the group velocity in cells/s of the fastest wave at ``frequency`` in rad/s.

    In a gap, or where all waves stand, it is that of the cell's fastest wave at any frequency.
    """
    # The fastest wave, since what arrives first decides how long a run lasts.
    speed = max((wave[2] for wave in waves_at(cell, frequency)), default=0.0)
    return speed or fastest_speed(cell)


def check_waves(cell: UnitCell, drive: DriveTable, time: TimeTable) -> Iterator[Problem]:
    """Yield problems with the waves of a valid ``drive``, and with what would follow from waves that do not exist."""
    if cell.joins_cells:
        yield from _check_wave(cell, drive, time)
    else:
        yield from _check_without_bands(drive, time)


def _check_wave(cell: UnitCell, drives: DriveTable, time: TimeTable) -> Iterator[Problem]:
    """Yield problems with valid drives that send no wave, or with a first wave that never crosses the lattice."""
    for path, drive in drives.every:
        if not drive.wave_choices:
            continue
        frequency, speed = driven_wave(cell, drive)
        # The problem names the key by which the user has chosen the wave.
        key = next((name for name in ("frequency", "wavenumber") if getattr(drive, name)), "band")
        value = getattr(drive, key)
        if not frequency > 0:
            remedy = "the frequency there is 0; choose another wavenumber or band"
            if drive.at is not None:
                remedy = "the waves of this band are fastest at the frequency 0; give a frequency or a wavenumber"
            yield Problem(f"{path}.{key}", value, remedy)
        elif drive is drives and time.end == "traverse" and not speed > STANDING * wave_speed(cell, np.inf):
            remedy = f"the wave at {frequency:.6g} rad/s has group velocity 0 and never crosses the lattice"
            yield Problem(f"{path}.{key}", value, f"{remedy}; give time.end in s, or another wavenumber")


def _check_without_bands(drive: DriveTable, time: TimeTable) -> Iterator[Problem]:
    """Yield problems with times of a lattice that contacts alone join, which has no bands to take them from."""
    none = "without springs from cell to cell there are no bands"
    remedy = f"missing; {none} from which it would follow"
    for path, one in drive.every:
        for key in ("wavenumber", "band"):
            if getattr(one, key) is not None:
                yield Problem(f"{path}.{key}", getattr(one, key), f"{none}; give {path}.frequency")
                return
    # The frequency of a pulse follows from its own keys, and that of a struck lattice from the mass that is struck.
    if drive.frequency is None and drive.is_sine and drive.amplitude != 0:
        yield Problem("drive.frequency", None, remedy)
    if time.end == "traverse":
        yield Problem("time.end", time.end, remedy)
    if time.sample_interval == "auto" and time.samples is None:
        yield Problem("time.sample_interval", time.sample_interval, remedy)


def resolve_drives(drives: DriveTable, cell: UnitCell, cells: int, frequency: float | None = None) -> DriveTable:
    """Return the valid section ``drives`` of a lattice of ``cells`` cells in which every choice is resolved.

    ``frequency`` in rad/s is that of the first drive where the motion at t = 0 gives it.
    """
    resolved = resolve_drive(drives, cell, cells, frequency)
    if not drives.more:
        return resolved.model_copy(update={"more": None})
    # Only the first drive may take its frequency from the motion at t = 0.
    others = [resolve_drive(drive, cell, cells) for drive in drives.more]
    return resolved.model_copy(update={"more": others})


def resolve_drive(drive: AnyDrive, cell: UnitCell, cells: int, frequency: float | None = None) -> AnyDrive:
    """Return valid ``drive`` with its frequency instead of keys that choose it, with a ramp and the place of a wall."""
    frequency = float(frequency or frequency_of(cell, drive))
    update: dict[str, Any] = {"frequency": frequency, "wavenumber": None, "band": None, "at": None}
    if drive.kind == DEFAULT:
        # A case that names the default waveform is the same as one that leaves it out.
        update["waveform"] = None
    if drive.record.ramp and drive.ramp is None:
        update["ramp"] = drive.record.ramp(drive, frequency)
    if drive.end:
        update |= _place_at_wall(cell, drive.end, cells)
    return drive.model_copy(update=update)


def build_drives(drives: DriveTable, chain: Chain) -> tuple[Drive, ...]:
    """Return the drives of a resolved section."""
    return tuple(built for _, drive in drives.every for built in build_drive(drive, chain))


def first_built(drives: DriveTable, chain: Chain) -> list[int]:
    """Return the number (from 0) in ``build_drives`` of the first drive that is built of each of the ``drives``."""
    numbers = []
    count = 0
    for _, drive in drives.every:
        numbers.append(count)
        # A wall may act through several springs.
        count += len(build_drive(drive, chain))
    return numbers


def build_drive(drive: OneDrive, chain: Chain) -> list[Drive]:
    """Return the drives of a resolved ``drive``: one, or one for each mass that a spring ties to a wall that moves."""
    waveform = waveform_of(drive)
    if drive.end is None:
        return [Drive(waveform, drive.cell - 1, drive.mass - 1)]

    # The springs to the left wall belong to the cell before the first one, which does not vary; those to the right wall
    # are the last cell's, which profiles and scatter may change.
    cell, of_springs = {"left": (0, -1), "right": (chain.cells - 1, chain.cells - 1)}[drive.end]
    built: list[Drive] = []
    for mass, number in _end_masses(chain.cell, drive.end):
        spring = chain.spring(of_springs, number)
        built.append(Drive(waveform, cell, mass, stiffness=spring.stiffness))
        if spring.damping:
            built.append(Drive(waveform, cell, mass, damping=spring.damping))
    return built
