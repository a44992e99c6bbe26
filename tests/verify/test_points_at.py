"""Points of curves and branches at chosen values of any quantity, against closed forms."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scipy.special import ellipk

from tests.steady_states import CUBIC_OSCILLATOR
from vipetsc.case import NnmCase
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.section import CaseError
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import follow_all

pytestmark = pytest.mark.parallel(1)
FORCE = 0.2
DAMPING = 0.1


def response(points_at, **output) -> NfrcCase:
    """Return the case of the cubic oscillator by one harmonic, over the frequency."""
    nfrc = {"source": "force", "over": "frequency", "range": [0.5, 2.0], "fixed": [FORCE], "harmonics": 1}
    drive = {"waveform": "harmonic", "frequency": 1.0, "amplitude": 1.0, "cell": 1}
    tables = CUBIC_OSCILLATOR | {"name": "duffing", "drive": drive, "time": {"end": 1.0}, "output": output}
    return NfrcCase.from_table(tables | {"nfrc": nfrc | {"points_at": points_at}})


def frequencies_at(a: float) -> list[float]:
    """Return the frequencies of the one-harmonic motion of amplitude a: ((1 - w^2 + 3a^2/4)^2 + (cw)^2) a^2 = F^2."""
    b = 1 + 0.75 * a**2
    squares = np.roots([1, DAMPING**2 - 2 * b, b**2 - (FORCE / a) ** 2])
    return sorted(float(w) for w in np.sqrt(squares.astype(complex)) if abs(w.imag) < 1e-12 for w in [w.real])


def test_a_response_at_values_of_three_quantities(tmp_path):
    """States of an amplitude, a frequency and a velocity are those of the closed form, with their names in the file."""
    a = 0.6
    points = [{"name": "mass", "cell": 1}]
    case = response({"first_displacement/mass": [a], "frequency": [1.3], "first_velocity/mass": [0.9]}, points=points)
    (curve,) = follow_all(case, tmp_path, MPI.COMM_SELF)

    at = [point for point in curve.points if point.kind == f"first_displacement/mass@{a}"]
    np.testing.assert_allclose([point.measured.frequency for point in at], frequencies_at(a), rtol=1e-9)
    # Three states have this frequency, between the folds.
    sizes = [p.measured.outputs["first_displacement"][0] for p in curve.points if p.kind == "frequency@1.3"]
    assert len(sizes) == 3
    for size in sizes:
        assert np.abs(np.array(frequencies_at(size)) - 1.3).min() < 1e-9
    speeds = [p.measured for p in curve.points if p.kind == "first_velocity/mass@0.9"]
    assert len(speeds) == 2
    for state in speeds:
        assert state.outputs["first_displacement"][0] * state.frequency == pytest.approx(0.9, rel=1e-9)

    stored = read_branch(tmp_path / f"branch-{curve.name}.h5")
    assert [point.kind for point in stored.points] == [point.kind for point in curve.points]


@pytest.mark.parametrize("method", ["shooting", "balance"])
def test_a_mode_at_an_energy_and_a_frequency(method):
    """The mode of u'' + u + u^3 = 0 has the period of the elliptic integral at both points."""
    spring = {"start": 0, "end": 1}
    system = {"masses": [1.0], "springs": [spring | {"stiffness": 1.0}], "smooth": [spring | {"cubic": 1.0}]}
    nnm = {"system": "own", "own": system, "modes": [1], "energy": [0.0, 1.0], "method": method}
    nnm["points_at"] = {"energy": [0.25], "frequency": [1.2]}
    (branch,) = follow_all(NnmCase.from_table({"name": "x", "nnm": nnm}), None, MPI.COMM_SELF)
    (at_energy,) = [point for point in branch.points if point.kind == "energy@0.25"]
    (at_frequency,) = [point for point in branch.points if point.kind == "frequency@1.2"]
    assert at_energy.energy == pytest.approx(0.25, rel=1e-9)
    assert 2 * np.pi * at_frequency.frequency == pytest.approx(1.2, rel=1e-9)
    for point in (at_energy, at_frequency):
        square = np.sqrt(1 + 4 * point.energy) - 1
        period = 4 * ellipk(square / (2 * (1 + square))) / np.sqrt(1 + square)
        assert point.period == pytest.approx(period, rel=1e-7)


def test_an_unknown_quantity_is_refused():
    """The message names the key, the quantity and those that there are."""
    with pytest.raises(CaseError, match=r"points_at.*size.*largest_elongation"):
        response({"size": [1.0]})
