"""Variables that are keys of a case: their places in designs, their values in the unit cube, and refusals."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from tests.conftest import with_sections
from vipetsc.case import case_id
from vipetsc.case.optimise import OptimiseCase, SearchSpace, Variable
from vipetsc.case.reading import put
from vipetsc.studies.sampler import CmaEs

OWN_CELL = {
    "masses": [4e-3, 2e-3],
    "springs": [
        {"start": 1, "end": 1, "stiffness": 1e4, "next_cell": True},
        {"start": 1, "end": 2, "stiffness": 5e3, "damping": 0.1},
    ],
}
TABLE = {
    "name": "own",
    "lattice": {
        "cells": 24,
        "cell": OWN_CELL,
        # These keys contain dots and brackets, at which a path must not be split.
        "profiles": {"masses[1]": {"first": 4e-3, "last": 4e-3}, "springs[1].stiffness": {"first": 1e4, "last": 2e4}},
    },
    "contacts": {"law": "hertz", "stiffness": 1e7, "sites": [6, 12, 14], "clearance": 1e-4, "restitution": 0.7},
    "drive": {"amplitude": 3.0, "frequency": 1000.0, "cycles": 3, "cell": 4, "more": [{"frequency": 900.0, "cell": 5}]},
    "time": {"end": 0.05},
    "optimise": {"objective": [{"measure": "entropy"}]},
}


def plan_of(variables: dict, **sections) -> OptimiseCase:
    """Return the search of ``TABLE`` over these variables."""
    table = with_sections(TABLE, sections)
    return OptimiseCase.from_table(table | {"optimise": table["optimise"] | {"variables": variables}})


def test_every_key_has_its_place_in_a_design():
    """Each value is at its path in the design, with its type; all other keys have the values of the case."""
    profiles = {"springs[1].stiffness": {"last": {"log": [1e3, 1e5]}}}
    plan = plan_of(
        {
            "lattice": {"cell": {"springs[2]": {"damping": {"linear": [0.0, 1.0]}}}, "profiles": profiles},
            "contacts": {"each": {"restitution": {"linear": [0.3, 0.9]}}, "law": ["hertz", "bilinear"]},
            "drive": {"cycles": {"whole": [2, 9]}, "more[1]": {"amplitude": {"log": [0.1, 10.0]}}},
            "time": {"end": [0.04, 0.05]},
        }
    )
    values = {
        # A list of all sites gives one variable a site; a choice is the number of its value, from 1.
        "lattice.cell.springs[2].damping": 0.4,
        "lattice.profiles.springs[1].stiffness.last": 3e4,
        "contacts.each.restitution[1]": 0.4,
        "contacts.each.restitution[2]": 0.5,
        "contacts.each.restitution[3]": 0.6,
        "contacts.law": 2,
        "drive.cycles": 7,
        "drive.more[1].amplitude": 0.3,
        "time.end": 1,
    }
    assert [variable.name for variable in plan.variables()] == [*values]

    design = plan.design(np.array([*values.values()]))
    expected = with_sections(
        {key: section for key, section in TABLE.items() if key != "optimise"},
        {"contacts": {"law": "bilinear", "each": {"restitution": [0.4, 0.5, 0.6]}}, "time": {"end": 0.04}},
    )
    expected["lattice"] = TABLE["lattice"] | {
        "cell": OWN_CELL | {"springs": [OWN_CELL["springs"][0], OWN_CELL["springs"][1] | {"damping": 0.4}]},
        "profiles": TABLE["lattice"]["profiles"] | {"springs[1].stiffness": {"first": 1e4, "last": 3e4}},
    }
    more = [{"frequency": 900.0, "cell": 5, "amplitude": 0.3}]
    expected["drive"] = TABLE["drive"] | {"cycles": 7, "more": more}
    # Searches take the faster engine where the case names none.
    expected["time"]["engine"] = "auto"
    # The hash of a case covers every key, also those that must not have changed.
    assert case_id(design) == case_id(type(design).from_table(expected | {"name": "design"}))
    # A float would be refused by the schema, or change the hash.
    assert type(design.drive.cycles) is int


def test_the_case_is_the_start_and_survives_the_unit_cube():
    """The design with the values of the case is the case, and values return from the cube unchanged."""
    plan = plan_of(
        {
            "clearance": [1e-5, 1e-2],
            "contacts": {"each": {"stiffness": {"log": [1e6, 1e8]}}, "damping": ["exact", "paper"]},
            "drive": {"cycles": {"whole": [2, 9]}},
        },
        contacts={"damping": "paper"},
    )
    values = plan.begin()
    # Choices are numbered: "paper" is the second of its list. Sites have the common value, since the case has no list.
    assert values.tolist() == [1e-4] * 3 + [1e7] * 3 + [2, 3]
    assert np.allclose(plan.space.from_unit(plan.space.to_unit(values)), values, rtol=1e-12)
    design = plan.design(values)
    assert design.model().chain.sites.laws == plan.base.model().chain.sites.laws
    # Models are compared and not cases, since the design has lists where the case has single values.
    assert design.model().chain == plan.base.model().chain


def test_names_are_keys_of_the_case():
    """A variable by its short name and by the path of its key gives the same design, with the same hash."""
    by_name = plan_of({"profile": [1e-5, 1e-2], "restitution": [0.1, 0.9], "masses": {"2": [1e-3, 1e-2]}})
    by_key = plan_of(
        {
            "lattice": {"cell": {"masses[2]": {"log": [1e-3, 1e-2]}}},
            "contacts": {"clearance": {s: {"log": [1e-5, 1e-2]} for s in ("first", "last")}}
            | {"restitution": {"linear": [0.1, 0.9]}},
        },
        contacts={"clearance": {"first": 1e-4, "last": 1e-4}},
    )

    values = {"contacts.clearance.first": 2e-4, "contacts.clearance.last": 3e-4, "contacts.restitution": 0.5}
    values["lattice.cell.masses[2]"] = 3e-3
    ids = []
    for plan in (by_name, by_key):
        ids.append(case_id(plan.design(np.array([values[variable.path] for variable in plan.variables()]))))
    assert ids[0] == ids[1]


def test_choices_and_whole_numbers_have_equal_parts_of_the_cube():
    """Every choice has the same part of the range; whole numbers are the nearest ones; ends of the cube are inside."""
    choice = Variable("law", "contacts.law", low=1, high=3, kind="choice", start=1, choices=("a", "b", "c"))
    whole = Variable("cycles", "drive.cycles", low=2, high=5, kind="whole", start=3)
    grid = np.linspace(0, 1, 3001)
    # A fine grid, so that the parts are measured to 1/3000.
    numbers = np.array([choice.from_unit(x) for x in grid])
    assert [np.mean(numbers == n) for n in (1, 2, 3)] == pytest.approx([1 / 3] * 3, abs=1e-3)
    # A choice has a third of the range, 1/6 on either side of its middle.
    for near in (-0.16, 0.0, 0.16):
        found = [choice.in_case(choice.from_unit(choice.to_unit(n) + near)) for n in (1, 2, 3)]
        assert found == ["a", "b", "c"]
    assert {whole.from_unit(x) for x in grid} == {2, 3, 4, 5}
    assert whole.in_case(whole.from_unit(whole.to_unit(4))) == 4


def test_a_search_of_mixed_kinds_finds_the_best_of_each():
    """A function of a real number, a whole number and a choice, with a given least value, is minimised."""
    kinds = [
        Variable("x", "x", low=1e-3, high=1e3, kind="log", start=1e-2),
        Variable("n", "n", low=1, high=30, kind="whole", start=3),
        Variable("c", "c", low=1, high=5, kind="choice", start=1, choices=(5, 3, 0, 4, 9)),
    ]
    space = SearchSpace({}, kinds)
    steps = np.array([variable.step for variable in kinds])
    # The start is far away: x at 1/200 of its best value, n at 3 instead of 21, and the second worst choice.
    search = CmaEs(space.to_unit(space.begin()), steps, np.eye(3), 0.3, seed=1, population=None)

    best = np.inf, None
    for _ in range(60):
        values = [space.from_unit(point) for point in search.ask()]
        # The loss is the sum of three functions, with their minima at x = 2, n = 21 and the choice of the value 0.
        losses = [np.log10(x / 2) ** 2 + 0.05 * (n - 21) ** 2 + kinds[2].choices[int(c) - 1] for x, n, c in values]
        search.tell(np.array(losses)[:, None], np.zeros(len(losses)))
        best = min(best, (min(losses), values[int(np.argmin(losses))]), key=lambda pair: pair[0])

    assert best[1][1:].tolist() == [21, 3]
    assert best[1][0] == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize(
    "path, value", [("drive.more.first.cell", None), ("name.first.second", 1), ("a.b.c[2].d.e", 1)]
)
def test_a_key_that_cannot_be_set_leaves_the_table_as_it_was(path, value):
    """Sections that are made for a key go with it."""
    table = {"name": "x", "a": {"b": {"c": [1]}}}
    before = copy.deepcopy(table)
    assert put(table, path, value)
    assert table == before
