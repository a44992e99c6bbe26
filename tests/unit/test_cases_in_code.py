"""Cases that are built in code: the same as those of tables, refused in the same words, and shown in a notebook."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import xarray as xr

import vipetsc
from tests.conftest import small_case
from vipetsc.case import Case, CaseError, LawCase, Sweep
from vipetsc.case.html import cell_svg
from vipetsc.lattice import Spring, UnitCell, four_band
from vipetsc.lattice.sites import Pair
from vipetsc.modes.branches.follow import follow_all
from vipetsc.studies.one_site import make_law
from vipetsc.studies.prediction import predict

TABLE = {
    "lattice": {"cells": 24},
    "contacts": {"sites": [6, 12, 13], "clearance": 2e-4},
    "drive": {"amplitude": 24.33, "cycles": 6},
    "time": {"end": 0.05},
}
SPRINGS = [{"start": 1, "end": 1, "stiffness": 2.0e4, "next_cell": True}, {"start": 1, "end": 2, "stiffness": 6.0e3}]


def test_keywords_give_the_case_of_the_table():
    """A case and a sweep of keywords are those of the same table, with the same text."""
    assert Case(**TABLE) == Case.from_table(TABLE)
    assert Case(name="a", **TABLE).to_toml() == Case.from_table({"name": "a"} | TABLE).to_toml()

    varied = {"sweep": {"drive": {"amplitude": [1.0, 2.0]}}}
    assert Sweep(**TABLE, **varied) == Sweep.from_table(TABLE | varied)


def test_what_a_program_holds_is_taken():
    """Arrays, tuples, NumPy's numbers, paths and a case's sections stand for a file's values; None leaves a key out."""
    written = {"cell": {"masses": [0.01, 0.004], "springs": SPRINGS}, "cells": 60}
    # The same values in the types of a program.
    held = {"cell": {"masses": np.array([0.01, 0.004]), "springs": tuple(SPRINGS)}, "cells": np.int64(60), "ends": None}
    drive = {"amplitude": np.float64(8.0), "band": 2, "at": "max-group-velocity"}
    case = Case(lattice=held, drive=drive, contacts=None)
    assert case == Case.from_table({"lattice": written, "drive": {**drive, "amplitude": 8.0}})

    assert Case(lattice=case.lattice, drive=case.drive, time=case.time) == case
    with pytest.raises(CaseError, match=r"no-such\.csv"):
        Case(drive={"waveform": "samples", "samples": {"file": Path("no-such.csv")}})


def test_bad_input_is_refused_as_in_a_file():
    """Problems of keywords are those of the table: key, value and remedy."""
    wrong = {"lattice": {"cels": 3}, "drive": {"amplitude": "x"}, "contacts": 5, "latice": {}}
    with pytest.raises(CaseError) as of_table:
        Case.from_table(wrong)
    with pytest.raises(CaseError) as of_keywords:
        Case(**wrong)
    # The whole text, with all problems in their order.
    assert str(of_keywords.value) == str(of_table.value)
    assert "lattice.cels = 3: unknown key; did you mean lattice.cells?" in str(of_keywords.value)

    with pytest.raises(CaseError, match="sweep: missing; give the keys that vary"):
        Sweep(**TABLE)


def drawing(cell: UnitCell, pair: Pair | None) -> list[str]:
    """Return the kinds of the elements of a cell's drawing, which is sound XML."""
    root = ElementTree.fromstring(cell_svg(cell, pair))
    return [element.tag.rpartition("}")[2] for element in root.iter()]


def test_a_notebook_shows_a_case_with_its_cell():
    """The table has name, lattice, bands, contacts and drive, and the drawing each mass, spring and stop."""
    html = small_case()._repr_html_()
    for text in (
        "<b>small</b>",
        "24 cells of 4 masses",
        "681.48 to 1414.2",
        "cell 6, cell 12, cell 13",
        "0.2 mm",
        "24.33 N",
    ):
        assert text in html, text

    # Four masses, and the first of the next cell; four springs and the two halves of the clearance.
    shapes = drawing(four_band("calibrated"), Pair(1, 2))
    assert shapes.count("circle") == 5
    assert shapes.count("polyline") == len(four_band("calibrated").springs) + 2
    assert drawing(four_band("calibrated"), None).count("polyline") == len(four_band("calibrated").springs)


def test_every_cell_can_be_drawn():
    """Beads without springs, a stop at the ground and masses that nothing ties together are drawn too."""
    bead = UnitCell((0.03,), (), 0, 0)
    assert drawing(bead, Pair(0, 0, offset=1)).count("circle") == 2
    lone = UnitCell((0.1,), (Spring(0, 0, 1e3, offset=1),), 0, 0)
    # The spring to the next cell, and two halves of the clearance.
    assert drawing(lone, Pair(-1, 0)).count("polyline") == 3
    apart = UnitCell((0.1, 0.2, 0.3), (Spring(0, 0, 1e3, offset=1), Spring(1, 2, 1e3)), 0, 1)
    assert drawing(apart, Pair(0, 1)).count("circle") == 4


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda: Case(None), "lattice={"),
        (lambda: Case("case.toml"), "Case.load"),
        (lambda: LawCase(5), "LawCase.load"),
        (lambda: Case.from_table(5), "a dict"),
        (lambda: Case.from_table(None), "a dict"),
        (lambda: Case.from_table([("lattice", {})]), "a dict"),
        (lambda: Case.from_toml(5), "a text"),
        (lambda: Case.from_toml(b"name = 'x'"), "a text"),
        (lambda: Case.load(5), "name of a case file"),
        (lambda: Case.load(None, "lattice.cells=5"), "list"),
        (lambda: Case.load(None, 5), "list"),
        (lambda: Case.of(5), "dataset"),
        (lambda: Case.of(xr.Dataset()), "dataset"),
        (lambda: Case().varied(lattice=5), "lattice is a section"),
        (lambda: vipetsc.simulate("case.toml"), "simulate takes a case of the class Case"),
        (lambda: vipetsc.simulate(None), "simulate takes a case"),
        (lambda: vipetsc.sweep(Case()), "sweep takes a case of the class Sweep"),
        (lambda: vipetsc.analyse("run.h5"), "dataset"),
        (lambda: make_law(Case(), "folder"), "make_law takes a case"),
        (lambda: predict(LawCase(), "folder"), "predict takes a case"),
        (lambda: follow_all(Case(), None, MPI.COMM_SELF), "NnmCase or NfrcCase"),
    ],
)
def test_the_door_says_what_it_takes(call, word):
    """An argument of a wrong type is refused where it is given, not by whatever it meets inside."""
    with pytest.raises(TypeError, match=re.escape(word)):
        call()


@pytest.mark.parametrize(
    ("call", "key"),
    [
        (lambda: Case.from_toml("["), "case"),
        (lambda: Case.from_toml("name = 'a'\nname = 'b'"), "case"),
        (lambda: Case.from_toml("x = " + 5000 * "["), "case"),
        (lambda: Case.from_table({1: 2}), "case"),
        (lambda: Case.from_table({"drive": {"more": [{2: 3}]}}), "drive.more[1]"),
        (lambda: Case(drive={"amplitude": 1j}), "drive.amplitude"),
    ],
)
def test_a_table_that_is_none_is_a_problem_of_the_case(call, key):
    """What a file could not hold either is an error of the case, with its place."""
    with pytest.raises(CaseError) as caught:
        call()
    assert key in [problem.key for problem in caught.value.problems]


@pytest.mark.parametrize("without, word", [(["drve"], "did you mean drive"), ("drive", "unknown key")])
def test_sections_that_are_left_out_exist(without, word):
    """A misspelt section, or a name in place of a list of names, does not silently leave out nothing."""
    with pytest.raises(CaseError, match=word):
        Case().varied(without=without)
