"""The case of a verb refuses the features that its class declares, by their keys, and accepts all others."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from vipetsc.case import VERB_CASES, Case, CaseError, CaseFile, DesignCase, NnmCase
from vipetsc.case.features import FEATURES

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
    "profiles": ({"lattice": {"profiles": {"masses[1]": {"first": 0.004, "last": 0.005}}}}, "lattice.profiles"),
    "scatter": (
        {"lattice": {"scatter": {"seed": 1, "quantities": {"masses[1]": {"relative": 0.01}}}}},
        "lattice.scatter",
    ),
    "absorbing ends": ({"lattice": {"absorbing": {"cells": 9, "strength": 1.0}}}, "lattice.absorbing"),
    "strips": ({"lattice": {"strip": {"rows": 2, "mass": 1.0, "stiffness": 3.0}}}, "lattice.strip"),
    "rings": ({"lattice": {"ends": "periodic"}}, "lattice.ends"),
    "unlike sites": ({"contacts": {"side": "plus"}}, "contacts.side"),
    "touching stops": ({"contacts": {"clearance": 0.0, "side": "plus", "restitution": 1.0}}, "contacts.clearance"),
    "rigid stops": ({"contacts": {"law": "rigid"}}, "contacts.law"),
    "initial motion": ({"initial": {"kind": "mode", "number": 3, "amplitude": 1e-4}}, "initial.kind"),
    "many drives": ({"drive": {"more": [{"frequency": 1000.0, "cell": 2}]}}, "drive.more"),
    "moved wall": ({"drive": {"end": "left"}}, "drive.end"),
    "damped wall": ({"drive": {"end": "left"}, "lattice": {"damping": {"stiffness": 1e-7}}}, "drive.end"),
    # The chirp is narrow in frequency, since ``predict`` refuses other waves.
    "other waveforms": (
        {"drive": {"waveform": "chirp", "frequency": 1000.0, "bandwidth": 100.0, "duration": 0.2}},
        "drive.waveform",
    ),
    "disorder": ({"disorder": {"clearance": {"relative": 1e-3}}}, "disorder"),
}
# Sections without which a verb's case is incomplete.
VERB_SECTIONS = {
    "sweep": {"drive": {"amplitude": [1.0, 2.0]}},
    "optimise": {"variables": {"profile": [1e-4, 1e-2]}},
    "nfrc": {"source": "force", "infinite": False},
    "identify": {
        "records": [
            {
                "file": "record.csv",
                "sha256": "",
                "rate": 4000.0,
                "sensors": [{"quantity": "velocity", "column": 2, "cell": 4}],
            }
        ],
        "unknowns": [{"quantity": "amplitude", "bounds": [0.1, 100.0]}],
    },
}
# Cases of normal modes and designs have no drive and are tested separately.
DRIVEN = [kind for kind in VERB_CASES if kind not in (NnmCase, DesignCase)]


def refused_keys(kind: type[CaseFile], changes: dict[str, dict[str, Any]]) -> set[str]:
    """Return the keys of the problems of the built-in case with the section of the verb and ``changes``."""
    table: dict[str, Any] = {"name": "four-band"}
    if kind.section:
        table[kind.section] = copy.deepcopy(VERB_SECTIONS.get(kind.section, {}))
    for section, values in changes.items():
        table[section] = table.get(section, {}) | values
    if {"cell", "strip"} & table.get("lattice", {}).keys():
        # A cell that is no preset has no defaults for these sections.
        table["contacts"] = {"sites": [9], "clearance": 1e-3, "stiffness": 1e4}
        table["drive"] = {"frequency": 1.0}
        table["time"] = {"end": 10.0, "sample_interval": 0.125}

    try:
        case = kind.from_table(table)
        # A sweep checks its members as it builds them.
        if kind.section == "sweep":
            case.members()
    except CaseError as error:
        return {problem.key for problem in error.problems}
    return set()


@pytest.mark.parametrize("feature", sorted(FEATURES))
@pytest.mark.parametrize("kind", DRIVEN, ids=lambda kind: kind.verb)
def test_a_feature_is_refused_by_verbs_that_give_a_reason(kind, feature):
    """A verb refuses a feature under its key if and only if its class gives a reason."""
    changes, key = CHANGES[feature]
    assert (key in refused_keys(kind, changes)) == (feature in kind.refuses)


@pytest.mark.parametrize("feature", ["damping", "absorbing ends", "unlike sites", "disorder", "rings", "rigid stops"])
def test_normal_modes_refuse_what_they_give_a_reason_for(feature):
    changes, key = CHANGES[feature]
    # The reduced model, which is the default, has one cell and one contact only.
    of_chain = {"nnm": {"system": "chain"}}
    assert (key in refused_keys(NnmCase, changes | of_chain)) == (feature in NnmCase.refuses)


def test_a_plain_run_accepts_every_feature():
    assert VERB_CASES[0] is Case
    assert not Case.section
    assert not Case.refuses
    assert FEATURES.keys() == CHANGES.keys()
    assert all(kind.refuses.keys() <= FEATURES.keys() for kind in VERB_CASES)
