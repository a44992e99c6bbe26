"""Curves of special points over frequency and amplitude: closed forms, and curves at other amplitudes."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from tests.steady_states import CUBIC_OSCILLATOR
from tests.verify.test_special_responses import FLIP, PAIR, UNEVEN, case_of
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.section import CaseError
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import follow_all

pytestmark = pytest.mark.parallel(1)
DAMPING = 0.1


def duffing(**nfrc) -> NfrcCase:
    """Return the case of the cubic oscillator by one harmonic, with the curve of its folds."""
    options = {
        "source": "force",
        "over": "frequency",
        "range": [0.5, 2.0],
        "fixed": [0.2],
        "harmonics": 1,
        "isola_reach": 4.5,
    }
    drive = {"waveform": "harmonic", "frequency": 1.0, "amplitude": 1.0, "cell": 1}
    tables = CUBIC_OSCILLATOR | {"name": "duffing", "drive": drive, "time": {"end": 1.0}}
    return NfrcCase.from_table(tables | {"nfrc": options | {"curves_of": ["fold"]} | nfrc})


def test_folds_of_the_duffing_oscillator(tmp_path):
    """On the curve (s - 3A/4)(s - 9A/4) + (c w)^2 = 0 with s = w^2 - 1; its cusp has s = sqrt(3) c w, A = 8s/9.

    A is the square of the motion's amplitude: of one harmonic F^2 = A ((3A/4 - s)^2 + (c w)^2), and dF/dA = 0.
    """
    curve, *special = follow_all(duffing(), tmp_path, MPI.COMM_SELF)
    # Both folds lie on one curve, which is followed in both directions.
    assert [branch.name for branch in special] == [f"{curve.name}-fold-curve-1{end}" for end in ("", "-back")]
    for branch in special:
        for point in branch.points:
            omega = point.measured.frequency
            shift = omega**2 - 1
            z = point.measured.outputs["spring_harmonics"] + 1j * point.measured.outputs["spring_harmonics_imaginary"]
            square = abs(z[0, 1]) ** 2
            loss = (DAMPING * omega) ** 2
            assert (shift - 0.75 * square) * (shift - 2.25 * square) + loss == pytest.approx(0, abs=1e-8)
            force = np.sqrt(square * ((0.75 * square - shift) ** 2 + loss))
            assert point.measured.amplitude == pytest.approx(force, rel=1e-9)

    (cusp,) = [point for branch in special for point in branch.points if point.kind == "cusp"]
    omega = (np.sqrt(3) * DAMPING + np.sqrt(3 * DAMPING**2 + 4)) / 2
    shift = omega**2 - 1
    force = np.sqrt(8 * shift / 9 * ((2 * shift / 3 - shift) ** 2 + (DAMPING * omega) ** 2))
    assert [cusp.measured.frequency, cusp.measured.amplitude] == pytest.approx([omega, force], rel=1e-8)
    stored = read_branch(tmp_path / f"branch-{special[1].name}.h5")
    assert [point.kind for point in stored.points] == [point.kind for point in special[1].points]


@pytest.mark.parametrize(
    "changes, kind",
    [(FLIP, "period-doubling"), (PAIR, "neimark-sacker"), (UNEVEN, "branch-point")],
    ids=["flip", "pair", "uneven"],
)
def test_the_curve_meets_special_points_of_other_amplitudes(changes, kind):
    """A special point that a curve over the frequency has at another amplitude lies on the curve of special points."""
    options = {"harmonics": 21, "isola_reach": 1.03, "points": 300}
    _, *special = follow_all(case_of(changes, curves_of=[kind], largest_step=0.05, **options), None, MPI.COMM_SELF)
    amplitude = 0.205
    (other,) = follow_all(case_of(changes, fixed=[amplitude], **options), None, MPI.COMM_SELF)
    expected = next(point.measured.frequency for point in other.points if point.kind == kind)

    passed = []
    for branch in special:
        assert branch.about["special"] == kind
        frequencies = np.array([point.measured.frequency for point in branch.points])
        amplitudes = np.array([point.measured.amplitude for point in branch.points])
        # A short step: a line errs by its square.
        for i in np.flatnonzero(np.diff(np.sign(amplitudes - amplitude))):
            place = (amplitude - amplitudes[i]) / (amplitudes[i + 1] - amplitudes[i])
            passed.append(frequencies[i] + place * (frequencies[i + 1] - frequencies[i]))
    assert np.abs(np.array(passed) - expected).min() < 2e-4
    at_first = [branch.points[0].measured.frequency for branch in special]
    assert abs(min(at_first, key=lambda value: abs(value - expected)) - expected) > 1e-3


def test_other_parameters_are_refused():
    """Curves of special points begin on curves over the frequency."""
    with pytest.raises(CaseError, match=r"curves_of"):
        duffing(over="amplitude", range=[0.1, 0.3], fixed=[1.2])
