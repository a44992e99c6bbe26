"""Runs under drives and free ones against theory: transfer functions, modes, packets, moved walls, resonance."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from mpi4py import MPI

import h5py
import numpy as np
import pytest
import xarray as xr
from scipy.interpolate import CubicSpline
from scipy.linalg import eigh

from tests.conftest import run_of, simulated, with_sections
from tests.zoo_by_scipy import lattice_by_scipy
from vipetsc.case import Case, CaseError, NnmCase
from vipetsc.case.waveforms import waveform_of
from vipetsc.dynamics import simulate
from vipetsc.io.netcdf import variable, write_netcdf
from vipetsc.io.store import RunMemory
from vipetsc.lattice import bloch
from vipetsc.lattice.drive import joined, sampled
from vipetsc.lattice.modes import linear_modes, mode_frequency
from vipetsc.modes.system import System
from vipetsc.spectra.modal_energies import ModalParts

ENGINES = ("ts", "propagator")
BURST = {"amplitude": 3.0, "cycles": 3, "frequency": 900.0, "mass": 2, "cell": 4}


def case_of(*drives: dict[str, Any], engine: str = "propagator", **sections: Any) -> Case:
    """A diatomic lattice of 16 cells without contacts, under one or more ``drives``."""
    first, *more = drives
    drive = dict(first)
    if more:
        drive["more"] = more
    table = {
        "lattice": {"preset": "diatomic", "cells": 16, **sections.pop("lattice", {})},
        "contacts": {"sites": []},
        "drive": drive,
        "time": {"end": 0.03, "engine": engine, "sample_interval": 1e-4, "rtol": 1e-11},
    }
    return Case.from_table(table | sections)


def ledger_error(run: xr.Dataset) -> float:
    """The largest error of work = stored + dissipated energy over the samples, divided by the largest work."""
    work = run["energy/work"].values
    spent = sum(run[f"energy/{name}"].values for name in ("kinetic", "spring", "contact", "dissipated"))
    return float(np.abs(work - spent).max() / np.abs(work).max())


def relative_error(values: np.ndarray, expected: np.ndarray) -> float:
    """The largest deviation from ``expected``, divided by the largest expected value."""
    return float(np.abs(values - expected).max() / np.abs(expected).max())


@pytest.mark.parametrize("engine", ENGINES)
def test_a_burst_from_a_file_is_the_burst_to_the_splines_error(engine, tmp_path):
    """A cubic spline through samples has an error of fourth order: twice as many samples divide it by 16."""
    burst = waveform_of(case_of(BURST).drive)
    expected = run_of(case_of(BURST, engine=engine))["displacement"].values

    errors = []
    for count in (160, 320):
        path = tmp_path / f"{count}.csv"
        time = np.linspace(0, burst.duration, count + 1)
        np.savetxt(path, np.column_stack([time, burst.force(time)]), "%.17g", ",", header="t, F")
        sampled = BURST | {
            "amplitude": 1.0,
            "waveform": "samples",
            "samples": {"file": str(path), "interpolation": "spline"},
        }
        del sampled["cycles"]

        run = run_of(case_of(sampled, engine=engine))
        assert ledger_error(run) < 1e-9
        errors.append(relative_error(run["displacement"].values, expected))

    assert 3.7 < np.log2(errors[0] / errors[1]) < 4.2
    assert errors[1] < 2e-8


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(("interpolation", "momentum"), [("monotone", 1e-4), ("linear", 1e-4), ("spline", None)])
def test_a_short_blow_between_long_samples_has_its_momentum(engine, interpolation, momentum):
    """A triangle of 1 N and 0.2 ms strikes a mass of 1 kg on 1e4 N/m; a spline through it is large, and says so."""
    samples = {"time": [0.0, 0.1, 0.1001, 0.1002, 0.2], "value": [0.0, 0.0, 1.0, 0.0, 0.0]}
    if interpolation != "monotone":
        samples["interpolation"] = interpolation
    spring = {"start": 1, "end": 1, "stiffness": 5000.0, "next_cell": True}
    case = Case.from_table(
        {
            "lattice": {"cells": 1, "cell": {"masses": [1.0], "springs": [spring]}},
            "contacts": {"sites": []},
            "drive": {"waveform": "samples", "amplitude": 1.0, "samples": samples},
            "time": {"end": 0.4, "samples": 2001, "engine": engine},
        }
    )
    run = run_of(case)
    assert ledger_error(run) < 1e-8
    if momentum is None:
        assert case.model().drive.peak > 1e4
        assert f"at most {case.model().drive.peak:.6g} N" in case.drive.describe()
        return

    assert case.model().drive.peak == pytest.approx(1.0, rel=1e-2)
    assert np.abs(run["velocity"].values).max() == pytest.approx(momentum, rel=1e-4)


@pytest.mark.parametrize("interpolation", ["monotone", "linear"])
def test_between_samples_a_force_stays_between_their_values(interpolation):
    """Times of all spacings, values that jump: nothing lies beyond the two neighbouring samples."""
    random = np.random.default_rng(5)
    times = np.cumsum(10 ** random.uniform(-6, 0, 60))
    values = random.choice([-1.0, 0.0, 1.0, 5.0], 60)
    wave = sampled(2.0, times, values, 1.0, interpolation)
    for i in range(59):
        between = wave.force(np.linspace(times[i], times[i + 1], 50)[:-1])
        assert between.min() >= 2 * values[i : i + 2].min() - 1e-9
        assert between.max() <= 2 * values[i : i + 2].max() + 1e-9
        assert between[0] == pytest.approx(2 * values[i])


def test_samples_travel_with_the_case(tmp_path):
    """A case holds the samples themselves, to the last bit, and their file's checksum; the file may be removed."""
    path = tmp_path / "lab.h5"
    time = np.linspace(0, 0.01, 30)
    # Few decimals would hold neither these numbers nor the first one, which is tiny and not zero.
    force = np.where(time == 0, 1e-20, np.sin(800 * time))
    with h5py.File(path, "w") as file:
        file["drive"] = np.column_stack([time, force])
    drive = {"waveform": "samples", "samples": {"file": str(path), "dataset": "drive"}}
    case = case_of(drive)
    path.unlink()

    again = Case.from_toml(case.to_toml())
    assert again == case
    assert again.model() == case.model()
    assert again.drive.samples.value == force.tolist()
    assert len(case.drive.samples.sha256) == 64

    other = case_of({"waveform": "samples", "samples": {"time": time.tolist(), "value": (2 * force).tolist()}})
    assert other.model() != case.model()
    with pytest.raises(CaseError, match=r"drive\.samples\.file.*lab\.h5"):
        case_of(drive)


def moving(initial: dict, **sections) -> Case:
    """A four-band lattice without a drive; ``initial`` is its table [initial]."""
    table = {
        "name": "moving",
        "lattice": {"preset": "four-band", "cells": 40},
        "contacts": {"sites": 0},
        "initial": initial,
    }
    return Case.from_table(with_sections(table, sections))


def run(case: Case) -> xr.Dataset:
    """The result of a run in memory; asserts that its energy balance closes."""
    data, result = simulated(case)
    assert result.statistics["ledger_error"] < 1e-8
    return data


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
@pytest.mark.parametrize("engine", ENGINES)
def test_a_mode_stays_a_mode(engine, ends):
    """A lattice that begins in one mode moves as u(t) = u(0) cos(omega t), and all energy stays in that mode."""
    end = 0.02
    case = moving(
        {"kind": "mode", "number": 50, "energy": 2e-3},
        lattice={"ends": ends},
        time={"engine": engine, "end": end, "rtol": 1e-13},
    )
    chain = case.model().chain
    omega = mode_frequency(chain, 50)
    # Without a drive the mode's frequency is the one that sets tolerances.
    assert case.initial.frequency == omega

    data = run(case)

    work = data["energy/work"].values
    assert work == pytest.approx(2e-3, rel=1e-12)
    assert np.ptp(work) == 0.0

    modes = linear_modes(chain)
    energy = 0.5 * np.abs(modes.amplitudes(data["displacement"].values, data["velocity"].values)) ** 2
    # On a ring waves in both directions have the same frequency.
    own = np.abs(modes.frequency - omega) < 1e-6 * omega
    assert own.sum() == (2 if ends == "periodic" else 1)
    assert energy[:, own].sum(axis=1) == pytest.approx(2e-3, rel=1e-12)

    u = data["displacement"].values
    wave = u[:1] * np.cos(omega * data["time"].values)[:, None, None]
    # The phase may err by 1e-12 in each radian of the run.
    assert np.abs(u - wave).max() < 1e-12 * np.abs(u).max() * omega * end
    assert np.abs(u).max() == pytest.approx(case.initial.amplitude, rel=1e-12)


@pytest.mark.parametrize("direction", [-1])
@pytest.mark.parametrize("engine", ENGINES)
def test_a_packet_travels_with_the_group_velocity_on_its_band(engine, direction):
    """All energy of a packet is in its band, and the centre of energy moves with the packet's mean group velocity."""
    kappa = 2 * np.pi / 5
    width = 8
    initial = {
        "kind": "packet",
        "band": 2,
        "wavenumber": "2pi/5",
        "cell": 120,
        "width": width,
        "direction": direction,
        "amplitude": 1e-4,
    }
    case = moving(initial, lattice={"cells": 240}, time={"engine": engine, "end": 0.1})
    assert case.drive.cell == 120

    data = run(case)
    model = case.model()
    v = data["velocity"].values
    parts = ModalParts.of(model.chain)
    by_part = parts.energies(data["displacement"].values, v, [0, len(v) - 1]).sum(axis=1)
    assert by_part[parts.parts.names.index("band 2")] == pytest.approx(data["energy/work"][0].item(), rel=1e-9)

    # Each wave is weighted by its energy, the square of its frequency times its amplitude in the Gaussian.
    k = kappa + np.linspace(-0.7, 0.7, 2001)
    point = bloch(model.chain.cell, k)
    weight = (point.frequency[:, 1] * np.exp(-0.5 * ((k - kappa) * width) ** 2)) ** 2
    speed = np.average(point.group_velocity[:, 1], weights=weight)
    energy = (v**2 @ np.asarray(model.chain.cell.masses)).astype(float)
    middle = (energy * data["cell"].values).sum(axis=1) / energy.sum(axis=1)
    measured = np.polyfit(data["time"].values, middle, 1)[0]
    assert measured == pytest.approx(direction * speed, rel=2e-3)


def write_state(path: Path, u: np.ndarray, v: np.ndarray) -> None:
    """Write rows 11 to 30 of displacements ``u`` in m and velocities ``v`` in m/s, both (cell, dof), to a file."""
    data = {
        "cell": variable("cell", np.arange(11, 31), "1", "cell"),
        "dof": variable("dof", np.arange(1, 5), "1", "mass"),
        "displacement": variable(("cell", "dof"), u[10:30], "m", "displacement"),
        "velocity": variable(("cell", "dof"), v[10:30], "m/s", "velocity"),
    }
    write_netcdf(path, xr.Dataset(data))


def test_a_file_that_changes_is_noticed(tmp_path):
    """A run begins with the state in a file, in the cells that the file names, and refuses a file that has changed."""
    path = tmp_path / "state.h5"
    u, v = np.random.default_rng(0).standard_normal((2, 40, 4)) * 1e-4
    write_state(path, u, v)
    case = moving({"kind": "file", "path": str(path)}, drive={"amplitude": 0.0, "frequency": 900.0}, time={"end": 0.01})
    data = run(case)

    assert np.array_equal(data["displacement"][0].values[10:30], u[10:30])
    assert not data["velocity"][0].values[[*range(10), *range(30, 40)]].any()
    # The slope of the first three recorded displacements is the file's velocity, as far as three samples determine it.
    spline = CubicSpline(data["time"].values[:3], data["displacement"].values[:3])
    assert spline(0.0, 1)[10:30] == pytest.approx(v[10:30], abs=0.2)

    write_state(path, u, 2 * v)
    with pytest.raises(CaseError, match="has changed since"):
        simulate(case, RunMemory())
    # A case can be read from results after its file has changed or has been removed.
    assert Case.from_toml(case.to_toml()) == case

    path.unlink()
    assert Case.from_toml(case.to_toml()) == case
    with pytest.raises(CaseError, match=r"initial\.path"):
        simulate(case, RunMemory())


@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_a_struck_chain_moves_as_its_modes(engine):
    """A struck lattice without contacts moves as the sum of its modes, phi_j (phi_j^T M v0) sin(w_j t)/w_j."""
    springs = [
        {"start": 1, "end": 1, "stiffness": 2.0e4, "next_cell": True},
        {"start": 1, "end": 2, "stiffness": 6.0e3},
    ]
    case = Case(
        lattice={"cells": 12, "cell": {"masses": [0.01, 0.004], "springs": springs}},
        initial={
            "kind": "velocity", "cell": 2, "velocity": 1.0, "more": [{"cell": 12, "mass": 2, "velocity": -0.3}]
        },
        time={"end": 0.02, "engine": engine, "rtol": 1e-12},
    )  # fmt: skip
    data, _ = simulated(case)

    chain = case.model().chain
    masses = chain.masses()
    squares, shapes = eigh(chain.stiffness_matrix().toarray(), np.diag(masses))
    omega = np.sqrt(squares)
    velocity = np.zeros(24)
    velocity[2] = 1.0
    velocity[23] = -0.3
    parts = shapes.T @ (masses * velocity)
    exact = np.sin(np.outer(data["time"].values, omega)) * (parts / omega) @ shapes.T
    assert data["displacement"].values.reshape(-1, 24) == pytest.approx(exact, abs=1e-9 * np.abs(exact).max())


SPAN = 0.4  # s


def wall_motion(t, derivative=0):
    """A motion in m that begins and ends at rest, (t (SPAN - t))^4 sin 60 t with a scale, and its derivatives."""
    h = 1e-3 * SPAN
    if derivative:
        # Differences of the sixth order.
        weights = [-1, 9, -45, 0, 45, -9, 1]
        shifted = [wall_motion(t + h * n, derivative - 1) for n in range(-3, 4)]
        return sum(w * s for w, s in zip(weights, shifted, strict=True)) / (60 * h)
    return 1e-3 * (4 * t * (SPAN - t) / SPAN**2) ** 4 * np.sin(60 * t)


@pytest.mark.parametrize("quantity, removed", [("velocity", [2e-3]), ("acceleration", [0.3, -2.0])])
def test_an_integrated_record_is_the_motion(quantity, removed):
    """Offset and drift that were added to the exact rates are found and removed; the motion is found to 1e-6."""
    derivative = len(removed)
    times = 0.1 + np.linspace(0, SPAN, 500)
    values = wall_motion(times - 0.1, derivative) + np.polynomial.polynomial.polyval(times - 0.1, removed)
    motion = joined(times, values, "spline", derivative)
    np.testing.assert_allclose(motion.removed, removed, rtol=1e-5)
    t = np.linspace(0, SPAN, 1999)
    np.testing.assert_allclose(motion.curve(0.1 + t), wall_motion(t), atol=1e-9)
    kept = joined(times, values, "spline", derivative, removes=False)
    assert abs(kept.last) > 1e-4 and not len(kept.removed) and motion.last == 0


@pytest.mark.parametrize("interpolation", ["linear", "monotone", "spline"])
def test_integrals_are_exact(interpolation):
    """The derivatives of the motion are the curve through uneven samples less what is removed."""
    random = np.random.default_rng(3)
    times = np.cumsum(random.uniform(0.01, 0.2, 9))
    values = random.standard_normal(9)
    given = joined(times, values, interpolation)
    t = np.linspace(times[0], times[-1], 200)[:-1]
    for derivative in (1, 2):
        motion = joined(times, values, interpolation, derivative)
        found = motion.curve.derivative(derivative)(t)
        removed = np.polynomial.polynomial.polyval(t - times[0], motion.removed)
        np.testing.assert_allclose(found, given.curve(t) - removed, atol=1e-12)
        assert abs(motion.curve(times[-1])) < 1e-13


TIMES = [0.0, 0.03, 0.05, 0.08, 0.12, 0.15]
VALUES = [4.0, -7.0, 6.0, 9.0, -8.0, 3.0]
CHAIN = {"masses": [0.1, 0.05], "springs": [{"start": 1, "end": 1, "stiffness": 900.0, "next_cell": True}]}
CHAIN["springs"].append({"start": 1, "end": 2, "stiffness": 400.0})
BETA = 2e-3  # s


def table(drive, engine="ts", **sections):
    """Four cells with stiffness-proportional damping between walls, of which the left one moves."""
    return {
        "lattice": {"cells": 4, "cell": CHAIN, "damping": {"stiffness": BETA}},
        "contacts": {"sites": []},
        "drive": {"amplitude": 2.0, "end": "left"} | drive,
        "time": {"end": 0.3, "engine": engine, "rtol": 1e-11, "samples": 601},
    } | sections


def test_tables_of_records_drive_a_wall(tmp_path):
    """Columns by name and number of text, at a rate, in milliseconds, and datasets of HDF5: the same samples."""
    times, values = np.array(TIMES), np.array(VALUES)
    text = tmp_path / "record.csv"
    rows = [f"{1e3 * t:.12g};{7.5};{v:.12g}" for t, v in zip(times, values, strict=True)]
    text.write_text("time (ms);other;a (m/s^2)\n" + "\n".join(rows) + "\n")
    with h5py.File(tmp_path / "record.h5", "w") as file:
        file["lab/clock"] = times
        file["lab/data"] = np.column_stack([0 * values, values])
    even = tmp_path / "even.txt"
    even.write_text("\n".join(map(str, VALUES)) + "\n")
    quantity = {"quantity": "acceleration"}

    def samples(**keys):
        drive = {"waveform": "samples", "samples": keys | quantity}
        return Case.from_table(table(drive)).drive.samples

    for keys in (
        {"file": str(text), "columns": ["time (ms)", "a (m/s^2)"], "time_factor": 1e-3},
        {"file": str(text), "columns": [1, 3], "time_factor": 1e-3},
        {"file": str(tmp_path / "record.h5"), "columns": ["lab/clock", "lab/data[2]"]},
    ):
        found = samples(**keys)
        np.testing.assert_allclose(found.time, times, rtol=1e-12)
        assert found.value == VALUES
    found = samples(file=str(even), rate=50.0)
    np.testing.assert_allclose(found.time, np.arange(6) / 50.0)
    case = Case.from_table(table({"waveform": "samples", "samples": {"file": str(text), "columns": [1, 3]} | quantity}))
    assert "offset" in case.drive.describe() and "drift" in case.drive.describe()
    assert case.drive.unit_of("amplitude", {"end": "left", "samples": quantity}) == "m/s^2"


every_engine = pytest.mark.parametrize("engine", ["ts", "propagator"])


def flat_band(engine: str, periods: int, damping: float = 0.0, coupling: float = 10.0) -> Case:
    """Three cells of a host and a resonator, hardly coupled, driven at the resonance of the middle one."""
    k = 1e4
    omega = float(np.sqrt(2 * k / 0.01))
    springs = [
        {"start": 1, "end": 1, "stiffness": coupling, "next_cell": True},
        {"start": 1, "end": 2, "stiffness": k, "damping": damping},
    ]
    cell = {"masses": [0.01, 0.01], "springs": springs, "contact": [1, 2]}
    period = 2 * np.pi / omega
    drive = {"waveform": "harmonic", "amplitude": 1e-3, "cell": 2, "mass": 1, "frequency": omega, "ramp": 2 * period}
    return Case.from_table(
        {
            "name": "flat",
            "lattice": {"cells": 3, "ends": "fixed", "cell": cell},
            "contacts": {"sites": 0},
            "drive": drive,
            "time": {"end": periods * period, "engine": engine},
            "output": {"figures": False},
        }
    )


@every_engine
@pytest.mark.parametrize("coupling", [1.0, 10.0])
def test_an_undamped_resonance_grows_as_long_as_it_is_driven(engine, coupling):
    """The amplitude grows with the time, the energy with its square, far beyond that of the forced wave."""
    run, result = simulated(flat_band(engine, 400, coupling=coupling))
    energy = run["energy/kinetic"].values + run["energy/spring"].values
    half = len(energy) // 2
    # Not exactly: the host's springs to its neighbours detune it by their part of the stiffness.
    assert energy[-1] / energy[half] == pytest.approx(4.0, rel=0.35)
    assert result.statistics["ledger_error"] < 1e-8


@every_engine
def test_what_dashpots_dissipate_may_exceed_the_energy_by_far(engine):
    """At a steady amplitude the loss grows by the same amount in each period, over 600 of them."""
    run, result = simulated(flat_band(engine, 600, damping=0.05))
    lost = run["energy/dissipated_by_damping"].values
    per_sixth = np.diff(lost[:: len(lost) // 6])
    assert per_sixth[3:] == pytest.approx(per_sixth[-1], rel=0.01)
    assert result.statistics["ledger_error"] < 1e-8


@pytest.mark.parametrize("clearance", [0.141421356237, 0.14142135623, 0.1414213562373, 0.14142135623731])
def test_a_mode_that_begins_at_a_turning_point_on_the_stop_goes_on(clearance):
    """The pair of two masses begins at rest within 1e-10 of the stop, with |w| = 2^1/2/10 of its second mode."""
    springs = [{"start": 1, "end": 1, "stiffness": 1.0, "next_cell": True}, {"start": 1, "end": 2, "stiffness": 1.0}]
    case = Case.from_table(
        {
            "lattice": {"cells": 1, "cell": {"masses": [1.0, 1.0], "springs": springs, "contact": [1, 2]}},
            "contacts": {"law": "bilinear", "stiffness": 100.0, "sites": [1], "clearance": clearance},
            "initial": {"kind": "mode", "number": 2, "amplitude": 0.1},
            "time": {"end": 20.0, "samples": 101, "engine": "ts"},
        }
    )
    run, result = simulated(case)
    # The stop is reached with hardly any velocity, if at all: the mode goes on, u_1 = 0.1 cos(omega t) up to a factor.
    u = run.displacement.values[:, 0]
    k = np.array([[3.0, -1.0], [-1.0, 1.0]])
    omega = np.sqrt(np.linalg.eigvalsh(k)[1])
    expected = u[0] * np.cos(omega * run.time.values)[:, None]
    np.testing.assert_allclose(u, expected, atol=1e-5)
    assert result.statistics["ledger_error"] < 1e-9


SHORTS = pytest.mark.parametrize("short", [1e-4, 1e-9, 1e-14])


def creeping(cells: int, coupling: float, ground: float, short: float) -> tuple[Case, float]:
    """A case in which a constant force pulls the middle mass of a chain on dashpots slowly to its stop.

    The stop is nearer than the position of equilibrium by the fraction ``short`` of this position, which is returned.
    """
    middle = cells // 2
    stiffness = coupling * (2 * np.eye(cells) - np.eye(cells, k=1) - np.eye(cells, k=-1))
    rest = np.linalg.inv(stiffness)[middle, middle]
    springs = [{"start": 1, "end": 1, "stiffness": coupling, "next_cell": True}]
    law = {"law": "bilinear", "stiffness": 1e4, "restitution": 0.5}
    # The rate at which the slowest mode decays.
    lowest = np.linalg.eigvalsh(stiffness)[0]
    rate = ground / 2 - np.sqrt(ground**2 / 4 - lowest)
    end = np.ceil(100.0 - np.log(short) / rate)
    case = Case.from_table(
        {
            "lattice": {"cells": cells, "cell": {"masses": [1.0], "springs": springs, "grounding": [ground]}},
            "contacts": law
            | {"sites": [middle + 1], "pair": [0, 1], "side": "plus", "clearance": rest * (1.0 - short)},
            "drive": {"waveform": "step", "amplitude": 1.0, "ramp": 0.1, "frequency": 1.0, "cell": middle + 1},
            "time": {"end": end, "samples": int(10 * end) + 1, "engine": "propagator" if cells > 1 else "ts"},
            "output": {"figures": False},
        }
    )
    return case, rest


@SHORTS
@pytest.mark.parametrize(("cells", "coupling", "ground"), [(1, 0.5, 3.0), (7, 2.0, 6.0)])
def test_a_mass_that_creeps_onto_a_stop_comes_to_rest_on_it(cells, coupling, ground, short):
    """The force presses the mass onto its stop in the end, by either engine, however little is left to press."""
    case, rest = creeping(cells, coupling, ground, short)
    run, result = simulated(case)
    statistics = result.statistics
    assert result.complete
    assert statistics["engine"] == case.time.engine
    assert statistics["rejected"] + statistics.get("substeps", statistics["steps"]) < 100_000
    assert statistics["missed"] == statistics["floored"] == 0
    assert statistics["ledger_error"] < 1e-11
    # The error in the end is what is allowed to a step; in equilibrium the contact is pressed by 1e-4 of ``short``.
    final = run["displacement"].values[-1, cells // 2, 0]
    assert final == pytest.approx(rest * (1.0 - short), abs=rest * (2e-4 * short + 1e-11))


CELLS = 12
MASSES = (4e-3, 2e-3)
STIFFNESS = (1e4, 5e3)
SPRINGS = [
    {"start": 1, "end": 1, "stiffness": STIFFNESS[0], "next_cell": True},
    {"start": 1, "end": 2, "stiffness": STIFFNESS[1]},
]
TABLE: dict[str, Any] = {
    "name": "defects",
    "lattice": {
        "cells": CELLS,
        "cell": {"masses": list(MASSES), "springs": SPRINGS},
        "profiles": {
            "springs[2].quadratic": {"cells": [6], "value": 3e6},
            "springs[2].cubic": {"cells": [6], "value": 4e9},
            "springs[1].quadratic": [0.0] * 8 + [-2e6, 0.0, 0.0, 2e6],
            "springs[1].cubic": [0.0] * 8 + [1e10, 0.0, 0.0, 5e9],
        },
    },
    "contacts": {"sites": []},
    "drive": {"amplitude": 0.0},
    # The struck cell is near two of the three springs; the waves reach the third, at the wall, within the run.
    "initial": {"kind": "velocity", "cell": 7, "velocity": 3.0},
    # Tolerances are far below those of the comparisons, which therefore measure the equations and not the steps.
    "time": {"end": 0.02, "sample_interval": 2e-4, "engine": "ts", "rtol": 1e-12, "atol": 1e-14},
    "output": {"figures": False, "points": [{"name": "near", "cell": 6, "mass": 2}, {"name": "last", "cell": CELLS}]},
}


def changed(*, lattice: dict[str, Any] | None = None, **sections: Any) -> Case:
    """The case of ``TABLE`` with replaced ``sections`` and keys of its ``lattice``, in which None removes a key."""
    merged = {key: value for key, value in (TABLE["lattice"] | (lattice or {})).items() if value is not None}
    return Case.from_table(TABLE | sections | {"lattice": merged})


def test_the_system_of_normal_modes_has_the_springs():
    """The forces and the energy of the system for normal modes are those of all springs."""
    nnm = {"system": "chain", "modes": [1], "energy": [0.0, 1.0]}
    table = {key: TABLE[key] for key in ("name", "lattice", "contacts")}
    system = System.from_case(NnmCase.from_table(table | {"nnm": nnm}))
    u = 1e-3 * np.random.default_rng(1).standard_normal(2 * CELLS)
    lattice = lattice_by_scipy(TABLE)
    forces = sum(spring.force(u) for spring in lattice.curved) - lattice.stiffness @ u
    energy = u @ lattice.stiffness @ u / 2
    for spring in lattice.curved:
        z = spring.row @ u
        energy += spring.quadratic * z**3 / 3 + spring.cubic * z**4 / 4
    # The system's forces stand on the left side of the equations of motion.
    np.testing.assert_allclose(system.forces(u), -forces, rtol=1e-10, atol=1e-10 * np.abs(forces).max())
    assert system.energy(u, 0 * u) == pytest.approx(energy, rel=1e-12)
    assert not system.odd


@pytest.mark.parametrize(
    ("cell", "number", "name", "initial"),
    [
        (6, 2, "quadratic", 7),
        (9, 1, "cubic", 9),
        # A motion towards the right wall compresses the spring to it, on the side where its force falls off.
        (CELLS, 1, "quadratic", CELLS),
    ],
)
def test_a_run_that_tears_a_spring_off_names_it(cell, number, name, initial):
    """A run stops and names the spring when a softening one passes z = -k/q, or |z| = (k/|c|)^(1/2) for a cubic one."""
    k = STIFFNESS[number - 1]
    value = {"quadratic": -1e4 * k, "cubic": -1e8 * k}[name]
    if initial == CELLS:
        value = -value
    profile = {f"springs[{number}].{name}": {"cells": [cell], "value": value}}
    case = changed(
        lattice={"profiles": profile},
        initial={"kind": "velocity", "cell": initial, "velocity": 10.0},
        time={"end": 0.02, "sample_interval": 2e-4, "engine": "ts"},
    )

    result = simulate(case, RunMemory(MPI.COMM_SELF))

    assert not result.complete
    # Both limits are 1e-4 m here.
    assert f"(cell {cell}; its spring {number} no longer pulls back" in result.sentence
    assert re.search(r"elongation of -?0\.0001 m", result.sentence)
