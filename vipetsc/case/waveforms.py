"""The waveforms of a drive, each with a record: its keys, its frequency, its description, and how it is built.

A new waveform is one more record in ``WAVEFORMS``, and a field of ``OneDrive`` for each key that no other waveform has:
the choices of ``drive.waveform``, the checks of its keys and the schema follow from these. The record of a waveform of
a user's module is built from what the module registers.
"""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, NamedTuple, cast, get_args

import numpy as np
from pydantic import Field

from vipetsc.case.parts import PartName
from vipetsc.case.places import BeamTable, Place, Places
from vipetsc.case.samples import WALL_UNITS, SamplesTable
from vipetsc.case.schema import Finite, Positive, Wavenumber
from vipetsc.case.section import Section, described
from vipetsc.lattice import ToneBurst, Waveform
from vipetsc.lattice.drive import along, impulse, main_frequency, ramped
from vipetsc.plugins import call, number_of
from vipetsc.register import PARTS, WAVEFORM, Parameter, PartError, WaveformPart, reserve
from vipetsc.wording import counted

# Defaults of the keys of ``[drive]``.
CYCLES = 30  # of a burst, as in the paper
RAMP_PERIODS = 10  # of a harmonic drive's ramp: its transient lies mostly within a tenth of its frequency
RAMP_FRACTION = 0.1  # of a chirp's duration, at either end: eight tenths of its band have the full amplitude


class WaveformRecord(NamedTuple):
    """A waveform of a drive: what builds and describes it, and its keys.

    ``build(drive)`` gives the waveform of a resolved drive, ``describe(drive)`` its description. ``needs`` are the keys
    that must be given, ``takes`` those that may; keys of other waveforms are refused. ``frequency(drive, highest)``
    gives the main frequency in rad/s, at most the ``highest`` that the lattice can follow; it is None for a waveform
    whose frequency the case gives. ``ramp(drive, frequency)`` is the default ramp in s; ``unit`` is that of the
    amplitude. ``parameters`` are numbers of ``[drive.parameters]`` that a waveform of a user's module takes.
    """

    build: Callable[["OneDrive"], Waveform]
    describe: Callable[["OneDrive"], str]
    needs: tuple[str, ...] = ()
    takes: tuple[str, ...] = ()
    frequency: Callable[["OneDrive", float], float] | None = None
    ramp: Callable[["OneDrive", float], float] | None = None
    unit: str = "N"
    parameters: Mapping[str, Parameter] = {}

    @property
    def keys(self) -> tuple[str, ...]:
        """The keys of the waveform."""
        keys = (*self.needs, *self.takes)
        if self.parameters:
            keys += ("parameters",)
        return keys


def _build_burst(drive: "OneDrive") -> Waveform:
    return ToneBurst(
        amplitude=drive.amplitude, frequency=_given(drive.frequency), cycles=drive.cycles, envelope=drive.envelope
    )


def _build_harmonic(drive: "OneDrive") -> Waveform:
    return ramped(
        drive.amplitude,
        frequency=_given(drive.frequency),
        ramp=_given(drive.ramp),
        duration=drive.duration or np.inf,
        phase=drive.phase or 0.0,
    )


def _build_chirp(drive: "OneDrive") -> Waveform:
    return ramped(
        drive.amplitude,
        frequency=_given(drive.frequency),
        ramp=_given(drive.ramp),
        duration=_given(drive.duration),
        sweep=drive.bandwidth,
    )


def _build_impulse(drive: "OneDrive") -> Waveform:
    return impulse(drive.amplitude, _given(drive.duration))


def _build_step(drive: "OneDrive") -> Waveform:
    return ramped(
        drive.amplitude,
        frequency=_given(drive.frequency),
        ramp=_given(drive.ramp),
        duration=drive.duration or np.inf,
        sweep=None,
    )


def _build_samples(drive: "OneDrive") -> Waveform:
    assert drive.samples
    # After the last sample a wall stays where it is, and a force is 0.
    hold = drive.end is not None
    return along(drive.amplitude, drive.samples.motion(), frequency=_given(drive.frequency), hold=hold)


def _given(value: float | None) -> float:
    """Return the value of a key that a resolved drive has."""
    assert value is not None
    return value


def _samples_frequency(drive: "OneDrive", highest: float) -> float:
    assert drive.samples
    return main_frequency(drive.samples.time, drive.samples.value, drive.samples.interpolation)


def _impulse_frequency(drive: "OneDrive", highest: float) -> float:
    # Half a sine lasts half a period: pi over its duration.
    return float(min(np.pi / (drive.duration or 1.0), highest))


def _step_frequency(drive: "OneDrive", highest: float) -> float:
    # The ramp counts as half a sine of its length.
    return float(min(np.pi / (drive.ramp or 1.0), highest))


def _harmonic_ramp(drive: "OneDrive", frequency: float) -> float:
    # A rise and a fall must fit into the duration.
    longest = (drive.duration or np.inf) / 2
    return float(min(2 * np.pi * RAMP_PERIODS / frequency, longest))


def _chirp_ramp(drive: "OneDrive", frequency: float) -> float:
    return float(RAMP_FRACTION * (drive.duration or 0.0))


def _omega(drive: "OneDrive") -> str:
    return f"Om = {drive.frequency or 0:.4f} rad/s"


def _describe_chirp(drive: "OneDrive") -> str:
    return f"{_omega(drive)} +- {(drive.bandwidth or 0) / 2:g} rad/s in {drive.duration or np.inf:g} s"


def _describe_samples(drive: "OneDrive") -> str:
    assert drive.samples
    samples = drive.samples
    # A spline may lie far beyond the samples: the largest value shows it.
    largest = waveform_of(drive).peak
    unit = "m" if drive.end else "N"
    text = f"{len(samples.time)} samples ({samples.interpolation}), at most {largest:.6g} {unit}"
    if samples.derivative:
        text += f" by the {samples.quantity}"
        removed = samples.describe_removed(drive.amplitude)
        if removed:
            text += f", {removed}"
    return text


WAVEFORMS = {
    "burst": WaveformRecord(
        build=_build_burst,
        describe=lambda drive: f"{counted(drive.cycles, 'cycle')}, {_omega(drive)}",
        takes=("cycles", "envelope"),
    ),
    "harmonic": WaveformRecord(
        build=_build_harmonic,
        describe=lambda drive: f"{_omega(drive)}, ramp {drive.ramp or 0:g} s",
        takes=("ramp", "duration", "phase"),
        ramp=_harmonic_ramp,
    ),
    "chirp": WaveformRecord(
        build=_build_chirp, describe=_describe_chirp, needs=("bandwidth", "duration"), takes=("ramp",), ramp=_chirp_ramp
    ),
    "impulse": WaveformRecord(
        build=_build_impulse,
        describe=lambda drive: f"half a sine of {drive.duration or np.inf:g} s",
        needs=("duration",),
        frequency=_impulse_frequency,
        unit="N s",
    ),
    "step": WaveformRecord(
        build=_build_step,
        describe=lambda drive: f"ramp {drive.ramp or 0:g} s",
        needs=("ramp",),
        takes=("duration",),
        frequency=_step_frequency,
    ),
    "samples": WaveformRecord(
        build=_build_samples, describe=_describe_samples, needs=("samples",), frequency=_samples_frequency
    ),
}
"""The record of every waveform, by the name that ``drive.waveform`` gives it."""

DEFAULT = "burst"
reserve(WAVEFORM, WAVEFORMS)


def waveform_record(name: str) -> WaveformRecord:
    """Return the record of a waveform, shipped or of a user's module; raises KeyError if there is none."""
    # The package's own names first, which no module can register.
    if name in WAVEFORMS:
        return WAVEFORMS[name]
    part = cast(WaveformPart, PARTS[WAVEFORM][name])

    def numbers(drive: "OneDrive") -> list[float]:
        given = drive.parameters or {}
        return [given[key] for key in part.parameters]

    def build(drive: "OneDrive") -> Waveform:
        # A user's function may return anything. It is checked here, where the message can name the file.
        built = call(part, part.function, drive, *numbers(drive))
        if not isinstance(built, get_args(Waveform)):
            returned = f"the waveform {part.name!r} of {part.file} returns {built!r}"
            raise PartError(f"{returned}; a waveform of vipetsc.lattice.drive is needed")
        if not np.isfinite(built.peak):
            raise PartError(f"the waveform {part.name!r} of {part.file} has a force that is not a finite number")
        return cast(Waveform, built)

    def describe(drive: "OneDrive") -> str:
        given = [f"{key} {value:g}" for key, value in (drive.parameters or {}).items()]
        return ", ".join([_omega(drive), *given])

    def frequency(drive: "OneDrive", highest: float) -> float:
        assert part.frequency
        value = number_of(part, call(part, part.frequency, drive, *numbers(drive)), "frequency")
        if not 0 < value < np.inf:
            given = f"the frequency of the waveform {part.name!r} of {part.file} is {value!r}"
            raise PartError(f"{given}; a positive number in rad/s is needed")
        return min(value, highest)

    return WaveformRecord(
        build=build,
        describe=describe,
        needs=part.needs,
        takes=part.takes,
        frequency=frequency if part.frequency else None,
        unit=part.unit,
        parameters=part.parameters,
    )


def is_sine(name: Any) -> bool:
    """Return whether ``name`` is that of a waveform whose frequency the case gives."""
    # The name may be a value of any type, from a table that is not checked yet.
    is_waveform = isinstance(name, str) and (name in WAVEFORMS or name in PARTS[WAVEFORM])
    return is_waveform and waveform_record(name).frequency is None


class OneDrive(Section):
    """A waveform of a force on one mass, or of the motion of an end's wall."""

    waveform: Annotated[str, PartName(WAVEFORM, tuple(WAVEFORMS))] | None = described(
        "waveform (default: tone burst); the chapter on drives lists the keys of each", None
    )
    amplitude: Finite = described(
        "amplitude of the force; of an impulse, its time integral; of a moving end, its displacement, or factor of"
        " the samples of its velocity or acceleration",
        1.0,
        unit="N, N s or m",
    )
    cycles: int = described("number of cycles of the burst", CYCLES, ge=1)
    envelope: Literal["paper", "hann"] = described("the paper's Hann window, or one of half its amplitude", "paper")
    ramp: Positive | None = described(
        "rise time of a harmonic drive, a chirp or a step, and fall time before its end; default: 10"
        " periods, or 0.1 of a chirp",
        None,
        unit="s",
    )
    duration: Positive | None = described(
        "length of a chirp or an impulse; end of a harmonic drive or a step, which by default do not end",
        None,
        unit="s",
    )
    bandwidth: Finite | None = described(
        "width of the linear frequency sweep of a chirp, centred at `frequency`; a negative value sweeps downwards",
        None,
        unit="rad/s",
    )
    samples: SamplesTable | None = described(
        "samples of the waveform, joined as `samples.interpolation` says; 0 before the first and after the"
        " last, where a wall that moves stays in its place",
        None,
    )
    parameters: dict[str, Finite] | None = described(
        "parameters of a waveform that a module of [plugins] registers", None, unit="that of the parameter"
    )
    phase: Finite | None = described("phase of the sine of a harmonic drive", None, unit="rad")
    frequency: Positive | None = described(
        "angular frequency, of a chirp its centre; alternatively `wavenumber` or `at`, with `band`", None, unit="rad/s"
    )
    wavenumber: Wavenumber | None = described(
        'wavenumber of the wave in `band`; multiples of pi as "5pi/9"', None, unit="rad/cell"
    )
    band: Annotated[int, Field(ge=1)] | None = described("pass band of the wave; the lowest is 1", None)
    at: Literal["max-group-velocity"] | None = described("position of the wave in `band`", None)
    cell: int = described("the driven cell", 1, ge=1)
    mass: int = described("the driven mass in that cell", 1, ge=1)
    place: Place | None = described("a strip: cell [i, j] or [i, j, mass], instead of cell and mass", None)
    places: Places | None = described("a strip: cells that are driven, a drive each", None)
    beam: BeamTable | None = described("phases and amplitudes of the drives at `places`", None)
    end: Literal["left", "right"] | None = described(
        "the end whose wall moves with the waveform, instead of a force on a mass", None
    )

    @classmethod
    def unit_of(cls, key: str, table: Mapping[str, Any]) -> str:
        """Return the unit of a ``key``; that of the amplitude depends on the waveform, and is m for a wall."""
        if key != "amplitude":
            return super().unit_of(key, table)
        if "end" in table:
            samples = table.get("samples")
            quantity = None
            # The table may have sections that are read already, and others.
            if isinstance(samples, SamplesTable):
                quantity = samples.quantity
            elif isinstance(samples, dict):
                quantity = samples.get("quantity")
            return WALL_UNITS.get(str(quantity), "m")
        name = table.get("waveform") or DEFAULT
        # A module that registers the waveform may not be imported.
        if isinstance(name, str) and (name in WAVEFORMS or name in PARTS[WAVEFORM]):
            return waveform_record(name).unit
        return "N"

    @property
    def kind(self) -> str:
        """The waveform's name."""
        return self.waveform or DEFAULT

    @property
    def record(self) -> WaveformRecord:
        """The waveform's record."""
        return waveform_record(self.kind)

    @property
    def is_sine(self) -> bool:
        """Whether the case gives the frequency."""
        return is_sine(self.kind)

    @property
    def foreign(self) -> set[str]:
        """The keys that belong to other waveforms alone."""
        every = {"parameters"} | {key for record in WAVEFORMS.values() for key in record.keys}
        return every - {*self.record.keys}

    @property
    def wave_choices(self) -> list[Any]:
        """The values given for frequency, wavenumber and ``at``, each of which chooses the wave; one is allowed."""
        return [given for given in (self.frequency, self.wavenumber, self.at) if given is not None]

    def describe(self) -> str:
        """Return a description of the resolved drive: amplitude, waveform and place."""
        about = self.record.describe(self)
        if self.end:
            unit = "m"
            if self.samples:
                unit = self.samples.unit
            return f"{self.amplitude:g} {unit}, {about}; {self.kind} of the {self.end} wall"

        size = f"{self.amplitude:g} {self.record.unit}, {about}"
        # The name and the place of the default drive are left out.
        if self.waveform is None and self.cell == self.mass == 1:
            return size
        return f"{size}; {self.kind} on mass {self.mass} of cell {self.cell}"


def waveform_of(drive: OneDrive) -> Waveform:
    """Return the waveform of a resolved drive."""
    return drive.record.build(drive)
