"""Steady states of sites: folds, energy, stability against Floquet's and time integration, files that go on."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import root

from tests.conftest import assert_same_bits, datasets
from vipetsc.case import Case, CaseError
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.verb_cases import load_every
from vipetsc.dynamics import simulate
from vipetsc.figures.registry import draw
from vipetsc.io.store import RunMemory
from vipetsc.lattice import DenseCompliance, Spring
from vipetsc.modes.balance.harmonic_balance import HarmonicBalance
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.balance.hill import Hill
from vipetsc.modes.branches.files import read_branch
from vipetsc.modes.branches.follow import follow_all
from vipetsc.modes.branches.response_layout import measure, sweep_down, sweep_up
from vipetsc.modes.branches.sweeps import ParameterSweep, swept, with_stable_folds
from vipetsc.modes.response.steady import SteadyStates
from vipetsc.modes.response.steps import first_state

pytestmark = pytest.mark.parallel(1)

LATTICE = {"preset": "four-band", "cells": 30}
D = 10**-2.75
CONTACTS = {"sites": [10], "clearance": D, "restitution": 1.0}
NFRC = {"harmonics": 11, "range": [0.98, 1.01]}


def case(lattice=None, contacts=None, **nfrc):
    table = {"name": "x", "lattice": LATTICE | (lattice or {}), "contacts": CONTACTS | (contacts or {})}
    return NfrcCase.from_table(table | {"nfrc": NFRC | nfrc})


def curve_of(of, folder):
    folder.mkdir(exist_ok=True)
    (curve,) = follow_all(of, folder, MPI.COMM_SELF)
    return curve


def refined(few, many, xi):
    """The solution beside ``xi`` with the harmonics of ``many``."""
    z = np.pad(few.balance.unpack(xi[:-1]), ((0, 0), (0, many.options.harmonics - few.options.harmonics)))
    return many.at(np.append(many.balance.pack(z), xi[-1]), xi[-1])


def start_of(states, xi, cells, phase=0.0):
    """Displacement and velocity (cells, dofs) of a steady state at a phase."""
    omega, amplitude = states.drive(xi[-1])
    z = states.balance.unpack(xi[:-1] * states.clearance)
    forces, rates = states.balance.series(xi[:-1] * states.clearance, omega).forces, 1j * omega * np.arange(z.shape[1])
    first = forces[:, 1] if states.wave else np.append(forces[:, 1], amplitude)
    parts = [states.compliance.field(k * omega, first if k == 1 else forces[:, k], cells) for k in range(1, z.shape[1])]
    if states.wave:
        parts[0] = parts[0] + states.linear_motion(omega).wave.field(cells) * amplitude * states.clearance
    parts = [part * np.exp(1j * k * phase) for k, part in enumerate(parts, 1)]
    return sum(part.real for part in parts), sum((rates[k] * part).real for k, part in enumerate(parts, 1))


def moved(chain, contact, site, periods, omega, state, force=0.0):
    """Displacement and velocity of pair and all masses after each of ``periods``, by integration in time."""
    stiffness, masses, n = chain.stiffness_matrix().tocsr(), chain.masses(), chain.cells * chain.cell.dofs
    host, resonator = site * chain.cell.dofs + chain.cell.host, site * chain.cell.dofs + chain.cell.resonator

    def rate(t, y):
        acceleration = -(stiffness @ y[:n])
        acceleration[0] += force * np.cos(omega * t)
        f = contact.force(y[resonator] - y[host], chain.clearances[0])
        acceleration[resonator] -= f
        acceleration[host] += f
        return np.concatenate([y[n:], acceleration / masses])

    times = np.arange(periods + 1) * 2 * np.pi / omega
    return solve_ivp(rate, times[[0, -1]], state, "DOP853", times, rtol=1e-9, atol=1e-12, max_step=2e-4).y


def test_hill_finds_the_multipliers_of_a_forced_duffing_oscillator():
    omega = 1.8
    forces = SiteForces([], [Spring(0, 1, 1.0, cubic=1.0)])
    compliance = DenseCompliance(np.ones(1), np.eye(1), np.eye(1))
    balance = HarmonicBalance(compliance, forces, 15, True, cosines=False)
    linear = np.zeros((1, 16), complex)
    linear[0, 1] = 0.3 / (1 - omega**2)
    shift, counts = balance.shift(omega), []
    for guess in (-0.14, 1.8, -1.6):  # out of phase and small; in phase and large; between
        x = balance.pack(np.zeros((1, 16), complex))
        x[0] = guess
        solved = root(lambda x: balance.residual(x, omega, shift, linear), x, tol=1e-13)
        assert solved.success
        series = balance.series(solved.x, omega)
        hill = Hill(compliance, omega, 15, odd=True, finite=True)
        counts.append(hill.unstable(series))

        def rate(t, y):
            return [y[1], -y[0] - y[0] ** 3 + 0.3 * np.cos(omega * t), y[3], -(1 + 3 * y[0] ** 2) * y[2], y[5],
                    -(1 + 3 * y[0] ** 2) * y[4]]  # fmt: skip

        z, k = balance.unpack(solved.x)[0], np.arange(16)
        start = [z.sum().real, (1j * k * omega * z).sum().real, 1, 0, 0, 1]
        end = solve_ivp(rate, (0, 2 * np.pi / omega), start, "DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
        assert end[:2] == pytest.approx(start[:2], abs=1e-8)
        largest = np.abs(np.linalg.eigvals(end[2:].reshape(2, 2))).max()
        assert hill.fastest(series) == pytest.approx(np.log(largest) / (2 * np.pi), abs=1e-8)
    assert counts == [0, 0, 1]


@pytest.mark.slow
def test_the_upper_fold_of_one_site_under_a_wave_and_its_energy(tmp_path):
    for curve in follow_all(case(restitutions=[1.0, 0.7], range=[0.996, 1.01]), tmp_path, MPI.COMM_SELF):
        assert curve.complete and curve.ending == "reached the end of nfrc.range, 0.996"
        folds = [i for i, point in enumerate(curve.points) if point.kind == "fold"]
        p, share = measure(curve, "amplitude"), measure(curve, "share")
        size = measure(curve, "largest")[:, 0] / 10**-2.75
        assert p[folds] == pytest.approx([1.0014], abs=2e-4)
        assert np.abs(share.sum(axis=1) - 1).max() < 1e-8
        assert np.all(share > -1e-12) and (share[-1, 3] > 1e-7) == ("r0.7" in curve.name) and share[-1, 2] > 1e-5
        free = p < 1
        free[folds[0] :] = False
        assert size[free] == pytest.approx(p[free], rel=1e-12) and np.all(measure(curve, "unstable")[free] == 0)
        after = np.arange(len(p)) > folds[0] + 1
        assert np.all(measure(curve, "unstable")[after] % 2 == 1) and np.all(measure(curve, "growth")[after] > 0.01)
        assert sweep_up(curve)[-1] <= folds[0] and sweep_down(curve) == sweep_up(curve)[::-1]


@pytest.mark.slow
def test_a_forced_lattice_with_ends_returns_after_a_period(tmp_path):
    """Over frequency, from a state in contact on; both parameters enter the equations."""
    of = case({"cells": 6}, {"sites": [3]}, source="force", infinite=False, over="frequency", range=[2000.0, 2010.0],
              fixed=[14.0], harmonics=9, largest_step=1.0)  # fmt: skip
    curve = curve_of(of, tmp_path)
    assert curve.complete, curve.ending
    last, chain = curve.points[-1], of.model().chain
    assert last.measures.episodes == 2 and last.measures.frequency == pytest.approx(2010)
    more = of.model_copy(update={"nfrc": of.nfrc.model_copy(update={"harmonics": 41})})
    states = SteadyStates(more, 1.0, 14.0)
    u, v = start_of(states, refined(SteadyStates(of, 1.0, 14.0), states, last.xi), np.arange(6))
    state = np.concatenate([u.ravel(), v.ravel()])
    end = moved(chain, of.contact(1.0), 2, 1, 2010.0, state, 14.0)[:, -1]
    assert np.abs(end - state)[:24].max() < 1e-5 * np.abs(state[:24]).max()
    assert np.isnan(measure(curve, "share")).all()  # nothing leaves and nothing is lost


@pytest.mark.slow
def test_a_steady_state_is_where_a_long_run_ends():
    """From rest, r = .3, under a force, until waves come back from the ends: the first harmonic of w."""
    place, force = {"sites": [250], "restitution": 0.3}, {"waveform": "harmonic", "cell": 230, "frequency": 1023.27}
    table = {"name": "x", "lattice": LATTICE | {"cells": 500}, "contacts": CONTACTS | place, "drive": force}
    options = {"source": "force", "largest_step": 1.0, "fixed": [1023.27]}
    amplitude = 1.6 * SteadyStates(NfrcCase.from_table(table | {"nfrc": options}), 0.3, 1023.27).parameter.scale
    few, many = (
        SteadyStates(NfrcCase.from_table(table | {"nfrc": options | {"harmonics": last, "range": [amplitude, 99.0]}}),
                     0.3, 1023.27) for last in (9, 61)
    )  # fmt: skip
    measures = many.measured(refined(few, many, first_state(few).xi))
    assert measures.unstable == 0 and measures.episodes == 4
    period, samples = 2 * np.pi / 1023.27, 64  # fewer would take high harmonics for the first
    drive = force | {"amplitude": amplitude, "ramp": 40 * period}
    time = {"engine": "propagator", "end": 180 * period, "sample_interval": period / samples}
    memory = RunMemory(MPI.COMM_SELF)
    simulate(Case.from_table(table | {"drive": drive, "time": time, "output": {"window": [250, 250]}}), memory)
    u = memory.dataset["displacement"].values[-1 - 8 * samples : -1, 0]
    turns = np.exp(-2j * np.pi * np.arange(len(u)) / samples)
    first = 2 * np.abs(np.mean(turns * (u[:, 2] - u[:, 1])))
    z = measures.harmonics[0, 1]
    assert first == pytest.approx(abs(z), rel=5e-4)


THREE = {"sites": [10, 12, 15], "clearance": [D, 0.97 * D, 0.9 * D], "restitution": 0.7}


@pytest.mark.slow
@pytest.mark.parametrize("nfrc", [{}, {"over": "frequency", "range": [1023.0, 1040.0], "fixed": [0.9008], "points": 3}])
def test_energy_at_several_sites_and_their_mirror_image(nfrc, tmp_path):
    """T + R + U + L = 1; the lattice is its own mirror image, so that a wave may come from the other side."""
    nfrc = {"range": [0.89, 0.94], "harmonics": 5, "points": 6, "first_step": 0.1, "largest_step": 0.5} | nfrc
    turned = THREE | {"sites": [21, 19, 16]}
    curves = [curve_of(case(None, contacts, **nfrc, direction=way), tmp_path / way)
              for contacts, way in ((THREE, "forward"), (turned, "backward"))]  # fmt: skip
    for curve in curves:
        share = measure(curve, "share")
        assert len(curve.points) >= 3 and np.abs(share.sum(axis=1) - 1).max() < 1e-8
        assert share[-1].min() > 1e-9 and measure(curve, "episodes")[-1] >= 2
    for name in ("share", "largest", "unstable"):
        assert measure(curves[0], name) == pytest.approx(measure(curves[1], name), rel=1e-6, abs=1e-12)
    # Even harmonics are zero, and what perturbations do is the same, found in one determinant or in two.
    ((_, _, fixed),) = NfrcCase.from_toml(curves[0].case).curves()
    both = [SteadyStates(case(None, THREE, **nfrc, symmetric=symmetric), 0.7, fixed) for symmetric in (True, False)]
    xi, parameter = curves[0].points[-1].xi[:-1], curves[0].points[-1].xi[-1]
    more = np.append(both[1].balance.pack(both[0].balance.unpack(xi)), parameter)
    shift = both[1].balance.shift(both[1].drive(more[-1])[0])
    assert np.abs(both[1].residual(more, shift)).max() < 1e-9
    for name in ("unstable", "growth", "fractions"):
        expected = pytest.approx(getattr(curves[0].points[-1].measures, name), rel=1e-6, abs=1e-9)
        assert getattr(both[1].measured(more), name) == expected
    (picture,) = draw("branches", [tmp_path / "forward"])
    assert picture.exists()


@pytest.mark.slow
def test_what_a_force_gives_a_lattice_with_ends_is_lost(tmp_path):
    sites, options = THREE | {"sites": [3, 5, 8]}, {"source": "force", "infinite": False, "fixed": [2000.0]}
    states = SteadyStates(case({"cells": 12}, sites, **options), 0.7, 2000.0)
    touching = min(sites["clearance"] / np.abs(states.linear_motion(2000.0).harmonics[:, 1]))
    options |= {"range": [0.999 * touching, 1.02 * touching], "points": 4, "harmonics": 5}
    curve = curve_of(case({"cells": 12}, sites, **options), tmp_path)
    touches = measure(curve, "episodes") > 0
    assert touches.any() and measure(curve, "share")[touches, 3] == pytest.approx(1.0, abs=1e-8)


@pytest.mark.slow
def test_a_curve_goes_on_to_the_same_bits(tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    whole.mkdir()
    parts.mkdir()
    of = case(harmonics=5, restitutions=[0.7], range=[0.999, 1.0005], first_step=2e-4, largest_step=3e-4)
    curve = curve_of(of, whole)
    begun = of.model_copy(update={"nfrc": of.nfrc.model_copy(update={"points": 3})})
    (first,) = follow_all(begun, parts, MPI.COMM_SELF)
    assert not first.complete and "raise nfrc.points" in first.ending
    (second,) = follow_all(of, parts, MPI.COMM_SELF, resume=True)
    assert second.complete
    name = f"branch-{curve.name}.h5"
    assert_same_bits(datasets(whole / name), datasets(parts / name))
    assert (whole / name.replace("h5", "csv")).read_text() == (parts / name.replace("h5", "csv")).read_text()
    again = read_branch(whole / name)
    assert np.array_equal(measure(again, "share"), measure(curve, "share")) and again.complete
    (picture,) = draw("branches", [whole])
    assert picture.name == f"branch-{curve.name}.png"


def test_sweeps_jump_between_stable_states(tmp_path):
    """A made-up S with a stable upper part: up it jumps at one fold, to the nearer of two states, down at the other."""
    p = [0.5, 0.8, 1.0, 0.9, 0.7, 0.6, 0.8, 1.0, 1.2, 1.15, 1.05, 0.95]
    stable = np.array([1, 1, 0, 0, 0, 0, 1, 1, 1, 0, 1, 1], bool)
    fold = np.isin(np.arange(12), (2, 5))
    up = ParameterSweep(np.array(p), size=0.1 * np.arange(12), stable=with_stable_folds(stable, fold))
    assert swept(up) == [0, 1, 2, 8]
    assert swept(up._replace(parameter=-up.parameter), start=8) == [8, 7, 6, 5, 0]


@pytest.mark.parametrize(
    ("nfrc", "key"),
    [
        ({"range": [1.0, 0.5]}, "nfrc.range"),
        ({"infinite": False}, "nfrc.infinite"),
        ({"over": "frequency", "range": [900.0, 1000.0]}, "nfrc.fixed"),
        ({"fixed": [650.0]}, "nfrc.fixed"),
        ({"band": 1}, "nfrc.fixed"),
        ({"smallest_step": 1.0}, "nfrc.smallest_step"),
        ({"harmonic": 3}, "nfrc.harmonic"),
    ],
)
def test_bad_input_names_its_key(nfrc, key):
    with pytest.raises(CaseError) as error:
        case(**nfrc)
    assert [problem.key for problem in error.value.problems] == [key]


def test_a_site_is_needed_and_validate_reads_the_section(tmp_path):
    with pytest.raises(CaseError, match=r"contacts\.sites"):
        case(contacts={"sites": 0, "clearance": None})
    path = tmp_path / "x.toml"
    path.write_text('[lattice]\npreset = "four-band"\n[nfrc]\n[contacts]\nsites = [10]\n')
    assert "NfrcCase" in [type(of).__name__ for of in load_every(path)]


def test_a_force_on_an_infinite_lattice_gives_what_leaves_and_is_lost(tmp_path):
    force = {"source": "force", "harmonics": 7, "largest_step": 1.0}
    touching = SteadyStates(case(**force), 0.7, 1023.27).parameter.scale
    (curve,) = follow_all(
        case(contacts={"restitution": 0.7}, **force, range=[0.99 * touching, 1.0005 * touching]),
        tmp_path,
        MPI.COMM_SELF,
    )
    assert curve.complete and curve.points[-1].measures.episodes == 2
    assert np.abs(measure(curve, "share").sum(axis=1) - 1).max() < 1e-8
    assert curve.points[-1].measures.fractions[3] > 0
