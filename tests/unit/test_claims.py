"""Verdicts on the paper's claims follow from numbers and thresholds, on either side of each threshold."""

from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from tests.unit.claim_files import measure
from vipetsc.paper.claims import measure_claims
from vipetsc.paper.claims.criteria import CLAIMS, FAILS, HOLDS, IN_PART, UNMEASURED, Criterion, verdict
from vipetsc.paper.claims.evidence import AmplitudeCurve

IDS = [f"C{number}" for number in range(1, 19)]


def contactless_curve(amplitude: list[float] | np.ndarray, value: list[float] | np.ndarray) -> AmplitudeCurve:
    """Return a curve of values over the amplitude, of runs without contact."""
    data = {"value": ("amplitude", value), "contact_episodes": ("amplitude", np.zeros(len(value)))}
    return AmplitudeCurve(xr.Dataset(data, {"amplitude": amplitude}, {"folder": "step"}), "value")


@given(st.floats(-1e6, 1e6), st.floats(0, 1e6), st.floats(-2e6, 2e6))
def test_a_criterion_is_met_within_its_bounds_alone(low, width, value):
    """A value meets a criterion from its lower to its upper bound; NaN does not."""
    high = low + width
    criterion = Criterion(quantity="x", comparison="within", threshold=(low, high), unit="", source="")
    # Bounds have a tolerance of 1e-9, so that rounding does not decide.
    assert criterion.met(value) == (low - 1e-9 <= value <= high + 1e-9)
    assert not criterion.met(float("nan"))
    assert f"{low:.4g} to {high:.4g}" in str(criterion)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"a": 1.0, "b": 1.0}, HOLDS),
        ({"a": 1.0, "b": 3.0}, IN_PART),
        # The criterion a is decisive.
        ({"a": 3.0, "b": 1.0}, FAILS),
        ({"a": 3.0, "b": 3.0}, FAILS),
        ({"a": 1.0, "b": None}, IN_PART),
        ({"a": 1.0}, IN_PART),
        ({"a": float("nan"), "b": 1.0}, FAILS),
        ({}, UNMEASURED),
    ],
)
def test_a_claim_holds_by_all_of_its_criteria_and_fails_by_a_decisive_one(values, expected):
    """A claim holds if all criteria are met, fails if a decisive one or all are missed, and else holds in part.

    A criterion without a value is missed; a claim without values is unmeasured.
    """
    criteria = (Criterion("a", "<=", 2, "", "", decisive=True), Criterion("b", "<=", 2, "", ""))
    judgement, _ = verdict(criteria, values)
    assert judgement == expected


@given(st.integers(2, 9), st.floats(1.1, 3.0))
def test_a_rise_is_measured_between_neighbouring_amplitudes(steps, ratio):
    """A curve that jumps between two amplitudes has their ratio as its growth."""
    levels = np.arange(steps + 3)
    value = np.where(levels < steps, 0.01, 1.0)
    assert contactless_curve(ratio**levels, value).growth_ratio(0.1, 0.5) == pytest.approx(ratio)
    # A curve that is high from the beginning has no rise.
    assert np.isnan(contactless_curve(ratio**levels, value + 1).growth_ratio(0.1, 0.5))


CRITERIA = [(claim, criterion) for claim, spec in CLAIMS.items() for criterion in spec.criteria]


def finite(values: tuple[float, ...]) -> list[float]:
    return [value for value in values if np.isfinite(value)]


def value_that_meets(criterion: Criterion) -> float:
    if criterion.comparison == "of":
        return 1.0
    return finite(criterion.interval)[0]


@pytest.mark.parametrize(
    ("claim", "criterion"), CRITERIA, ids=[f"{claim} {criterion.quantity}" for claim, criterion in CRITERIA]
)
def test_a_number_on_either_side_of_its_threshold_decides(claim, criterion):
    """Each criterion is met just inside its threshold; just outside it is missed, which changes the verdict."""
    criteria = CLAIMS[claim].criteria
    values = {each.quantity: value_that_meets(each) for each in criteria}
    low, high = criterion.interval
    if criterion.comparison == "of":
        # Thresholds of counts are "so many of so many".
        inside = [low / high]
        outside = [(low - 1) / high]
    else:
        # The distance from a bound is a hundredth of the larger bound, or 0.01 where that is zero: far above rounding.
        size = 1e-2 * max(map(abs, finite((low, high)))) or 1e-2
        inside = finite((low + size, high - size))
        outside = finite((low - size, high + size))

    for value in inside:
        assert verdict(criteria, values | {criterion.quantity: value}) == (HOLDS, [])
    is_alone = len(criteria) == 1
    for value in outside:
        judgement, missed = verdict(criteria, values | {criterion.quantity: value})
        assert judgement == (FAILS if criterion.decisive or is_alone else IN_PART)
        assert missed == [criterion.quantity]


def test_without_files_nothing_is_measured_and_thresholds_stand(tmp_path):
    """Without files every claim is unmeasured and has its reason, thresholds and figure."""
    rows = [SimpleNamespace(**row) for row in measure_claims(tmp_path)]

    assert [(row.id, row.reading) for row in rows] == [(id, reading) for id in IDS for reading in CLAIMS[id].readings]
    assert list(CLAIMS) == IDS
    for row in rows:
        assert row.verdict == UNMEASURED
        assert "missing" in row.reason
        assert not row.files
        assert not row.value
        for criterion in CLAIMS[row.id].criteria:
            assert str(criterion) in row.threshold
            assert all(f"{bound:.4g}" in str(criterion) for bound in finite(criterion.interval))
        # Names of figures are complete, and claims are sentences.
        assert row.figure
        assert "{" not in row.figure
        assert row.claim.endswith(".")


def test_a_broken_file_is_named_and_stops_no_other_claim(tmp_path):
    file = tmp_path / "design" / "design.h5"
    file.parent.mkdir()
    file.write_bytes(b"not HDF5")
    claims = {row["id"]: row for row in measure_claims(tmp_path)}
    assert claims["C10"]["verdict"] == UNMEASURED
    assert "design.h5" in claims["C10"]["reason"]
    # The text of a report does not depend on the folder of its files.
    assert str(tmp_path) not in claims["C10"]["reason"]

    with h5py.File(file, "w") as incomplete:
        incomplete["reading"] = ["printed"]
    again = measure("C10", tmp_path)
    assert again.verdict == UNMEASURED
    assert again.files == ["design/design.h5"]
