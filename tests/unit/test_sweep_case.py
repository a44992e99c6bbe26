"""The section [sweep]: ranges, products, zipped keys, names of members, and sections that are refused."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vipetsc.case import Case, CaseError, Sweep
from vipetsc.case.sweep import coordinate

BASE = """
name = "small"
[lattice]
preset = "diatomic"
cells = 40
"""


def sweep_of(text: str, *overrides: str) -> Sweep:
    """Return the sweep of the base case with ``text`` behind it."""
    return Sweep.from_table(tomllib.loads(BASE + text), overrides)


def test_members_are_the_product_in_the_files_order():
    """Members are the product of all axes, the last one in the file varying fastest; each is a case."""
    plan = sweep_of("[sweep.drive]\namplitude = [1.0, 2.0, 3.0]\n[sweep.contacts]\nsites = [1, 2]")
    assert plan.shape == (3, 2)
    cases = [member.case for member in plan.members()]
    assert [case.drive.amplitude for case in cases] == [1.0, 1.0, 2.0, 2.0, 3.0, 3.0]
    assert [len(case.contacts.sites) for case in cases] == [1, 2] * 3

    table = tomllib.loads(BASE) | {"drive": {"amplitude": 2.0}, "contacts": {"sites": 2}, "time": {"engine": "auto"}}
    assert cases[3] == Case.from_table(table)


def test_zipped_keys_vary_together_and_share_a_dimension():
    """Zipped keys take their values in pairs, along one axis."""
    text = '[sweep]\nzip = [["contacts.sites", "drive.cycles"]]\n[sweep.contacts]\nsites = [5, 5, 1]\n'
    text += "[sweep.drive]\ncycles = [30, 15, 30]\namplitude = [1.0, 2.0]"

    plan = sweep_of(text)

    assert plan.shape == (3, 2)
    # Every second member has the first amplitude.
    assert [(len(m.case.contacts.sites), m.case.drive.cycles) for m in plan.members()[::2]] == [
        (5, 30),
        (5, 15),
        (1, 30),
    ]


def test_a_key_inside_a_table_and_short_names():
    """A key inside a table may vary; the short names of axes differ."""
    text = "[contacts]\nsites = { first = 11, spacing = 1, count = 1 }\n[sweep.contacts.sites]\ncount = [1, 3]"
    plan = sweep_of(text)
    assert plan.names() == {"contacts.sites.count": "sites"}
    assert [member.case.contacts.sites for member in plan.members()] == [[11], [11, 12, 13]]

    twice = sweep_of("[sweep.drive]\ncell = [1, 2]\n[sweep.lattice]\ncells = [40]\n[sweep.contacts]\nsites = [1]")
    assert set(twice.names().values()) == {"cell", "cells", "sites"}


def test_coordinates_are_numbers_where_they_can_be():
    """Multiples of pi become numbers; names stay, and values of several kinds become texts."""
    assert coordinate(["2pi/9", "5pi/9"]) == pytest.approx(np.pi * np.array([2, 5]) / 9)
    assert list(coordinate(["hertz", "bilinear"])) == ["hertz", "bilinear"]
    assert list(coordinate([1, {"first": 3, "count": 2}])) == ["1", '{"first": 3, "count": 2}']


def test_written_out_and_read_back_it_has_the_same_members():
    """The text of a sweep gives the same members under the same names."""
    plan = sweep_of('[sweep.drive]\nwavenumber = ["2pi/9", "5pi/9"]\namplitude = { log = [0.1, 20.0], count = 7 }')

    restored = Sweep.from_table(tomllib.loads(plan.to_toml()))

    assert restored.ids() == plan.ids()
    assert restored.members() == plan.members()
    assert len(set(plan.ids())) == 14


def test_one_impossible_member_does_not_spoil_the_others():
    """A member outside the lattice has its problems in place of a case, and the sweep warns of them."""
    plan = sweep_of("[sweep.contacts]\nsites = [[10], [99], [20]]")
    members = plan.members()

    assert [member.case is not None for member in members] == [True, False, True]
    assert "contacts.sites = [99]" in str(members[1].problems[0])
    assert plan.warnings() == [f"members that will fail: {members[1].problems[0]} (1 member)"]
    assert not sweep_of("[sweep.contacts]\nsites = [[10], [20]]").warnings()


def test_names_of_members_are_those_of_their_values():
    """A name depends on a member's values, not on the order of the axes; equal members have one name."""
    amplitudes = "[sweep.drive]\namplitude = [1.0, 2.0, 1.0]\n"
    sites = "[sweep.contacts]\nsites = [1, 2]\n"
    plan = sweep_of(amplitudes + sites)
    transposed = sweep_of(sites + amplitudes)

    names = np.array(plan.ids()).reshape(3, 2)
    assert (names == np.array(transposed.ids()).reshape(2, 3).T).all()
    assert (names[0] == names[2]).all()
    assert len(set(plan.ids())) == 4
    # Another value of a key that does not vary is another member.
    assert sweep_of(amplitudes + sites, "drive.cycles=7").ids()[0] not in plan.ids()


def test_a_number_or_a_name_finds_its_member():
    """A member is found by its number or its name; others are refused."""
    plan = sweep_of("[sweep.drive]\namplitude = [1.0, 2.0, 1.0]\n[sweep.contacts]\nsites = [1, 2]")

    assert plan.number(plan.ids()[3]) == 3
    assert plan.number("3") == 3
    assert plan.case(3).drive.amplitude == 2.0
    # A number beyond the last member, one before the first, and a name of no member.
    for name in ("6", "-1", "0123456789abcdef"):
        with pytest.raises(CaseError, match="is not a member; ensemble"):
            plan.number(name)


@given(
    first=st.floats(1e-3, 1e3),
    ratio=st.floats(1.1, 1e3),
    count=st.integers(2, 40),
    kind=st.sampled_from(["log", "linear"]),
)
@settings(max_examples=50)
def test_a_range_has_its_ends_and_rises(first, ratio, count, kind):
    """A range has its count of values, its ends, and equal differences of values or of their logarithms."""
    plan = sweep_of(f"[sweep.drive]\namplitude = {{ {kind} = [{first!r}, {first * ratio!r}], count = {count} }}")

    values = np.array(plan.axes[0]["drive.amplitude"])
    assert len(values) == count
    assert values[[0, -1]] == pytest.approx([first, first * ratio], rel=1e-12)
    # A step may be a thousandth of the values, hence its relative rounding error is larger than theirs.
    steps = np.diff(np.log(values) if kind == "log" else values)
    assert steps == pytest.approx(np.full(count - 1, steps[0]), rel=1e-6)


def test_a_range_meets_decimal_numbers_without_rounding():
    """A value of a range that misses a number of a few digits by its rounding alone is that number; others stay."""

    def values(text: str) -> tuple[float, ...]:
        """Return the amplitudes of a sweep over the range."""
        return sweep_of(f"[sweep.drive]\namplitude = {text}").axes[0]["drive.amplitude"]

    # NumPy's ranges have 4.999999999999999 for 5, 0.30000000000000004 for 0.3, and 1.4e-17 for 0.
    log = values("{ log = [0.5, 50.0], count = 7 }")
    assert log[3] == 5.0
    assert log[1] == np.geomspace(0.5, 50.0, 7)[1]
    assert values("{ linear = [0, 1], count = 11 }") == tuple(i / 10 for i in range(11))
    assert values("{ linear = [-0.1, 0.2], count = 4 }") == (-0.1, 0.0, 0.1, 0.2)
    # Small values of a logarithmic range over 16 decades are not taken for 0.
    assert values("{ log = [1e-9, 1e7], count = 3 }") == (1e-9, 0.1, 1e7)


@pytest.mark.parametrize(("section", "value"), [("contacts", [0]), ("contacts", "1e9"), ("output", 0)])
def test_a_section_of_a_sweep_that_is_no_table_is_refused(section, value):
    sweep = Sweep.from_table({section: value, "sweep": {"drive": {"amplitude": [1.0, 2.0]}}})
    with pytest.raises(CaseError) as error:
        sweep.tried()
    assert error.value.problems[0].key == section
    assert sweep.wants_pictures == (section != "output")
