"""Subharmonics of order 1/3 of the Duffing oscillator: against multiple scales, and integration in time."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from vipetsc.case.nfrc import NfrcCase
from vipetsc.modes.branches.follow import follow_all

pytestmark = pytest.mark.parallel(1)
FORCE = 16.0
DAMPING = 0.1


def duffing(small: float, **nfrc) -> NfrcCase:
    """Return the case u'' + 2 small DAMPING u' + u + small u^3 = FORCE cos(Om t), with motions of three periods."""
    spring = {"start": 1, "end": 1, "stiffness": 0.5, "cubic": 0.5 * small, "damping": DAMPING * small}
    cell = {"masses": [1.0], "springs": [spring | {"next_cell": True}], "contact": [1, 1]}
    options = {"source": "force", "over": "frequency", "fixed": [FORCE], "subharmonic": 3, "isolas": 2}
    drive = {"waveform": "harmonic", "frequency": 3.0, "amplitude": 1.0, "cell": 1}
    tables = {"lattice": {"cells": 1, "cell": cell}, "contacts": {"sites": []}, "drive": drive, "time": {"end": 1.0}}
    return NfrcCase.from_table(tables | {"name": "duffing", "nfrc": options | nfrc})


def test_the_fold_is_that_of_multiple_scales():
    """For small terms the fold and its amplitude are those of Nayfeh and Mook (1979), section 4.1.4.

    With Om = 3 + small s: 9 mu^2 + (s - 9 L^2 - 9 a^2/8)^2 = 81 L^2 a^2/16, L = FORCE/(2 (1 - 9)), mu = DAMPING.
    """
    folds = []
    for small in (1e-3, 1e-4):
        case = duffing(small, range=[3 + 7 * small, 3 + 12 * small], harmonics=9)
        curves = follow_all(case, None, MPI.COMM_SELF)
        assert curves[0].about["drive_harmonic"] == 3
        # All shifts in time of a motion are one curve, which leaves the range at both ends.
        assert len(curves) == 3
        assert [point.kind for point in curves[0].points if point.kind != "regular"] == []
        (fold,) = [point for curve in curves for point in curve.points if point.kind == "fold"]
        first = fold.measured.outputs["spring_harmonics"] + 1j * fold.measured.outputs["spring_harmonics_imaginary"]
        folds.append([(fold.measured.frequency - 3) / small, abs(first[0, 1])])

    rho = 9 / 8
    level = FORCE**2 / (2 * (1 - 9)) ** 2
    slope = 81 * level / 16
    detuning = (36 * (rho * DAMPING) ** 2 - slope**2) / (4 * rho * slope)
    amplitude = np.sqrt((2 * rho * detuning + slope) / (2 * rho**2))
    # The method's error is of first order in ``small``.
    extrapolated = (10 * np.array(folds[1]) - folds[0]) / 9
    np.testing.assert_allclose(extrapolated, [detuning + 9 * level, amplitude], rtol=3e-4)


def test_motions_close_after_three_periods_and_have_their_stability():
    """Integrated in time, states return after three periods and not after one, and as many multipliers grow as said."""
    small = 0.05
    curves = follow_all(duffing(small, range=[3.1, 3.6], harmonics=27), None, MPI.COMM_SELF)
    numbers = set()
    for point in [point for curve in curves[1:] for point in curve.regular()[::16]]:
        omega = point.measured.frequency
        z = (point.measured.outputs["spring_harmonics"] + 1j * point.measured.outputs["spring_harmonics_imaginary"])[0]
        rates = 1j * omega / 3 * np.arange(len(z))
        begin = np.array([z.real.sum(), (rates * z).real.sum()])

        def after(periods, state, omega=omega):
            def rate(t, y):
                return [y[1], FORCE * np.cos(omega * t) - 2 * small * DAMPING * y[1] - y[0] - small * y[0] ** 3]

            end = periods * 2 * np.pi / omega
            return solve_ivp(rate, (0, end), state, rtol=1e-10, atol=1e-12).y[:, -1]

        np.testing.assert_allclose(after(3, begin), begin, atol=1e-5)
        assert np.abs(after(1, begin) - begin).max() > 0.1
        step = 1e-5 * np.eye(2)
        monodromy = np.column_stack([after(3, begin + d) - after(3, begin - d) for d in step]) / 2e-5
        growing = int(np.sum(np.abs(np.linalg.eigvals(monodromy)) > 1))
        assert point.measured.unstable == growing
        numbers.add(growing)
    assert numbers == {0, 1}
