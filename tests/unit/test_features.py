"""What a verb's case takes is taken, and what it does not take is refused by name; one list of verbs and sections."""

from __future__ import annotations

import copy

import pytest

from vipetsc.case import VERB_CASES, Case, CaseError, CaseFile, NnmCase
from vipetsc.case.features import FEATURES
from vipetsc.case.verb_cases import OF_SECTION, SECTIONS

CELL = {
    "masses": [1.0, 2.0],
    "springs": [
        {"start": 1, "end": 1, "stiffness": 3.0, "next_cell": True},
        {"start": 1, "end": 2, "stiffness": 4.0, "cubic": 1.0},
    ],
}
# A change of the built-in case that brings in each feature, and the key under which it is refused.
CHANGES = {
    "damping": ({"lattice": {"damping": {"mass": 1.0}}}, "lattice"),
    "nonlinear springs": ({"lattice": {"cell": CELL}}, "lattice.cell.springs"),
    "inhomogeneity": ({"lattice": {"profiles": {"masses[1]": {"first": 0.004, "last": 0.005}}}}, "lattice.profiles"),
    "absorbing ends": ({"lattice": {"absorbing": {"cells": 9, "strength": 1.0}}}, "lattice.absorbing"),
    "rings": ({"lattice": {"ends": "periodic"}}, "lattice.ends"),
    "unlike sites": ({"contacts": {"side": "plus"}}, "contacts.side"),
    "initial motion": ({"initial": {"kind": "mode", "number": 3, "amplitude": 1e-4}}, "initial.kind"),
    "many drives": ({"drive": {"more": [{"frequency": 1000.0, "cell": 2}]}}, "drive.waveform"),
    "disorder": ({"disorder": {"clearance": {"relative": 1e-3}}}, "disorder"),
}
OWN = {
    "sweep": {"drive": {"amplitude": [1.0, 2.0]}},
    "optimise": {"variables": {"profile": [1e-4, 1e-2]}},
    "nfrc": {"source": "force", "infinite": False},
}
PLANS = [kind for kind in VERB_CASES if kind.takes and kind is not NnmCase]


def refused(kind: type[CaseFile], changes: dict) -> set[str]:
    """The keys of the problems of the built-in case with the section of the verb and with ``changes``."""
    table = {"name": "four-band", kind.section: copy.deepcopy(OWN.get(kind.section, {}))} if kind.section else {}
    for section, values in changes.items():
        table[section] = table.get(section, {}) | values
    if "cell" in table.get("lattice", {}):
        table |= {"contacts": {"sites": [9], "clearance": 1e-3, "stiffness": 1e4}, "drive": {"frequency": 1.0}}
        table["time"] = {"end": 10.0, "sample_interval": 0.125}
    try:
        case = kind.from_table(table)
        if kind.section == "sweep":
            case.members()
    except CaseError as error:
        return {problem.key for problem in error.problems}
    return set()


@pytest.mark.parametrize("feature", sorted(FEATURES))
@pytest.mark.parametrize("kind", PLANS, ids=lambda kind: kind.verb)
def test_a_feature_is_refused_by_verbs_that_do_not_take_it(kind, feature):
    changes, key = CHANGES[feature]
    assert (key in refused(kind, changes)) == (feature not in kind.takes)


@pytest.mark.parametrize("feature", ["damping", "absorbing ends", "unlike sites", "disorder", "rings"])
def test_normal_modes_refuse_what_they_do_not_take(feature):
    changes, key = CHANGES[feature]
    assert (key in refused(NnmCase, changes)) == (feature not in NnmCase.takes)


def test_every_verb_has_a_name_and_a_section_of_its_own():
    assert len({kind.verb for kind in VERB_CASES}) == len({kind.section for kind in VERB_CASES}) == len(VERB_CASES)
    assert VERB_CASES[0] is Case and not Case.section and Case.takes == FEATURES == CHANGES.keys()
    assert all(kind.takes <= FEATURES for kind in VERB_CASES)
    assert [*OF_SECTION] == [kind.verb for kind in VERB_CASES[1:]] == [*SECTIONS][-len(OF_SECTION) :]
