"""Steady states of sites: folds, energy, stability against Floquet's and time integration, files that go on."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import xarray as xr
from scipy.integrate import solve_ivp
from scipy.optimize import root

from tests.conftest import assert_same_bits, datasets
from vipetsc.case import Case, CaseError
from vipetsc.case.every import load_every
from vipetsc.case.nfrc import NfrcCase
from vipetsc.dynamics import simulate
from vipetsc.figures.registry import draw
from vipetsc.io.netcdf import variable, write_netcdf
from vipetsc.io.store import RunMemory
from vipetsc.lattice import DenseCompliance
from vipetsc.modes.condensed import Balance
from vipetsc.modes.harmonics import SiteForces
from vipetsc.modes.hill import Hill
from vipetsc.modes.nfrc import Curve, follow_curves, swept
from vipetsc.modes.steady import SteadyPoint, SteadyStates

pytestmark = pytest.mark.parallel(1)

LATTICE = {"preset": "four-band", "cells": 30}
CONTACTS = {"sites": [10], "clearance": 10**-2.75, "restitution": 1.0}
NFRC = {"harmonics": 11, "range": [0.98, 1.01]}


def case(lattice=None, contacts=None, **nfrc):
    table = {"name": "x", "lattice": LATTICE | (lattice or {}), "contacts": CONTACTS | (contacts or {})}
    return NfrcCase.from_table(table | {"nfrc": NFRC | nfrc})


def curve_of(of, folder):
    (curve,) = follow_curves(of, folder, MPI.COMM_SELF)
    return curve


def start_of(states, xi, cells, phase=0.0):
    """Displacement and velocity (cells, dofs) of a steady state at a phase."""
    omega, amplitude = states.parameters(xi[-1])
    z = states.balance.unpack(xi[:-1] * states.clearance)
    forces, rates = states.balance.series(xi[:-1] * states.clearance, omega).forces, 1j * omega * np.arange(z.shape[1])
    first = forces[:, 1] if states.wave else np.append(forces[:, 1], amplitude)
    states.linear(omega)
    parts = [states.compliance.field(k * omega, first if k == 1 else forces[:, k], cells) for k in range(1, z.shape[1])]
    if states.wave:
        parts[0] = parts[0] + states._known[omega][1].field(cells) * amplitude * states.clearance
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
    omega, forces, compliance = 1.8, SiteForces([], [(0.0, 1.0)]), DenseCompliance(np.ones(1), np.eye(1), np.eye(1))
    balance = Balance(compliance, forces, 15, True, cosines=False)
    linear = np.zeros((1, 16), complex)
    linear[0, 1] = 0.3 / (1 - omega**2)
    counts = []
    for guess in (-0.14, 1.8, -1.6):  # out of phase and small; in phase and large; between
        x = balance.pack(np.zeros((1, 16), complex))
        x[0] = guess
        solved = root(lambda x: balance.residual(x, omega, linear), x, tol=1e-13)
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


def test_the_upper_fold_of_one_site_under_a_wave_and_its_energy(tmp_path):
    for curve in follow_curves(case(restitutions=[1.0, 0.7]), tmp_path, MPI.COMM_SELF):
        assert curve.complete and curve.ending == "reached the end of nfrc.range, 0.98"
        folds = [i for i, point in enumerate(curve.points) if point.kind == "fold"]
        p, share, size = curve.column("amplitude"), curve.column("share"), curve.column("largest")[:, 0] / 10**-2.75
        assert p[folds] == pytest.approx([1.0014], abs=2e-4)
        assert np.abs(share.sum(axis=1) - 1).max() < 1e-8
        assert np.all(share > -1e-12) and (share[-1, 3] > 1e-5) == ("r0.7" in curve.name) and share[-1, 2] > 1e-4
        free = p < 1
        free[folds[0] :] = False
        assert size[free] == pytest.approx(p[free], rel=1e-12) and np.all(curve.column("unstable")[free] == 0)
        after = np.arange(len(p)) > folds[0] + 1
        assert np.all(curve.column("unstable")[after] % 2 == 1) and np.all(curve.column("growth")[after] > 0.01)
        assert swept(curve, 1)[-1] <= folds[0] and swept(curve, -1) == swept(curve, 1)[::-1]


def test_a_forced_lattice_with_ends_returns_after_a_period(tmp_path):
    """Over frequency, from a state in contact on; both parameters enter the equations."""
    of = case({"cells": 6}, {"sites": [3]}, source="force", infinite=False, over="frequency", range=[2000.0, 2010.0],
              fixed=[14.0], harmonics=41, largest_step=1.0)  # fmt: skip
    curve = curve_of(of, tmp_path)
    assert curve.complete, curve.ending
    last, chain = curve.points[-1], of.model().chain
    assert last.measures["episodes"] == 2 and last.measures["frequency"] == pytest.approx(2010)
    states = SteadyStates(of, 1.0, 14.0)
    u, v = start_of(states, last.xi, np.arange(6))
    state = np.concatenate([u.ravel(), v.ravel()])
    end = moved(chain, of.contact(1.0), 2, 1, 2010.0, state, 14.0)[:, -1]
    assert np.abs(end - state)[:24].max() < 1e-5 * np.abs(state[:24]).max()
    assert np.isnan(curve.column("share")).all()  # nothing leaves and nothing is lost


def test_a_stable_state_under_a_wave_stays_in_a_long_lattice(tmp_path):
    """Behind the folds, with r = .3: the engine's run from the state, disturbed, comes back to it period by period."""
    of = case({"cells": 161}, {"sites": [81], "restitution": 0.3}, range=[1.6, 1.7], harmonics=41, points=1)
    curve = curve_of(of, tmp_path)
    point, states = curve.points[0], SteadyStates(of, 0.3, of.nfrc.fixed[0])
    assert point.measures["unstable"] == 0 and point.measures["largest"][0] > 1.15 * 10**-2.75
    z = point.measures["harmonics"][0] + 1j * point.measures["harmonics_imaginary"][0]
    order, phases = np.arange(len(z)), np.linspace(0, np.pi, 2001)
    w = (z * np.exp(1j * order * phases[:, None])).sum(axis=1).real
    open_phase = phases[np.argmin(np.abs(w))]
    u, v = start_of(states, point.xi, np.arange(161), open_phase)
    at_rest = u[80, 2] - u[80, 1]
    u[80, 2] += 0.02 * 10**-2.75
    cells, dofs = (variable(name, np.arange(1, n + 1), "1", name) for name, n in (("cell", 161), ("dof", 4)))
    fields = {name: variable(("cell", "dof"), f, "m", name) for name, f in (("displacement", u), ("velocity", v))}
    write_netcdf(tmp_path / "state.h5", xr.Dataset({"cell": cells, "dof": dofs} | fields))
    period = 2 * np.pi / states.fixed
    time = {"engine": "propagator", "end": 20 * period, "sample_interval": period / 8}
    initial = {"kind": "file", "path": str(tmp_path / "state.h5")}
    table = {"name": "x", "lattice": LATTICE | {"cells": 161}, "initial": initial, "time": time}
    contacts = CONTACTS | {"sites": [81], "restitution": 0.3}
    run = Case.from_table(table | {"contacts": contacts, "drive": {"frequency": states.fixed, "amplitude": 0.0}})
    memory = RunMemory(MPI.COMM_SELF)
    simulate(run, memory)
    u = memory.dataset["displacement"].values[::8, 80]
    away = np.abs(u[:, 2] - u[:, 1] - at_rest) / 10**-2.75
    assert away[0] == pytest.approx(0.02, rel=1e-6) and away[10:18].max() < 4e-3  # what harmonics left out make


def test_a_curve_goes_on_to_the_same_bits(tmp_path):
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    whole.mkdir()
    parts.mkdir()
    of = case(harmonics=5, restitutions=[0.7])
    curve = curve_of(of, whole)
    begun = of.model_copy(update={"nfrc": of.nfrc.model_copy(update={"points": 12})})
    (first,) = follow_curves(begun, parts, MPI.COMM_SELF)
    assert not first.complete and "raise nfrc.points" in first.ending
    (second,) = follow_curves(of, parts, MPI.COMM_SELF, resume=True)
    assert second.complete
    name = f"branch-{curve.name}.h5"
    assert_same_bits(datasets(whole / name), datasets(parts / name))
    assert (whole / name.replace("h5", "csv")).read_text() == (parts / name.replace("h5", "csv")).read_text()
    again = Curve.read(whole / name, of)
    assert np.array_equal(again.column("share"), curve.column("share")) and again.complete
    (picture,) = draw("branches", [whole])
    assert picture.name == f"branch-{curve.name}.png"


def test_sweeps_jump_between_stable_states(tmp_path):
    """A made-up S with a stable upper part: up it jumps at one fold, to the nearer of two states, down at the other."""
    curve = Curve("s", case())
    p = [0.5, 0.8, 1.0, 0.9, 0.7, 0.6, 0.8, 1.0, 1.2, 1.15, 1.05, 0.95]
    for i, (at, stable) in enumerate(zip(p, [1, 1, 0, 0, 0, 0, 1, 1, 1, 0, 1, 1], strict=True)):
        measures = {"amplitude": at, "unstable": 1 - stable, "largest": np.array([0.1 * i])}
        kind = "fold" if i in (2, 5) else "regular"
        curve.points.append(SteadyPoint(np.zeros(1), np.zeros(1), 0.1, kind, measures))
    assert swept(curve, 1) == [0, 1, 2, 8]
    assert swept(curve, -1) == [8, 7, 6, 5, 0]


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
    touching = SteadyStates(case(**force), 0.7, 1023.27).scale
    (curve,) = follow_curves(
        case(contacts={"restitution": 0.7}, **force, range=[0.99 * touching, 1.0005 * touching]),
        tmp_path,
        MPI.COMM_SELF,
    )
    assert curve.complete and curve.points[-1].measures["episodes"] == 2
    assert np.abs(curve.column("share").sum(axis=1) - 1).max() < 1e-8
    assert curve.points[-1].measures["share"][3] > 0
