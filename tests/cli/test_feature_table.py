"""The manual's table of verbs and features: each yes is computed by the verb, each no is the verb's own message.

Fast verbs compute every sixth feature, runs and verbs that take seconds every eighteenth, each verb others. A variable
asks for all of them, which takes minutes of CPU:

    EVERY_FEATURE=1 python -m pytest tests/cli/test_feature_table.py

That engines agree on what a run computes is tested with the lattices of ``tests/zoo.py``.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tomli_w

from scripts.feature_table import BASE, CHAPTER, COLUMNS, FEATURES, YES, Column, Feature, answers, chapter, merged
from vipetsc.figures import registry
from vipetsc.lattice import UnitCell

PLAIN = next(feature for feature in FEATURES if feature.name == "burst")
# Columns whose verbs take seconds, and those of runs, whose features are in ``tests/zoo.py``.
DEAR = {"run", "propagator", "optimise", "identify", "law", "predict", "nfrc", "wave", "condensed"}
EVERY = bool(os.environ.get("EVERY_FEATURE"))
LATTICE = {"profiles of cells", "disorder of cells", "free ends", "ring", "strip of the plane"}
ENDS = {"free ends", "ring"}
GRAINS = {"grains", "grains with resonators"}
# Features that a verb accepts although they do not change its results. Linear modes have no drive and no dashpot, and
# contacts act on them only if they are pressed at rest. The scattering law has one site on a ring of cells. An infinite
# lattice has no ends, and the reduced model is one pair of masses. Steady states take the frequency of a burst as they
# take that of a harmonic drive. The few points of branches touch one site or none.
WITHOUT_INFLUENCE = {
    "bands": {feature.name for feature in FEATURES} - LATTICE - GRAINS - {"preload"},
    "law": ENDS | {"several in a cell"},
    "nfrc": {"harmonic"},
    "wave": {"harmonic"} | ENDS,
    "reduced": {"law of a plugin"} | ENDS,
    "chain": {"unequal clearances", "law of a plugin", "a law for each site", "restitutions of sites"},
    "own": {"law of a plugin"},
    "condensed": {"unequal clearances"},
}


def answer(column: Column, feature: Feature) -> str:
    """What the table says of a feature: each of its cases is read once for all tests."""
    return answers()[feature.name][COLUMNS.index(column)]


def is_in_turn(column: Column, feature: Feature) -> bool:
    """Whether an answer is computed: every sixth one of a fast verb, every eighteenth one of the columns ``DEAR``."""
    place = COLUMNS.index(column) + FEATURES.index(feature)
    return EVERY or place % (18 if column.heading in DEAR else 6) == 0


def words_of(column: Column, case: Path) -> list[str]:
    """The words of the command line that compute the case file of a column."""
    if column.heading == "bands":
        return ["bands", str(case), "--modes", "2"]
    return [column.kind.verb, str(case)]


def put_case(column: Column, feature: Feature, folder: Path) -> Path:
    """Write the case of a column with a feature into ``folder``, which is created; returns its path."""
    folder.mkdir(exist_ok=True)
    path = folder / "case.toml"
    path.write_text(tomli_w.dumps(column.table(feature)), encoding="utf-8")
    return path


def numbers_of(folder: Path) -> dict[str, np.ndarray]:
    """All datasets of floating-point numbers in the results of a folder, by file and name."""
    numbers: dict[str, np.ndarray] = {}

    def keep(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and item.dtype.kind == "f":
            numbers[f"{path.name}/{name}"] = item[...]

    for path in sorted(folder.glob("*.h5")):
        with h5py.File(path) as file:
            file.visititems(keep)
    return numbers


@pytest.fixture
def picture_of_each_cell(monkeypatch):
    """Draw bands once for each cell and frequency: their picture depends on nothing else."""
    draw = registry.draw_bands
    drawn: dict[Any, Path] = {}

    def draw_once(cell: UnitCell, path: Path, frequency: float | None, strip: object) -> Path:
        key = cell, frequency
        if key not in drawn:
            drawn[key] = draw(cell, path, frequency)
        return drawn[key]

    monkeypatch.setattr(registry, "draw_bands", draw_once)


@pytest.mark.usefixtures("plain_pictures", "picture_of_each_cell")
@pytest.mark.parametrize("column", COLUMNS, ids=lambda column: column.heading)
def test_every_yes_is_computed(column, tmp_path, in_process):
    """The verb ends with 0, and its results differ from those without the feature, but for ``WITHOUT_INFLUENCE``."""

    def computed(case: Path) -> dict[str, np.ndarray]:
        out = case.parent / "out"
        ended = in_process(*words_of(column, case), "--out", out)
        assert ended.returncode == 0, f"{case}: {ended.stdout}{ended.stderr}"
        return numbers_of(out)

    plain = tmp_path / "plain.toml"
    plain.write_text(tomli_w.dumps(merged(BASE, column.sections)), encoding="utf-8")
    before = computed(plain)

    for feature in FEATURES:
        if answer(column, feature) != YES or not is_in_turn(column, feature):
            continue
        results = computed(put_case(column, feature, tmp_path / feature.name))
        assert results

        is_same = results.keys() == before.keys() and all(
            np.array_equal(values, before[name], equal_nan=True) for name, values in results.items()
        )
        has_no_influence = feature is PLAIN or feature.name in WITHOUT_INFLUENCE.get(column.heading, ())
        assert is_same == has_no_influence, feature.name


def test_the_chapter_is_that_of_the_program():
    """The manual's chapter has the answers of this version; ``python scripts/feature_table.py`` writes it."""
    assert CHAPTER.read_text(encoding="utf-8") == chapter()


def test_no_feature_is_refused_for_a_fault_of_the_small_case():
    """No answer is a message about a missing or misplaced key, which would say nothing about the feature."""
    said = {answer for row in answers().values() for answer in row}
    assert not [answer for answer in said if "missing" in answer or "outside" in answer or "unknown" in answer]
