"""The manual's table of verbs and features: each yes is computed as a user would, each no is what the program says.

Of the verbs that take seconds, every fifth feature is computed, another fifth by each verb; all of them (minutes of
CPU) are with a variable: ``EVERY_FEATURE=1 python -m pytest tests/cli/test_feature_table.py``.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tomli_w

from vipetsc.case import Case
from vipetsc.cli.feature_table import BASE, COLUMNS, FEATURES, UNREAD, YES, Column, Feature, answers, chapter, merged
from vipetsc.dynamics import simulate

ANSWERS = answers()
BY_HEADING = {column.heading: column for column in COLUMNS}
PLAIN = next(feature for feature in FEATURES if feature.name == "burst")
DEAR = {"optimise", "identify", "law", "predict", "nfrc", "wave", "condensed"}  # columns whose verbs take seconds
TURNS = 1 if os.environ.get("EVERY_FEATURE") else 5
# The columns of the verb run: its motions are compared feature by feature.
RUNS = {"run", "propagator"}
LATTICE = {"profiles of cells", "disorder of cells", "free ends", "ring"}
ENDS = {"free ends", "ring"}
# What a verb accepts and what does not change its results: linear modes have no drive, no dashpot, and of contacts
# only those that are pressed at rest; the law's site is alone on a ring of cells; an infinite lattice has no ends, and
# the reduced model is one pair of masses; for steady states a burst gives the frequency, as a harmonic drive does; the
# few points of branches touch a site or none.
WITHOUT_INFLUENCE = {
    "bands": {feature.name for feature in FEATURES} - LATTICE - {"preload"},
    "law": ENDS | {"several in a cell"},
    "nfrc": {"harmonic"},
    "wave": {"harmonic"} | ENDS,
    "reduced": {"law of a plugin"} | ENDS,
    "chain": {"unequal clearances", "law of a plugin", "a law for each site", "restitutions of sites"},
    "own": {"law of a plugin"},
    "condensed": {"unequal clearances"},
}
pytestmark = pytest.mark.slow


def pairs(is_asked, dear: set[str] | None = None) -> list[Any]:
    """The column and the feature of each answer that ``is_asked``, in columns that are ``dear`` of features in turn."""
    found = []
    for row, feature in enumerate(FEATURES):
        for place, (column, answer) in enumerate(zip(COLUMNS, ANSWERS[feature.name], strict=True)):
            is_in_turn = (row + place) % TURNS == 0 or column.heading not in (dear or ())
            if is_asked(answer) and is_in_turn:
                found.append(pytest.param(column, feature, id=f"{column.heading}-{feature.name}"))
    return found


def studies_that_accept() -> list[Any]:
    """The columns, but for those of runs, and the features that they accept."""
    accepted = pairs(lambda answer: answer == YES, dear=DEAR)
    return [parameter for parameter in accepted if parameter.values[0].heading not in RUNS]


def words_of(column: Column, case: Path) -> list[str]:
    """The command for the case file of a column."""
    if column.heading == "bands":
        return ["bands", str(case), "--modes", "2"]
    return [column.kind.verb, str(case)]


def put_case(column: Column, feature: Feature, folder: Path) -> Path:
    """Write the case of a column with a feature; returns its path."""
    path = folder / "case.toml"
    path.write_text(tomli_w.dumps(column.table(feature)), encoding="utf-8")
    return path


def motion_of(folder: Path) -> np.ndarray:
    """Displacements in m of a run, over time, cell and mass."""
    with h5py.File(folder / "run.h5") as file:
        return file["displacement"][...]


def numbers_of(folder: Path) -> dict[str, np.ndarray]:
    """All numbers of the results in a folder, by file and name."""
    numbers: dict[str, np.ndarray] = {}

    def keep(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.dtype.kind == "f":
            numbers[f"{path.name}/{name}"] = item[...]

    for path in sorted(folder.glob("*.h5")):
        with h5py.File(path) as file:
            file.visititems(keep)
    return numbers


@pytest.fixture(scope="module")
def plain_results() -> dict[str, dict[str, np.ndarray]]:
    """The results of columns without a feature, by heading, filled by the tests that need them."""
    return {}


@pytest.mark.parametrize(("column", "feature"), studies_that_accept())
def test_every_yes_is_computed(column, feature, tmp_path, in_process, plain_results):
    """The verb ends well, and its results differ from those without the feature: no yes is one that is ignored."""

    def computed(case: Path, out: Path) -> dict[str, np.ndarray]:
        ended = in_process(*words_of(column, case), "--out", out)
        assert ended.returncode == 0, ended.stdout + ended.stderr
        return numbers_of(out)

    if column.heading not in plain_results:
        plain = tmp_path / "plain.toml"
        plain.write_text(tomli_w.dumps(merged(BASE, column.sections)), encoding="utf-8")
        plain_results[column.heading] = computed(plain, tmp_path / "plain")
    results = computed(put_case(column, feature, tmp_path), tmp_path / "out")
    assert results

    before = plain_results[column.heading]
    is_same = results.keys() == before.keys() and all(
        np.array_equal(values, before[name], equal_nan=True) for name, values in results.items()
    )
    assert is_same == (feature is PLAIN or feature.name in WITHOUT_INFLUENCE.get(column.heading, ()))


@pytest.mark.parametrize(("column", "feature"), pairs(lambda answer: answer not in (YES, UNREAD)))
def test_every_no_is_what_the_program_says(column, feature, tmp_path, in_process):
    """A verb that refuses a feature writes nothing, and its message has the sentences of the table."""
    [answer] = [a for c, a in zip(COLUMNS, ANSWERS[feature.name], strict=True) if c is column]
    folder = tmp_path / "out"
    ended = in_process(*words_of(column, put_case(column, feature, tmp_path)), "--out", folder)
    if column.heading == "propagator":
        # The run goes on with the other engine, and says why.
        assert ended.returncode == 0
        assert answer in ended.stdout + ended.stderr
    else:
        assert ended.returncode == 2
        assert all(sentence in ended.stderr for sentence in answer.split("; "))
        assert not list(folder.glob("*.h5"))


@pytest.fixture(scope="module")
def plain_motion(tmp_path_factory) -> np.ndarray:
    """The motion of the case without a feature."""
    folder = tmp_path_factory.mktemp("plain")
    simulate(Case.load(put_case(BY_HEADING["run"], PLAIN, folder)), folder / "out")
    return motion_of(folder / "out")


@pytest.mark.parametrize("feature", FEATURES, ids=lambda feature: feature.name)
def test_a_feature_changes_a_run_and_both_engines_agree(feature, tmp_path, in_process, plain_motion):
    """A yes is no feature that is ignored: the motion differs from that of the plain case, equally by both engines."""
    motions = {}
    for heading in sorted(RUNS):
        folder = tmp_path / heading
        folder.mkdir()
        ended = in_process("run", put_case(BY_HEADING[heading], feature, folder), "--out", folder / "out")
        assert ended.returncode == 0, ended.stderr
        motions[heading] = motion_of(folder / "out")

    largest = np.abs(motions["run"]).max()
    difference = np.abs(motions["propagator"] - motions["run"]).max()
    assert difference < 1e-6 * largest
    if feature is not PLAIN:
        assert np.abs(motions["run"] - plain_motion).max() > 1e-4 * largest


@pytest.mark.parametrize("feature", FEATURES[::TURNS], ids=lambda feature: feature.name)
def test_results_are_exported_and_drawn(feature, tmp_path, in_process, plain_pictures):
    """``export`` and ``plot`` accept the run of every feature."""
    folder = tmp_path / "out"
    in_process("run", put_case(BY_HEADING["run"], feature, tmp_path), "--out", folder)
    for verb in ("export", "plot"):
        ended = in_process(verb, folder)
        assert ended.returncode == 0, ended.stderr


def test_the_chapter_has_every_answer():
    """Each row has an answer of every column, and each number is that of a sentence below the table."""
    text = chapter()
    rows = [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")]
    assert [row[0] for row in rows] == ["feature", *(feature.name for feature in FEATURES)]

    sentences = dict(line.split(". ", 1) for line in text.splitlines() if line[:1].isdigit())
    for row in rows[1:]:
        shown = [sentences.get(answer, answer) for answer in row[1:]]
        assert shown == ANSWERS[row[0]]


def test_no_feature_is_refused_for_a_fault_of_the_small_case():
    """A message about a key that is missing or misplaced would say nothing about the feature."""
    said = {answer for row in ANSWERS.values() for answer in row}
    assert not [answer for answer in said if "missing" in answer or "outside" in answer or "unknown" in answer]
