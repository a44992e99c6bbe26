"""Runs sampled by the period of the drive, runs that follow one another, and what the pictures of points show."""

from __future__ import annotations

from itertools import pairwise

from mpi4py import MPI

import numpy as np
import pytest
from scipy.optimize import brentq

from vipetsc import Case, Sweep
from vipetsc.dynamics.run import simulate
from vipetsc.figures.sections import sections_of
from vipetsc.io.read import open_ensemble, open_run, whole_members
from vipetsc.spectra.fourier import amplitude_spectrum
from vipetsc.studies.sweep import run_sweep

RESTITUTION = 0.8
IMPACT = {
    "lattice": {"cells": 1, "cell": {"masses": [1.0], "springs": [
        {"start": 1, "end": 1, "stiffness": 0.5, "next_cell": True}]}},
    "contacts": {
        "law": "bilinear", "stiffness": 1e8, "restitution": RESTITUTION, "damping": "exact", "approach_floor": 1e-3,
        "sites": [1], "pair": [0, 1], "side": "plus", "clearance": 0.0,
    },
    "drive": {"waveform": "harmonic", "amplitude": 1.0, "frequency": 2.3},
    "time": {"engine": "propagator", "samples_per_period": 16, "end": 250.0},
    "output": {"points": [{"name": "mass", "cell": 1}]},
}  # fmt: skip


def one_impact_a_period(omega: float) -> tuple[float, float]:
    """Return the speed at impacts, and the displacement at t = 0, of x'' + x = sin(omega t), x <= 0, x'+ = -r x'-.

    The flight is a cos s + b sin s + G sin(omega t), s after an impact at the phase theta of sin; at both of its ends
    x = 0, and the speeds there are in the ratio r.
    """
    period = 2 * np.pi / omega
    force = 1 / (1 - omega**2)
    t = np.tan(period / 2)
    # With the impact at omega t = theta: G omega cos(theta) (1 + r) = G sin(theta) t (1 - r), of two angles the one
    # with an approach.
    theta = np.arctan2(omega * (1 + RESTITUTION), t * (1 - RESTITUTION))
    if force * (np.sin(theta) * t + omega * np.cos(theta)) < 0:
        theta += np.pi
    speed = force * (np.sin(theta) * t + omega * np.cos(theta))
    s = np.mod(-theta / omega, period)
    x = -force * np.sin(theta) * (np.cos(s) + t * np.sin(s))
    return speed, x


def test_the_impact_oscillator_has_its_motion_of_one_impact_a_period():
    """Speed of the impacts and section of the impact oscillator are those of the closed form for a rigid stop."""
    run = simulate(Case.from_table(IMPACT)).dataset
    speed, x = one_impact_a_period(2.3)
    (section,) = sections_of(run)
    assert run["impacts/approach_velocity"].values[-1] == pytest.approx(speed, rel=2e-3)
    assert np.ptp(section.displacement) < 1e-3 * abs(x)
    assert section.displacement[-1] == pytest.approx(x, rel=5e-3)
    periods = float(run["time"][-1]) * 2.3 / (2 * np.pi)
    assert periods == pytest.approx(round(periods), abs=1e-9)


@pytest.mark.parametrize("follow", ["up", "down"])
def test_members_follow_one_another_in_the_order_of_their_values(tmp_path, capfd, follow):
    """The first run begins at rest, and each later one with the last state of the one before."""
    table = IMPACT | {"sweep": {"fields": True, "measures": ["motion"], "follow": follow, "drive": {
        "frequency": [2.4, 2.2, 2.3]}}}  # fmt: skip
    table["time"] = table["time"] | {"end": 20.0}
    result = run_sweep(Sweep.from_table(table), tmp_path, MPI.COMM_SELF, progress=True)
    assert result.complete
    assert "3 of 3 runs" in capfd.readouterr().err

    ends = {}
    for member, folder in whole_members(open_ensemble(tmp_path)):
        with open_run(folder / "run.h5") as run:
            state = np.stack([run["displacement"].values[:, 0, 0], run["velocity"].values[:, 0, 0]])
            ends[float(member["frequency"])] = state[:, 0], state[:, -1]
    order = sorted(ends, reverse=follow == "down")
    assert not ends[order[0]][0].any()
    # A member is repeated from the same state.
    again = Sweep.from_table(table).case_in(tmp_path, [2.4, 2.2, 2.3].index(order[1]))
    assert simulate(again).dataset["displacement"].values[-1, 0, 0] == ends[order[1]][1][0]
    for before, after in pairwise(order):
        assert ends[after][0].tolist() == ends[before][1].tolist()


def period_doubling(r: float) -> float:
    """Return where the motion of x'' + x = sin(omega t), x <= 0, with one impact a period doubles its period.

    Shaw and Holmes (1983): the map of deviations over a period has the determinant r^2; here -1 is one of its
    multipliers where its trace is -(1 + r^2). With T = 2 pi/omega the force at the impact over the approach velocity is
    (1 - omega^2) (1 + r) cot(T/2)/2, so that the trace is -2 r cos T + (1 + r)^2 (1 - omega^2) cos^2(T/2), and
    cos^2(pi/omega) (omega^2 - ((1 - r)/(1 + r))^2) = 1.
    """
    return brentq(lambda w: np.cos(np.pi / w) ** 2 * (w**2 - ((1 - r) / (1 + r)) ** 2) - 1, 2.5, 2.8)


@pytest.mark.parametrize(("restitution", "published"), [(0.8, 2.653348), (0.5, 2.658152)])
def test_a_sweep_up_doubles_its_period_where_shaw_and_holmes_say(tmp_path, restitution, published):
    """Rigid stop: 0.3 % below that frequency every period is alike, 0.3 % above it every second one."""
    onset = period_doubling(restitution)
    assert onset == pytest.approx(published, abs=1e-6)
    ratios = [0.997, 1.003]
    contacts = {"law": "rigid", "restitution": restitution} | {
        key: IMPACT["contacts"][key] for key in ("sites", "pair", "side", "clearance")
    }
    sweep = {"fields": True, "measures": ["motion"], "follow": "up"}
    sweep["drive"] = {"frequency": [ratio * onset for ratio in ratios]}
    table = IMPACT | {"contacts": contacts, "time": IMPACT["time"] | {"end": 1000.0}, "sweep": sweep}
    assert run_sweep(Sweep.from_table(table), tmp_path, MPI.COMM_SELF).complete
    parted = {}
    for member, folder in whole_members(open_ensemble(tmp_path)):
        with open_run(folder / "run.h5") as run:
            (section,) = sections_of(run)
        x = section.displacement[-40:]
        assert np.ptp(x[::2]) < 1e-4
        parted[round(float(member["frequency"]) / onset, 6)] = abs(x[-1] - x[-2])
    below, above = ratios
    assert parted[below] < 1e-5
    assert parted[above] > 0.02


def test_the_spectrum_of_a_sine_has_its_amplitude():
    """A sine of whole periods has a peak of its amplitude at its frequency; a constant has its value at 0."""
    time = 0.01 * np.arange(1000)
    frequency, amplitude = amplitude_spectrum(0.7 * np.sin(2 * np.pi * 5 * time), 0.01)
    top = int(amplitude.argmax())
    assert frequency[top] == pytest.approx(2 * np.pi * 5)
    assert amplitude[top] == pytest.approx(0.7, rel=5e-3)
    assert amplitude_spectrum(np.full(100, 2.0), 0.01)[1][0] == pytest.approx(2.0)
