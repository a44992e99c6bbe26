"""Steady states of lattices with contact sites: folds, energy, stability against time integration, resumed files."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import root

from tests.models import CLEARANCE
from tests.steady_states import curve_of, nfrc_case
from vipetsc.case import CaseError
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.verb_cases import load_every
from vipetsc.figures.registry import draw
from vipetsc.lattice import DenseCompliance, Spring
from vipetsc.modes.balance.harmonic_balance import HarmonicBalance
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.sweeps import ParameterSweep, measure, sweep_down, sweep_up, swept, with_stable_folds
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.stability import Hill

pytestmark = pytest.mark.parallel(1)

THREE = {"sites": [10, 12, 15], "clearance": [CLEARANCE, 0.97 * CLEARANCE, 0.9 * CLEARANCE], "restitution": 0.7}


def test_hill_finds_the_multipliers_of_a_forced_duffing_oscillator():
    """Hill's exponents of the three orbits of x'' + x + x^3 = 0.3 cos(1.8 t) are those of the monodromy matrix."""
    omega = 1.8
    order = 15
    forces = SiteForces([], [Spring(0, 1, 1.0, cubic=1.0)])
    compliance = DenseCompliance(np.ones(1), np.eye(1), np.eye(1))
    balance = HarmonicBalance(compliance, forces, order, True, cosines=False)
    shift = balance.shift(omega)
    linear = np.zeros((1, order + 1), complex)
    linear[0, 1] = 0.3 / (1 - omega**2)

    def rate(t, y):
        stiffness = 1 + 3 * y[0] ** 2
        orbit = [y[1], -y[0] - y[0] ** 3 + 0.3 * np.cos(omega * t)]
        columns = [y[3], -stiffness * y[2], y[5], -stiffness * y[4]]
        return orbit + columns

    counts = []
    # The guesses are amplitudes near the small orbit out of phase, the large one in phase and the one between them.
    for guess in (-0.14, 1.8, -1.6):
        x = balance.pack(np.zeros((1, order + 1), complex))
        x[0] = guess
        solved = root(lambda x: balance.residual(x, omega, shift, linear), x, tol=1e-13)
        assert solved.success

        z = balance.unpack(solved.x)[0]
        speeds = 1j * np.arange(order + 1) * omega * z
        start = [z.sum().real, speeds.sum().real, 1, 0, 0, 1]
        end = solve_ivp(rate, (0, 2 * np.pi / omega), start, "DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
        assert end[:2] == pytest.approx(start[:2], abs=1e-8)

        series = balance.series(solved.x, omega)
        hill = Hill(compliance, omega, order, odd=True, finite=True)
        largest = np.abs(np.linalg.eigvals(end[2:].reshape(2, 2))).max()
        assert hill.fastest(series) == pytest.approx(np.log(largest) / (2 * np.pi), abs=1e-8)
        counts.append(hill.stability(series).unstable)

    assert counts == [0, 0, 1]


def test_the_upper_fold_of_one_site_under_a_wave_and_its_energy(tmp_path):
    """The curve folds at amplitude/clearance 1.0014 and is unstable beyond; the shares of the energy sum to one."""
    for curve in follow_all(nfrc_case(restitutions=[1.0, 0.7], range=[0.996, 1.01]), tmp_path, MPI.COMM_SELF):
        assert curve.complete
        assert curve.ended.sentence == "reached the end of nfrc.range, 0.996"

        parameter = measure(curve, "amplitude")
        (fold,) = (number for number, point in enumerate(curve.points) if point.kind == "fold")
        # The amplitude at which the motion jumps into contact, by an earlier computation.
        assert parameter[fold] == pytest.approx(1.0014, abs=2e-4)

        # The shares are those transmitted, reflected, sent to other bands, and lost.
        share = measure(curve, "share")
        assert np.abs(share.sum(axis=1) - 1).max() < 1e-8
        assert np.all(share > -1e-12)
        assert share[-1, 2] > 1e-5
        assert (share[-1, 3] > 1e-7) == ("r0.7" in curve.name)

        # Below contact the site moves as in the linear lattice.
        free = parameter < 1
        free[fold:] = False
        largest = measure(curve, "largest")[:, 0] / CLEARANCE
        assert largest[free] == pytest.approx(parameter[free], rel=1e-12)
        assert np.all(measure(curve, "unstable")[free] == 0)

        after = slice(fold + 2, None)
        assert np.all(measure(curve, "unstable")[after] % 2 == 1)
        assert np.all(measure(curve, "growth")[after] > 0.01)
        assert sweep_up(curve)[-1] <= fold
        assert sweep_down(curve) == sweep_up(curve)[::-1]


@pytest.mark.parametrize("nfrc", [{"over": "frequency", "range": [1023.0, 1040.0], "fixed": [0.9008], "points": 3}])
def test_energy_at_several_sites_and_their_mirror_image(nfrc, tmp_path):
    """The shares satisfy T + R + U + L = 1, and a wave from the other side of mirrored sites has the same curve.

    The four-band cell is its own mirror image.
    """
    nfrc = {"range": [0.89, 0.94], "harmonics": 5, "points": 6, "first_step": 0.1, "largest_step": 0.5} | nfrc
    mirrored = THREE | {"sites": [21, 19, 16]}
    forward = curve_of(nfrc_case(contacts=THREE, **nfrc, direction="forward"), tmp_path / "forward")
    backward = curve_of(nfrc_case(contacts=mirrored, **nfrc, direction="backward"), tmp_path / "backward")

    for curve in (forward, backward):
        share = measure(curve, "share")
        assert len(curve.points) >= 3
        assert np.abs(share.sum(axis=1) - 1).max() < 1e-8
        assert share[-1].min() > 1e-9
        assert measure(curve, "episodes")[-1] >= 2

    for name in ("share", "largest", "unstable"):
        assert measure(forward, name) == pytest.approx(measure(backward, name), rel=1e-6, abs=1e-12)

    # With even harmonics among the unknowns, these are zero in the same state, and perturbations grow alike. The
    # symmetric state has two determinants, for even and for odd harmonics of perturbations, the other has one.
    ((_, _, fixed),) = NfrcCase.from_toml(forward.case).curves()
    odd = SteadyStates(nfrc_case(contacts=THREE, **nfrc, symmetric=True), 0.7, fixed)
    every = SteadyStates(nfrc_case(contacts=THREE, **nfrc, symmetric=False), 0.7, fixed)
    last = forward.points[-1]
    xi = np.append(every.balance.pack(odd.balance.unpack(last.xi[:-1])), last.xi[-1])
    shift = every.balance.shift(every.drive(xi[-1])[0])
    assert np.abs(every.residual(xi, shift)).max() < 1e-9

    measures = every.measured(xi)
    for name in ("unstable", "growth", "fractions"):
        assert getattr(measures, name) == pytest.approx(getattr(last.measures, name), rel=1e-6, abs=1e-9)

    (picture,) = draw("branches", [tmp_path / "forward"])
    assert picture.exists()


def test_sweeps_jump_between_stable_states():
    """A sweep along an S-shaped curve with a stable upper part jumps at a fold to the nearer of two stable states."""
    parameter = np.array([0.5, 0.8, 1.0, 0.9, 0.7, 0.6, 0.8, 1.0, 1.2, 1.15, 1.05, 0.95])
    stable = np.array([1, 1, 0, 0, 0, 0, 1, 1, 1, 0, 1, 1], bool)
    is_fold = np.isin(np.arange(12), (2, 5))
    upwards = ParameterSweep(parameter, size=0.1 * np.arange(12), stable=with_stable_folds(stable, is_fold))
    downwards = upwards._replace(parameter=-parameter)

    assert swept(upwards) == [0, 1, 2, 8]
    assert swept(downwards, start=8) == [8, 7, 6, 5, 0]


def test_a_lattice_without_sites_needs_points_and_validate_reads_the_section(tmp_path):
    """A linear lattice has no incident wave to scatter, and its response is that of named masses."""
    with pytest.raises(CaseError, match=r"(?s)nfrc\.source.*output\.points"):
        nfrc_case(contacts={"sites": 0, "clearance": None})

    path = tmp_path / "x.toml"
    path.write_text('[lattice]\npreset = "four-band"\n[nfrc]\n[contacts]\nsites = [10]\n')
    assert "NfrcCase" in [type(case).__name__ for case in load_every(path)]


def test_a_force_on_an_infinite_lattice_gives_what_leaves_and_is_lost(tmp_path):
    """Waves carry away what a force works on an infinite lattice, or the site loses it: the shares sum to one."""
    force = {"source": "force", "harmonics": 7, "largest_step": 1.0}
    touching = SteadyStates(nfrc_case(**force), 0.7, 1023.27).parameter.scale
    case = nfrc_case(contacts={"restitution": 0.7}, **force, range=[0.99 * touching, 1.0005 * touching])

    curve = curve_of(case, tmp_path)

    assert curve.complete
    assert curve.points[-1].measures.episodes == 2
    assert np.abs(measure(curve, "share").sum(axis=1) - 1).max() < 1e-8
    assert curve.points[-1].measures.fractions[3] > 0
