"""Verdicts on the paper's claims follow from numbers and thresholds, on either side of each threshold."""

import errno
import json
import os
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st

from tests.unit.claim_files import measure, put_sweep
from vipetsc.paper.claims import measure_claims, write_claims
from vipetsc.paper.claims.criteria import CLAIMS, FAILS, HOLDS, IN_PART, UNMEASURED, Criterion, verdict
from vipetsc.paper.claims.evidence import AmplitudeCurve, Evidence, MissingEvidence
from vipetsc.paper.claims.measure import measure_claim, rounded

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


def test_a_criterion_of_counts_is_met_from_its_number_on():
    criterion = Criterion("fraction of curves", "of", (4, 6), "", "")
    assert criterion.met(4 / 6)
    assert criterion.met(2 / 3)
    assert not criterion.met(0.5)
    assert str(criterion) == "fraction of curves: at least 4 of 6"


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


def test_numbers_of_a_report_are_rounded_and_finite():
    values = {"a": 0.123456789, "b": np.float64("nan"), "c": np.int64(3), "d": None, "e": float("inf")}
    assert rounded(values) == {"a": 0.123457, "b": None, "c": 3.0, "d": None, "e": None}


@given(st.integers(2, 9), st.floats(1.1, 3.0))
def test_a_rise_is_measured_between_neighbouring_amplitudes(steps, ratio):
    """A curve that jumps between two amplitudes has their ratio as its growth."""
    levels = np.arange(steps + 3)
    value = np.where(levels < steps, 0.01, 1.0)
    assert contactless_curve(ratio**levels, value).growth_ratio(0.1, 0.5) == pytest.approx(ratio)
    # A curve that is high from the beginning has no rise.
    assert np.isnan(contactless_curve(ratio**levels, value + 1).growth_ratio(0.1, 0.5))


def test_a_growth_ends_at_the_first_value_that_is_high_enough():
    """The growth is the ratio of the first amplitude at 0.5 or more to the last one before it at 0.1 or less."""
    curve = contactless_curve([1.0, 2.0, 4.0, 8.0, 16.0], [0.3, 0.01, 0.6, 0.8, 1.0])
    assert curve.growth_ratio(0.1, 0.5) == 2.0

    # A rise after the peak does not count.
    late = contactless_curve([1.0, 2.0, 8.0, 9.0], [0.01, 1.0, 0.05, 0.6])
    assert late.growth_ratio(0.1, 0.5) == 2.0


def test_a_curve_that_stays_on_its_floor_does_not_grow():
    # Ten times the floor is above all values, as in a sweep without contacts.
    floor = contactless_curve([1.0, 2.0, 4.0], [0.9, 1.0, 1.1])
    assert np.isnan(floor.growth_ratio(10.0, 0.55))


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


def test_json_is_strict_and_the_same_every_time(tmp_path):
    for name in ("a", "b"):
        write_claims(measure_claims(tmp_path), tmp_path / f"{name}.json")
    text = (tmp_path / "a.json").read_text()
    assert text == (tmp_path / "b.json").read_text()

    rows = json.loads(text)
    fields = {"id", "reading", "claim", "value", "uncertainty", "threshold", "verdict", "reason", "figure", "files"}
    assert len(rows) == 35
    assert all(row.keys() == fields for row in rows)
    # No temporary file stays.
    assert not list(tmp_path.glob(".*.part"))


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


def test_a_reading_that_is_not_there_is_not_measured(tmp_path):
    table = {"lattice": {"preset": "diatomic", "reading": "calibrated"}, "sweep": {"drive": {"amplitude": [0.1, 1.0]}}}
    put_sweep(tmp_path / "scattering", table, content=lambda case: {}, episodes=lambda case: 0)
    with Evidence(tmp_path) as evidence:
        assert list(evidence.select("scattering", "calibrated")["amplitude"].values) == [0.1, 1.0]
        with pytest.raises(MissingEvidence, match="calibrated"):
            evidence.select("scattering", "printed")
        assert evidence.files == ["scattering/ensemble.h5"]


@pytest.mark.parametrize(("number", "is_kept"), [(errno.EIO, False), (errno.ESTALE, False), (None, True)])
def test_a_claim_is_not_judged_by_a_disk_that_fails_for_a_moment(monkeypatch, tmp_path, number, is_kept):
    """An error of the file system ends the paper, since verdicts are kept; a file that was cut off is a reason."""

    def fail(path: Path, *more: object) -> None:
        if number is None:
            raise OSError("truncated")
        raise OSError(number, os.strerror(number), str(path))

    (tmp_path / "design").mkdir()
    (tmp_path / "design" / "design.h5").touch()
    monkeypatch.setattr("vipetsc.paper.claims.evidence.open_netcdf", fail)
    with Evidence(tmp_path) as evidence, nullcontext() if is_kept else pytest.raises(OSError, match=r"design\.h5"):
        row = measure_claim("C10", "calibrated", evidence)
        assert row["verdict"] == UNMEASURED
        assert "truncated" in row["reason"]
