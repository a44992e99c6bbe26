"""Steady states under a wave or a force in long lattices: energy, mirror images, multipliers, long runs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import root
from scipy.sparse import diags
from scipy.sparse.linalg import spsolve

from tests.conftest import run_of
from tests.models import CLEARANCE, TWO_MASS_CELL
from tests.steady_states import curve_of, first_harmonic, nfrc_case
from vipetsc.case import Case
from vipetsc.case.nfrc import NfrcCase
from vipetsc.cli.verbs.branch_verbs import curve_rows
from vipetsc.figures.registry import draw
from vipetsc.lattice import Chain, DenseCompliance, Spring, UnitCell, WaveCompliance
from vipetsc.lattice.sites import Pair, sites_at
from vipetsc.modes.balance.harmonic_balance import HarmonicBalance
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.responses import ResponseMethod
from vipetsc.modes.branches.sweeps import ParameterSweep, measure, sweep_down, sweep_up, swept, with_stable_folds
from vipetsc.modes.response.state import Measures
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state
from vipetsc.modes.stability import Hill

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
    """The shares satisfy T + R + U + L = 1, and a wave from the other side of mirrored sites has the same curve."""
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


# A row of masses on which resonators sit, with springs between neighbouring resonators as well.
SPRINGS = (Spring(0, 0, 1e4, offset=1), Spring(0, 1, 5e3), Spring(1, 1, 1e3, offset=1))
CELL = UnitCell((4e-3, 2e-3), SPRINGS, host=0, resonator=1)
PAIRS = (Pair(-1, 1), Pair(1, 0, offset=1), Pair(0, 1), Pair(-1, 0))
SITES = (500, 501, 503, 503)


def rows_of(chain: Chain) -> np.ndarray:
    """Rows (pair, mass) that give relative displacements from displacements of masses, in a chain that is no ring."""
    d = chain.cell.dofs
    rows = np.zeros((len(chain.sites), chain.cells * d))
    for row, (cell, pair, *_) in zip(rows, chain.sites, strict=True):
        row[(cell + pair.offset) * d + pair.resonator] = 1
        if pair.host >= 0:
            row[cell * d + pair.host] = -1
    return rows


@pytest.mark.parametrize("omega", [400.0 - 40j, 1000.0 - 40j, 3000.0 - 90j])
def test_compliances_are_those_of_a_long_damped_lattice(omega):
    """Compliances of an infinite lattice are those of a long one, at complex frequencies."""
    chain = Chain(CELL, 1000, "free", sites_at(SITES, PAIRS))
    dynamic = chain.stiffness_matrix().tocsc() - omega**2 * diags(chain.masses(), format="csc")
    rows = rows_of(chain)
    expected = rows @ spsolve(dynamic.astype(complex), rows.T.astype(complex))
    found = WaveCompliance(chain, infinite=True).at(omega)[0]
    assert np.abs(found - expected).max() < 1e-10 * np.abs(expected).max()


GROUND = {"pair": [0, 2], "sites": [12, 14]}
NEIGHBOURS = {"pair": [1, 1], "next_cell": True, "sites": [12, 14]}
# In one cell a resonator meets that of the next cell; in another cell a resonator meets its host and the ground.
SEVERAL = {
    "sites": [10, 12, 12],
    "clearance": [1e-4, 3e-5, 1e-4],
    "each": {"pair": [[2, 2], [1, 2], [0, 2]], "next_cell": [True, False, False]},
}
# In the mirror image of 24 cells, cell n becomes 25 - n, and the contact of cells n and n + 1 belongs to cell 24 - n.
MIRRORED = {
    "ground": (GROUND, GROUND | {"sites": [13, 11]}),
    "neighbours": (NEIGHBOURS, NEIGHBOURS | {"sites": [12, 10]}),
    "several": (SEVERAL, SEVERAL | {"sites": [14, 13, 13]}),
}


def wave_case(contacts: dict[str, Any], **nfrc: Any) -> NfrcCase:
    """The case of lossy sites under a wave of 1000 rad/s and 2.5 clearances; ``nfrc`` updates the table [nfrc]."""
    common = {"law": "bilinear", "stiffness": 1e4, "clearance": 1e-4, "restitution": 0.5}
    steps = {"harmonics": 15, "first_step": 0.2, "largest_step": 1.0, "range": [2.5, 9.0]}
    return NfrcCase.from_table(
        {
            "name": "x",
            "lattice": {"cells": 24, "cell": TWO_MASS_CELL},
            "contacts": common | contacts,
            "drive": {"frequency": 1000.0, "cycles": 3, "amplitude": 1.0, "cell": 4},
            "nfrc": steps | nfrc,
        }
    )


def measures_of(case: NfrcCase, restitution: float) -> Measures:
    """The measures of the state at the beginning of the range."""
    states = SteadyStates(case, restitution, case.nfrc.fixed[0])
    return states.measured(first_state(states).xi)


@pytest.mark.parametrize("name", MIRRORED)
def test_energy_and_mirror_images(name):
    """A state in contact satisfies T + R + U + L = 1, and a wave from the other side moves mirrored sites alike."""
    forward, backward = (
        measures_of(wave_case(contacts, direction=direction), 0.5)
        for direction, contacts in zip(("forward", "backward"), MIRRORED[name], strict=True)
    )
    assert forward.episodes >= 4
    assert (forward.closed > 0).all()
    assert forward.fractions.sum() == pytest.approx(1.0, abs=1e-9)
    assert forward.fractions.min() > 1e-4

    assert backward.fractions == pytest.approx(forward.fractions, rel=1e-7)
    assert backward.largest == pytest.approx(forward.largest, rel=1e-7)
    assert backward.unstable == forward.unstable


def test_a_steady_state_under_a_wave_is_where_a_long_run_ends():
    """A run under the wave of a distant force settles to the steady state of contacts with ground and next cell."""
    omega = 1000.0
    period = 2 * np.pi / omega
    contacts = {
        "law": "bilinear",
        "stiffness": 1e4,
        "clearance": 1e-4,
        "restitution": 0.3,
        "sites": [320, 322],
        "each": {"pair": [[0, 2], [1, 1]], "next_cell": [False, True]},
    }
    # Waves travel 8 cells in a period and come back from the ends after the run has ended.
    lattice = {"cells": 640, "cell": TWO_MASS_CELL}
    drive = {"waveform": "harmonic", "frequency": omega, "cell": 300}
    table = {"name": "x", "lattice": lattice, "contacts": contacts, "drive": drive}
    options = {"harmonics": 31, "largest_step": 1.0, "first_step": 0.2}

    amplitude = 2.5
    case = NfrcCase.from_table(table | {"nfrc": options | {"range": [amplitude, 9.0]}})
    measures = measures_of(case, 0.3)
    assert measures.unstable == 0
    assert measures.episodes == 4

    # Without contacts the run's force would move the first site by 2.5 clearances.
    forced = NfrcCase.from_table(table | {"nfrc": options | {"source": "force", "infinite": True, "range": [0.1, 1.0]}})
    relative = SteadyStates(forced, 0.3, omega).linear_motion(omega).harmonics[0, 1]
    force = amplitude * 1e-4 / abs(relative)
    samples = 64
    run = Case.from_table(
        table
        | {
            "drive": drive | {"amplitude": force, "ramp": 20 * period},
            "time": {"engine": "propagator", "end": 60 * period, "sample_interval": period / samples},
            "output": {"window": [320, 323]},
        }
    )
    u = run_of(run)["displacement"].values[-1 - 4 * samples : -1]
    motions = (u[:, 0, 1], u[:, 3, 0] - u[:, 2, 0])
    found = [first_harmonic(motion, samples) for motion in motions]
    assert found == pytest.approx(np.abs(measures.harmonics[:, 1]).tolist(), rel=1e-4)


ALLOWED = 1e-4
# The amplitude over the clearance at the fold, with 61 harmonics at every state.
FOLD = 1.00145038
CURVES = {
    "amplitude": {},
    "contacts.restitution": {
        "over": "contacts.restitution",
        "range": [0.985, 1.0],
        "fixed": [1.05],
        "largest_step": 0.5,
    },
}


@pytest.fixture(scope="module")
def over_amplitude(tmp_path_factory):
    """The case and the curve over the amplitude."""
    case = nfrc_case(truncation=ALLOWED, harmonics=61)
    return case, curve_of(case, tmp_path_factory.mktemp("whole"))


def orders_of(curve) -> np.ndarray:
    """The highest harmonic (point,) of each state of a curve."""
    return np.array([np.flatnonzero(np.abs(p.measured.harmonics).max(axis=0)).max() for p in curve.points])


@pytest.mark.parametrize("over", CURVES)
def test_states_have_as_many_harmonics_as_the_truncation_needs(tmp_path, over, over_amplitude):
    """All have less than is allowed left out and solve their equations; folds are near those of all harmonics."""
    options = CURVES[over] | {"harmonics": 61}
    case, curve = over_amplitude
    if over != "amplitude":
        case = nfrc_case(truncation=ALLOWED, **options)
        curve = curve_of(case, tmp_path / "few")
    orders = orders_of(curve)
    assert 15 < orders[1:-1].max() < 61
    assert over != "amplitude" or len(set(orders[1:-1])) > 2
    assert max(point.measured.truncation for point in curve.points) < ALLOWED

    states = ResponseMethod(case).problem(0)
    for point in curve.points[2:-1:7]:
        of_point = states.of_state(point.xi)
        assert of_point.balance.order < 61
        inner = of_point.resized(point.xi)
        assert np.abs(of_point.residual(inner, of_point.shift_near(inner))).max() < 1e-10

    if over == "amplitude":
        assert [point.xi[-1] for point in curve.points if point.kind == "fold"] == pytest.approx([FOLD], abs=3e-5)

        # A state may have too few harmonics for its perturbations: the summary says which key gives it more.
        first = curve.points[0]
        curve.points[0] = replace(first, measures=first.measured._replace(unstable=-1))
        assert "nfrc.truncation" in dict(curve_rows(case, curve))["undecided"]


def test_a_stopped_curve_goes_on_to_the_same_bits(tmp_path, over_amplitude):
    _, whole = over_amplitude
    parts = tmp_path / "parts"
    curve_of(nfrc_case(truncation=ALLOWED, harmonics=61, points=12), parts)
    case = nfrc_case(truncation=ALLOWED, harmonics=61, points=18)
    (resumed,) = follow_all(case, parts, MPI.COMM_SELF, resume=True)
    assert len(resumed.points) >= 18
    assert [p.xi.tolist() for p in resumed.points] == [p.xi.tolist() for p in whole.points[: len(resumed.points)]]
