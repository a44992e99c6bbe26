"""Identification from records that SciPy computed, of lattices that already move when the record begins."""

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
from vipetsc.studies.identification import read_measured_records, run_identification

CHAIN = {
    "masses": [0.25],
    "springs": [{"start": 1, "end": 1, "stiffness": 4e4, "damping": 3.5, "next_cell": True}],
    "contact": [1, 1],
}
GROUND_STOP = {"law": "bilinear", "stiffness": 1.8e6, "restitution": 0.85, "sites": [3], "pair": [0, 1], "side": "plus"}


def results_of(folder, table):
    """The results of an identification of ``table`` in ``folder``."""
    run_identification(IdentifyCase.from_table(table), folder)
    with open_netcdf(folder / "identified.h5", "identification") as file:
        return file.load()


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
