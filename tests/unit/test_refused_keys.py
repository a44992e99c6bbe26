"""Keys without effect and motions that a lattice does not have are refused; sentences describe stops and drives."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from tests.conftest import small_case
from vipetsc.case import Case, CaseError
from vipetsc.case.reading import sections_in
from vipetsc.case.verb_cases import SECTIONS
from vipetsc.cli.verbs.run_verb import run_rows
from vipetsc.dynamics.propagator.step_choice import refusal


def unsprung_table(**sections: dict[str, Any]) -> dict[str, Any]:
    """Return the table of beads that contacts alone join, driven by half a sine; ``sections`` update it."""
    table: dict[str, Any] = {
        "lattice": {"cell": {"masses": [1e-3]}, "cells": 4, "ends": "free"},
        "contacts": {"stiffness": 1e8, "clearance": 0.0, "next_cell": True, "side": "minus", "sites": [1, 2, 3]},
        "drive": {"waveform": "impulse", "amplitude": 1e-3, "duration": 1e-5},
        "time": {"end": 1e-3, "sample_interval": 1e-5},
    }
    return table | {name: table.get(name, {}) | values for name, values in sections.items()}


def problem_of(table: dict[str, Any], overrides: tuple[str, ...] = ()) -> tuple[str, str]:
    """Return key and remedy of the only problem of a case."""
    with pytest.raises(CaseError) as error:
        Case.from_table(table, overrides)
    [problem] = error.value.problems
    return problem.key, problem.remedy


def test_a_clearance_of_the_side_minus_is_taken_where_one_site_has_a_stop_there():
    """``clearance_minus`` is accepted if at least one site has a stop on that side."""
    case = small_case(contacts={"sites": [4, 9], "clearance": 3e-5, "clearance_minus": 1e-5,
                                "each": {"side": ["plus", "both"]}})  # fmt: skip
    assert case.model().chain.sites[1].gaps == (3e-5, 1e-5)


def test_what_follows_in_other_lines_of_an_override_is_refused():
    """An override with a second assignment in another line is refused, with a hint at a second ``--set``."""
    key, remedy = problem_of(Case.builtin_table, ("drive.amplitude=2.0\ntime.end=5",))
    assert key == "--set" and "--set each" in remedy


def test_the_frequency_of_an_impulse_follows_from_its_duration_without_springs_too():
    """An impulse of the duration T has the frequency pi/T, also in a lattice without springs."""
    case = Case.from_table(unsprung_table())
    assert case.drive.frequency == pytest.approx(3.141592653589793e5)


def test_every_union_is_read_by_the_shape_of_its_value():
    """A union without the mark would give the errors of all of its types, with pydantic's own names in their paths."""
    waiting = list(SECTIONS.values())
    seen = set()
    while waiting:
        table = waiting.pop()
        if table in seen:
            continue
        seen.add(table)
        for name, field in table.model_fields.items():
            waiting += sections_in(field.annotation)
            key = field.alias or name
            with pytest.raises(ValidationError) as caught:
                table.model_validate({key: object()})
            assert len([item for item in caught.value.errors() if item["loc"][:1] == (key,)]) <= 1, key
    assert len(seen) > 40


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("grounding", [1e6, 1e12])
@pytest.mark.parametrize("cells", [4, 30])
def test_a_step_that_is_far_too_long_is_refused_without_an_overflow(grounding, cells):
    """Without springs no interval of samples is too coarse, and a dashpot's rate times it may be any number."""
    case = Case.from_table(
        unsprung_table(
            lattice={"cell": {"masses": [1.0], "grounding": [grounding]}, "cells": cells},
            time={"end": 1e7, "sample_interval": 1e6},
        )
    )
    assert "is too long for" in refusal(case.model())
    assert dict(run_rows(case, 1))["engine"].startswith("ts")
