"""Families of frequency responses over keys of a case: members, files, legends and refusals."""

from __future__ import annotations

import json
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

import vipetsc
from tests.rigs import TWO_MASSES
from vipetsc.case.keys import unit_of
from vipetsc.case.nfrc import NfrcCase
from vipetsc.figures.registry import draw
from vipetsc.figures.response_family import legend_of
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.sweeps import measure

pytestmark = pytest.mark.parallel(1)

SHORT = {"range": [1.2, 1.3], "harmonics": 5, "points": 4}
MASS = "lattice.cell.masses[1]"


def family_case(family: dict[str, Any], drive: dict[str, Any] | None = None, **nfrc: Any) -> NfrcCase:
    """The case of two masses with a ``family`` of curves, and with another ``drive`` if one is given."""
    options = TWO_MASSES["nfrc"] | SHORT | nfrc | {"family": family}
    return NfrcCase.from_table(TWO_MASSES | {"drive": drive or TWO_MASSES["drive"], "nfrc": options})


@pytest.fixture(scope="module")
def family(tmp_path_factory):
    """The folder and the curves of a family over a clearance and a mass."""
    folder = tmp_path_factory.mktemp("family")
    case = family_case({"contacts": {"clearance": [0.8, 0.7]}, MASS: [1.0, 1.1]})
    return folder, follow_all(case, folder, MPI.COMM_SELF)


def test_a_member_is_the_case_with_its_keys(family, tmp_path):
    _, curves = family
    names = [curve.name for curve in curves]
    assert names == [f"clearance-{gap}-masses1-{mass}-r1-0.2" for gap in ("0.8", "0.7") for mass in ("1", "1.1")]

    lattice = TWO_MASSES["lattice"] | {"cell": TWO_MASSES["lattice"]["cell"] | {"masses": [1.1]}}
    contacts = TWO_MASSES["contacts"] | {"clearance": 0.7}
    table = TWO_MASSES | {"lattice": lattice, "contacts": contacts, "nfrc": TWO_MASSES["nfrc"] | SHORT}
    (alone,) = follow_all(NfrcCase.from_table(table), tmp_path, MPI.COMM_SELF)
    assert np.array_equal(measure(alone, "harmonics"), measure(curves[3], "harmonics"))
    assert NfrcCase.from_toml(curves[3].case) == NfrcCase.from_table(table)


def test_files_and_legends_name_the_keys(family):
    folder, _ = family
    (picture,) = [path for path in draw("branches", [folder]) if path.stem == "responses"]
    assert picture.exists()
    curves = []
    for path in sorted(folder.glob("branch-*.h5")):
        with vipetsc.open(path) as data:
            curves.append(data.load())
    assert json.loads(curves[0].attrs["family"]) == {"contacts.clearance": 0.7, MASS: 1.0}
    legend = [text.replace("\u00a0", " ") for text in legend_of(curves)]
    assert legend[0] == "contact clearance 0.7 m, lattice cell masses[1] 1 kg"
    assert len(set(legend)) == 4
    assert unit_of("lattice.cell.springs[1].stiffness", {}) == "N/m"


def test_a_family_is_read_back_and_goes_on(family):
    folder, curves = family
    case = family_case({"contacts": {"clearance": {"linear": [0.8, 0.7], "count": 2}}, MASS: [1.0, 1.1]})
    again = NfrcCase.from_toml(case.to_toml())
    assert [curve.name for curve in again.every_curve()] == [curve.name for curve in curves]
    assert again.physics() == case.physics()
    more = family_case({"contacts": {"clearance": [0.8, 0.7]}, MASS: [1.0, 1.1]}, points=5)
    # The number of points does not belong to the physics: a folder may be continued with more.
    assert more.physics() == case.physics()
    assert other_physics() != case.physics()

    resumed = follow_all(more, folder, MPI.COMM_SELF, resume=True)
    assert [len(curve.regular()) for curve in resumed] == [5] * 4


def other_physics() -> NfrcCase:
    """The physics of a family with another value."""
    return family_case({"contacts": {"clearance": [0.8, 0.6]}, MASS: [1.0, 1.1]}).physics()


def test_what_follows_from_a_key_is_that_of_each_member():
    """Options that follow from a key follow from each member's value: symmetry from sides, dashpots from a loss."""
    sides = family_case({"contacts": {"side": ["plus", "both"]}})
    assert [curve.case.nfrc.symmetric for curve in sides.every_curve()] == [False, True]
    assert [curve.name for curve in sides.every_curve()] == ["side-plus-r1-0.2", "side-both-r1-0.2"]
    drive = {"waveform": "harmonic", "amplitude": 0.1, "frequency": 1.0, "cell": 1, "mass": 1}
    losses = family_case({"lattice": {"damping": [{"mass": 0.1}, {"loss": {"1": 0.02}}]}}, drive)
    first, second = (curve.case.model().chain.cell.grounding[0] for curve in losses.every_curve())
    assert first == pytest.approx(0.1)
    assert 0 < second < 0.1
    assert [curve.name for curve in losses.every_curve()] == ["damping-no-1-r1-0.2", "damping-no-2-r1-0.2"]
