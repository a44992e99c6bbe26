"""Identification: derivatives against engines and SciPy, parameters that come back, uncertainty, unknown motions."""

from __future__ import annotations

import itertools
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.optimize import least_squares

from tests.conftest import run_of
from tests.identified import POINTS, identify_table, lattice_table, measured_table
from tests.independent_lattice import CurvedSpring, ScipyLattice, Stop, chain_matrices
from vipetsc.case import Case
from vipetsc.case.identify import IdentifyCase
from vipetsc.identification.growing_windows import other_contacts
from vipetsc.identification.misfit import Misfit
from vipetsc.identification.uncertainty import errors_with_sensor, ljung_box, quantile, uncertainty_of
from vipetsc.io.netcdf import open_netcdf
from vipetsc.parallel import StopRequest
from vipetsc.studies.identification import Identification, read_measured_records, run_identification

UNKNOWNS = [
    {"quantity": "clearance", "of": [[1], [2, 3]], "bounds": [1e-4, 2e-3], "start": 4e-4},
    {"quantity": "stiffness", "bounds": [1e5, 1e7]},
    {"quantity": "exponent", "bounds": [1.0, 3.0]},
    {"quantity": "restitution", "bounds": [0.2, 1.0]},
    {"quantity": "mass", "of": [[3]], "bounds": [1e-4, 1.0]},
    {"quantity": "spring", "of": [[1, 2]], "bounds": [10.0, 1e5]},
    {"quantity": "dashpot", "of": "all", "bounds": [1e-3, 10.0], "start": 0.05},
    {"quantity": "amplitude", "bounds": [1.0, 100.0]},
]
POWER = {"law": "power", "exponent": 1.4, "stiffness": 2e6}
SAMPLES = {"time": [0.0, 2e-3, 4e-3, 6e-3, 0.02], "value": [0.0, 3.0, -2.0, 1.0, 0.5]}
# How the motion of a record begins: sections of its case.
BEGINS = {
    "burst": {},
    "samples": {"drive": {"waveform": "samples", "samples": SAMPLES, "frequency": 500.0, "amplitude": 20.0}},
    "step": {"drive": {"waveform": "step", "ramp": 5e-3, "amplitude": 60.0, "frequency": 500.0}},
    "struck": {
        "drive": {"amplitude": 0.0, "frequency": 500.0},
        "initial": {"kind": "velocity", "cell": 3, "velocity": 2.0},
    },
}
# These unknowns start from the values of the case, which are the true ones. The default unknowns start far from them.
FROM_THE_TRUTH = [
    {"quantity": "clearance", "of": "each", "bounds": [5e-5, 3e-3]},
    {"quantity": "restitution", "bounds": [0.2, 1.0]},
]


def fits_of(table) -> Identification:
    """The identification that ``table`` asks for, with its records read."""
    plan = IdentifyCase.from_table(table)
    return Identification(plan, read_measured_records(plan), StopRequest())


def results_of(folder, table):
    """The results of an identification of ``table`` in ``folder``."""
    run_identification(IdentifyCase.from_table(table), folder)
    with open_netcdf(folder / "identified.h5", "identification") as file:
        return file.load()


def slopes_of(misfit, z: np.ndarray) -> np.ndarray:
    """Derivatives (sample, sensor, coordinate) of the signals of the only record at ``z`` (coordinate,)."""
    jacobian = misfit.jacobian(z, [1.0], range(len(z)))
    return jacobian.reshape(-1, len(misfit.noise[0]), len(z)) * misfit.noise[0][:, None]


def differences(plan: IdentifyCase, z: np.ndarray, number: int, engine: str) -> np.ndarray:
    """Derivatives (sample, point) of velocities by coordinate ``number``, from runs of an engine.

    They are central differences of fourth order.
    """
    # With steps of 1e-5 the errors of ts, at rtol = 1e-13, would be ten times as large in the difference; with steps of
    # 3e-4 the error of fourth order would be.
    h = 1e-4
    total = 0.0
    for steps, weight in ((-2, 1), (-1, -8), (1, 8), (2, -1)):
        moved = z.copy()
        moved[number] += steps * h
        values = [p.from_coordinate(x) for p, x in zip(plan.parameters, moved, strict=True)]
        case = plan.case_of(values).varied(time={"engine": engine})
        total = total + weight * run_of(case)["points/velocity"].values / (12 * h)
    return np.asarray(total)


def test_derivatives_are_those_of_both_engines_over_1_5_and_20_impacts(tmp_path):
    """Derivatives by parameters of every kind, through lossy contacts, are central differences of engines' runs."""
    table = lattice_table(contacts=POWER, time={"rtol": 1e-13, "end": 0.022})
    plan_table = identify_table(table, measured_table(tmp_path, table), unknowns=UNKNOWNS)
    work = fits_of(plan_table)
    misfit = work.windows().misfit
    z = work.starts()[0]
    onsets = misfit.motion(z, 0, 1.0).onset
    assert len(onsets) > 20
    slopes = slopes_of(misfit, z)
    times = misfit.records[0].times

    for number, engine in zip(range(len(z)), itertools.cycle(["ts", "propagator"]), strict=False):
        expected = differences(work.plan, z, number, engine)
        for impacts in (1, 5, 20):
            window = times < onsets[impacts]
            assert window.sum() > 10
            error = np.abs(slopes[window, :, number] - expected[window]).max()
            scale = np.abs(expected[window]).max()
            # The derivative by a clearance is zero before the site's first contact, where differences are rounding
            # errors.
            assert error <= 1e-6 * scale + 1e-9, (impacts, number, error / scale)


@pytest.mark.parametrize(
    ("begin", "late"), [("burst", 0.0), ("burst", -2e-4), ("samples", 5e-5), ("step", -2e-4), ("struck", 5e-5)]
)
def test_samples_of_a_record_need_not_be_those_of_the_engine(tmp_path, begin, late):
    """Signals of all kinds are those of a run, also where the drive begins between two samples of the record."""
    table = lattice_table() | BEGINS[begin]
    times = 2.5e-4 * np.arange(60)
    path = tmp_path / "record.csv"
    np.savetxt(path, np.column_stack([times, np.sin(times)]), delimiter=",")
    kinds = ["displacement", "velocity", "acceleration"]
    sensors = [{"quantity": kind, "column": 2, "cell": 3, "mass": 2} for kind in kinds]
    if begin != "struck":
        sensors.append({"quantity": "force", "column": 2})
    record = {"file": str(path), "time": 1, "offset": late, "sensors": sensors}
    work = fits_of(identify_table(table, record, unknowns=UNKNOWNS[3:4]))
    z = np.array([work.plan.parameters[0].to_coordinate(0.7)])
    motion = work.windows().misfit.motion(z, 0, 1.0)
    values = work.windows().misfit.predicted(z, 0, 1.0)

    # A run whose samples, five times as many, are those of the record.
    points = [{"name": "p", "cell": 3, "mass": 2}]
    timed = {"sample_interval": 5e-5, "end": 0.0151, "rtol": 1e-12}
    run = run_of(work.plan.case_of([0.7]).varied(output={"points": points}, time=timed))
    sample = np.round((times - late) / 5e-5).astype(int)
    started = sample >= 0
    for column, kind in enumerate(kinds):
        expected = run[f"points/{kind}"].values[sample, 0] * started
        assert np.abs(values[:, column] - expected).max() < 1e-8 * np.abs(expected).max(), kind
    if begin != "struck":
        force = work.plan.base.model().drives[0].waveform.force(times - late)
        assert values[:, 3] == pytest.approx(force, abs=1e-9)
    onsets = run["impacts/onset"].values + late
    assert len(onsets) > 3
    assert motion.onset == pytest.approx(onsets[onsets < times[-1]], abs=1e-9)


def test_clearances_and_restitution_come_back_without_noise(tmp_path):
    """From starts 30 % off, three sensors determine three clearances, the stiffness and the restitution to 1e-6."""
    table = lattice_table(time={"end": 0.014})
    stiffness = IdentifyCase.from_table(identify_table(table, measured_table(tmp_path, table))).base.contacts.stiffness
    options = identify_table(table, measured_table(tmp_path, table))["identify"]
    options["unknowns"].append({"quantity": "stiffness", "bounds": [5e5, 5e7], "start": 0.7 * stiffness})
    found = results_of(tmp_path / "out", table | {"name": "found", "identify": options})

    truth = [*table["contacts"]["clearance"], 0.7, stiffness]
    assert found["value"].values == pytest.approx(truth, rel=1e-6)
    assert (found["determined"].values == 1).all()
    # The residuals are rounding errors, whose whiteness is not judged.
    assert found.attrs["warnings"] == "[]"
    assert found["windows/impacts"].values[-1] > 5


def test_linear_parts_come_from_a_record_without_contact(tmp_path):
    """A record without contact determines a spring first; the clearances keep their starts until later windows."""
    quiet = lattice_table(drive={"amplitude": 1.0}, lattice={"cells": 6}) | {"name": "quiet"}
    loud = lattice_table(time={"end": 0.014})
    records = [
        measured_table(tmp_path, quiet) | {"contact": False, "drive": {"amplitude": 1.0}},
        measured_table(tmp_path, loud),
    ]
    cell = IdentifyCase.from_table(identify_table(loud, records)).base.lattice.undamped_cell()
    stiffness = cell.springs[0].stiffness
    unknowns = [
        {"quantity": "spring", "of": [[1]], "bounds": [0.3 * stiffness, 3 * stiffness], "start": 1.2 * stiffness},
        {"quantity": "clearance", "of": "each", "bounds": [5e-5, 3e-3], "start": [6e-4, 3.2e-4, 3.6e-4]},
    ]
    found = results_of(tmp_path / "out", identify_table(loud, records, unknowns=unknowns))

    assert found["value"].values == pytest.approx([stiffness, *loud["contacts"]["clearance"]], rel=1e-6)
    # The first window has only the record without contact, and leaves the clearance at its start.
    assert found["windows/impacts"].values[0] == 0
    assert found["windows/value"].values[0, 1] == pytest.approx(6e-4, rel=1e-12)


def test_a_record_that_never_touches_bounds_the_clearance(tmp_path):
    """Data without contact bound a clearance from below by the largest relative displacement, and give no estimate."""
    table = lattice_table(drive={"amplitude": 2.0}, contacts={"clearance": 5e-3}, time={"end": 0.014})
    record = measured_table(tmp_path, table, noise=0.02)
    unknowns = [{"quantity": "clearance", "bounds": [1e-5, 1e-2], "start": 6e-3}]
    found = results_of(tmp_path / "out", identify_table(table, record, unknowns=unknowns))

    run = run_of(IdentifyCase.from_table(identify_table(table, record, unknowns=unknowns)).base)
    u = run["displacement"].values
    cell = IdentifyCase.of(found).base.lattice.unit_cell()
    sites = np.array([2, 3, 5]) - 1
    largest = np.abs(u[:, sites, cell.resonator] - u[:, sites, cell.host]).max()
    assert found["at_least"].values[0] == pytest.approx(largest, rel=2e-2)
    assert found["determined"].values[0] == 0
    assert np.isnan(found["standard_error"].values[0])
    assert "at least" in found.attrs["warnings"]


@pytest.mark.parametrize(("truth", "start"), [(5e-3, 2e-4), (3e-4, 2.9e-3)])
def test_a_clearance_on_the_wrong_side_of_the_motion_is_moved(tmp_path, truth, start):
    """A clearance that has contacts where the record has none, or none where it has some, is moved to the other side.

    The misfit has no derivative that leads there, so that other clearances are tried.
    """
    free = lattice_table(contacts={"clearance": [5e-4, 4e-4, 5e-3]}, time={"end": 0.014})
    table = lattice_table(contacts={"clearance": [5e-4, 4e-4, truth]}, time={"end": 0.014})
    record = measured_table(tmp_path, table)
    unknowns = [{"quantity": "clearance", "of": [[3]], "bounds": [5e-5, 6e-3], "start": start}]
    work = fits_of(identify_table(table, record, unknowns=unknowns))
    windows = work.windows()
    moved = other_contacts(windows.misfit, work.starts()[0], windows.last, windows.high)

    base = Case.from_table(free)
    cell = base.lattice.unit_cell()
    u = run_of(base)["displacement"].values[:, 4]
    largest = np.abs(u[:, cell.resonator] - u[:, cell.host]).max()
    value = windows.misfit.values(moved)[0]
    assert value > largest if truth > largest else 0.3 * largest < value < largest


def test_a_law_of_the_wrong_kind_is_seen(tmp_path):
    """A bilinear model fitted to data of Hertz's law leaves residuals that are not white; Hertz's law does not."""
    table = lattice_table(time={"end": 0.011})
    record = measured_table(tmp_path, table, noise=0.002)
    wrong = table | {"contacts": table["contacts"] | {"law": "bilinear", "stiffness": 3e4}}
    unknowns = [*FROM_THE_TRUTH, {"quantity": "stiffness", "bounds": [1e3, 1e6]}]

    # From the truth on no windows are needed: all impacts are in the first one.
    right = results_of(tmp_path / "right", identify_table(table, record, unknowns=FROM_THE_TRUTH, impacts=1000))
    assert "not white" not in right.attrs["warnings"]
    found = results_of(tmp_path / "wrong", identify_table(wrong, record, unknowns=unknowns, impacts=1000, steps=6))
    assert "not white" in found.attrs["warnings"]


def test_intervals_hold_the_truth(tmp_path):
    """Intervals of 90 % contain most true values in two records with 2 % noise; deviations are as large as stated."""
    table = lattice_table(time={"end": 0.014})
    truth = np.array([*table["contacts"]["clearance"], 0.7])
    inside = []
    deviations = []
    for seed in (2, 4):
        record = measured_table(tmp_path, table, noise=0.02, seed=seed)
        # The errors of a fit do not depend on its start: from the truth on all impacts are in the first window.
        work = fits_of(identify_table(table, record, unknowns=FROM_THE_TRUTH, impacts=1000))
        windows, z = work.solution(work.fit(0))
        known = uncertainty_of(windows.misfit.jacobian(z, windows.last, range(len(z))))
        expected = [p.to_coordinate(v) for p, v in zip(work.plan.parameters, truth, strict=True)]
        deviations.append((z - expected) / known.errors)
        inside.append(np.abs(deviations[-1]) < quantile(0.9))
    assert 0.75 <= np.mean(inside) <= 1.0
    assert 0.5 < np.sqrt(np.mean(np.square(deviations))) < 1.5


def test_white_noise_is_white_and_a_slow_drift_is_not():
    """The probability of Ljung and Box's statistic is uniform for white noise, and small for a moving average."""
    generator = np.random.default_rng(3)
    noise = generator.standard_normal((200, 300))
    probabilities = [ljung_box(row).probability for row in noise]
    assert np.mean(np.array(probabilities) < 0.1) == pytest.approx(0.1, abs=0.06)
    assert ljung_box(noise[0, 1:] + 0.6 * noise[0, :-1]).probability < 1e-6
    # Five values have one autocorrelation r, and the statistic is n (n + 2) r^2/(n - 1) by definition.
    short = np.array([1.0, -1.0, 2.0, 0.0, -2.0])
    r = np.sum(short[1:] * short[:-1]) / np.sum(short**2)
    assert ljung_box(short).statistic == pytest.approx(5 * 7 * r**2 / 4)


def test_a_direction_without_data_is_not_determined():
    """Parameters with parallel derivatives are not determined; a sensor that separates them reduces their errors."""
    jacobian = np.array([[100.0, 100.0], [50.0, 50.0], [0.0, 0.1]])
    known = uncertainty_of(jacobian)
    assert known.determined.tolist() == [False, False]
    assert known.correlation[0, 1] == pytest.approx(-1, abs=1e-5)
    assert np.abs(known.directions[1]) == pytest.approx([0.5**0.5, 0.5**0.5], abs=1e-3)
    assert known.errors == pytest.approx(np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian))), rel=1e-6)

    slopes = np.zeros((1, 2, 2))
    slopes[0, 1] = [1.0, -1.0]
    errors = errors_with_sensor(known, slopes, noise=0.1)
    assert errors[0] == pytest.approx(known.errors, rel=1e-3)
    assert (errors[1] < 0.1).all()


CHAIN = {
    "masses": [0.25],
    "springs": [{"start": 1, "end": 1, "stiffness": 4e4, "damping": 3.5, "next_cell": True}],
    "contact": [1, 1],
}
GROUND_STOP = {"law": "bilinear", "stiffness": 1.8e6, "restitution": 0.85, "sites": [3], "pair": [0, 1], "side": "plus"}


def chain_record(path, start: np.ndarray, speed: np.ndarray, times: np.ndarray, clock: float = 0.0) -> np.ndarray:
    """Write a record of a chain of four masses with a stop and dashpots to ``path``.

    Returns displacements and velocities (2, mass) at the first of the ``times``.
    """
    stiffness, damping = chain_matrices(4, 4e4, 3.0)
    stop = Stop(resonator=2, host=-1, gap=4e-4, stiffness=2e6, exponent=1.0, restitution=0.8)
    # SciPy integrates the motion: a record by this package's own engine would hide an error of that engine.
    lattice = ScipyLattice(np.full(4, 0.25), stiffness, damping, (stop,), force=lambda t: np.zeros(4))
    motion, impacts = lattice.recorded_motion(path.stem, times, start, speed, start=0.0)
    # Fewer impacts would not separate stiffness and restitution.
    assert impacts > 4
    # The file has milliseconds, accelerations in g and a clock of its own, as laboratories store them.
    columns = np.column_stack([1e3 * (times + clock), motion[0, :, 0], motion[1, :, 3], motion[2, :, 1] / 9.81])
    np.savetxt(path, columns, delimiter=";", header="ms;u1;v4;a2", comments="", fmt="%.17g")
    return motion[:2, 0]


def chain_table(path, **record: Any) -> dict[str, Any]:
    """The identification of the stop and the dashpots of the chain from the record in ``path``."""
    sensors = [
        {"quantity": "displacement", "column": "u1", "cell": 1},
        {"quantity": "velocity", "column": "v4", "cell": 4},
        {"quantity": "acceleration", "column": "a2", "cell": 2, "factor": 9.81},
    ]
    unknowns = [
        {"quantity": "clearance", "bounds": [1e-4, 2e-3]},
        {"quantity": "stiffness", "bounds": [2e5, 2e7]},
        {"quantity": "restitution", "bounds": [0.3, 1.0]},
        {"quantity": "dashpot", "bounds": [0.1, 50.0]},
    ]
    records = [{"file": str(path), "time": "ms", "time_factor": 1e-3, "sensors": sensors} | record]

    return {
        "name": "chain",
        "lattice": {"cells": 4, "cell": CHAIN},
        "contacts": GROUND_STOP | {"clearance": 4.6e-4},
        "drive": {"amplitude": 0.0},
        "initial": {"kind": "velocity", "cell": 1, "velocity": 0.5},
        "identify": {"records": records, "unknowns": unknowns, "profile": 0, "growth": 4.0},
    }


def test_a_displaced_lattice_determines_its_stop_and_its_initial_state(tmp_path):
    """The free decay after an unknown release determines the parameters, to 1e-6, and the whole initial state."""
    times = np.arange(0.0, 0.065, 1 / 2000)
    # The offset in the case is half a second off the clock of the record, which does not matter without a drive.
    begin = chain_record(tmp_path / "decay.csv", np.array([3e-3, 0.0, 0.0, 0.0]), np.zeros(4), times, clock=7.5)
    found = results_of(tmp_path / "out", chain_table(tmp_path / "decay.csv", offset=7.0, initial="estimate"))

    assert found["value"].values == pytest.approx([4e-4, 2e6, 0.8, 3.0], rel=1e-6)
    assert found["initial/displacement"].values == pytest.approx(begin[0], abs=1e-8)
    assert found["initial/velocity"].values == pytest.approx(begin[1], abs=1e-5)
    assert found["initial/cell"].values.tolist() == [1, 2, 3, 4]
    # The record measures every direction of the initial state: none depends on the prior alone.
    assert (found["initial/singular"].values > 2).all()
    assert found.attrs["warnings"] == "[]"


def shaken_record(path, window: tuple[float, float]) -> dict[str, Any]:
    """The identification of a row of masses, shaken by its left frame, with unlike stops on both sides.

    The accelerations from ``window[0]`` to ``window[1]`` (s) are written to the HDF5 file ``path``.
    """
    count = 4
    stiffness = 4e4
    mass = 0.25
    amplitude = 4e-4
    frequency = 250.0
    # The ramp takes ten periods, the default of a harmonic drive.
    ramp = 10 * 2 * np.pi / frequency

    def force(t: float) -> np.ndarray:
        s = min(t / ramp, 1.0)
        forces = np.zeros(count)
        # A frame that moves by U acts on the first mass as the force k U.
        forces[0] = stiffness * amplitude * (10 * s**3 - 15 * s**4 + 6 * s**5) * np.sin(frequency * t)
        return forces

    matrices = chain_matrices(count, stiffness, 0.0, ground=3.0)
    stops = tuple(
        Stop(resonator, host, gap, stiffness=3e8, exponent=1.5, restitution=0.75, side=side)
        for resonator, host, gap, side in ((1, 0, 2e-4, 1), (1, 0, 1.5e-4, -1), (2, -1, 6e-4, 1), (2, -1, 3e-4, -1))
    )
    lattice = ScipyLattice(np.full(count, mass), *matrices, stops, force)
    times = np.arange(0.0, window[1], 1 / 3200)
    motion, _ = lattice.recorded_motion(path.stem, times, np.zeros(count), np.zeros(count), start=0.0)
    with h5py.File(path, "w") as file:
        used = times >= window[0]
        # The clock of a data logger began 100 s earlier.
        file["daq/clock"] = times[used] + 100.0
        file["daq/g"] = motion[2][used][:, [0, 2, 3]] / 9.81
    sensors = [
        # With noise that is given nothing is fitted again for a better estimate of it.
        {"quantity": "acceleration", "column": f"daq/g[{column}]", "cell": cell, "factor": 9.81, "noise": 1e-3}
        for column, cell in enumerate((1, 3, 4), 1)
    ]
    record = {"file": str(path), "time": "daq/clock", "offset": 100.0, "sensors": sensors}
    unknowns = [
        {"quantity": "clearance", "of": "each", "bounds": [5e-5, 5e-3], "start": [2.01e-4, 5.98e-4]},
        {"quantity": "clearance_minus", "of": "each", "bounds": [5e-5, 5e-3], "start": [1.49e-4, 3.01e-4]},
        {"quantity": "restitution", "bounds": [0.3, 1.0], "start": 0.76},
        {"quantity": "grounding", "bounds": [0.1, 30.0], "start": 2.9},
    ]
    spring = {"start": 1, "end": 1, "stiffness": stiffness, "next_cell": True}
    return {
        "name": "shaken",
        "lattice": {"cells": count, "cell": {"masses": [mass], "springs": [spring], "contact": [1, 1]}},
        "contacts": {
            "stiffness": 3e8,
            "restitution": 0.9,
            "sites": [1, 3],
            "each": {"pair": [[1, 1], [0, 1]], "next_cell": [True, False]},
            "clearance": [2.4e-4, 4.4e-4],
            "clearance_minus": 2.2e-4,
        },
        "drive": {"waveform": "harmonic", "end": "left", "amplitude": amplitude, "frequency": frequency},
        # So near the truth no windows are needed: all impacts are in the first one.
        "identify": {"records": [record], "unknowns": unknowns, "profile": 0, "impacts": 1000, "growth": 4.0},
    }


def test_a_record_that_begins_while_the_lattice_is_shaken(tmp_path):
    """Accelerations under base motion determine unlike stops on two sides, together with an unknown initial state."""
    # The record begins after the ramp, in the midst of impacts.
    table = shaken_record(tmp_path / "shaken.h5", window=(0.27, 0.295))
    table["identify"]["records"][0]["initial"] = "estimate"
    found = results_of(tmp_path / "out", table)
    named = dict(zip(found["parameter"].values.tolist(), found["value"].values.tolist(), strict=True))
    truth = {
        "clearance 1": 2e-4,
        "clearance 2": 6e-4,
        "clearance_minus 1": 1.5e-4,
        "clearance_minus 2": 3e-4,
        "restitution": 0.75,
        "grounding": 3.0,
    }
    assert named == pytest.approx(truth, rel=1e-6)


@pytest.mark.parametrize(("size", "touching"), [(0.1, 0), (1.0, 2)])
def test_derivatives_by_the_initial_state_are_central_differences(tmp_path, size, touching):
    """Derivatives by parameters and by the initial state are differences, with free sites and with sites in contact."""
    table = lattice_table(time={"end": 0.0065})
    record = measured_table(tmp_path, table) | {"begin": 4e-3, "initial": "estimate", "offset": [-1e-4, 1e-4]}
    unknowns = [
        {"quantity": "clearance", "bounds": [1e-4, 2e-3], "start": 4e-4},
        {"quantity": "stiffness", "bounds": [1e5, 1e7]},
        {"quantity": "mass", "of": [[2, 3]], "bounds": [1e-4, 1.0]},
    ]
    plan = IdentifyCase.from_table(identify_table(table, record, unknowns=unknowns))
    misfit = Misfit(plan, read_measured_records(plan))
    state = misfit.states[0]
    generator = np.random.default_rng(5)
    z = np.array([p.to_coordinate(p.start) for p in plan.parameters])
    # Signs of modes depend on the LAPACK that is installed. Coordinates solved from a state give the same state
    # everywhere.
    moving = size * np.linalg.norm(state.matrix, axis=1) * generator.standard_normal(len(state.matrix))
    z = np.concatenate([z, np.linalg.solve(state.matrix, moving)])
    ends = [0.0052]
    every = [0, 1, 2, 3, *range(4, misfit.size, 7)]
    jacobian = misfit.jacobian(z, ends, every)
    # An onset before the record is logged at its beginning.
    assert np.sum(misfit.motion(z, 0, 1.0).onset == misfit.records[0].times[0]) == touching
    # The five-point formula has an error of order h^4, and divides the errors of the runs by h. With this h both are
    # below the tolerance.
    h = 1e-4
    for column, p in enumerate(every):
        expected = np.zeros(len(jacobian))
        for steps, weight in ((-2, 1), (-1, -8), (1, 8), (2, -1)):
            moved = z.copy()
            moved[p] += steps * h
            expected += weight * misfit.residuals(moved, ends) / (12 * h)
        error = np.abs(jacobian[:, column] - expected).max()
        # The force of power 1.5 has no second derivative at an onset: differences across an onset err by up to 1e-4.
        assert error < 3e-4 * np.abs(expected).max() + 1e-7, (p, error)


COUNT = 3
STRIKE = 0.8  # m/s of the second mass
TRUTH = {"mass": 0.25, "spring": 4e4, "quadratic": 2e6, "cubic": 2e9, "clearance": 4e-4, "stiffness": 2e6}
TIMES = np.arange(0.0, 0.06, 1 / 2000)
STRUCK = np.array([0.0, 0.0, 0.0, 0.0, STRIKE, 0.0])
KINDS = ["displacement", "velocity", "acceleration"]


def motion_of(truth: dict[str, float], times: np.ndarray = TIMES, state: np.ndarray = STRUCK) -> np.ndarray:
    """The motion u, u', u'' (quantity, time, mass) of a chain between walls, whose last mass has a stop.

    The motion begins in the ``state`` (2n,) of displacements in m and velocities in m/s at ``times[0]``.
    """
    shape, _ = chain_matrices(COUNT, 1.0, 0.0)
    # The springs to the walls are curved like the others.
    rows = np.eye(COUNT + 1, COUNT) - np.eye(COUNT + 1, COUNT, k=-1)
    lattice = ScipyLattice(
        masses=np.full(COUNT, truth["mass"]),
        stiffness=truth["spring"] * shape,
        damping=3.0 * shape,
        stops=(Stop(COUNT - 1, -1, truth["clearance"], truth["stiffness"], exponent=1.0, restitution=0.8),),
        force=lambda t: np.zeros(COUNT),
        curved=tuple(CurvedSpring(row, truth["quadratic"], truth["cubic"]) for row in rows),
    )
    motion, impacts = lattice.motion(times, *np.split(state, 2), start=float(times[0]))
    assert impacts > 2
    return motion


def table_of(path, unknowns: list[dict[str, Any]], **changes: Any) -> dict[str, Any]:
    """The table that identifies ``unknowns`` from the record in ``path``, which has u, v and a of masses 1, 2 and 3.

    ``changes`` are values of the case that differ from the true ones.
    """
    sensors = [{"quantity": kind, "column": kind, "cell": cell} for cell, kind in enumerate(KINDS, 1)]
    truth = TRUTH | changes
    spring = {"start": 1, "end": 1, "stiffness": truth["spring"], "damping": 3.0, "next_cell": True}
    spring |= {key: truth[key] for key in ("quadratic", "cubic") if truth[key]}
    return {
        "name": "curved",
        "lattice": {"cells": COUNT, "cell": {"masses": [truth["mass"]], "springs": [spring], "contact": [1, 1]}},
        "contacts": {
            "law": "bilinear",
            "stiffness": truth["stiffness"],
            "restitution": 0.8,
            "sites": [COUNT],
            "pair": [0, 1],
            "side": "plus",
            "clearance": truth["clearance"],
        },
        "drive": {"amplitude": 0.0},
        "initial": {"kind": "velocity", "cell": 2, "velocity": STRIKE},
        "identify": {
            "records": [{"file": str(path), "time": "t", "sensors": sensors}],
            "unknowns": unknowns,
            "profile": 0,
        },
    }


def measured(motion: np.ndarray) -> np.ndarray:
    """The signals (time, sensor) of the sensors of ``table_of``: u of mass 1, u' of mass 2, u'' of mass 3."""
    return np.stack([motion[k, :, k] for k in range(COUNT)], axis=1)


def written(path, values: np.ndarray, times: np.ndarray = TIMES):
    """Write a record of the sensors' ``values`` (time, sensor) to ``path``, which is returned."""
    rows = np.column_stack([times, values])
    np.savetxt(path, rows, delimiter=",", header=",".join(["t", *KINDS]), comments="", fmt="%.17g")
    return path


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    """The file of the record without noise."""
    return written(tmp_path_factory.mktemp("record") / "exact.csv", measured(motion_of(TRUTH)))


def test_derivatives_are_differences_of_scipy(record):
    """Derivatives through three impacts, by parameters of springs, mass, stop and offset, are differences of SciPy."""
    quantities = ["quadratic", "cubic", "spring", "mass", "clearance"]
    unknowns = [{"quantity": q, "bounds": [0.5 * TRUTH[q], 2 * TRUTH[q]]} for q in quantities]
    table = table_of(record, unknowns)
    table["identify"]["records"][0]["offset"] = [-1e-3, 1e-3]
    plan = IdentifyCase.from_table(table)
    misfit = Misfit(plan, read_measured_records(plan))
    z = np.array([p.to_coordinate(p.start) for p in plan.parameters])
    values = misfit.predicted(z, 0, 1.0)
    slopes = misfit.jacobian(z, [1.0], range(len(z))).reshape(*values.shape, -1) * misfit.noise[0][:, None]
    exact = measured(motion_of(TRUTH))
    assert np.abs(values - exact).max(axis=0) == pytest.approx(0.0, abs=1e-8 * np.abs(exact).max())

    h = 1e-4
    for column, quantity in enumerate(quantities):
        parameter = plan.parameters[column]
        ends = [
            measured(motion_of(TRUTH | {quantity: parameter.from_coordinate(z[column] + step)})) for step in (-h, h)
        ]
        expected = (ends[1] - ends[0]) / (2 * h)
        error = np.abs(slopes[:, :, column] - expected).max(axis=0)
        assert (error < 2e-5 * np.abs(expected).max(axis=0)).all(), (quantity, error)

    # A larger offset moves every sample to an earlier time of the motion, whose beginning stays at the first sample.
    short = 1e-6
    ends = [measured(motion_of(TRUTH, np.append(0.0, TIMES[1:] + step)))[1:] for step in (short, -short)]
    expected = (ends[1] - ends[0]) / (2 * short) * plan.parameters[-1].slope(z[-1])
    error = np.abs(slopes[1:, :, -1] - expected).max(axis=0)
    assert (error < 1e-3 * np.abs(expected).max(axis=0)).all(), error


SPRING_UNKNOWNS = [
    {"quantity": "quadratic", "bounds": [-1e7, 1e7]},
    {"quantity": "cubic", "bounds": [-1e10, 1e10]},
    {"quantity": "spring", "bounds": [1e4, 1e5]},
    {"quantity": "clearance", "bounds": [1e-4, 2e-3]},
]
SOUGHT = [TRUTH[unknown["quantity"]] for unknown in SPRING_UNKNOWNS]
# The case has linear springs, so that the fit begins with quadratic and cubic parts of zero.
CASE = {"quadratic": 0.0, "cubic": 0.0, "spring": 4.2e4, "clearance": 4.6e-4}


def found_in(table, folder):
    """The results of the identification that ``table`` describes, run in ``folder``."""
    run_identification(IdentifyCase.from_table(table), folder)
    with open_netcdf(folder / "identified.h5", "identification") as file:
        return file.load()


def test_curved_springs_come_back_from_linear_ones(record, tmp_path):
    """From linear springs and without noise the fit finds all true parameters, and the identified case has them."""
    found = found_in(table_of(record, SPRING_UNKNOWNS, **CASE), tmp_path)
    assert found["value"].values == pytest.approx(SOUGHT, rel=1e-7)
    case = IdentifyCase.of(found).case_of(found["value"].values)
    assert case.lattice.unit_cell().springs[0].cubic == pytest.approx(TRUTH["cubic"], rel=1e-7)


FEW_UNKNOWNS = [
    {"quantity": "clearance", "of": [[1], [2]], "bounds": [1e-4, 2e-3]},
    {"quantity": "restitution", "bounds": [0.2, 1.0]},
]


def engine_derivatives(plan: IdentifyCase, z: np.ndarray, cell: int, mass: int) -> np.ndarray:
    """Derivatives (sample, parameter) of a mass's velocity in runs of the propagator, by central differences."""
    h = 1e-5
    columns = []
    for number in range(len(plan.parameters)):
        runs = []
        for sign in (-1, 1):
            moved = z.copy()
            moved[number] += sign * h
            values = [p.from_coordinate(x) for p, x in zip(plan.parameters, moved, strict=True)]
            case = plan.case_of(values).varied(output={"points": [{"name": "p", "cell": cell, "mass": mass}]})
            runs.append(run_of(case)["points/velocity"].values[:, 0])
        columns.append((runs[1] - runs[0]) / (2 * h))
    return np.column_stack(columns)


@pytest.fixture(scope="module")
def identified(tmp_path_factory):
    """The plan, the coordinates (3,) found, and the results of a fit of three parameters to a record with contacts."""
    folder = tmp_path_factory.mktemp("uncertainty")
    table = lattice_table(time={"end": 0.011})
    record = measured_table(folder, table, noise=0.02)
    for sensor in record["sensors"]:
        sensor["noise"] = 0.02
    plan = IdentifyCase.from_table(identify_table(table, record, unknowns=FEW_UNKNOWNS, profile=3))
    run_identification(plan, folder / "out")
    with open_netcdf(folder / "out" / "identified.h5", "identification") as file:
        results = file.load()
    z = np.array([p.to_coordinate(v) for p, v in zip(plan.parameters, results["value"].values, strict=True)])
    return plan, z, results


def test_errors_and_correlation_are_those_of_an_engines_derivatives(identified):
    """The covariance is (J^T J)^-1 with J from differences of runs, and the sensor that is named lowers an error most.

    Another sensor adds its rows to J.
    """
    plan, z, results = identified
    rows = [engine_derivatives(plan, z, point["cell"], point["mass"]) for point in POINTS]
    jacobian = np.vstack(rows) / 0.02
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    errors = np.sqrt(np.diag(covariance))
    assert results["relative_error"].values == pytest.approx(errors, rel=1e-4)
    assert results["correlation"].values == pytest.approx(covariance / np.outer(errors, errors), abs=1e-4)
    assert results["singular"].values == pytest.approx(np.linalg.svd(jacobian, compute_uv=False), rel=1e-4)

    # The places tried are every fifth mass, and the mass that is named for the first parameter.
    named = int(results["sensor/cell"][0]), int(results["sensor/mass"][0])
    lowest = float(results["sensor/relative_error"][0])
    for cell, mass in [named, *((1 + k // 4, 1 + k % 4) for k in range(0, 24, 5))]:
        more = np.vstack([jacobian, engine_derivatives(plan, z, cell, mass) / 0.02])
        error = np.sqrt(np.linalg.inv(more.T @ more)[0, 0])
        assert error >= lowest * (1 - 1e-4)
        if (cell, mass) == named:
            assert error == pytest.approx(lowest, rel=1e-4)


def test_profiles_are_the_least_misfit_with_one_parameter_held(identified):
    """At the last value of a profile the misfit is the least one with that parameter held."""
    plan, z, results = identified
    misfit = Identification(plan, read_measured_records(plan), StopRequest()).windows().misfit
    ends = [float(misfit.records[0].times[-1])]
    misfit.noise = [np.full(3, 0.02)]
    least = float(np.sum(misfit.residuals(z, ends) ** 2))
    for number in (0, 2):
        place = float(results["profile/value"].values[number, 2])
        held = plan.parameters[number].to_coordinate(place)

        def residuals(others: np.ndarray, number: int = number, held: float = held) -> np.ndarray:
            return misfit.residuals(np.insert(others, number, held), ends)

        fitted = least_squares(residuals, np.delete(z, number), method="lm", x_scale=1e-3)
        assert results["profile/cost"].values[number, 2] == pytest.approx(2 * fitted.cost - least, rel=2e-2)
        # In a linear problem the sum of squares grows by 3^2 at three standard errors.
        assert 5 < results["profile/cost"].values[number, 2] < 15
    assert results["profile/cost"].values[:, 1] == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("confidence", [0.5, 0.9, 0.99])
def test_intervals_of_few_data_are_as_wide_as_their_noise_is_uncertain(confidence):
    """Intervals of a straight line through six points with estimated noise hold the truth as often as they state."""
    generator = np.random.default_rng(6)
    jacobian = np.column_stack([np.ones(6), np.linspace(-1, 1, 6)])
    noise = generator.standard_normal((40_000, 6))
    found = noise @ np.linalg.pinv(jacobian).T
    # Four degrees of freedom are left to the noise.
    estimated = np.sqrt(np.sum((noise - found @ jacobian.T) ** 2, axis=1) / 4)
    error = uncertainty_of(jacobian).errors[1] * estimated
    held = np.abs(found[:, 1]) < quantile(confidence, 4) * error
    assert np.mean(held) == pytest.approx(confidence, abs=0.01)


@pytest.mark.parametrize("given", [False, True])
def test_a_value_at_its_bound_has_no_interval(tmp_path, given):
    """A fit that wants a value beyond a bound says so; the interval of the others has the noise that is known."""
    table = lattice_table(time={"end": 0.009})
    record = measured_table(tmp_path, table, noise=0.01)
    if given:
        for sensor in record["sensors"]:
            sensor["noise"] = 0.01
    unknowns = [
        {"quantity": "clearance", "bounds": [5.3e-4, 8e-4], "of": [[1]]},
        {"quantity": "restitution", "bounds": [0.2, 1.0]},
    ]
    run_identification(IdentifyCase.from_table(identify_table(table, record, unknowns=unknowns)), tmp_path / "out")
    with open_netcdf(tmp_path / "out" / "identified.h5", "identification") as file:
        found = file.load()
    assert found["at_bound"].values.tolist() == [-1, 0]
    assert found["value"].values[0] == pytest.approx(5.3e-4, rel=1e-3)
    assert np.isnan(found["interval_low"].values[0])
    assert "lower bound" in found.attrs["warnings"]
    assert "at its bound" in found.attrs["summary"]

    freedom = np.inf
    if not given:
        freedom = found.sizes["datum"] - 2
    width = (found["interval_high"] - found["interval_low"]).values[1]
    assert width == pytest.approx(2 * quantile(0.9, freedom) * found["standard_error"].values[1], rel=1e-6)
