"""Rules between keys: what a case refuses, by the key that it names and a word of its remedy.

The rules are the rows of ``rules_between_keys.toml``. What single keys exclude is in ``test_refusals_by_schema``, what
a verb does not take of a lattice in ``test_features``.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from tests.conftest import set_words
from vipetsc.case import CaseError
from vipetsc.case.verb_cases import VERB_CASES

INSIDE = {"start": 1, "end": 2, "stiffness": 5e3}
TIMES = {"drive": {"frequency": 1e3}, "time": {"end": 0.01, "sample_interval": 1e-4}}
LATTICES: dict[str, dict[str, Any]] = {
    "built-in": {},
    "own cell": {
        "lattice": {
            "cells": 24,
            "cell": {
                "masses": [4e-3, 2e-3],
                "springs": [{"start": 1, "end": 1, "stiffness": 1e4, "next_cell": True}, INSIDE],
                "contact": [1, 2],
            },
        },
        "contacts": {"stiffness": 1e7, "sites": [6, 12], "clearance": 1e-4},
    }
    | TIMES,
    "grains": {
        "lattice": {"cells": 4, "ends": "free", "cell": {"masses": [4e-3, 2e-3], "springs": [INSIDE]}},
        "contacts": {"stiffness": 1e7, "pair": [1, 1], "next_cell": True, "sites": [1, 2, 3], "clearance": 1e-5},
    }
    | TIMES,
    "beads": {
        "lattice": {"cells": 4, "ends": "free", "cell": {"masses": [1e-3]}},
        "contacts": {"stiffness": 1e8, "pair": [1, 1], "next_cell": True, "sites": [1, 2, 3]}
        | {"clearance": 0.0, "side": "minus"},
    }
    | TIMES,
}
RULES = tomllib.loads(Path(__file__).with_name("rules_between_keys.toml").read_text())
ROWS = [
    pytest.param(verb, lattice, key, word, changes, id=f"{verb}-{key}-{word}")
    for verb, tables in RULES.items()
    for lattice, table in tables.items()
    for key, word, *changes in table["rows"]
]
OF_VERB = {kind.verb: kind for kind in VERB_CASES}


@pytest.mark.parametrize(("verb", "lattice", "key", "word", "changes"), ROWS)
def test_a_rule_between_keys_is_kept(verb, lattice, key, word, changes):
    """One rule is broken, and one problem is told: by the key that a user gave, with a remedy."""
    with pytest.raises(CaseError) as caught:
        OF_VERB[verb].from_table(LATTICES[lattice], changes)
    (problem,) = caught.value.problems
    assert problem.key == key
    assert word in problem.remedy


@pytest.mark.parametrize("verb", RULES)
def test_a_command_with_such_a_case_ends_with_2_and_writes_nothing(verb, in_process, tmp_path):
    """Every verb tells its user the same key and word."""
    lattice, table = next(iter(RULES[verb].items()))
    key, word, *changes = table["rows"][0]
    file = tmp_path / "case.toml"
    file.write_text(tomli_w.dumps(LATTICES[lattice]))
    ended = in_process(verb, file, *set_words(*changes), "--out", tmp_path / "out")
    assert ended.returncode == 2
    assert key in ended.stderr and word in ended.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["case.toml"]
