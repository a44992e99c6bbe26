"""The amplitude of a case: that of its drive or, where nothing is driven, that of the motion at t = 0."""

from typing import Any

from vipetsc.case.case import Case
from vipetsc.case.drive import DriveTable

Changes = dict[str, dict[str, Any]]


def amplitude_of(case: Case) -> float:
    """Return the amplitude of the first drive of a resolved ``case``, or of its motion at t = 0 if nothing is driven.

    The amplitude of a mode, of a packet or of a state from a file is its largest displacement in m; that of masses that
    are struck is the speed in m/s of the one that is listed first.
    """
    initial = case.initial
    if case.drive.amplitude or initial is None:
        return case.drive.amplitude
    if initial.kind == "velocity":
        assert initial.velocity is not None
        return abs(initial.velocity)
    assert initial.amplitude is not None
    return initial.amplitude


def amplitude_unit(case: Case) -> str:
    """Return the unit of ``amplitude_of``."""
    initial = case.initial
    if case.drive.amplitude or initial is None:
        return drive_unit(case.drive)
    if initial.kind == "velocity":
        return "m/s"
    return "m"


def drive_unit(drive: DriveTable) -> str:
    """Return the unit of the amplitude of a resolved ``drive``: that of its waveform, or m where it moves a wall."""
    if drive.end:
        return "m"
    return drive.record.unit


def has_free_amplitude(case: Case) -> bool:
    """Return whether ``amplitude_changes`` can change the amplitude of the case, which that of a file cannot."""
    return bool(case.drive.amplitude) or case.initial is None or case.initial.kind != "file"


def amplitude_changes(case: Case, amplitude: float) -> Changes:
    """Return the changes, as ``Case.varied`` takes them, that give a resolved ``case`` another ``amplitude``.

    Further drives stay as they are; masses that are struck keep the ratios of their velocities. A state from a file has
    a fixed amplitude, and no changes.
    """
    initial = case.initial
    if case.drive.amplitude or initial is None:
        return {"drive": {"amplitude": float(amplitude)}}
    if initial.kind == "file":
        return {}
    if initial.kind != "velocity":
        return {"initial": {"amplitude": float(amplitude)}}

    assert initial.velocity is not None and initial.amplitude is not None
    # The magnitude of the velocity counts, since its sign is a direction: amplitudes are positive.
    factor = float(amplitude) / abs(initial.velocity)
    changes: dict[str, Any] = {"velocity": factor * initial.velocity, "amplitude": factor * initial.amplitude}
    if initial.more:
        struck = [strike.model_copy(update={"velocity": factor * strike.velocity}) for strike in initial.more]
        changes["more"] = [strike.model_dump() for strike in struck]
    return {"initial": changes}
