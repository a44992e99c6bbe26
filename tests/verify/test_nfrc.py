"""Steady states of lattices with contact sites: folds, energy, stability against time integration, resumed files."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import eigh
from scipy.optimize import root

from tests.conftest import assert_same_bits, datasets, run_of
from tests.models import CLEARANCE
from tests.steady_states import (
    CONTACTS,
    CUBIC_OSCILLATOR,
    LATTICE,
    curve_of,
    first_harmonic,
    motion_at,
    nfrc_case,
    refined,
)
from vipetsc.case import Case, CaseError
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.verb_cases import load_every
from vipetsc.figures.registry import draw
from vipetsc.lattice import DenseCompliance, Spring
from vipetsc.modes.balance.harmonic_balance import HarmonicBalance
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.sweeps import ParameterSweep, measure, sweep_down, sweep_up, swept, with_stable_folds
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state
from vipetsc.modes.stability import Hill

pytestmark = pytest.mark.parallel(1)

THREE = {"sites": [10, 12, 15], "clearance": [CLEARANCE, 0.97 * CLEARANCE, 0.9 * CLEARANCE], "restitution": 0.7}


def varied(case: NfrcCase, **options: Any) -> NfrcCase:
    """The same case with other ``options`` of its section [nfrc]."""
    return case.model_copy(update={"nfrc": case.nfrc.model_copy(update=options)})


@pytest.mark.parametrize("detuning", [3e-7, 1e-4, 1e-2])
def test_the_derivative_by_frequency_is_exact_beside_a_mode_that_hardly_moves_the_pair(detuning):
    """The drive's term changes as the lattice with a spring of the shift at its pair, by d(D^-1)/domega = 2 omega/D^2.

    A mode of such a lattice is at 3e-6 of the frequency of the lattice's own mode.
    """
    cell = {
        "masses": [1.0, 0.15],
        "springs": [
            {"start": 1, "end": 1, "stiffness": 1e3, "next_cell": True},
            {"start": 1, "end": 2, "stiffness": 4e4},
        ],
    }
    table = {
        "lattice": {"cells": 3, "cell": cell},
        "contacts": {"law": "bilinear", "stiffness": 1e4, "restitution": 1.0, "sites": [2], "clearance": 1e-3},
        "drive": {"waveform": "harmonic", "frequency": 20.0, "cell": 1, "amplitude": 1.0},
        "time": {"end": 1.0},
        "nfrc": {"source": "force", "over": "frequency", "infinite": False, "harmonics": 5, "range": [10.0, 30.0]},
    }
    table["nfrc"]["fixed"] = [1.0]
    states = SteadyStates(NfrcCase.from_table(table), restitution=1.0, fixed=1.0)
    chain = states.case.model().chain
    stiffness = chain.stiffness_matrix().toarray()
    masses = np.diag(chain.masses())
    omega = np.sqrt(eigh(stiffness, masses, eigvals_only=True)[0]) * (1 + detuning)

    # At rest the pair's force, and the derivative of its term, vanish.
    rest = np.append(np.zeros(states.balance.size), omega / states.parameter.scale)
    shift = states.shift_near(rest)
    column = states.jacobian(rest, shift)[:, -1] * states.clearance / states.parameter.scale

    first = list(states.balance.orders).index(1)
    pair = np.array([0.0, 0.0, -1.0, 1.0, 0.0, 0.0])
    push = np.eye(6)[0]
    dynamic = stiffness + shift[first, 0, 0] * np.outer(pair, pair) - omega**2 * masses
    expected = -2 * omega * pair @ np.linalg.solve(dynamic, masses @ np.linalg.solve(dynamic, push))
    (place,) = np.flatnonzero(column)
    assert column[place] == pytest.approx(expected, rel=1e-4)


def after_a_period(chain, contact, site: int, omega: float, state: np.ndarray, force: float) -> np.ndarray:
    """Displacements and velocities (2n,) a period after ``state`` under ``force`` cos(omega t) on the first mass.

    SciPy integrates the lattice with one contact, in cell ``site`` from 0.
    """
    stiffness = chain.stiffness_matrix().tocsr()
    masses = chain.masses()
    n = len(masses)
    host = site * chain.cell.dofs + chain.cell.host
    resonator = site * chain.cell.dofs + chain.cell.resonator

    def rate(t, y):
        acceleration = -(stiffness @ y[:n])
        acceleration[0] += force * np.cos(omega * t)
        push = contact.force(y[resonator] - y[host], chain.clearances[0])
        acceleration[resonator] -= push
        acceleration[host] += push
        return np.concatenate([y[n:], acceleration / masses])

    # A longer step could pass over a contact.
    solved = solve_ivp(rate, (0, 2 * np.pi / omega), state, "DOP853", rtol=1e-9, atol=1e-12, max_step=2e-4)
    return solved.y[:, -1]


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_forced_lattice_with_ends_returns_after_a_period(tmp_path):
    """A steady state in contact, on a curve over the frequency, returns after one period of SciPy's integration."""
    case = nfrc_case(
        lattice={"cells": 6},
        contacts={"sites": [3]},
        source="force",
        infinite=False,
        over="frequency",
        range=[2000.0, 2010.0],
        fixed=[14.0],
        harmonics=9,
        largest_step=1.0,
    )
    curve = curve_of(case, tmp_path)
    assert curve.complete, curve.ended.sentence

    last = curve.points[-1]
    assert last.measures.episodes == 2
    assert last.measures.frequency == pytest.approx(2010)
    # The shares are NaN: no energy leaves a lattice with ends, and these contacts lose none.
    assert np.isnan(measure(curve, "share")).all()

    few = SteadyStates(case, 1.0, 14.0)
    many = SteadyStates(varied(case, harmonics=41), 1.0, 14.0)
    start = np.ravel(motion_at(many, refined(few, many, last.xi), np.arange(6)))
    end = after_a_period(case.model().chain, case.laws(1.0)[0], site=2, omega=2010.0, state=start, force=14.0)

    u = slice(0, 24)
    assert np.abs(end[u] - start[u]).max() < 1e-5 * np.abs(start[u]).max()


@pytest.mark.slow
def test_a_steady_state_is_where_a_long_run_ends():
    """A long run from rest, with a lossy site under a force, ends with the first harmonic of the steady state."""
    omega = 1023.27
    drive = {"waveform": "harmonic", "cell": 230, "frequency": omega}
    table = {
        "name": "x",
        # The lattice is so long that no wave comes back from its ends during the run.
        "lattice": LATTICE | {"cells": 500},
        "contacts": CONTACTS | {"sites": [250], "restitution": 0.3},
        "drive": drive,
    }

    def states(**options: Any) -> SteadyStates:
        common = {"source": "force", "largest_step": 1.0, "fixed": [omega]}
        return SteadyStates(NfrcCase.from_table(table | {"nfrc": common | options}), 0.3, omega)

    amplitude = 1.6 * states().parameter.scale
    few = states(harmonics=9, range=[amplitude, 99.0])
    many = states(harmonics=61, range=[amplitude, 99.0])
    measures = many.measured(refined(few, many, first_state(few).xi))
    assert measures.unstable == 0
    assert measures.episodes == 4

    # With fewer samples in a period, high harmonics would alias to the first.
    samples = 64
    period = 2 * np.pi / omega
    case = Case.from_table(
        table
        | {
            "drive": drive | {"amplitude": amplitude, "ramp": 40 * period},
            "time": {"engine": "propagator", "end": 180 * period, "sample_interval": period / samples},
            "output": {"window": [250, 250]},
        }
    )
    u = run_of(case)["displacement"].values[-1 - 8 * samples : -1, 0]

    found = first_harmonic(u[:, 2] - u[:, 1], samples)
    assert found == pytest.approx(abs(measures.harmonics[0, 1]), rel=5e-4)


@pytest.mark.slow
@pytest.mark.parametrize("nfrc", [{}, {"over": "frequency", "range": [1023.0, 1040.0], "fixed": [0.9008], "points": 3}])
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


@pytest.mark.slow
def test_what_a_force_gives_a_lattice_with_ends_is_lost(tmp_path):
    """In a lattice with ends, which no energy leaves, sites dissipate all of the work in every state with contact."""
    sites = THREE | {"sites": [3, 5, 8]}
    options = {"source": "force", "infinite": False, "fixed": [2000.0]}
    linear = SteadyStates(nfrc_case({"cells": 12}, sites, **options), 0.7, 2000.0).linear_motion(2000.0)
    touching = min(sites["clearance"] / np.abs(linear.harmonics[:, 1]))

    options |= {"range": [0.999 * touching, 1.02 * touching], "points": 4, "harmonics": 5}
    curve = curve_of(nfrc_case({"cells": 12}, sites, **options), tmp_path)

    touches = measure(curve, "episodes") > 0
    assert touches.any()
    assert measure(curve, "share")[touches, 3] == pytest.approx(1.0, abs=1e-8)


@pytest.mark.slow
def test_a_curve_goes_on_to_the_same_bits(tmp_path):
    whole = tmp_path / "whole"
    parts = tmp_path / "parts"
    whole.mkdir()
    parts.mkdir()
    case = nfrc_case(harmonics=5, restitutions=[0.7], range=[0.999, 1.0005], first_step=2e-4, largest_step=3e-4)
    curve = curve_of(case, whole)

    (first,) = follow_all(varied(case, points=3), parts, MPI.COMM_SELF)
    assert not first.complete
    assert "increase nfrc.points" in first.ended.sentence

    (second,) = follow_all(case, parts, MPI.COMM_SELF, resume=True)
    assert second.complete

    name = f"branch-{curve.name}"
    assert_same_bits(datasets(whole / f"{name}.h5"), datasets(parts / f"{name}.h5"))
    assert (whole / f"{name}.csv").read_text() == (parts / f"{name}.csv").read_text()

    again = read_branch(whole / f"{name}.h5")
    assert again.complete
    assert np.array_equal(measure(again, "share"), measure(curve, "share"))

    (picture,) = draw("branches", [whole])
    assert picture.name == f"{name}.png"


def test_sites_may_have_a_restitution_of_their_own(tmp_path):
    """Equal restitutions in a list over sites give the curve of one for all, in a file that can be read and drawn."""
    options = {"harmonics": 5, "range": [0.999, 1.0005], "first_step": 2e-4, "largest_step": 3e-4, "points": 3}
    common = curve_of(nfrc_case(restitutions=[0.7], **options), tmp_path / "common")
    each = nfrc_case(contacts={"each": {"restitution": [0.7]}}, **options)
    curve = curve_of(each, tmp_path / "each")

    assert np.array_equal([point.xi for point in curve.points], [point.xi for point in common.points])
    assert read_branch(tmp_path / f"each/branch-{curve.name}.h5").case == each.to_toml()
    assert draw("branches", [tmp_path / "each"])


def test_a_resumed_curve_finds_two_folds_in_its_first_step(tmp_path):
    """Two folds in one step are found, to the same bits, also by a command that goes on from the beginning of it.

    That they may lie there shows in the direction of the point before. An oscillator with hardening springs has two
    folds close together, at an amplitude little above that of the first fold at all.
    """
    table = CUBIC_OSCILLATOR | {
        "drive": {"waveform": "harmonic", "amplitude": 0.05138, "frequency": 1.0, "cell": 1, "mass": 1},
        "time": {"end": 100.0},
        "nfrc": {"source": "force", "over": "frequency", "range": [0.8, 1.6], "fixed": [0.05138], "harmonics": 3},
    }
    case = NfrcCase.from_table(table)
    (whole,) = follow_all(case, None, MPI.COMM_SELF)
    folds = [point for point in whole.points if point.kind == "fold"]
    assert len(folds) == 2
    # The number of a special point is that of the regular one after it.
    assert folds[0].index == folds[1].index

    # As many states as there are before the step with the folds, of which the start has the number 0.
    (part,) = follow_all(varied(case, points=folds[0].index), tmp_path, MPI.COMM_SELF)
    assert part.points[-1].index == folds[0].index - 1
    (resumed,) = follow_all(case, tmp_path, MPI.COMM_SELF, resume=True)

    assert [point.kind for point in resumed.points] == [point.kind for point in whole.points]
    for name in ("xi", "tangent", "step", "next_step"):
        assert np.array_equal(resumed.column(name), whole.column(name)), name


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
