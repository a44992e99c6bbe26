"""The section [sweep]: ranges, products, zipped keys, names, and what is wrong with it, all at once."""

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


def read(text: str, *overrides: str) -> Sweep:
    return Sweep.from_table(tomllib.loads(BASE + text), overrides)


def test_members_are_the_product_in_the_files_order():
    plan = read("[sweep.drive]\namplitude = [1.0, 2.0, 3.0]\n[sweep.contacts]\nsites = [1, 2]")
    assert plan.shape == (3, 2)
    cases = [m.case for m in plan.members()]
    assert [c.drive.amplitude for c in cases] == [1.0, 1.0, 2.0, 2.0, 3.0, 3.0]
    assert [len(c.contacts.sites) for c in cases] == [1, 2] * 3
    table = tomllib.loads(BASE) | {"drive": {"amplitude": 2.0}, "contacts": {"sites": 2}, "time": {"engine": "auto"}}
    assert cases[3] == Case.from_table(table)


def test_a_key_may_be_written_in_one_piece():
    nested = read("[sweep.drive]\namplitude = [1.0, 2.0]\n[sweep.contacts]\nsites = [1, 2]")
    flat = read('[sweep]\n"drive.amplitude" = [1.0, 2.0]\n"contacts.sites" = [1, 2]')
    assert flat.ids() == nested.ids() and flat.members() == nested.members()


def test_ranges():
    plan = read("[sweep.drive]\namplitude = { log = [0.1, 10], count = 3 }\nfrequency = { linear = [1, 2], count = 5 }")
    amplitude, frequency = (next(iter(axis.values())) for axis in plan.axes)
    assert amplitude == pytest.approx([0.1, 1.0, 10.0], rel=1e-15)
    assert frequency == (1.0, 1.25, 1.5, 1.75, 2.0)


def test_zipped_keys_vary_together_and_share_a_dimension():
    text = '[sweep]\nzip = [["contacts.sites", "drive.cycles"]]\n[sweep.contacts]\nsites = [5, 5, 1]\n'
    plan = read(text + "[sweep.drive]\ncycles = [30, 15, 30]\namplitude = [1.0, 2.0]")
    assert plan.shape == (3, 2)
    assert [(len(m.case.contacts.sites), m.case.drive.cycles) for m in plan.members()[::2]] == [
        (5, 30),
        (5, 15),
        (1, 30),
    ]


def test_a_key_inside_a_table_and_short_names():
    text = "[contacts]\nsites = { first = 11, spacing = 1, count = 1 }\n[sweep.contacts.sites]\ncount = [1, 3]"
    plan = read(text)
    assert plan.names() == {"contacts.sites.count": "sites"}
    assert [m.case.contacts.sites for m in plan.members()] == [[11], [11, 12, 13]]
    twice = read("[sweep.drive]\ncell = [1, 2]\n[sweep.lattice]\ncells = [40]\n[sweep.contacts]\nsites = [1]")
    assert set(twice.names().values()) == {"cell", "cells", "sites"}


def test_coordinates_are_numbers_where_they_can_be():
    assert coordinate(["2pi/9", "5pi/9"]) == pytest.approx(np.pi * np.array([2, 5]) / 9)
    assert list(coordinate(["hertz", "bilinear"])) == ["hertz", "bilinear"]
    assert list(coordinate([1, {"first": 3, "count": 2}])) == ["1", '{"first": 3, "count": 2}']


def test_written_out_and_read_back_it_has_the_same_members():
    plan = read('[sweep.drive]\nwavenumber = ["2pi/9", "5pi/9"]\namplitude = { log = [0.1, 20.0], count = 7 }')
    again = Sweep.from_table(tomllib.loads(plan.to_toml()))
    assert again.ids() == plan.ids() and again.members() == plan.members()
    assert len(set(plan.ids())) == 14


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "sweep: missing"),
        ("[sweep]\nfields = true", "names no key that varies"),
        ("[sweep]\nfeilds = true\n[sweep.drive]\namplitude = [1.0]", "did you mean sweep.fields?"),
        ("[sweep.drive]\namplitude = 3.0", "sweep.drive.amplitude = 3.0: give a list"),
        ("[sweep.drive]\namplitude = []", "give a list"),
        ("[sweep.drive]\namplitude = { log = [0, 1], count = 3 }", "must be positive"),
        ("[sweep.drive]\namplitude = { log = [1, 2] }", "give a list"),
        ("[sweep.drive]\namplitud = [1.0]", "did you mean drive.amplitude?"),
        ('[sweep]\nzip = [["drive.cycles"]]\n[sweep.drive]\namplitude = [1.0]', "not among the keys that vary"),
        ('[sweep]\nzip=[["drive.cycles","drive.amplitude"]]\n[sweep.drive]\namplitude=[1.0]\ncycles=[3,4]', "as many"),
        ('[sweep]\nzip=[["drive.cycles"],["drive.cycles"]]\n[sweep.drive]\ncycles=[3,4]', "in one group only"),
    ],
)
def test_what_is_wrong_is_named_with_its_remedy(text, says):
    with pytest.raises(CaseError) as error:
        read(text).members()
    assert says in str(error.value)


def test_one_impossible_member_does_not_spoil_the_others():
    members = read("[sweep.contacts]\nsites = [[10], [99], [20]]").members()
    assert [m.case is not None for m in members] == [True, False, True]
    assert "contacts.sites = [99]" in str(members[1].problems[0])


def test_names_of_members_are_those_of_their_values():
    """Whatever the order of the axes; equal members have one name, and a number or a name finds its member."""
    rows = "[sweep.drive]\namplitude = [1.0, 2.0, 1.0]\n[sweep.contacts]\nsites = [1, 2]"
    plan, turned = read(rows), read("[sweep.contacts]\nsites = [1, 2]\n[sweep.drive]\namplitude = [1.0, 2.0, 1.0]")
    table = np.array(plan.ids()).reshape(3, 2)
    assert (table == np.array(turned.ids()).reshape(2, 3).T).all()
    assert (table[0] == table[2]).all() and len(set(plan.ids())) == 4
    assert read(rows, "drive.cycles=7").ids()[0] not in plan.ids()
    assert plan.number(table[1, 1]) == plan.number("3") == 3 and plan.case(3).drive.amplitude == 2.0
    for name in ("6", "-1", "0123456789abcdef"):
        with pytest.raises(CaseError, match="is no member; ensemble"):
            plan.number(name)


@pytest.mark.slow
def test_many_members_are_cheap_until_one_is_asked_for():
    plan = read("[sweep.drive]\namplitude = { linear = [0.0, 1.0], count = 250_000 }")
    assert len(plan.ids()) == plan.count == 250_000 and len(plan.members(20)) == 20
    assert plan.member(0).case is None and plan.case(plan.count - 1).drive.amplitude == 1.0
    rows = "{ linear = [1, 2], count = 1001 }", "{ linear = [1, 2], count = 1000 }"
    with pytest.raises(CaseError, match="makes 1001000 members; at most 1000000"):
        read("[sweep.drive]\namplitude = {}\nfrequency = {}".format(*rows))


@given(
    first=st.floats(1e-3, 1e3),
    ratio=st.floats(1.1, 1e3),
    count=st.integers(2, 40),
    kind=st.sampled_from(["log", "linear"]),
)
@settings(max_examples=50)
def test_a_range_has_its_ends_and_rises(first, ratio, count, kind):
    plan = read(f"[sweep.drive]\namplitude = {{ {kind} = [{first!r}, {first * ratio!r}], count = {count} }}")
    values = np.array(plan.axes[0]["drive.amplitude"])
    assert len(values) == count
    assert values[[0, -1]] == pytest.approx([first, first * ratio], rel=1e-12)
    steps = np.diff(np.log(values) if kind == "log" else values)
    assert steps == pytest.approx(np.full(count - 1, steps[0]), rel=1e-6)


def test_a_member_is_made_once():
    plan = read("[sweep.drive]\namplitude = [1.0, 2.0]")
    members = plan.members()
    assert plan.member(1) is members[1] is plan.members()[1]
    assert plan.model_copy(update={"name": "other"}).member(1) is not members[1]
