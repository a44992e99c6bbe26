"""Verdicts on the paper's claims follow from numbers and thresholds, and the thresholds are those listed here."""

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
from vipetsc.paper.cell_costs import PAPER_CELL
from vipetsc.paper.claims import criteria as constants
from vipetsc.paper.claims import measure_claims, write_claims
from vipetsc.paper.claims.criteria import CLAIMS, FAILS, HOLDS, IN_PART, LAWS, UNMEASURED, Criterion, verdict
from vipetsc.paper.claims.evidence import AmplitudeCurve, Evidence, MissingEvidence
from vipetsc.paper.claims.measure import measure_claim, rounded
from vipetsc.spectra import FEWEST

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


# The thresholds, apart from the file that the program reads: who changes one has to change both. A line is "claim |
# quantity | comparison | threshold"; * stands for both laws.
SPECIFIED = """
C1 | ridge's largest distance from the optical branch | <= | 1
C1 | loudest wavenumber's distance from 5 pi/9 | <= | 1
C2 | contact episodes at low amplitude | <= | 0
C2 | largest fraction of the energy that changes its wavenumber | <= | 0.01
C3 | fraction at new wavenumbers, medium amplitude | >= | 0.1
C3 | fraction at new wavenumbers, medium over low amplitude | >= | 10
C3 | fraction within 2 % of the top edge from the Bloch branches | >= | 0.95
C4 | new wavenumbers, high over medium amplitude | <= | 1
C4 | fraction of the incident energy reflected, high amplitude | >= | 0.5
C5 | smallest fraction in bins 7 and 8, Fourier | >= | 0.99
C5 | smallest fraction in bins 7 and 8, wavelet | >= | 0.85
C6 | largest error of the reconstructed kinetic energy after the drive | <= | 0.01
C7 | floor of the normalised entropy | <= | 0.1
C7 | fraction of configurations with an abrupt rise | of | 4 6
C7 | fraction of configurations with the peak at 0.9 to 1.8 N | of | 4 6
C7 | normalised entropy at 10 N behind the peak, 3 sites or more | <= | 0.17
C7 | fraction of configurations of spread sites with adjusted R^2 >= 0.95 over 4 points or more | of | 4 6
C7 | fraction of configurations of neighbouring sites with adjusted R^2 >= 0.95 over 4 points or more | of | 4 6
C8 | fraction of curves that rise, peak and fall by half | of | 30 36
C8 | fraction of curves with adjusted R^2 >= 0.9 over 4 points or more | of | 30 36
C9 | fraction of configurations with larger error bars from 10 N on than at the peak | of | 4 6
C9 | fraction of configurations with larger error bars from 10 N on than without contact | of | 4 6
C10 | lambda at the optimum of a grid of 0.1 | within | 0.05 0.15
C10 | eta at the optimum of a grid of 0.1 | within | 0.45 0.55
C10 | u2 and u3 out of phase on band 2 at the paper's cell (1 = yes) | >= | 1
C11 | floor* | within | 3.1622776601683795e-05 0.00031622776601683794
C11 | ratio of amplitudes from the floor to half the maximum* | <= | 3.1622776601683795
C11 | maximum* | within | 0.28 0.36
C12 | medium over low amplitude* | >= | 1
C12 | medium over high amplitude* | >= | 1
C13 | largest error of the mean over the record | <= | 0.01
C13 | mean error over a period of the drive, largest of the runs | <= | 0.01
C13 | largest fraction outside the paper's bands and gaps | <= | 0.01
C13 | largest difference of a part's fraction from that in the space-time spectrum | <= | 0.01
C13 | bound on the relative error of the modal energies' sum at any sample | <= | 1e-6
C14 | maximum with one site* | within | 0.05 0.15
C14 | maximum with one site over that with five* | <= | 1
C14 | correlation of 15 and 30 cycles* | >= | 0.9
C14 | ratio of the peaks' amplitudes, 15 and 30 cycles* | <= | 2
C15 | regions* | >= | 4
C15 | largest |d ln f / d ln E| in region I* | <= | 1e-06
C15 | energy folds in region II* | >= | 2
C15 | largest |multiplier| in region II* | >= | 1.001
C15 | adjusted R^2 of the slope in region III* | >= | 0.95
C15 | last frequency's relative distance from the limit, bilinear | <= | 0.01
C15 | last d ln f / d ln E's distance from the 3/2 law's .1, hertz | <= | 0.01
C16 | adjusted R^2 in region III* | >= | 0.95
C16 | difference of the exponents* | <= | 0.2
C16 | mean factor between transfer and slope* | <= | 2
C17 | I: correlation of host and resonator* | <= | -0.9
C17 | II: correlation with the motion without contact* | >= | 0.9
C17 | III: largest fraction of energy above the driven band* | >= | 0.1
C17 | IV: correlation of host and resonator* | >= | 0.99
C17 | IV: fraction of energy above the driven band* | <= | 0.01
C18 | rms of the upper bands' energy at the end, in decades* | <= | 0.06
C18 | largest error of the dissipated fraction* | <= | 0.04
C18 | amplitudes with contact on one side alone* | <= | 0
"""


CRITERIA = [(claim, criterion) for claim, spec in CLAIMS.items() for criterion in spec.criteria]


def test_thresholds_are_those_specified():
    """Quantities, comparisons and thresholds of all claims are those of ``SPECIFIED``, each with its source."""
    expected = set()
    for line in SPECIFIED.strip().splitlines():
        claim, quantity, comparison, bounds = line.split(" | ")
        numbers = tuple(map(float, bounds.split()))
        threshold = numbers if len(numbers) > 1 else numbers[0]
        for law in LAWS if quantity.endswith("*") else ("",):
            name = quantity.replace("*", f", {law}")
            expected.add((claim, name, comparison, threshold))

    assert {(claim, c.quantity, c.comparison, c.threshold) for claim, c in CRITERIA} == expected
    assert len(CRITERIA) == len(expected)
    assert all(c.source for _, c in CRITERIA)
    decisive = {(claim, c.threshold) for claim, c in CRITERIA if c.decisive}
    assert decisive == {("C2", 0), ("C3", 0.1), ("C3", 10), ("C13", 0.01)}


def test_constants_inside_of_quantities_are_those_specified():
    """Constants within the definitions of quantities have these values, and Hertz's limit is that of its formula."""
    assert (constants.STRAIGHT, constants.STRAIGHT_EVERYWHERE) == (0.95, 0.9)
    assert (FEWEST, constants.SEVERAL) == (4, 3)
    assert (constants.QUIET, constants.PEAK, constants.HIGH) == (0.1, (0.9, 1.8), 10.0)
    assert (constants.ABRUPT, constants.LOW) == (10**0.5, 10)
    assert (constants.HALF_WIDTH, constants.NATIVE) == (0.02, (7, 8))
    assert (PAPER_CELL, constants.GRID) == ((0.1, 0.5), 0.1)
    assert constants.COUNTED == ("band 1", "band 2", "band 3", "band 4", "gap 1", "gap 3")
    # (n - 1)/(2 (n + 1)) for the exponent n = 3/2 of Hertz's law.
    assert pytest.approx((1.5 - 1) / (2 * (1.5 + 1))) == constants.HERTZ_LIMIT


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
