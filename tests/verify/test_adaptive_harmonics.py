"""Curves of steady states with as many harmonics at each state as a truncation needs."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest

from tests.steady_states import curve_of, nfrc_case
from vipetsc.cli.verbs.branch_verbs import curve_rows
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.responses import ResponseMethod

pytestmark = pytest.mark.parallel(1)

ALLOWED = 1e-4
CURVES = {
    "amplitude": {},
    "contacts.restitution": {
        "over": "contacts.restitution",
        "range": [0.97, 1.0],
        "fixed": [1.05],
        "largest_step": 0.5,
    },
}


@pytest.fixture(scope="module")
def over_amplitude(tmp_path_factory):
    """The case and the curve over the amplitude."""
    case = nfrc_case(truncation=ALLOWED, harmonics=61)
    return case, curve_of(case, tmp_path_factory.mktemp("whole"))


def orders_of(curve) -> np.ndarray:
    """The highest harmonic (point,) of each state of a curve."""
    return np.array([np.flatnonzero(np.abs(p.measured.harmonics).max(axis=0)).max() for p in curve.points])


@pytest.mark.parametrize("over", CURVES)
def test_states_have_as_many_harmonics_as_the_truncation_needs(tmp_path, over, over_amplitude):
    """All have less than is allowed left out and solve their equations; folds are near those of all harmonics."""
    options = CURVES[over] | {"harmonics": 61}
    case, curve = over_amplitude
    if over != "amplitude":
        case = nfrc_case(truncation=ALLOWED, **options)
        curve = curve_of(case, tmp_path / "few")
    orders = orders_of(curve)
    assert 15 < orders[1:-1].max() < 61
    assert over != "amplitude" or len(set(orders[1:-1])) > 2
    assert max(point.measured.truncation for point in curve.points) < ALLOWED

    states = ResponseMethod(case).problem(0)
    for point in curve.points[2:-1:7]:
        of_point = states.of_state(point.xi)
        assert of_point.balance.order < 61
        inner = of_point.resized(point.xi)
        assert np.abs(of_point.residual(inner, of_point.shift_near(inner))).max() < 1e-10

    if over == "amplitude":
        whole = curve_of(nfrc_case(**options), tmp_path / "all")
        folds = [[p.xi[-1] for p in c.points if p.kind == "fold"] for c in (curve, whole)]
        assert folds[0]
        np.testing.assert_allclose(*folds, rtol=3e-4)

        # A state may have too few harmonics for its perturbations: the summary says which key gives it more.
        first = curve.points[0]
        curve.points[0] = replace(first, measures=first.measured._replace(unstable=-1))
        assert "nfrc.truncation" in dict(curve_rows(case, curve))["undecided"]


def test_a_stopped_curve_goes_on_to_the_same_bits(tmp_path, over_amplitude):
    case, whole = over_amplitude
    parts = tmp_path / "parts"
    curve_of(nfrc_case(truncation=ALLOWED, harmonics=61, points=12), parts)
    (resumed,) = follow_all(case, parts, MPI.COMM_SELF, resume=True)
    assert [p.xi.tolist() for p in resumed.points] == [p.xi.tolist() for p in whole.points]
