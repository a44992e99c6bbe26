"""Numbers that a case file gives as texts with a unit."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.conftest import small_case
from tests.rigs import TWO_MASSES
from vipetsc.case import Case, CaseError
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.optimise import OptimiseCase
from vipetsc.case.units import PREFIXES, SYMBOLS, in_unit

WALL = {"end": "left", "waveform": "harmonic", "frequency": 500.0}
LINEAR = {"law": "bilinear", "sites": [6]}


@given(st.floats(1e-6, 1e6), st.sampled_from(sorted(PREFIXES)), st.sampled_from(sorted(set(SYMBOLS) - {"1", "rad"})))
def test_a_prefix_is_a_power_of_ten(number, prefix, symbol):
    """A number in a unit with a prefix is the number times the prefix; a quotient divides by it."""
    factor = PREFIXES[prefix]
    assert in_unit(f"{number!r} {prefix}{symbol}", symbol) == pytest.approx(number * factor, rel=1e-14)
    assert in_unit(f"{number!r} 1/{prefix}{symbol}", f"1/{symbol}") == pytest.approx(number / factor, rel=1e-14)


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("1.1 mm", "m", 0.0011),
        ("150 Hz", "rad/s", 300 * math.pi),
        ("150 Hz", "Hz", 150.0),
        ("12 N/mm", "N/m", 12e3),
        ("3 N/mm^1.5", "N/m^1.5", 3 * 1000**1.5),
        ("0.5 N s/m", "N s/m", 0.5),
        ("2 g", "kg", 0.002),
        ("1 kg m/s^2", "N", 1.0),
    ],
)
def test_texts_are_numbers_to_the_last_digits(text, unit, value):
    assert in_unit(text, unit) == pytest.approx(value, rel=1e-15)
    assert in_unit([text, 2], unit) == [in_unit(text, unit), 2]


@pytest.mark.parametrize("text", ["1 mm", "150", "Hz", "1e3Hz", "5pi/9", "1 rpm", "one m", ""])
def test_other_texts_stay_texts(text):
    """What is not a number in a unit of the same dimension stays a text, which the key then refuses."""
    assert in_unit(text, "rad/s") == text


def test_a_case_with_units_is_the_case_in_si():
    """Keys, entries of lists and of tables take texts; the unit of an amplitude is that of its drive."""
    sections = {
        "contacts": ({"clearance": "0.2 mm"}, {"clearance": 2e-4}),
        "drive": ({"amplitude": "24 N", "frequency": "1.005 krad/s"}, {"amplitude": 24.0, "frequency": 1005.0}),
        "time": ({"end": "40 ms"}, {"end": 0.04}),
        "output": ({"figures": False}, {"figures": False}),
    }
    texts = small_case(**{name: pair[0] for name, pair in sections.items()})
    numbers = small_case(**{name: pair[1] for name, pair in sections.items()})
    assert texts.to_toml() == numbers.to_toml()

    spread = small_case(contacts={"clearance": {"first": "1 mm", "last": "2 mm"}})
    assert spread.model().chain.sites[0].clearance == 1e-3
    assert small_case(contacts=LINEAR | {"stiffness": "3 kN/m"}).contacts.stiffness == 3000.0
    lattice = {"preset": "four-band", "ends": "fixed", "cells": 24}
    moved = Case.from_table({"lattice": lattice, "drive": WALL | {"amplitude": "1 mm"}, "time": {"end": 0.05}})
    assert moved.drive.amplitude == 1e-3


def test_ranges_of_keys_that_vary_have_units():
    """A search varies a key between texts with units, and a frequency response its frequency."""
    table = {"lattice": {"cells": 20}, "contacts": {"sites": [5, 9], "clearance": 2e-4}}
    for wanted, values in (({"log": ["0.1 mm", "1 mm"]}, (1e-4, 1e-3)), (["0.1 mm", "0.2 mm"], (1, 2))):
        search = table | {"optimise": {"variables": {"contacts": {"clearance": wanted}}}}
        (variable,) = OptimiseCase.from_table(search).variables()
        assert (variable.low, variable.high) == values
    # The search begins with the choice that is the case's.
    assert (variable.choices, variable.start) == ((1e-4, 2e-4), 2)

    for over, varying, fixed, read in (
        ("frequency", ["150 Hz", "160 Hz"], [1.0], {"range": [300 * math.pi, 320 * math.pi]}),
        ("amplitude", [1.0, 2.0], ["150 Hz"], {"fixed": [300 * math.pi]}),
        ("contacts.clearance", ["0.1 mm", "1 mm"], [1.0], {"range": [1e-4, 1e-3]}),
    ):
        nfrc = {"source": "force", "over": over, "range": varying, "fixed": fixed}
        drive = {"waveform": "harmonic", "frequency": 1000.0, "amplitude": 1.0}
        options = NfrcCase.from_table(table | {"drive": drive, "nfrc": nfrc}).nfrc
        ((key, values),) = read.items()
        assert getattr(options, key) == pytest.approx(values, rel=1e-12)


@pytest.mark.parametrize(
    ("family", "values"),
    [
        ({"clearance": {"linear": ["700 mm", "0.8 m"], "count": 2}}, [0.7, 0.8]),
        ({"clearance": ["700 mm", "0.8 m"]}, [0.7, 0.8]),
        # The exponent is that of the second law alone.
        ({"law": ["bilinear", "power"]}, ["bilinear", "power"]),
    ],
)
def test_values_of_a_family_are_read_as_those_of_a_sweep(family, values):
    """Units are read, and each law takes its own of the keys that all members have."""
    ((key, _),) = family.items()
    contacts = TWO_MASSES["contacts"] | ({"exponent": 2.0} if key == "law" else {})
    options = TWO_MASSES["nfrc"] | {"family": {"contacts": family}}
    curves = NfrcCase.from_table(TWO_MASSES | {"contacts": contacts, "nfrc": options}).every_curve()
    assert [curve.values[f"contacts.{key}"] for curve in curves] == values
    taken = [getattr(curve.case.contacts, key) for curve in curves]
    assert taken == values if key == "law" else taken == [[value] for value in values]


@pytest.mark.parametrize(
    ("sections", "key"),
    [
        ({"drive": {"amplitude": "1 mm"}}, "drive.amplitude"),
        ({"drive": {"frequency": "150 mm"}}, "drive.frequency"),
        ({"contacts": LINEAR | {"stiffness": "3 N/m^1.5"}}, "contacts.stiffness"),
        ({"contacts": {"clearance": ["1 mm", "1 s", 1e-3]}}, "contacts.clearance[2]"),
    ],
)
def test_a_unit_of_another_dimension(sections, key):
    """The key is named, and the unit that it has."""
    with pytest.raises(CaseError) as error:
        small_case(**sections)
    assert key in str(error.value)
    assert "unit" in str(error.value)
