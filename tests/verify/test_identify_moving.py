"""Identification from records of another program, of lattices that move already when the record begins."""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np
import pytest

from tests.identified import identify_table, lattice_table, measured_table
from tests.independent_lattice import ScipyLattice, Stop, chain_matrices
from vipetsc.case.identify import IdentifyCase
from vipetsc.identification.misfit import Misfit
from vipetsc.io.netcdf import open_netcdf
from vipetsc.studies.identification import read_records, run_identification

pytestmark = pytest.mark.slow

CHAIN = {
    "masses": [0.25],
    "springs": [{"start": 1, "end": 1, "stiffness": 4e4, "damping": 4.0, "next_cell": True}],
    "contact": [1, 1],
}
GROUND_STOP = {"law": "bilinear", "stiffness": 1.5e6, "restitution": 0.9, "sites": [3], "pair": [0, 1], "side": "plus"}


def results_of(folder, table):
    """The results of an identification of ``table`` in ``folder``."""
    run_identification(IdentifyCase.from_table(table), folder)
    with open_netcdf(folder / "identified.h5", "identification") as file:
        return file.load()


def chain_record(path, start: np.ndarray, speed: np.ndarray, times: np.ndarray, clock: float = 0.0) -> np.ndarray:
    """Write the motion of a chain of four masses with a stop and dashpots; returns the state (2, mass) at its begin."""
    stiffness, damping = chain_matrices(4, 4e4, 3.0)
    stop = Stop(resonator=2, host=-1, gap=4e-4, stiffness=2e6, exponent=1.0, restitution=0.8)
    # By SciPy: a record of this package's own integrator would hide an error that both have.
    lattice = ScipyLattice(np.full(4, 0.25), stiffness, damping, (stop,), force=lambda t: np.zeros(4))
    motion, impacts = lattice.motion(times, start, speed, start=0.0)
    # Fewer would not determine stiffness and restitution apart.
    assert impacts > 4
    # Milliseconds, g and a clock of its own, as laboratories store them.
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
        "contacts": GROUND_STOP | {"clearance": 5.2e-4},
        "drive": {"amplitude": 0.0},
        "initial": {"kind": "velocity", "cell": 1, "velocity": 0.5},
        "identify": {"records": records, "unknowns": unknowns, "profile": 0},
    }


def test_a_displaced_lattice_determines_its_stop_and_its_initial_state(tmp_path):
    """Free decay after an unknown release, from another integrator: parameters and the whole state to 1e-6."""
    times = np.arange(0.0, 0.15, 1 / 2000)
    # The offset in the case is half a second off: with no drive the clock must not matter.
    begin = chain_record(tmp_path / "decay.csv", np.array([3e-3, 0.0, 0.0, 0.0]), np.zeros(4), times, clock=7.5)
    found = results_of(tmp_path / "out", chain_table(tmp_path / "decay.csv", offset=7.0, initial="estimate"))

    assert found["value"].values == pytest.approx([4e-4, 2e6, 0.8, 3.0], rel=1e-6)
    assert found["initial/displacement"].values == pytest.approx(begin[0], abs=1e-8)
    assert found["initial/velocity"].values == pytest.approx(begin[1], abs=1e-5)
    assert found["initial/cell"].values.tolist() == [1, 2, 3, 4]
    # Every direction of the initial state is measured, and none left to its prior.
    assert (found["initial/singular"].values > 2).all()
    assert found.attrs["warnings"] == "[]"


def test_a_struck_lattice_begins_as_the_case_says(tmp_path):
    """A mass is struck with a given velocity at the offset; the record overrides the case's [initial].

    Its first samples are left out: the first window has contacts behind its beginning only.
    """
    times = np.arange(0.0, 0.15, 1 / 2000)
    chain_record(tmp_path / "strike.csv", np.zeros(4), np.array([0.0, 1.1, 0.0, 0.0]), times, clock=-2.0)
    strike = {"cell": 2, "velocity": 1.1}
    table = chain_table(tmp_path / "strike.csv", offset=-2.0, begin=-1.92, initial=strike)
    # A first window with one impact, which begins after the record's own beginning.
    table["identify"]["impacts"] = 1
    found = results_of(tmp_path / "out", table)
    assert found["value"].values == pytest.approx([4e-4, 2e6, 0.8, 3.0], rel=1e-6)
    # No state was estimated: the case states it.
    assert found.sizes["moving"] == 0


def shaken_record(path, window: tuple[float, float]) -> dict[str, Any]:
    """Write accelerations of a row of masses, shaken by its left frame, with unlike stops on both sides; its table."""
    count, stiffness, mass, amplitude, frequency = 4, 4e4, 0.25, 4e-4, 250.0
    # Ten periods, the default of a harmonic drive.
    ramp = 10 * 2 * np.pi / frequency

    def force(t: float) -> np.ndarray:
        s = min(t / ramp, 1.0)
        forces = np.zeros(count)
        # A frame that moves by U acts on the first mass as the force k U.
        forces[0] = stiffness * amplitude * (10 * s**3 - 15 * s**4 + 6 * s**5) * np.sin(frequency * t)
        return forces

    matrices = chain_matrices(count, stiffness, 0.0, ground=3.0)
    stops = tuple(
        Stop(resonator, host, gap, 3e8, 1.5, 0.75, side)
        for resonator, host, gap, side in ((1, 0, 2e-4, 1), (1, 0, 1.5e-4, -1), (2, -1, 6e-4, 1), (2, -1, 3e-4, -1))
    )
    lattice = ScipyLattice(np.full(count, mass), *matrices, stops, force)
    times = np.arange(0.0, window[1], 1 / 3200)
    motion, _ = lattice.motion(times, np.zeros(count), np.zeros(count), start=0.0)
    with h5py.File(path, "w") as file:
        used = times >= window[0]
        # A clock that began 100 s earlier, as data loggers have.
        file["daq/clock"] = times[used] + 100.0
        file["daq/g"] = motion[2][used][:, [0, 2, 3]] / 9.81
    sensors = [
        {"quantity": "acceleration", "column": f"daq/g[{column}]", "cell": cell, "factor": 9.81}
        for column, cell in enumerate((1, 3, 4), 1)
    ]
    record = {"file": str(path), "time": "daq/clock", "offset": 100.0, "sensors": sensors}
    unknowns = [
        {"quantity": "clearance", "of": "each", "bounds": [5e-5, 5e-3]},
        {"quantity": "clearance_minus", "of": "each", "bounds": [5e-5, 5e-3]},
        {"quantity": "restitution", "bounds": [0.3, 1.0]},
        {"quantity": "grounding", "bounds": [0.1, 30.0], "start": 2.0},
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
        "identify": {"records": [record], "unknowns": unknowns, "profile": 0},
    }


def test_a_record_that_begins_while_the_lattice_is_shaken(tmp_path):
    """Base motion, accelerations in HDF5, other stops on the two sides: all come back with the unknown state."""
    # After the ramp has ended, in the midst of impacts.
    table = shaken_record(tmp_path / "daq.h5", window=(0.27, 0.36))
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


def test_a_stop_that_the_lattice_does_not_meet(tmp_path):
    """The record from rest on is too short for one stop, which the model meets at first: the others are still exact."""
    found = results_of(tmp_path / "out", shaken_record(tmp_path / "daq.h5", window=(0.0, 0.17)))
    named = dict(zip(found["parameter"].values.tolist(), found["value"].values.tolist(), strict=True))
    truth = {"clearance 1": 2e-4, "clearance_minus 1": 1.5e-4, "clearance_minus 2": 3e-4, "grounding": 3.0}
    assert {name: named[name] for name in truth} == pytest.approx(truth, rel=1e-6)
    at_least = found["at_least"].values[found["parameter"].values.tolist().index("clearance 2")]
    # The largest approach of the record is just below the clearance, which is all that the record says of it.
    assert 5.5e-4 < at_least < 6e-4


@pytest.mark.parametrize(("size", "touching"), [(0.1, 0), (0.3, 2), (1.0, 2)])
def test_derivatives_by_the_initial_state_are_central_differences(tmp_path, size, touching):
    """Of parameters and coordinates of the state, from states of all sites free and from ones with sites in contact."""
    table = lattice_table(time={"end": 0.0065})
    record = measured_table(tmp_path, table) | {"begin": 4e-3, "initial": "estimate", "offset": [-1e-4, 1e-4]}
    unknowns = [
        {"quantity": "clearance", "bounds": [1e-4, 2e-3], "start": 4e-4},
        {"quantity": "stiffness", "bounds": [1e5, 1e7]},
        {"quantity": "mass", "of": [[2, 3]], "bounds": [1e-4, 1.0]},
    ]
    plan = IdentifyCase.from_table(identify_table(table, record, unknowns=unknowns))
    misfit = Misfit(plan, read_records(plan))
    state = misfit.states[0]
    generator = np.random.default_rng(5)
    z = np.array([p.to_coordinate(p.start) for p in plan.parameters])
    # The signs of modes are those of the LAPACK that is installed; the state is the same everywhere.
    moving = size * np.linalg.norm(state.matrix, axis=1) * generator.standard_normal(len(state.matrix))
    z = np.concatenate([z, np.linalg.solve(state.matrix, moving)])
    ends = [0.0052]
    every = [0, 1, 2, 3, *range(4, misfit.size, 7)]
    jacobian = misfit.jacobian(z, ends, every)
    # An onset before the record is logged at 0.
    assert np.sum(misfit.respond(z, 0, 1.0).episodes["onset"] == 0) == touching
    # Of a five-point formula: its error h^4 and that of the runs over h are both below the tolerance.
    h = 1e-4
    for column, p in enumerate(every):
        expected = np.zeros(len(jacobian))
        for steps, weight in ((-2, 1), (-1, -8), (1, 8), (2, -1)):
            moved = z.copy()
            moved[p] += steps * h
            expected += weight * misfit.residuals(moved, ends) / (12 * h)
        error = np.abs(jacobian[:, column] - expected).max()
        # A force of the power 1.5 has no second derivative at an onset: differences across one have errors up to 1e-4.
        assert error < 3e-4 * np.abs(expected).max() + 1e-7, (p, error)
