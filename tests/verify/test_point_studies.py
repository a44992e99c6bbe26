"""Measures of points in sweeps and searches are those of single runs, also where members are scaled."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import run_of, search_table, with_sections
from vipetsc.case import Case, Sweep
from vipetsc.case.optimise import OptimiseCase, measures_of_runs
from vipetsc.io.netcdf import open_netcdf
from vipetsc.io.read import open_ensemble
from vipetsc.spectra.measures import MEASURES, RunMeasure, measures_of
from vipetsc.studies.analysis import analyse
from vipetsc.studies.ensemble import COMPLETE, SCALED
from vipetsc.studies.optimum_search import run_search
from vipetsc.studies.sweep import run_sweep

POINTS = [{"name": "base", "cell": 2}, {"name": "tip", "cell": 8, "mass": 2}]
FORCE = 15.0  # N, a bound that some designs exceed, among them the best one without the bound
OUTPUT = {"points": POINTS, "transmission": [["base", "tip"]]}
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
            {"measure": "largest_force", "at_most": FORCE},
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
    assert optimum["excess"].values == pytest.approx(np.maximum((force - FORCE) / FORCE, 0.0), rel=1e-12)
    feasible = np.flatnonzero(force <= FORCE)
    assert 0 < len(feasible) < len(force)
    assert np.argmin(optimum["value"].values[:, 0]) not in feasible
    assert optimum["front"].values.tolist() == [feasible[np.argmin(optimum["value"].values[feasible, 0])]]
    assert "designs meet the constraints" in summary
    assert Case.load(folder / "best.toml").output.points[1].name == "tip"


def test_a_measure_of_unknown_power_is_not_scaled(tmp_path, monkeypatch):
    """A registered measure is a variable of the sweep, and every member is simulated if its power is not given.

    The power of a measure says how it scales with the amplitude.
    """

    def squared(record) -> float:
        return float(record.points["tip"].velocity.max() ** 2)

    monkeypatch.setitem(MEASURES, "squared", RunMeasure("squared", "m2/s2", "largest velocity, squared", squared))
    axes = {"drive": {"amplitude": [0.1, 0.2]}, "measures": ["motion"]}
    table = with_sections(SHAKEN, {"drive": {"frequency": 900.0}, "time": {"end": 0.05}})
    result = run_sweep(Sweep.from_table(table | {"sweep": axes}), tmp_path, MPI.COMM_SELF)

    assert result.count(COMPLETE) == 2
    ensemble = open_ensemble(tmp_path)
    assert ensemble["squared"].attrs == {"units": "m2/s2", "long_name": "largest velocity, squared"}
    weak, strong = ensemble["squared"].values
    assert strong == pytest.approx(4 * weak, rel=1e-5)
    assert "squared" in measures_of_runs(Case.from_table(table))
