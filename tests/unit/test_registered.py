"""Formulas and values of registered laws, factors and waveforms are checked before a case is simulated."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from vipetsc.case.registered import check_factors, check_law
from vipetsc.case.waveforms import OneDrive, waveform_record
from vipetsc.lattice.drive import impulse
from vipetsc.register import DISSIPATION, PARTS, WAVEFORM, DissipationPart, PartError, WaveformPart

pytestmark = pytest.mark.parallel(1)

ONSET = 1e-7  # m: below every indentation at which force, slope and energy are compared


class Formulas:
    """A law by its force, slope and energy over the indentation in m, as ``check_law`` asks a contact for them."""

    def __init__(self, force: Callable, slope: Callable, energy: Callable, onset_exponent: float) -> None:
        self.elastic_force = force
        self.elastic_slope = slope
        self.elastic_energy = energy
        self.onset_exponent = onset_exponent


@pytest.mark.parametrize(
    ("slope", "energy", "exponent", "defect"),
    [
        (3.1e6, 0.8e6, 1.5, "as the differences of its force"),
        (3e6, 0.9e6, 1.5, "as the differences of its energy"),
        (3e6, 0.8e6, 1.0, "its force begins as x^1.5, and onset_exponent is 1"),
    ],
)
def test_formulas_that_contradict_each_other_are_named(slope, energy, exponent, defect):
    """A slope, an energy or an exponent that does not belong to the force is named."""
    law = Formulas(lambda x: 2e6 * x**1.5, lambda x: slope * x**0.5, lambda x: energy * x**2.5, exponent)
    assert defect in check_law(law)


def test_a_force_that_begins_later_has_no_onset():
    """A law whose force is 0 over the first tenth of a micrometre beyond the clearance is refused."""

    def beyond(x: np.ndarray) -> np.ndarray:
        return np.maximum(np.asarray(x) - ONSET, 0.0)

    law = Formulas(
        lambda x: 2e6 * beyond(x), lambda x: 2e6 * (np.asarray(x) > ONSET), lambda x: 1e6 * beyond(x) ** 2, 1.0
    )
    assert check_law(law) == "its force must be positive for x > 0, and must not fall"


ORIGIN = {"modules": {__name__}, "file": __file__, "sha256": ""}


def test_a_factor_that_fails_is_named_with_its_file(monkeypatch):
    """A user's function that raises an error is refused with its name, file and error."""
    part = DissipationPart(name="inverse", function=lambda restitution: 1 / restitution, **ORIGIN)
    monkeypatch.setitem(PARTS[DISSIPATION], "inverse", part)
    assert list(check_factors("contacts.damping", ["inverse"], [0.5])) == []
    with pytest.raises(PartError, match=r"the dissipation 'inverse' of .* fails: ZeroDivisionError"):
        list(check_factors("contacts.damping", ["inverse"], [0.0]))


@pytest.mark.parametrize("value", [1j, np.complex128(2), [1.0, 2.0], "2", None, np.datetime64("2020-01-01")])
def test_a_factor_that_is_no_number_is_named_with_its_file(monkeypatch, value):
    part = DissipationPart(name="odd", function=lambda restitution: value, **ORIGIN)
    monkeypatch.setitem(PARTS[DISSIPATION], "odd", part)
    with pytest.raises(PartError, match=r"the dissipation 'odd' of .*; a real number"):
        list(check_factors("contacts.damping", ["odd"], [0.5]))


@pytest.mark.parametrize("amplitude", [np.nan, np.inf])
def test_a_waveform_without_a_finite_force_is_named_with_its_file(monkeypatch, amplitude):
    part = WaveformPart(name="tap", function=lambda drive: impulse(amplitude, 0.1), **ORIGIN)
    monkeypatch.setitem(PARTS[WAVEFORM], "tap", part)
    with pytest.raises(PartError, match=r"the waveform 'tap' of .* not a finite number"):
        waveform_record("tap").build(OneDrive())
