"""Damped modes: a Duffing oscillator in closed form, eigenvalues of small motions, and decay in time."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipk

from vipetsc.case import NnmCase
from vipetsc.modes.branches.files import read_branch, write_branch
from vipetsc.modes.branches.follow import follow_all

pytestmark = pytest.mark.parallel(1)
GROUND = {"start": 0, "end": 1}
STIFFNESS = np.array([[2.0, -1.0], [-1.0, 2.0]])
DAMPING = np.array([[0.07, -0.05], [-0.05, 0.05]])
TWO_MASSES = {
    "masses": [1.0, 1.0],
    "springs": [
        GROUND | {"stiffness": 1.0},
        {"start": 1, "end": 2, "stiffness": 1.0},
        {"start": 0, "end": 2, "stiffness": 1.0},
    ],
    "smooth": [GROUND | {"cubic": 0.5}],
    "dashpots": [GROUND | {"damping": 0.02}, {"start": 1, "end": 2, "damping": 0.05}],
}


def case_of(system, **nnm) -> NnmCase:
    """Return the case of the damped modes of a ``system``."""
    options = {"system": "own", "own": system, "method": "damped", "energy": [0.0, 1.0]}
    return NnmCase.from_table({"name": "x", "nnm": options | nnm})


def test_a_duffing_oscillator_has_the_conservative_frequency():
    """Of u'' + c u' + u + u^3 = 0 the added damping cancels the dashpot: zeta = c/(2 Om), Om as without it."""
    c = 0.3
    system = {
        "masses": [1.0],
        "springs": [GROUND | {"stiffness": 1.0}],
        "smooth": [GROUND | {"cubic": 1.0}],
        "dashpots": [GROUND | {"damping": c}],
    }
    (branch,) = follow_all(case_of(system, modes=[1], energy=[0.0, 10.0]), None, MPI.COMM_SELF)
    assert branch.points[-1].energy > 10
    for point in branch.regular():
        omega = 2 * np.pi / point.period
        assert point.damping_ratio == pytest.approx(c / (2 * omega), rel=1e-10)
        # The conservative motion has its energy at every time: the mean is that of the motion without damping.
        square = np.sqrt(1 + 4 * point.energy) - 1
        period = 4 * ellipk(square / (2 * (1 + square))) / np.sqrt(1 + square)
        assert point.period == pytest.approx(period, rel=1e-8)


def test_a_file_has_the_motions_of_different_orders(tmp_path):
    """The harmonics of a branch adapt to the motion; a file returns each point with its own."""
    (branch,) = follow_all(case_of(TWO_MASSES, modes=[1], energy=[0.0, 10.0], truncation=1e-12), None, MPI.COMM_SELF)
    assert len(set(branch.column("order").tolist())) > 1
    write_branch(branch, tmp_path, {})
    read = read_branch(tmp_path / f"branch-{branch.name}.h5")
    for point, stored in zip(branch.points, read.points, strict=True):
        for name in ("x", "tangent", "zeta", "loss", "period", "order", "truncation", "elongations"):
            assert np.array_equal(getattr(point, name), getattr(stored, name)), name


def test_small_motions_are_the_complex_modes():
    """Frequency and damping ratio are |lambda| and -Re lambda/|lambda| of the linear modes, up to zeta^2."""
    state = np.block([[np.zeros((2, 2)), np.eye(2)], [-STIFFNESS, -DAMPING]])
    values = np.linalg.eigvals(state)
    exact = sorted((abs(v), -v.real / abs(v)) for v in values if v.imag > 0)
    for branch, (frequency, ratio) in zip(
        follow_all(case_of(TWO_MASSES, modes=[1, 2], points=1, start_energy=1e-8), None, MPI.COMM_SELF),
        exact,
        strict=True,
    ):
        first = branch.points[0]
        assert 2 * np.pi * first.frequency == pytest.approx(frequency, rel=2e-4)
        assert first.damping_ratio == pytest.approx(ratio, rel=2e-3)


def test_a_free_motion_decays_as_the_mode_says():
    """A motion that starts on the mode loses in each period what the mode of its present energy loses."""
    (branch,) = follow_all(case_of(TWO_MASSES, modes=[1]), None, MPI.COMM_SELF)
    energies = branch.column("energy")
    ratios = np.array([point.damping_ratio for point in branch.points])
    losses = branch.column("loss")
    periods = branch.column("period")
    # The nonlinearity moves the damping ratio by more than the rate's error.
    assert ratios.max() / ratios.min() > 1.15

    point = branch.points[-1]
    order = point.order
    count = order // 2 + 1
    parts = point.x[1:].reshape(2, 2 * count)
    omega = 2 * np.pi / point.period
    u = parts[:, :count].sum(axis=1)
    v = -omega * (parts[:, count:] * np.arange(1, order + 1, 2)).sum(axis=1)

    def rate(t, y):
        force = STIFFNESS @ y[:2] + DAMPING @ y[2:]
        force[0] += 0.5 * y[0] ** 3
        return np.concatenate([y[2:], -force])

    times = np.linspace(0, 12 * point.period, 4001)
    y = solve_ivp(rate, (0, times[-1]), np.concatenate([u, v]), t_eval=times, rtol=1e-10, atol=1e-12).y
    energy = 0.5 * (y[2:] ** 2).sum(axis=0) + 0.5 * np.einsum("it,ij,jt->t", y[:2], STIFFNESS, y[:2]) + y[0] ** 4 / 8
    mean = np.convolve(energy, np.ones(335) / 335, "valid")
    growing = np.argsort(energies)

    def slow(t, e):
        return -np.interp(e, energies[growing], (losses / periods)[growing])

    predicted = solve_ivp(slow, (0, times[len(mean) - 1]), [mean[0]], rtol=1e-8).y[0, -1]
    assert mean[-1] < 0.6 * mean[0]
    assert np.log(mean[-1] / mean[0]) == pytest.approx(np.log(predicted / mean[0]), rel=0.004)
