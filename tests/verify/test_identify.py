"""Identification: derivatives against both engines, parameters from computed records, and what a record cannot show."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from tests.conftest import run_of
from tests.identified import identify_table, lattice_table, measured_table
from vipetsc.case import Case
from vipetsc.case.identify import IdentifyCase
from vipetsc.identification.growing_windows import other_contacts
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
    """Derivatives by parameters of every kind, through lossy contacts, are central differences of engines' runs.

    The engines take turns: each differentiates half of the parameters.
    """
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
    table = lattice_table(time={"end": 0.014})
    record = measured_table(tmp_path, table, noise=0.005)
    wrong = table | {"contacts": table["contacts"] | {"law": "bilinear", "stiffness": 3e4}}
    unknowns = [*FROM_THE_TRUTH, {"quantity": "stiffness", "bounds": [1e3, 1e6]}]

    # From the truth on no windows are needed: all impacts are in the first one.
    right = results_of(tmp_path / "right", identify_table(table, record, unknowns=FROM_THE_TRUTH, impacts=1000))
    assert "not white" not in right.attrs["warnings"]
    found = results_of(tmp_path / "wrong", identify_table(wrong, record, unknowns=unknowns, impacts=1000, steps=6))
    assert "not white" in found.attrs["warnings"]


def test_intervals_hold_the_truth(tmp_path):
    """Intervals of 90 % contain most true values in four records with 2 % noise; deviations are as large as stated."""
    table = lattice_table(time={"end": 0.014})
    truth = np.array([*table["contacts"]["clearance"], 0.7])
    inside = []
    deviations = []
    for seed in (1, 2, 4, 8):
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
