"""Named points and contact forces, compared with the complex compliance, the contact law and the system's matrices."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.conftest import run_of, small_case
from vipetsc.case import Case
from vipetsc.spectra import histories
from vipetsc.studies.analysis import analyse

FREQUENCY = 900.0
FORCE = 2.0
BASE = {"name": "base", "cell": 2}
TIP = {"name": "tip", "cell": 6, "mass": 2}
DIATOMIC = {
    "masses": [0.01, 0.004],
    "springs": [{"start": 1, "end": 1, "stiffness": 2e4, "next_cell": True}, {"start": 1, "end": 2, "stiffness": 6e3}],
}


def shaken(engine: str) -> Case:
    """A damped lattice of two masses a cell under a harmonic force, of which two points alone are recorded."""
    table = {
        "lattice": {"cells": 24, "cell": DIATOMIC, "damping": {"mass": 60.0, "stiffness": 2e-5}},
        "drive": {"waveform": "harmonic", "amplitude": FORCE, "frequency": FREQUENCY, "cell": 2},
        # By the end of the run free vibrations have decayed to about 1e-8.
        "time": {"end": 0.6, "engine": engine},
        "output": {"fields": [], "points": [BASE, TIP], "transmission": [["base", "tip"]]},
    }
    return Case.from_table(table)


@pytest.fixture(scope="module", params=["ts", "propagator"])
def steady_run(request):
    """The run of ``shaken`` by either engine."""
    run = run_of(shaken(request.param))
    # An engine that refuses the case would be replaced by the other one.
    assert json.loads(json.dumps(run.attrs["statistics"]))["engine"] == request.param
    return run


def test_steady_amplitudes_are_those_of_the_complex_compliance(steady_run):
    """Steady amplitudes and transmission are those of (K + i w C - w^2 M) U = F, w |U| and w^2 |U|."""
    chain = Case.of(steady_run).model().chain
    stiffness = chain.stiffness_matrix().toarray()
    damping = chain.damping_rows(0, chain.cells).toarray()
    force = np.zeros(len(stiffness))
    force[2] = FORCE
    dynamic = stiffness + 1j * FREQUENCY * damping - FREQUENCY**2 * np.diag(chain.masses())
    # The rows are mass 1 of cell 2 and mass 2 of cell 6.
    expected = np.abs(np.linalg.solve(dynamic, force))[[2, 11]]

    measured = analyse(steady_run)

    for power, quantity in enumerate(("displacement", "velocity", "acceleration")):
        amplitudes = [float(measured[f"steady_{quantity}/{point}"]) for point in ("base", "tip")]
        assert amplitudes == pytest.approx(FREQUENCY**power * expected, rel=1e-7)
    assert float(measured["steady_transmission/base-tip"]) == pytest.approx(expected[1] / expected[0], rel=1e-7)
    assert float(measured["steady_drift/tip"]) < 1e-5
    assert json.loads(measured.attrs["warnings"]) == []


def test_transmission_by_part_is_that_of_each_frequency():
    """Transmission by part is the ratio of receiver and source in each part of the spectrum, NaN without a source.

    Cosines of the cosine transform itself fall into one part each.
    """
    count = 400
    # The cosine transform has its nodes at the middles of samples.
    phase = np.pi * (np.arange(count) + 0.5) / count
    interval = 1e-3
    frequencies = np.pi * np.array([20, 60]) / (count * interval)
    source = np.cos(20 * phase) + 3 * np.cos(60 * phase)
    # The receiver has half of the one tone, and twice the other in antiphase.
    receiver = 0.5 * np.cos(20 * phase) - 6 * np.cos(60 * phase)
    edges = [0.0, 0.5 * frequencies.sum(), 2 * frequencies[1], np.inf]

    parts = histories.transmission_by_part(source, receiver, interval, edges)

    assert parts[:2] == pytest.approx([0.5, 2.0], rel=1e-12)
    assert np.isnan(parts[2])
    # A tone that is cut off while it moves leaks into all parts. Where it fades out instead, weak tones are resolved.
    tone = np.cos(20.37 * phase)  # without a kink at its beginning
    weak = 0.01 * np.cos(60 * phase)
    cut = histories.transmission_by_part(tone + weak, tone + 2 * weak, interval, edges)
    faded = histories.transmission_by_part(tone + weak, tone + 2 * weak, interval, edges, goes_on=True)
    assert cut[1] < 1.5
    assert faded[:2] == pytest.approx([1.0, 2.0], rel=0.02)

    # The transmission of the whole is the ratio of root mean squares, which sum over the tones.
    assert histories.transmission(source, receiver) ** 2 == pytest.approx((0.25 + 4 * 9) / 10, rel=1e-12)


# Points at masses of cells with and without a site, at both ends, and at the driven mass.
PLACES = [(1, 1), (6, 1), (6, 2), (6, 3), (6, 4), (12, 2), (13, 3), (24, 4)]
POINTS = [{"name": f"c{cell}m{mass}", "cell": cell, "mass": mass} for cell, mass in PLACES]
COLUMNS = [4 * (cell - 1) + mass - 1 for cell, mass in PLACES]
IMPACTS = {"time": {"end": 0.03, "samples": 3001}, "output": {"points": POINTS, "forces": True}}
LAWS = {"law": "hertz", "sites": [6, 12, 13], "restitution": 0.7}


@pytest.fixture(scope="module", params=["ts", "propagator"])
def impacts(request):
    """A short run by either engine with impacts at three sites, ten samples or more in each, and all fields."""
    case = small_case(
        lattice={"damping": {"mass": 5.0, "stiffness": 1e-6}},
        contacts=LAWS,
        time=IMPACTS["time"] | {"engine": request.param},
        output=IMPACTS["output"],
    )
    run = run_of(case)
    assert run.sizes["episode"] > 5
    return run


def test_the_force_is_the_law_at_the_samples(impacts):
    """The force is side k x^n (1 + c w'/w'_minus) within episodes and 0 outside; the log has the largest one."""
    model = Case.of(impacts).model()
    law = model.chain.sites[0].law
    time = impacts["time"].values
    force = impacts["sites/force"].values
    expected = np.zeros_like(force)
    motion = {}
    for name in ("displacement", "velocity"):
        field = impacts[name].values[:, [5, 11, 12]]
        motion[name] = field[..., model.chain.cell.resonator] - field[..., model.chain.cell.host]

    log = {name: impacts[f"impacts/{name}"].values for name in ("site", "side", "onset", "separation", "force")}
    log["approach"] = impacts["impacts/approach_velocity"].values
    for k, site in enumerate(log["site"] - 1):
        # The comparison is negated for contacts that have not ended, whose separation is NaN.
        inside = (time >= log["onset"][k]) & ~(time > log["separation"][k])
        side = log["side"][k]
        x = side * motion["displacement"][inside, site] - model.chain.sites[site].clearance
        rate = motion["velocity"][inside, site]
        expected[inside, site] = side * law.elastic_force(x) * (1 + law.damping * rate / log["approach"][k])

    largest = log["force"].max()
    assert np.abs(force - expected).max() < 1e-8 * largest
    # The comparison would hold trivially if the law were never evaluated.
    assert np.count_nonzero(force) > 100
    # The largest sample is a little below the largest force of an impact, as samples are this fine.
    sampled = np.abs(force).max()
    assert 0.95 * largest < sampled <= largest * (1 + 1e-9)
    assert float(analyse(impacts, ["motion"])["largest_force"]) == largest


def test_the_acceleration_is_that_of_the_equation_of_motion(impacts):
    """Accelerations satisfy M a = drive - K u - C v + contacts with assembled matrices, at every point and sample."""
    model = Case.of(impacts).model()
    chain = model.chain
    samples = impacts.sizes["time"]
    u = impacts["displacement"].values.reshape(samples, -1)
    v = impacts["velocity"].values.reshape(samples, -1)
    total = -(chain.stiffness_matrix() @ u.T).T - (chain.damping_rows(0, chain.cells) @ v.T).T
    # The drive's force is computed by a formula of this test's own.
    total[:, 0] += [_burst(model.drive, t) for t in impacts["time"].values]
    for column, site in enumerate(chain.sites.cells):
        force = impacts["sites/force"].values[:, column]
        total[:, 4 * site + chain.cell.host] += force
        total[:, 4 * site + chain.cell.resonator] -= force
    expected = (total / chain.masses())[:, COLUMNS]

    for name, field in (("displacement", u), ("velocity", v)):
        assert np.array_equal(impacts[f"points/{name}"].values, field[:, COLUMNS])
    assert np.abs(impacts["points/acceleration"].values - expected).max() < 1e-11 * np.abs(expected).max()


def _burst(drive, t: float) -> float:
    """The force in N of the tone burst at time ``t`` in s, by eq. (3) of the paper."""
    if not 0 < t < drive.duration:
        return 0.0
    phase = drive.frequency * t
    return drive.window_amplitude * (1 - np.cos(phase / drive.cycles)) * np.sin(phase)
