"""Special points of frequency responses: kinds and places against multipliers by time integration; files of them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.rigs import TWO_MASSES, followed, period_map
from tests.steady_states import motion_at
from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes.response.stability_changes import StabilityChanges
from vipetsc.modes.response.state import Response
from vipetsc.modes.stability import Hill, Stability

pytestmark = pytest.mark.parallel(1)

# Changes of the rig of two masses with a stop, with the ranges in rad/s in which a complex pair of multipliers passes
# the unit circle, one passes -1, and one passes +1, beyond which the motion is asymmetric.
PAIR = {"nfrc": {"range": [1.12, 1.24]}}
FLIP = {"contacts": {"clearance": 0.1}, "nfrc": {"range": [1.05, 1.15]}}
UNEVEN = {"contacts": {"side": "both", "clearance": 0.05}, "nfrc": {"range": [0.9, 0.95]}}


def case_of(changes: dict[str, Any], **nfrc: Any) -> NfrcCase:
    """The case of two masses with ``changes`` by section, in long steps; ``nfrc`` updates the table [nfrc]."""
    table = TWO_MASSES | {"nfrc": TWO_MASSES["nfrc"] | {"harmonics": 41, "largest_step": 1.0}}
    table |= {section: table[section] | values for section, values in changes.items()}
    return NfrcCase.from_table(table | {"nfrc": table["nfrc"] | nfrc})


@pytest.fixture(scope="module")
def with_pair(tmp_path_factory):
    """The steady states and the points of the curve on which a pair of multipliers passes the unit circle."""
    return followed(case_of(PAIR), tmp_path_factory.mktemp("pair") / "rig")


def multipliers_at(states, point) -> np.ndarray:
    """The Floquet multipliers (4,) of a state, by differences of the period map."""
    state = np.ravel(motion_at(states, point.xi, np.arange(2)))
    return period_map(states, point, state).multipliers


@pytest.mark.parametrize(
    ("changes", "kind", "count"),
    [(PAIR, "neimark-sacker", 2), (FLIP, "period-doubling", 2), (UNEVEN, "branch-point", 1)],
)
def test_a_special_point_has_the_multiplier_of_its_kind(changes, kind, count, tmp_path, request):
    """SciPy's period map at a special point has the multiplier of its kind: -1, 1, or a pair on the unit circle."""
    if changes is PAIR:
        states, points = request.getfixturevalue("with_pair")
    else:
        states, points = followed(case_of(changes), tmp_path / "rig")
    special = [point for point in points if point.kind != "regular"]
    assert [point.kind for point in special] == [kind] * count
    for point in special:
        found = multipliers_at(states, point)
        if kind == "neimark-sacker":
            pair = found[np.argsort(np.abs(np.abs(found) - 1))[:2]]
            np.testing.assert_allclose(np.abs(pair), 1, atol=3e-3)
            np.testing.assert_allclose(np.abs(np.angle(pair)) / (2 * np.pi), point.measured.sideband, atol=1e-3)
        else:
            critical = -1 if kind == "period-doubling" else 1
            assert np.abs(found - critical).min() < 1e-2
            assert point.measured.sideband == (0.5 if critical < 0 else 0.0)
        # Only the critical multipliers have a modulus of 1.
        assert point.measured.unstable == 0
        assert np.abs(found).max() < 1.01

    # On one side of a special point its multipliers exceed 1, on the other side none does.
    places = [points.index(point) for point in special]
    for place in places:
        around = sorted(points[near].measured.unstable for near in (place - 1, place + 1))
        assert around == [0, 2 if kind == "neimark-sacker" else 1]


def test_folds_are_no_branch_points(tmp_path):
    """Folds are not reported as branch points, although a multiplier is 1 at them as well."""
    states, points = followed(case_of({"nfrc": {"range": [1.2, 1.45]}}, harmonics=31, special_points="all"), tmp_path)
    kinds = [point.kind for point in points if point.kind != "regular"]
    assert kinds.count("fold") == 2
    assert "branch-point" not in kinds
    fold = next(point for point in points if point.kind == "fold")
    assert np.abs(multipliers_at(states, fold) - 1).min() < 5e-3


class States:
    """A stand-in for steady states that has the given ``stabilities``, by the first unknown, and nothing else."""

    options = SimpleNamespace(special_points="all")

    def __init__(self, *stabilities: Stability) -> None:
        self.stabilities = stabilities

    def stability(self, xi: np.ndarray) -> Stability:
        return self.stabilities[int(xi[0])]

    def determinant(self, xi: np.ndarray, exponent: complex) -> float:
        return self.stability(xi).at_one

    def least_growth(self, xi: np.ndarray) -> float:
        return 1e-4

    def growing_pairs(self, xi: np.ndarray) -> list[complex]:
        return []


@pytest.mark.parametrize(
    ("right", "slope", "kinds"),
    [
        (Stability(0, 1.0, 1.0), 1.0, []),
        (Stability(1, -1.0, 1.0), 1.0, ["branch-point"]),
        (Stability(1, -1.0, 1.0), -1.0, []),  # a fold
        (Stability(1, 1.0, -1.0), 1.0, ["period-doubling"]),
        (Stability(2, 1.0, 1.0), 1.0, ["neimark-sacker"]),
        (Stability(2, -1.0, -1.0), -1.0, ["period-doubling"]),
        (Stability(3, 1.0, -1.0), 1.0, ["period-doubling", "neimark-sacker"]),
    ],
)
def test_signs_and_numbers_give_the_kinds(right, slope, kinds):
    """The kinds of special points in a step follow from signs of determinants and the number of multipliers beyond 1.

    A determinant that changes sign is a real multiplier that passes 1 or -1. Complex pairs account for the rest.
    """
    states = States(Stability(0, 1.0, 1.0), right)
    ends = [Response(xi=np.array([float(i)]), tangent=np.array([tangent])) for i, tangent in enumerate((1.0, slope))]
    assert [kind.name for kind in StabilityChanges(states, *ends).kinds()] == kinds


def test_pairs_come_in_the_order_of_their_growth(monkeypatch):
    """Complex pairs are given by their members above the real axis, in the order of growth; real ones are left out."""
    zeros = [0.2 + 0.1j, 0.2 - 0.1j, 0.3 + 0j, 0.1 + 0.4j, 0.1 - 0.4j, 0.15 + 0.5j]
    monkeypatch.setattr(Hill, "_beyond", lambda self, series, growth: zeros)
    hill = Hill(None, omega=1.0, order=3, odd=False, finite=True)
    assert hill.pairs(None) == [0.1 + 0.4j, 0.2 + 0.1j]
