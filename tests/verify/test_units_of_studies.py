"""Modes, responses and scattering laws do not depend on the units of mass, length and time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from mpi4py import MPI

import h5py
import numpy as np
import pytest

from tests.models import KERSCHEN
from tests.units import HUGE, TINY, Units
from tests.zoo import PAIR
from vipetsc.case import LawCase
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.nnm import NnmCase
from vipetsc.modes.branches.follow import follow_all
from vipetsc.studies import one_site

SITE = {"law": "bilinear", "stiffness": 1e7, "sites": [9], "clearance": 3e-4}
LATTICE = {"cells": 24, "cell": PAIR}
BREATHERS = {"system": "condensed", "start_frequency": [1400.0], "points": 12, "truncation": 1e-4}


def branches(case: Any, folder: Path) -> None:
    """Follow the branches of a ``case``, into ``folder``."""
    follow_all(case, folder, MPI.COMM_SELF)


def law(case: LawCase, folder: Path) -> None:
    """Compute the scattering law of a ``case``, into ``folder``."""
    one_site.STUDY.run(case, folder, MPI.COMM_SELF)


def nnm(**options: Any) -> dict[str, Any]:
    """Return the table of a branch of modes; the default ranges of energy and frequency are numbers."""
    return {"nnm": {"modes": [2], "points": 30, "energy": [0.0, 1e3], "frequency": [0.0, 1e5]} | options}


# The studies by name: the table of a case, its class, what computes it, and the tolerance of its numbers. Harmonics
# pass through eigenvalue problems, whose rounding differs with the size of the numbers.
STUDIES: dict[str, tuple[dict[str, Any], Any, Callable[[Any, Path], None], float]] = {
    "smooth modes": (nnm(system="own", own=KERSCHEN, start_energy=1e-3, energy=[0.0, 10.0]), NnmCase, branches, 0.0),
    "modes in contact": ({"lattice": LATTICE, "contacts": SITE, **nnm()}, NnmCase, branches, 0.0),
    "breathers": ({"lattice": LATTICE, "contacts": SITE, **nnm(**BREATHERS)}, NnmCase, branches, 1e-6),
    "responses": (
        {
            "lattice": LATTICE,
            "contacts": SITE | {"restitution": 0.8},
            "drive": {"frequency": 800.0},
            "nfrc": {"range": [0.8, 1.1], "harmonics": 9, "fixed": [900.0]},
        },
        NfrcCase,
        branches,
        1e-12,
    ),
    "scattering": (
        {
            "lattice": {"cell": PAIR},
            "contacts": SITE | {"sites": [2]},
            "drive": {"band": 2, "at": "max-group-velocity", "cycles": 4},
            # The default interval is rounded to a short decimal number.
            "time": {"sample_interval": 5e-4},
            "law": {"largest": 1.2, "samples": 1, "tolerance": 0.5, "finest": 0.2},
        },
        LawCase,
        law,
        1e-9,
    ),
}
KEYS = {"contacts.stiffness": "N/m", "nfrc.fixed": "rad/s"}
# How many steps a method took, and what is left at its solution, depend on the last digits.
OF_THE_SEARCH = ("newton", "residual", "slope", "next_step")


# Each change of units is tried with every other study: motions have both (test_laws_of_motion).
@pytest.mark.parametrize(
    ("name", "units"), [(name, (TINY, HUGE)[number % 2]) for number, name in enumerate(STUDIES)], ids=[*STUDIES]
)
def test_studies_do_not_depend_on_units(name, units, tmp_path):
    """No threshold, floor or first step of a method is absolute."""
    table, of, run, tolerance = STUDIES[name]
    for folder, of_units in (("found", units.of_table(table, KEYS)), ("expected", table)):
        (tmp_path / folder).mkdir()
        run(of.from_table(of_units), tmp_path / folder)
    expected = sorted((tmp_path / "expected").glob("*.h5"))
    found = sorted((tmp_path / "found").glob("*.h5"))
    assert expected and len(found) == len(expected)
    for pair in zip(found, expected, strict=True):
        assert_same_file(*pair, units, tolerance)


def assert_same_file(found: Path, expected: Path, units: Units, tolerance: float) -> None:
    """Assert that the datasets of two files are the same in other ``units``."""
    compared = 0
    with h5py.File(found) as new, h5py.File(expected) as old:
        names: list[str] = []
        old.visititems(lambda name, item: names.append(name) if isinstance(item, h5py.Dataset) else None)
        for name in names:
            values = old[name][()]
            if name.split("/")[-1] in OF_THE_SEARCH or np.asarray(values).dtype.kind not in "fciu":
                continue
            if np.asarray(values).dtype.kind == "f":
                values = values * units.factor(old[name].attrs.get("units", "1"))
            largest = np.max(np.abs(values[np.isfinite(values)]), initial=0.0)
            np.testing.assert_allclose(new[name][()], values, rtol=0, atol=tolerance * largest, err_msg=name)
            compared += 1
    assert compared > 5
