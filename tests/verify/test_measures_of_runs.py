"""Modal energies, transfers, named points, contact forces, Lyapunov exponents and sections of runs, against theory."""

from __future__ import annotations

import json
from itertools import pairwise

from mpi4py import MPI

import numpy as np
import pytest
from scipy.optimize import brentq

from tests.conftest import StopAt, run_of, search_table, small_case
from vipetsc.case import Case, Sweep
from vipetsc.case.optimise import OptimiseCase
from vipetsc.dynamics.run import simulate
from vipetsc.figures.modal import MovedEnergies
from vipetsc.figures.sections import sections_of
from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.read import open_ensemble, open_run, whole_members
from vipetsc.lattice import modes
from vipetsc.spectra import ModalParts, histories
from vipetsc.spectra.measures import measures_of
from vipetsc.studies.analysis import analyse
from vipetsc.studies.ensemble import COMPLETE, SCALED
from vipetsc.studies.optimum_search import run_search
from vipetsc.studies.sweep import run_sweep

# The indices of the bands among the parts of the four-band lattice's spectrum; the other parts are gaps.
BANDS = [0, 2, 4, 6]


@pytest.fixture(scope="module")
def builtin():
    """The built-in run by exact steps, and its modal energies and transfers."""
    run = run_of(Case.load(overrides=['time.engine="propagator"']))
    return run, analyse(run, ["bands/transfer"])


def losses(run, analysis):
    """The energy in J lost in each cluster of contacts, summed from the log of impacts."""
    cluster = analysis["bands/cluster_of_episode"].values - 1
    return np.bincount(cluster, run["impacts/loss"].values, len(analysis["bands/cluster"]))


def test_modal_energies_of_the_built_in_run(builtin):
    """Modal energies sum to the energy, change in contacts alone, and end with known shares."""
    run, analysis = builtin
    energy = analysis["bands/modal_energy"]
    time = analysis["bands/instant"].values
    work = run["energy/work"].values[-1]
    assert len(time) > 400
    assert energy.attrs["error"] < 1e-12
    assert energy.attrs["modes"] == "of the lattice"

    whole = (run["energy/kinetic"] + run["energy/spring"]).values[np.searchsorted(run["time"].values, time)]
    assert np.abs(energy.values.sum(axis=0) - whole).max() < 1e-12 * whole.max()
    assert analysis["bands/bin_energy"].values.sum(axis=0) == pytest.approx(energy.values.sum(axis=0), rel=1e-12)

    # Nothing changes between two clusters of contacts, nor after the last one.
    begin = analysis["bands/cluster_begin"].values
    end = analysis["bands/cluster_end"].values
    waits = 0
    for start, stop in zip(end, [*begin[1:], np.inf], strict=True):
        inside = energy.values[:, (time >= start) & (time <= stop)]
        assert np.ptp(inside, axis=1).max() < 1e-9 * work
        waits += inside.shape[1] > 1
    assert waits > 20

    shares = energy.values[BANDS, -1] / energy.values[:, -1].sum()
    assert shares == pytest.approx([0.0021, 0.5691, 0.2974, 0.1314], abs=6e-5)

    # Modes of the fixed ends lie in a gap.
    parts = ModalParts.of(Case.of(run).model().chain)
    at_ends = np.flatnonzero(~np.isin(parts.part, BANDS))
    assert parts.modes.frequency[at_ends] == pytest.approx([2034.825] * 2, abs=1e-3)


def test_transfers_close_the_ledger_of_every_cluster(builtin):
    """The transfers of a cluster of contacts sum to minus the loss of its impacts, which lie within the cluster."""
    run, analysis = builtin
    transfer = analysis["bands/transfer"]
    work = run["energy/work"].values[-1]
    assert len(transfer) < len(run["impacts/onset"])
    assert transfer.attrs["cluster_stride"] == 1

    assert np.abs(transfer.values.sum(axis=1) + losses(run, analysis)).max() < 1e-9 * work
    assert analysis["bands/drive_work"].values.sum() == pytest.approx(work, rel=1e-9)

    cluster = analysis["bands/cluster_of_episode"].values - 1
    assert np.all(analysis["bands/cluster_begin"].values[cluster] <= run["impacts/onset"].values)
    assert np.all(run["impacts/separation"].values <= analysis["bands/cluster_end"].values[cluster])


@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_what_contacts_that_are_closed_at_first_and_last_dissipate_is_that_of_the_log(engine):
    """A contact that is closed when the run begins or ends has energy of its own, which is not dissipated."""
    cell = {"masses": [1e-3], "springs": [{"start": 1, "end": 1, "stiffness": 1.1e3, "next_cell": True}]}
    contacts = {"law": "bilinear", "stiffness": 4e4, "restitution": 0.5, "sites": [1, 2], "pair": [0, 1]}
    contacts |= {"side": "plus", "clearance": 0.0}
    initial = {"kind": "mode", "number": 1, "amplitude": 5e-4}
    table = {"lattice": {"cells": 2, "cell": cell}, "contacts": contacts, "initial": initial}
    run = run_of(Case.from_table(table | {"time": {"end": 3.6e-3, "engine": engine}}))
    contact = run["energy/contact"].values
    analysis = analyse(run, ["bands/transfer"])

    moved = MovedEnergies.of(run, analysis, parts=[0])

    # The contacts are closed at first, and at last.
    assert contact[0] > 0
    assert contact[-1] > 0
    lost = moved.energy[:, -1].sum()
    assert lost == pytest.approx(run["energy/dissipated"].values[-1], rel=1e-9)
    assert -analysis["bands/transfer"].values.sum() == pytest.approx(lost + contact[-1] - contact[0], rel=1e-9)


def test_work_of_the_drive_is_no_transfer():
    """The work that the drive does during a cluster of contacts is not part of the cluster's transfers."""
    run = run_of(small_case(time={"engine": "propagator", "end": 0.08}))
    model = Case.of(run).model()
    analysis = analyse(run, ["bands/transfer"])
    time = run["time"].values
    work = run["energy/work"].values
    begin = analysis["bands/cluster_begin"].values
    end = analysis["bands/cluster_end"].values

    # Some clusters lie within the burst, and the drive does noticeable work in them.
    done = np.interp(end, time, work) - np.interp(begin, time, work)
    driven = (begin < model.drive.duration) & (end - begin < 2e-3)
    assert np.count_nonzero(driven & (np.abs(done) > 1e-3 * work[-1])) > 2

    transfer = analysis["bands/transfer"].values
    missing = np.abs(transfer.sum(axis=1) + losses(run, analysis))
    assert missing[driven].max() < 1e-8 * np.abs(work).max()

    total = run["energy/kinetic"].values[-1] + run["energy/spring"].values[-1]
    assert transfer.sum() + analysis["bands/drive_work"].values.sum() == pytest.approx(total, rel=1e-12)


def test_a_long_lattice_is_measured_on_a_ring(monkeypatch):
    """A lattice with more than MOST_DOFS degrees of freedom is measured by modes of a ring with one cell more."""
    run = run_of(small_case(lattice={"cells": 60}, time={"engine": "propagator", "end": 0.08}))
    exact = analyse(run, ["bands/transfer"])

    # The modes of this lattice are kept from the analysis before, and must not be kept for the next test.
    modes._modes.cache_clear()
    monkeypatch.setattr(modes, "MOST_DOFS", 100)
    ring = analyse(run, ["bands/transfer"])
    modes._modes.cache_clear()

    assert ring["bands/modal_energy"].attrs["modes"] == "of a ring of 61 cells"
    assert ring["bands/modal_energy"].attrs["error"] < 1e-12

    largest = exact["bands/modal_energy"].values.max()
    # The drive acts at an end, which the ring does not have: while it acts, waves are assigned to other bands.
    late = exact["bands/instant"].values > 0.06
    difference = ring["bands/modal_energy"].values - exact["bands/modal_energy"].values
    assert np.abs(difference[:, late]).max() < 0.02 * largest


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
    """Transmission by part is the ratio of receiver and source in each part of the spectrum, NaN without a source."""
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


SHAKEN_POINTS = [{"name": "base", "cell": 2}, {"name": "tip", "cell": 8, "mass": 2}]
FORCE_BOUND = 15.0  # N, a bound that some designs exceed, among them the best one without the bound
OUTPUT = {"points": SHAKEN_POINTS, "transmission": [["base", "tip"]]}
SHAKEN = {
    "name": "shaken",
    "lattice": {
        "cells": 24,
        # The damping is so strong that the motion settles within the run, and steady amplitudes exist.
        "damping": {"mass": 60.0, "stiffness": 2e-5},
        "cell": {
            "masses": [0.01, 0.004],
            "springs": [
                {"start": 1, "end": 1, "stiffness": 2e4, "next_cell": True},
                {"start": 1, "end": 2, "stiffness": 6e3},
            ],
        },
    },
    "contacts": {"stiffness": 5e6, "restitution": 0.7, "sites": [4], "clearance": 4e-5},
    "drive": {"waveform": "harmonic", "cell": 2},
    "time": {"end": 0.4, "rtol": 1e-8},
    "output": OUTPUT,
}


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """The plan, the folder and the result of a sweep over amplitude and frequency."""
    folder = tmp_path_factory.mktemp("shaken")
    # Members of the lower amplitude have no contact and are scaled from the linear run; those of the upper one impact.
    axes = {"drive": {"amplitude": [0.25, 3.0], "frequency": [300.0, 900.0]}, "measures": ["motion"]}
    plan = Sweep.from_table(SHAKEN | {"sweep": axes})
    return plan, folder, run_sweep(plan, folder, MPI.COMM_SELF)


def test_members_have_the_measures_of_single_runs(swept):
    """A member, simulated or scaled from the linear run, has the measures of a run of its case."""
    plan, folder, result = swept
    # Some members were simulated and some were scaled.
    assert {COMPLETE, SCALED} == set(result.status.ravel().tolist())
    ensemble = open_ensemble(folder)
    assert "ibtet" not in ensemble

    for number in (1, 3):
        case = plan.case(number)
        single = analyse(run_of(case), ["motion"])
        place = dict(zip(ensemble["status"].dims, np.unravel_index(number, plan.shape), strict=True))
        # Every measure of motions and of contacts that is registered, those of points among them.
        names = {str(name) for name in single.data_vars} & set(measures_of(["base", "tip"], [("base", "tip")]))
        assert len(names) > 20 and names <= set(ensemble.data_vars)
        for name in sorted(names):
            value = ensemble[name].isel(place).values
            # A scaled member has the steps of the linear run, which differ from those of its own run.
            tolerance = 1e-9 if "drift" in name else 1e-5 * np.abs(single[name].values).max()
            if name.startswith("band"):
                # In other parts, which the drive does not excite, only leakage from the ends of the record is left.
                value, tolerance = value[:1], 1e-3
            assert value == pytest.approx(
                np.atleast_1d(single[name].values)[: value.size].reshape(value.shape), abs=tolerance, nan_ok=True
            ), name
    # The comparison would hold trivially if all forces were zero.
    assert ensemble["largest_force"].values.max() > 0.1
    assert ensemble["largest_force"].attrs["units"] == "N"


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    """A small search that minimises the velocity at a point, with a bounded force and a bounded transmission."""
    table = search_table(
        24,
        [8],
        output={"points": [{"name": "base", "cell": 2}, {"name": "tip", "cell": 16, "mass": 3}]},
        drive={"amplitude": 24.33},
        optimise={"budget": 6, "population": 4},
    )
    table["output"]["transmission"] = [["base", "tip"]]
    table["optimise"] |= {
        "objective": [{"measure": "peak_velocity/tip", "goal": "minimise"}],
        "constraint": [
            {"measure": "largest_force", "at_most": FORCE_BOUND},
            {"measure": "band_transmission/base-tip", "band": 2, "at_most": 100.0, "amplitudes": [5.0]},
        ],
    }

    folder = tmp_path_factory.mktemp("search")
    plan = OptimiseCase.from_table(table)
    return plan, folder, run_search(plan, folder, MPI.COMM_SELF).attrs["summary"]


def test_a_search_takes_measures_of_points_and_keeps_to_its_constraints(searched):
    """A search has the values of single runs, and its best design is the best of those that keep to all bounds."""
    plan, folder, summary = searched
    with open_netcdf(folder / "optimum.h5", "search") as file:
        optimum = file.load()
    design = plan.design(optimum["parameter"].values[2])
    run = analyse(run_of(plan.run(design, 24.33)), ["motion"])
    assert float(optimum["value"][2, 0]) == pytest.approx(float(run["peak_velocity/tip"]), rel=1e-12)
    assert float(optimum["constrained"][2, 0]) == pytest.approx(float(run["largest_force"]), rel=1e-12)
    weaker = analyse(run_of(plan.run(design, 5.0)), ["motion"])["band_transmission/base-tip"]
    second = list(weaker.attrs["parts"]).index("band 2")
    assert float(optimum["constrained"][2, 1]) == pytest.approx(float(weaker[second]), rel=1e-12)

    force = optimum["constrained"].values[:, 0]
    assert optimum["excess"].values == pytest.approx(np.maximum((force - FORCE_BOUND) / FORCE_BOUND, 0.0), rel=1e-12)
    feasible = np.flatnonzero(force <= FORCE_BOUND)
    assert 0 < len(feasible) < len(force)
    assert np.argmin(optimum["value"].values[:, 0]) not in feasible
    assert optimum["front"].values.tolist() == [feasible[np.argmin(optimum["value"].values[feasible, 0])]]
    assert "designs meet the constraints" in summary
    assert Case.load(folder / "best.toml").output.points[1].name == "tip"


EXPONENT = {"lyapunov": True}


def exponent(table: dict) -> tuple[float, float]:
    """Return the exponent and its error in 1/s of the case of a ``table``."""
    statistics = simulate(Case.from_table(table | {"output": EXPONENT})).statistics
    return statistics["lyapunov"], statistics["lyapunov_error"]


@pytest.mark.parametrize("engine", ["ts", "propagator"])
@pytest.mark.parametrize("rate", [0.05, 0.3])
def test_a_linear_lattice_has_the_exponent_of_its_damping(engine, rate):
    """With C = 2 rate M every mode falls as exp(-rate t), whatever its frequency; no amplitude plays a part."""
    table = {
        "lattice": {"cells": 12, "damping": {"mass": 2 * rate}, "cell": {"masses": [0.5], "springs": [
            {"start": 1, "end": 1, "stiffness": 2.0, "next_cell": True}]}},
        "contacts": {"sites": 0},
        "drive": {"waveform": "harmonic", "amplitude": 3.0, "frequency": 1.5},
        "time": {"samples_per_period": 12, "end": 400.0, "engine": engine},
    }  # fmt: skip
    found, _ = exponent(table)
    assert found == pytest.approx(-rate, abs=4e-3)


def test_the_oscillator_of_ueda_has_its_published_exponent():
    """x'' + 0.05 x' + x^3 = 7.5 cos t: 0.1034 (Sprott, Chaos and Time-Series Analysis, Oxford 2003, app. A.5.3)."""
    # Both ends of the spring of a single cell are fixed, so that it acts twice. A stiffness must be positive.
    spring = {"start": 1, "end": 1, "stiffness": 1e-6, "cubic": 0.5, "damping": 0.025, "next_cell": True}
    found, error = exponent(
        {
            "lattice": {"cells": 1, "cell": {"masses": [1.0], "springs": [spring]}},
            "contacts": {"sites": 0},
            "drive": {"waveform": "harmonic", "amplitude": 7.5, "frequency": 1.0},
            "time": {"samples_per_period": 20, "end": 4000.0},
        }
    )
    assert error < 0.005
    assert found == pytest.approx(0.1034, abs=0.012)


def impacting(omega: float, end: float) -> dict:
    """Return the table of the impact oscillator x'' + x = sin(omega t), with a stiff stop at x = 0, up to ``end``."""
    return IMPACT | {"drive": IMPACT["drive"] | {"frequency": omega}, "time": IMPACT["time"] | {"end": end}}


@pytest.mark.parametrize("omega", [2.0, 2.3])
def test_one_impact_a_period_has_the_exponent_of_its_multipliers(omega):
    """The map from impact to impact has the determinant r^2 (Shaw and Holmes 1983); here |multipliers| = r, each."""
    found, _ = exponent(impacting(omega, 600.0))
    assert found == pytest.approx(np.log(RESTITUTION) * omega / (2 * np.pi), rel=0.04)


def rigid_exponent(omega: float, impacts: int) -> float:
    """Return the exponent in 1/s of the impact oscillator with a rigid stop, from its flights in closed form.

    The deviation turns in each flight, and an impact at the speed v and the force a = sin(omega t) changes it to
    -r dx, -r dv + (1 + r) (a/v) dx (Mueller, Chaos, Solitons and Fractals 5 (1995) 1671).
    """
    force = 1 / (1 - omega**2)
    time = 0.3
    speed = -0.5
    deviation = np.array([1.0, 0.3])
    total = 0.0
    begin = 0.0
    for number in range(impacts):
        if number == impacts // 10:
            total = 0.0
            begin = time
        a = -force * np.sin(omega * time)
        b = speed - force * omega * np.cos(omega * time)

        def x(s: float, time: float = time, a: float = a, b: float = b) -> float:
            return a * np.cos(s) + b * np.sin(s) + force * np.sin(omega * (time + s))

        s = np.linspace(1e-6, 40.0, 40_000)
        first = int(np.argmax(x(s) > 0))
        flight = brentq(x, s[first - 1], s[first], xtol=1e-13)
        time += flight
        before = -a * np.sin(flight) + b * np.cos(flight) + force * omega * np.cos(omega * time)
        turn = np.array([[np.cos(flight), np.sin(flight)], [-np.sin(flight), np.cos(flight)]])
        ratio = np.sin(omega * time) / before
        jump = np.array([[-RESTITUTION, 0.0], [(1 + RESTITUTION) * ratio, -RESTITUTION]])
        deviation = jump @ turn @ deviation
        speed = -RESTITUTION * before
        size = float(np.linalg.norm(deviation))
        total += np.log(size)
        deviation /= size
    return total / (time - begin)


def test_the_chaos_of_the_impact_oscillator_has_the_exponent_of_a_rigid_stop():
    """A stop of 1e8 N/m, by engines and a second run, against closed flights and derivatives at a rigid stop."""
    found, error = exponent(impacting(2.85, 1500.0))
    expected = rigid_exponent(2.85, 3000)
    assert error < 0.03
    assert expected > 0.1
    assert found == pytest.approx(expected, abs=0.06)


EXPONENT_OF_CHAIN = {
    "lattice": {"cells": 12},
    "contacts": {"sites": [6], "clearance": 1e-4},
    "drive": {"waveform": "harmonic", "amplitude": 20.0, "frequency": 700.0},
    "time": {"samples_per_period": 16, "end": 0.5},
    "output": EXPONENT,
}


# After the companion has begun: ``ts`` looks at requests to stop in each sample, the propagator in each block of 16.
@pytest.mark.parametrize(("engine", "looks"), [("ts", 301), ("propagator", 30)])
def test_a_stopped_run_goes_on_to_the_same_exponent(tmp_path, engine, looks):
    """Wherever it is stopped, and if it is extended; the run itself has the same bits without the exponent."""
    case = Case.from_table(EXPONENT_OF_CHAIN | {"time": EXPONENT_OF_CHAIN["time"] | {"engine": engine}})
    straight = simulate(case)
    assert straight.statistics["engine"] == engine
    assert straight.statistics["episodes"] > 5
    without = simulate(case.varied(without=["output"]))
    assert np.array_equal(straight.dataset["velocity"], without.dataset["velocity"])

    assert simulate(case, tmp_path / "run", stop=StopAt(looks)).resumable
    again = simulate(case, tmp_path / "run")
    assert again.complete
    assert again.statistics["lyapunov"] == straight.statistics["lyapunov"]

    shorter = EXPONENT_OF_CHAIN["time"] | {"engine": engine, "end": 0.2}
    assert simulate(Case.from_table(EXPONENT_OF_CHAIN | {"time": shorter}), tmp_path / "extended").complete
    extended = simulate(case, tmp_path / "extended", extend=True)
    assert extended.statistics["lyapunov"] == straight.statistics["lyapunov"]
    measured = analyse(straight.dataset, ["motion"])
    assert float(measured["lyapunov"]) == straight.statistics["lyapunov"]


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
