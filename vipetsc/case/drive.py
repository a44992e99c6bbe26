"""The section ``[drive]``: waveforms and where they act; from its choices to drives."""

from collections.abc import Iterator
from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from vipetsc.case.case_file import Problem, Section, Table, Valid
from vipetsc.case.samples import SamplesTable
from vipetsc.case.schema import Finite, LatticeTable, Positive, TimeTable, Wavenumber
from vipetsc.lattice import Chain, Drive, ToneBurst, UnitCell, Waveform, bloch, max_group_velocity, pass_bands, waves_at
from vipetsc.lattice.drive import impulse, main_frequency, ramped, spline

CYCLES = 30  # of a burst that is not told
STANDING = 1e-6  # of the cell's fastest group velocity, below which a wave stands
PERIODS, SHARE = 10, 0.1  # of a ramp that is not told: of a harmonic drive, of a chirp's duration
KEYS: dict[str, tuple[str, ...]]  # of each waveform, and the first few of them that it needs
KEYS = {"burst": ("cycles", "envelope"), "harmonic": ("ramp", "duration"), "chirp": ("bandwidth", "duration", "ramp"),
        "impulse": ("duration",), "step": ("ramp", "duration"), "samples": ("samples",)}  # fmt: skip
NEEDED = {"chirp": 2, "impulse": 1, "step": 1, "samples": 1}
SINES = "burst", "harmonic", "chirp"  # waveforms that want a frequency
WAYS = 'give one of: frequency; wavenumber and band; band and at = "max-group-velocity"'


class OneDrive(Section):
    """A waveform of a force on one mass, or of the motion of an end's wall.

    ``frequency`` in rad/s, or ``wavenumber`` + ``band``, or ``band`` + ``at``.
    """

    waveform: Literal["burst", "harmonic", "chirp", "impulse", "step", "samples"] | None = None
    amplitude: Finite = 1.0
    cycles: int = Field(CYCLES, ge=1)
    envelope: Literal["paper", "hann"] = "paper"
    ramp: Positive | None = None
    duration: Positive | None = None
    bandwidth: Finite | None = None
    samples: SamplesTable | None = None
    frequency: Positive | None = None
    wavenumber: Wavenumber | None = None
    band: Annotated[int, Field(ge=1)] | None = None
    at: Literal["max-group-velocity"] | None = None
    cell: int = Field(1, ge=1)
    mass: int = Field(1, ge=1)
    end: Literal["left", "right"] | None = None

    @property
    def kind(self) -> str:
        """The waveform's name."""
        return self.waveform or "burst"

    def describe(self) -> str:
        """A resolved drive in words."""
        unit = "m" if self.end else "N s" if self.kind == "impulse" else "N"
        om, length = f"Om = {self.frequency or 0:.4f} rad/s", self.duration or np.inf
        about = {
            "burst": f"{self.cycles} cycles, {om}",
            "harmonic": f"{om}, ramp {self.ramp or 0:g} s",
            "chirp": f"{om} +- {(self.bandwidth or 0) / 2:g} rad/s in {length:g} s",
            "impulse": f"half a sine of {length:g} s",
            "step": f"ramp {self.ramp or 0:g} s",
            "samples": f"{len(self.samples.time) if self.samples else 0} samples, joined by a cubic spline",
        }[self.kind]
        if self.end:
            return f"{self.amplitude:g} {unit}, {about}; {self.kind} of the {self.end} wall"
        plain = self.waveform is None and self.cell == self.mass == 1
        where = "" if plain else f"; {self.kind} on mass {self.mass} of cell {self.cell}"
        return f"{self.amplitude:g} {unit}, {about}{where}"

    @property
    def foreign(self) -> set[str]:
        """The keys that belong to other waveforms alone."""
        return {name for names in KEYS.values() for name in names} - {*KEYS[self.kind]}

    @property
    def ways(self) -> list[Any]:
        """The frequency as it is given, in how many ways it is."""
        return [way for way in (self.frequency, self.wavenumber, self.at) if way is not None]


class DriveTable(OneDrive):
    """A drive, and ``more`` of them. With an initial state ``amplitude`` may be 0.

    Then ``frequency`` and ``cell`` are by default those of its motion.
    """

    more: list[OneDrive] | None = None

    @property
    def every(self) -> list[tuple[str, OneDrive]]:
        """All drives by the path of their keys, this one first."""
        return [("drive", self), *((f"drive.more[{i}]", drive) for i, drive in enumerate(self.more or [], 1))]


def drive_tables(table: Table) -> list[Table]:
    """The tables of all drives of a resolved section."""
    return [table, *table.get("more", [])]


def check_drives(
    drives: DriveTable, lattice: LatticeTable, cell: UnitCell | None, length: int | None, valid: Valid
) -> Iterator[Problem]:
    """What is wrong with the keys of each drive: those of its waveform, its frequency, where it acts."""
    for key, drive in drives.every:
        yield from _check_place(drive, key, lattice, cell, length)
        if not valid("drive"):
            continue
        given, kind = drive.model_dump(exclude_none=True, exclude_defaults=True), drive.kind
        for name in sorted(drive.foreign & given.keys()):
            yield Problem(f"{key}.{name}", None, f"belongs to another waveform than {kind!r}")
        for name in KEYS[kind][: NEEDED.get(kind, 0)]:
            if name not in given:
                yield Problem(f"{key}.{name}", None, f"missing; the waveform {kind!r} needs it")
        if drive.duration and (drive.ramp or 0) > drive.duration / 2 and "ramp" in KEYS[kind]:
            yield Problem(f"{key}.ramp", drive.ramp, f"at most half the duration of {drive.duration:g} s")
        if drive.amplitude == 0 and (drive is not drives or kind != "burst"):
            yield Problem(f"{key}.amplitude", 0.0, "must not be zero")
        yield from _check_frequency(drive, key, cell)
        if drive.samples is not None and kind == "samples":
            yield from _check_samples(drive, drive.samples, key)


def _check_frequency(drive: OneDrive, key: str, cell: UnitCell | None) -> Iterator[Problem]:
    by_band = drive.wavenumber is not None or drive.at is not None
    if len(drive.ways) > 1 or (not drive.ways and drive.amplitude != 0 and drive.kind in SINES):
        yield Problem(f"{key}.frequency", drive.frequency, WAYS)
    elif by_band != (drive.band is not None):
        yield Problem(f"{key}.band", drive.band, WAYS)
    if cell and drive.band is not None and drive.band > cell.dofs:
        yield Problem(f"{key}.band", drive.band, f"the cell has {cell.dofs} bands")


def _check_samples(drive: OneDrive, samples: SamplesTable, key: str) -> Iterator[Problem]:
    times, values = np.array(samples.time), np.array(samples.value)
    if len(times) != len(values) or len(times) < 2:
        yield Problem(f"{key}.samples.time", len(times), f"two or more are needed, and as many values ({len(values)})")
    elif times[0] < 0 or not (np.diff(times) > 0).all():
        yield Problem(f"{key}.samples.time", None, "must grow from sample to sample, from 0 s or later on")
    elif not values.any():
        yield Problem(f"{key}.samples.value", None, "are all zero")
    elif drive.end and values[0] != 0:
        yield Problem(f"{key}.samples.value", float(values[0]), "an end begins at rest: the first value must be 0")


def _check_place(
    drive: OneDrive, key: str, lattice: LatticeTable, cell: UnitCell | None, length: int | None
) -> Iterator[Problem]:
    if drive.end is None:
        if length is not None and drive.cell > length:
            yield Problem(f"{key}.cell", drive.cell, f"outside the lattice; cells count from 1 to {length}")
        if cell and drive.mass > cell.dofs:
            yield Problem(f"{key}.mass", drive.mass, f"the cell has {cell.dofs} masses")
        return
    if lattice.ends != "fixed":
        yield Problem(
            f"{key}.end", drive.end, f'only a wall can be moved, and lattice.ends = "{lattice.ends}" has none'
        )
    if cell and any(s.damping or s.quadratic or s.cubic for s in cell.springs if s.next_cell):
        yield Problem(f"{key}.end", drive.end, "a wall moves a linear spring alone: no damping, quadratic, cubic")
    if cell and not cell.springs:
        yield Problem(f"{key}.end", drive.end, "a wall moves the springs to it, and the cell has none")
    elif cell and length:
        place = _beside_wall(cell, drive.end, length)
        for name in sorted(place.keys() & drive.model_fields_set):
            if getattr(drive, name) != place[name]:
                remedy = f"leave it out: the wall acts on mass {place['mass']} of cell {place['cell']}"
                yield Problem(f"{key}.{name}", getattr(drive, name), remedy)


def _end_masses(cell: UnitCell, end: str) -> list[tuple[int, int]]:
    """Masses of the end's cell that springs tie to the wall, and these springs' numbers."""
    return [(s.end if end == "left" else s.start, i) for i, s in enumerate(cell.springs) if s.next_cell]


def _beside_wall(cell: UnitCell, end: str, cells: int) -> Table:
    """The cell and the mass (from 1) of ``cells`` cells that the wall at an ``end`` acts on first."""
    return {"cell": 1 if end == "left" else cells, "mass": _end_masses(cell, end)[0][0] + 1}


def frequency_of(cell: UnitCell, drive: OneDrive) -> float:
    """The frequency in rad/s that a valid ``drive`` is about: as given, else that of its samples or its half-sine.

    Of half a sine that is shorter than the lattice can follow, it is the top band's edge, if springs make bands.
    """
    if drive.ways or drive.kind in SINES:
        return driven_wave(cell, drive)[0]
    if drive.kind == "samples" and drive.samples is not None:
        return main_frequency(drive.samples.time, drive.samples.value)
    half = (drive.duration if drive.kind == "impulse" else drive.ramp) or 1.0
    return float(min(np.pi / half, pass_bands(cell)[-1].high or np.inf))


def driven_wave(cell: UnitCell, drive: OneDrive) -> tuple[float, float]:
    """Frequency in rad/s and |group velocity| in cells/s of the wave that a valid ``drive`` makes."""
    return _wave(cell, drive.frequency, drive.wavenumber, drive.band)


def packet_speed(cell: UnitCell, drive: OneDrive) -> float:
    """Speed in cells/s of what a resolved ``drive`` sends out: of its wave, without a sine that of the fastest one."""
    return wave_speed(cell, drive.frequency or np.inf if drive.kind in SINES else np.inf)


@lru_cache
def _wave(cell: UnitCell, frequency: float | None, wavenumber: float | None, band: int | None) -> tuple[float, float]:
    if wavenumber is not None and band is not None:
        point = bloch(cell, wavenumber)
        return float(point.frequency[band - 1]), float(abs(point.group_velocity[band - 1]))
    frequency = frequency or max_group_velocity(cell, band or 1)[1]
    return frequency, wave_speed(cell, frequency)


def check_wave(cell: UnitCell, drive: OneDrive, time: TimeTable) -> Iterator[Problem]:
    """What is wrong with a valid drive that is to make a wave, and with a wave that is to cross the lattice."""
    frequency, speed = driven_wave(cell, drive)
    key = "frequency" if drive.frequency else "wavenumber" if drive.wavenumber else "band"
    if not frequency > 0:
        yield Problem(f"drive.{key}", getattr(drive, key), "the frequency there is 0; drive another wavenumber or band")
    elif time.end == "traverse" and not speed > STANDING * wave_speed(cell, np.inf):
        remedy = f"the wave at {frequency:.6g} rad/s stands (group velocity 0) and never crosses the lattice"
        yield Problem(f"drive.{key}", getattr(drive, key), f"{remedy}; give time.end in s, or another wavenumber")


def wave_speed(cell: UnitCell, frequency: float) -> float:
    """Group velocity in cells/s of the fastest wave at ``frequency``; in a gap, the cell's fastest."""
    speed = max((wave[2] for wave in waves_at(cell, frequency)), default=0.0)
    return speed or max(max_group_velocity(cell, band + 1)[2] for band in range(cell.dofs))


def resolved_drive(drive: OneDrive, cell: UnitCell, cells: int, frequency: float | None = None) -> Table:
    """The table of a valid drive in which every choice is made; ``frequency`` in rad/s is that of a motion."""
    table = drive.model_dump(by_alias=True, exclude_none=True)
    table = {k: v for k, v in table.items() if k not in drive.foreign | {"wavenumber", "band", "at", "more"}}
    if drive.kind == "burst":
        table.pop("waveform", None)  # as if left out: the same case
    table["frequency"] = frequency = frequency or frequency_of(cell, drive)
    longest = (drive.duration or np.inf) / 2
    if drive.kind in ("harmonic", "chirp") and drive.ramp is None:
        of_chirp = SHARE * (drive.duration or 0.0)
        table["ramp"] = float(of_chirp if drive.kind == "chirp" else min(2 * np.pi * PERIODS / frequency, longest))
    if drive.end:
        table |= _beside_wall(cell, drive.end, cells)
    return table


def waveform_of(drive: OneDrive) -> Waveform:
    """The waveform of a resolved drive."""
    assert drive.frequency
    ramp, duration, sine = drive.ramp or 0.0, drive.duration or np.inf, (drive.amplitude, drive.frequency)
    if drive.kind == "samples" and drive.samples:
        hold = drive.end is not None
        return spline(drive.amplitude, drive.samples.time, drive.samples.value, drive.frequency, hold)
    if drive.kind == "impulse":
        return impulse(drive.amplitude, duration)
    if drive.kind == "burst":
        return ToneBurst(*sine, drive.cycles, drive.envelope)
    sweep = {"harmonic": 0.0, "chirp": drive.bandwidth, "step": None}[drive.kind]
    return ramped(*sine, ramp, duration, sweep)


def build_drives(drives: DriveTable, chain: Chain) -> tuple[Drive, ...]:
    """The drives of a resolved section; the motion of a wall acts on each mass that a spring ties to it."""
    built: list[Drive] = []
    for _, drive in drives.every:
        wave = waveform_of(drive)
        if drive.end is None:
            built.append(Drive(wave, drive.cell - 1, drive.mass - 1))
            continue
        springs, last = chain.cell.springs, chain.cells - 1
        for mass, number in _end_masses(chain.cell, drive.end):
            left = drive.end == "left"  # whose wall spring is that of the cell before the first one, as told
            stiffness = springs[number].stiffness if left else chain.coefficients(last, last + 1).stiffness[0, number]
            built.append(Drive(wave, 0 if left else last, mass, float(stiffness)))
    return tuple(built)
