"""The amplitude of a case, whatever it is that moves: its value, its unit, and cases of other amplitudes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from tests.conftest import small_case
from vipetsc.case.amplitude import amplitude_changes, amplitude_of, amplitude_unit, has_free_amplitude

REST = {"amplitude": 0.0, "frequency": 1000.0}
STRUCK = {"kind": "velocity", "cell": 6, "velocity": -0.5, "more": [{"cell": 9, "velocity": 0.2}]}
MODE = {"kind": "mode", "number": 3, "amplitude": 1e-4}
# Sections of a case, its amplitude and the unit. A drive counts before a motion at the beginning.
AMPLITUDES: dict[str, tuple[dict[str, Any], float, str]] = {
    "force": ({"drive": {"amplitude": 24.0}}, 24.0, "N"),
    "wall": ({"drive": {"amplitude": 2e-4, "end": "left"}}, 2e-4, "m"),
    "struck": ({"drive": REST, "initial": STRUCK}, 0.5, "m/s"),
    "mode": ({"drive": REST, "initial": MODE}, 1e-4, "m"),
    "force on a mode": ({"drive": REST | {"amplitude": 3.0}, "initial": MODE}, 3.0, "N"),
}


@pytest.mark.parametrize("moves", AMPLITUDES)
def test_an_amplitude_is_read_and_changed(moves):
    """Another amplitude changes nothing else; masses that are struck keep the ratios and the signs of their speeds."""
    sections, amplitude, unit = AMPLITUDES[moves]
    case = small_case(**sections)
    assert (amplitude_of(case), amplitude_unit(case)) == (amplitude, unit)

    other = case.varied(**amplitude_changes(case, 3 * amplitude))
    assert amplitude_of(other) == pytest.approx(3 * amplitude, rel=1e-15)
    assert other.varied(**amplitude_changes(other, amplitude)).drive == case.drive
    if moves == "struck":
        struck = other.initial
        assert struck.amplitude == pytest.approx(3 * case.initial.amplitude)
        assert [struck.velocity, *(strike.velocity for strike in struck.more)] == pytest.approx([-1.5, 0.6])


@pytest.mark.parametrize(
    ("amplitude", "kind", "free"), [(1.0, "file", True), (0.0, "file", False), (0.0, "mode", True), (0.0, "", True)]
)
def test_a_state_from_a_file_has_the_amplitude_that_it_has(amplitude, kind, free):
    initial = SimpleNamespace(kind=kind) if kind else None
    case: Any = SimpleNamespace(drive=SimpleNamespace(amplitude=amplitude), initial=initial)
    assert has_free_amplitude(case) == free
