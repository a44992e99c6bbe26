"""Identification in lattices with quadratic and cubic springs, from records and differences by SciPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.independent_lattice import CurvedSpring, ScipyLattice, Stop, chain_matrices
from vipetsc.case.identify import IdentifyCase
from vipetsc.identification.misfit import Misfit
from vipetsc.io.netcdf import open_netcdf
from vipetsc.studies.identification import read_measured_records, run_identification

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


def test_derivatives_by_an_unknown_state_are_differences_of_scipy(record):
    """Derivatives by an initial displacement and velocity, through curved springs, are differences of SciPy."""
    unknowns = [{"quantity": "cubic", "bounds": [1e9, 4e9]}]
    table = table_of(record, unknowns)
    table["identify"]["records"][0] |= {"initial": "estimate", "begin": 1e-3}
    plan = IdentifyCase.from_table(table)
    records = read_measured_records(plan)
    misfit = Misfit(plan, records)
    begin = motion_of(TRUTH)[:2, 2].ravel()
    matrix = misfit.states[0].matrix
    z = np.append(plan.parameters[0].to_coordinate(TRUTH["cubic"]), np.linalg.solve(matrix, begin))
    every = [0, 1, 2 * COUNT]
    values = misfit.predicted(z, 0, 1.0)
    slopes = misfit.jacobian(z, [1.0], every).reshape(*values.shape, -1) * misfit.noise[0][:, None]

    h = 1e-4
    for column, number in enumerate(every[1:], 1):
        ends = [measured(motion_of(TRUTH, TIMES[2:], begin + step * matrix[:, number - 1])) for step in (-h, h)]
        expected = (ends[1] - ends[0]) / (2 * h)
        error = np.abs(slopes[:, :, column] - expected).max(axis=0)
        assert (error < 2e-5 * np.abs(expected).max(axis=0)).all(), (number, error)


UNKNOWNS = [
    {"quantity": "quadratic", "bounds": [-1e7, 1e7]},
    {"quantity": "cubic", "bounds": [-1e10, 1e10]},
    {"quantity": "spring", "bounds": [1e4, 1e5]},
    {"quantity": "clearance", "bounds": [1e-4, 2e-3]},
]
SOUGHT = [TRUTH[unknown["quantity"]] for unknown in UNKNOWNS]
# The case has linear springs, so that the fit begins with quadratic and cubic parts of zero.
CASE = {"quadratic": 0.0, "cubic": 0.0, "spring": 4.2e4, "clearance": 4.6e-4}


def found_in(table, folder):
    """The results of the identification that ``table`` describes, run in ``folder``."""
    run_identification(IdentifyCase.from_table(table), folder)
    with open_netcdf(folder / "identified.h5", "identification") as file:
        return file.load()


def test_curved_springs_come_back_from_linear_ones(record, tmp_path):
    """From linear springs and without noise the fit finds all true parameters, and the identified case has them."""
    found = found_in(table_of(record, UNKNOWNS, **CASE), tmp_path)
    assert found["value"].values == pytest.approx(SOUGHT, rel=1e-7)
    case = IdentifyCase.of(found).case_of(found["value"].values)
    assert case.lattice.unit_cell().springs[0].cubic == pytest.approx(TRUTH["cubic"], rel=1e-7)
