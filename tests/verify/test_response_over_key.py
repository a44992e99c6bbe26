"""Responses over a key of the case: states as over the frequency, stability, ends of curves and refusals."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest

from tests.rigs import TWO_MASSES, period_map
from tests.steady_states import motion_at
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.reading import put
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.responses import ResponseMethod
from vipetsc.modes.branches.sweeps import parameter_values
from vipetsc.modes.response.state import Response
from vipetsc.modes.response.steps import first_state

pytestmark = pytest.mark.parallel(1)

FREQUENCY = 1.5  # rad/s
# With this clearance the motion of the wall below closes the contact at 1.5 rad/s.
CLOSER = TWO_MASSES | {"contacts": TWO_MASSES["contacts"] | {"clearance": 0.12}}
STEPS = {"first_step": 0.2, "largest_step": 1.0, "harmonics": 11}


def over(key: str, low: float, high: float, table: dict[str, Any] = TWO_MASSES, **nfrc: Any) -> NfrcCase:
    """The case of two masses with curves over a ``key``, at 1.5 rad/s and an amplitude of 0.2 m of the wall."""
    options = {"source": "force", "over": key, "range": [low, high], "fixed": [0.2], "harmonics": 11} | nfrc
    drive = table["drive"] | {"frequency": FREQUENCY}
    return NfrcCase.from_table(table | {"drive": drive, "nfrc": options})


def equations(case: NfrcCase):
    """The equations of the only curve of a case."""
    return ResponseMethod(case).problem(0)


@pytest.fixture(scope="module")
def clearances(tmp_path_factory):
    """The case, the folder and the curve over the clearance, on which two folds and a period doubling lie."""
    folder = tmp_path_factory.mktemp("clearances")
    case = over("contacts.clearance", 0.125, 0.35, harmonics=31, largest_step=1.0)
    (curve,) = follow_all(case, folder, MPI.COMM_SELF)
    return case, folder, curve


@pytest.fixture(scope="module")
def by_frequency(tmp_path_factory):
    """The curve over the frequency, up to 1.5 rad/s, of two masses with a clearance of 0.12 m."""
    options = STEPS | {"source": "force", "over": "frequency", "range": [1.47, FREQUENCY], "fixed": [0.2]}
    folder = tmp_path_factory.mktemp("by-frequency")
    (curve,) = follow_all(NfrcCase.from_table(CLOSER | {"nfrc": options}), folder, MPI.COMM_SELF)
    return curve


@pytest.mark.parametrize(
    ("key", "low", "high"),
    [("contacts.clearance", 0.1, 0.12), ("lattice.cell.masses[1]", 0.98, 1.0), ("lattice.damping.mass", 0.05, 0.06)],
)
def test_it_comes_to_the_state_of_the_curve_over_the_frequency(key, low, high, by_frequency, tmp_path):
    """A curve over a key and one over the frequency end in the same state, at the key's upper value and 1.5 rad/s."""
    (by_key,) = follow_all(over(key, low, high, CLOSER, **STEPS), tmp_path, MPI.COMM_SELF)
    assert by_key.ended.sentence.startswith("reached the end")

    # The upper value of each key is that of the lattice of the curve over the frequency.
    case = NfrcCase.from_table(CLOSER)
    changed = case.model_dump(by_alias=True, exclude_none=True)
    assert not put(changed, key, high)
    assert NfrcCase.from_table(changed).model().chain == case.model().chain
    ends = [curve.points[-1].measured for curve in (by_key, by_frequency)]
    assert ends[0].episodes > 0
    # The frequencies are equal to the bit, since a curve ends exactly on its range.
    assert ends[0].frequency == ends[1].frequency == FREQUENCY
    np.testing.assert_allclose(ends[0].harmonics, ends[1].harmonics, atol=1e-10)
    assert ends[0].unstable == ends[1].unstable


def test_newtons_method_converges_quadratically():
    """Newton's method converges quadratically although the column of the key is a difference.

    From a guess that is off by 1e-2 it needs three steps.
    """
    for key, low, high in (("contacts.clearance", 0.1, 0.2), ("lattice.cell.masses[1]", 0.9, 1.0)):
        states = equations(over(key, low, high, CLOSER))
        start = first_state(states)
        frame = states.frame(start)
        attempt = frame.correct(start.xi + 0.05 * start.tangent + 1e-2 * np.sin(np.arange(len(start.xi))), 0.05)
        assert attempt.converged
        # Residuals above 0.1, in which terms of third order matter, are left out.
        first, second, third, *_ = (residual for residual in attempt.history if residual < 0.1)
        # The linear term is the error of the column by differences.
        assert second < 30 * first**2 + 1e-9 * first
        assert third < 30 * second**2 + 1e-9 * second


def test_states_come_back_after_a_period_and_are_stable_as_their_multipliers_are(clearances):
    """States return after a period by SciPy with their own clearance, and are stable as its multipliers say."""
    case, _, curve = clearances
    states = equations(case)
    touching = [point for point in curve.points if point.measured.episodes and point.kind == "regular"]
    unstable = set()
    for number in np.linspace(0, len(touching) - 1, 8).astype(int):
        point = touching[number]
        value = float(point.measured.outputs["parameter"])
        inner = states.states_at(value)
        assert inner.forces.contacts[0].plus == value
        # Unknowns are in units of the clearance, which varies along the curve.
        xi = np.append(point.xi[:-1] * states.clearance / inner.clearance, 0.2 / inner.parameter.scale)
        state = np.concatenate([part.ravel() for part in motion_at(inner, xi, np.arange(2))])
        period = period_map(inner, Response(xi=xi), state)
        assert np.abs(period.end - state).max() < 1e-3 * np.abs(state).max()
        grows = np.abs(period.multipliers) > 1.001
        assert point.measured.unstable == np.count_nonzero(grows)
        unstable.add(point.measured.unstable)
    # Both stable and unstable states are among them.
    assert len(unstable) > 1
    folds = parameter_values(curve)[curve.is_kind("fold")]
    values = parameter_values(curve)
    assert len(folds) == 2
    # There are three states at a clearance between the folds.
    assert np.sum(np.diff(np.sign(values - folds.mean())) != 0) == 3


@pytest.mark.parametrize(("key", "low", "high"), [("contacts.restitution", 0.9, 1.0), ("contacts.clearance", 0.1, 0.2)])
def test_a_curve_ends_on_its_range_where_no_case_lies_beyond(key, low, high, tmp_path):
    case = over(key, low, high, CLOSER, first_step=0.2, largest_step=1.0)
    (curve,) = follow_all(case, tmp_path, MPI.COMM_SELF)
    assert curve.ended.sentence == f"reached the end of nfrc.range, {high:g}"
    assert parameter_values(curve)[[0, -1]].tolist() == [low, high]

    # At a restitution of 1 the state is that of the elastic contact.
    if key == "contacts.restitution":
        alone = NfrcCase.from_table(
            CLOSER
            | {
                "drive": CLOSER["drive"] | {"frequency": FREQUENCY},
                "nfrc": {"source": "force", "range": [0.2, 0.3], "fixed": [FREQUENCY], "harmonics": 11},
            }
        )
        elastic = first_state(equations(alone))
        expected = equations(alone).measured(elastic.xi).harmonics
        np.testing.assert_allclose(curve.points[-1].measured.harmonics, expected, atol=1e-10)
