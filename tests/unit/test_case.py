"""Cases are strict, complete, resolved, and the same after a round trip."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vipetsc.case import Case, CaseError, LawCase, case_id
from vipetsc.case.resolve import _round_down
from vipetsc.lattice import Contact

# A lattice with a cell of its own: its contacts, drive and times have no defaults.
PLAIN = {
    "name": "plain",
    "lattice": {
        "cell": {
            "masses": [1.0, 2.0],
            "springs": [
                {"start": 1, "end": 1, "stiffness": 3.0, "next_cell": True},
                {"start": 1, "end": 2, "stiffness": 4.0},
            ],
            "contact": [1, 2],
        },
        "cells": 20,
    },
    "contacts": {"sites": [3], "clearance": 1e-3, "stiffness": 1e4},
    "drive": {"frequency": 1.0},
    "time": {"end": 10.0, "sample_interval": 0.125},
}
EXAMPLES = Path(__file__).parents[2] / "vipetsc" / "examples"


def problems(table: dict[str, Any], *overrides: str) -> dict[str, str]:
    """Return the printed problems of a case by their keys."""
    with pytest.raises(CaseError) as caught:
        Case.from_table(table, overrides)
    return {problem.key: str(problem) for problem in caught.value.problems}


def test_the_builtin_case_has_the_papers_contacts_and_drive():
    """Sites, clearances, stiffness, frequency and contact law are those of the paper's four-band lattice."""
    case = Case.load()
    assert case.contacts.sites == [75, 106, 138, 169, 200]
    np.testing.assert_allclose(case.contacts.clearance, np.geomspace(10**-2.65, 10**-2.75, 5), rtol=1e-12)
    assert case.contacts.stiffness == pytest.approx(5180269.459, rel=1e-9)
    assert case.drive.frequency == pytest.approx(1023.27, abs=5e-3)
    assert case.model().chain.sites[0].law == Contact("hertz", case.contacts.stiffness, 0.7, "allow", 0.0)


def test_the_builtin_case_lasts_until_the_wave_has_crossed():
    """The end is the duration of the burst and the time of the wave through all cells: 2 pi n/omega + cells/c_g."""
    model = Case.load().model()
    assert model.speed == pytest.approx(428.7, abs=0.05)
    # The burst of 30 cycles, and 300 cells at the group velocity.
    crossed = 2 * np.pi * 30 / 1023.2717 + 300 / 428.682
    # The last sample is the one before.
    assert model.end == 4420 * model.sample_interval
    assert crossed - model.sample_interval < model.end < crossed
    assert model.samples == 4421
    assert model.scale == pytest.approx(2.42261e-3, rel=1e-5)


@pytest.mark.parametrize("wavenumber", ["5pi/9", "5*pi/9", 5 * np.pi / 9])
def test_a_drive_may_be_given_by_its_wavenumber(wavenumber):
    """The drive's frequency is that of the band at the wavenumber: 5520.026 rad/s at 5 pi/9."""
    table = {"lattice": {"preset": "diatomic", "reading": "printed"}, "drive": {"wavenumber": wavenumber}}
    assert Case.from_table(table).drive.frequency == pytest.approx(5520.026, abs=1e-3)


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda p: p.stem)
def test_every_case_file_is_sound_and_survives_a_round_trip(path):
    case = Case.load(path)
    assert Case.from_toml(case.to_toml()) == case
    assert case.model().samples > 1


def test_the_model_of_a_case_is_built_once_and_not_carried_by_copies():
    """A case keeps its model; changed copies and pickled cases have none."""
    case = Case.load()
    model = case.model()
    assert case.model() is model
    assert case == Case.load()

    weaker = case.model_copy(update={"drive": case.drive.model_copy(update={"amplitude": 1.0})})
    assert weaker.model().drive.amplitude == 1.0

    # The keys alone are sent to another rank, without the model.
    sent = pickle.loads(pickle.dumps(case))
    assert sent == case
    assert sent.__dict__.keys() == case.model_dump().keys() == Case.model_fields.keys()


def test_a_varied_case_is_that_of_a_run_with_other_values():
    """``varied`` yields a plain case with some values changed, sections left out and overrides applied."""
    law = LawCase.load(EXAMPLES / "law.toml", ["output.stride=2", "time.rtol=1e-9"])
    varied = law.varied(name="ring", without=("output",), lattice={"ends": "periodic"}, drive={"amplitude": 3.0})
    assert type(varied) is Case
    assert varied.name == "ring"
    assert varied.lattice.ends == "periodic"
    assert varied.drive.amplitude == 3.0

    # Sections left out begin with their defaults, all others stay.
    assert varied.output.stride == 1
    assert varied.time == law.time
    assert varied.drive.frequency == law.drive.frequency
    assert law.varied(overrides=["output.stride=4"]).output.stride == 4


def test_a_varied_case_is_resolved_again():
    """``varied`` resolves defaults of the changed sections and checks the case."""
    case = Case.load()
    nine = case.varied(contacts={"sites": 9, "clearance": None}, time={"rtol": None})
    assert nine.contacts == Case.load(overrides=["contacts.sites=9"]).contacts
    assert nine.time == case.time

    with pytest.raises(CaseError, match="outside the lattice"):
        case.varied(lattice={"cells": 10})


def test_tolerances_scale_with_the_drive():
    """Absolute tolerances are 0.1 rtol times the scale of the displacement, and omega times that for velocities."""
    # Powers of two, so that nothing is rounded.
    weak = Case.load(overrides=[f"drive.amplitude={2.0**-10}"]).model()
    strong = Case.load(overrides=[f"drive.amplitude={2.0**3}"]).model()
    assert strong.atol[0] == weak.atol[0] * 2**13
    assert strong.atol[0] == 0.1 * strong.rtol * strong.scale
    assert strong.atol[1] == strong.atol[0] * strong.drive.frequency


def test_tolerances_of_the_paper_are_a_billionth_of_its_amplitude():
    """``time.atol = "paper"`` is 1e-9 times 24.33, the number of the paper's force."""
    assert Case.load(overrides=["time.atol=paper"]).model().atol == (24.33e-9, 24.33e-9)


def test_a_misspelt_choice_and_an_unknown_section_name_the_nearest():
    found = problems({"contacts": {"law": "hertzz"}}, "desing.wavenumbers=5")
    assert "did you mean 'hertz'?" in found["contacts.law"]
    assert "did you mean design?" in found["desing"]
    # Of a word that is near to none, none is named.
    assert "did you mean" not in problems({"drive": {"waveform": "tone"}})["drive.waveform"]
    assert "did you mean 'harmonic'?" in problems({"drive": {"waveform": "harm"}})["drive.waveform"]


def test_a_check_that_rests_on_an_invalid_key_is_left_out():
    """An invalid clearance is the only problem: checks that use it are not made."""
    with pytest.raises(CaseError) as caught:
        Case.from_table(PLAIN | {"contacts": PLAIN["contacts"] | {"clearance": -1.0}})
    assert [problem.key for problem in caught.value.problems] == ["contacts.clearance"]
    assert "greater than or equal to 0" in str(caught.value)


@given(end=st.floats(0.5, 100.0), interval=st.floats(1e-3, 0.5) | st.just("auto"))
def test_the_last_sample_is_at_the_end(end, interval):
    """An interval that does not divide the end is shortened to one that does, and stays when the case is read again."""
    case = Case.from_table(PLAIN | {"time": {"end": end, "sample_interval": interval}})
    model = case.model()
    assert model.end == end
    assert (model.samples - 1) * model.sample_interval == pytest.approx(end, rel=1e-11)
    if interval != "auto":
        assert model.sample_interval <= interval * (1 + 1e-12)
        assert model.samples - 2 < end / interval * (1 + 1e-12)
    assert Case.from_toml(case.to_toml()) == case


def test_automatic_sample_intervals_are_round():
    found = [_round_down(value) for value in (5.6e-4, 4.9e-4, 1.9e-3, 0.01)]
    assert found == [5e-4, 2e-4, 1e-3, 0.01]


def test_the_identity_of_a_case_stays_what_folders_on_disk_bear():
    """The hash of a case does not change between versions, and differs between cases."""
    # With another identity the program would not recognise finished runs in users' folders and would run them again.
    assert case_id(Case.from_table(PLAIN)) == "8ca6fe4316aa84be"
    assert case_id(Case.from_table(PLAIN, ["drive.amplitude=2.0"])) != case_id(Case.from_table(PLAIN))


def test_errors_travel_between_ranks():
    """A CaseError is the same after pickling."""
    with pytest.raises(CaseError) as caught:
        Case.load(overrides=["lattice.cels=3"])
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("output.stride=10", "resolve 1570.8 of 3644.8 rad/s: dispersion, bands and ibtet are not"),
        ("output.every=4", "shorter than 8 cells"),
        ("output.window=[1, 40]", "contains none of the contact sites"),
    ],
)
def test_an_output_too_coarse_to_measure_is_a_warning(override, message):
    (warning,) = Case.load(overrides=[override]).warnings()
    assert message in warning


def test_a_missing_file_of_samples_hides_no_problem_with_times():
    """A missing file of a drive's samples and a wrong number of samples in time are both reported."""
    found = problems({"drive": {"waveform": "samples", "samples": {"file": "none.csv"}}, "time": {"samples": 1}})
    assert list(found) == ["drive.samples.file", "time.samples"]


def test_a_key_whose_name_begins_with_that_of_an_invalid_one_is_checked_too():
    """A wrong type of ``clearance`` does not hide that ``clearance_minus`` is too large."""
    found = problems({"contacts": {"clearance": "wide", "clearance_minus": 1e60}})
    assert list(found) == ["contacts.clearance", "contacts.clearance_minus"]


@pytest.mark.parametrize(
    "change, word",
    [
        ("contacts.sites[3]=5", "has 2 entries"),
        ("contacts.sites[1]=", "set the whole list"),
        ("contacts.sites[0]=5", "count from 1"),
        ("contacts.restitution[1]=0.5", "or set contacts.restitution"),
        ("drive.more[1].amplitude=3", "or set drive.more"),
        ("contacts.sitse[1]=5", "unknown key"),
    ],
)
def test_an_entry_that_a_list_does_not_have(change, word):
    """It is not a misspelt key: the message says how entries count, and that a list is made longer as a whole."""
    with pytest.raises(CaseError) as caught:
        Case.from_table({"contacts": {"sites": [20, 30]}}, [change])
    assert word in str(caught.value)


def test_names_of_points_are_refused_in_words():
    """The user sees which characters a name may have, not a regular expression."""
    found = problems({"output": {"points": [{"name": "a b", "cell": 1}]}})["output.points[1].name"]
    assert "letters, digits" in found and "^" not in found
