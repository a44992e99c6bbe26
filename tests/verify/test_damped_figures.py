"""Pictures of a laboratory's lattices: what dashpots take, how waves decay, impacts of many sites."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import xarray as xr

from tests.conftest import small_case
from vipetsc.case import Case
from vipetsc.dynamics import simulate
from vipetsc.figures import impact_panels, panels, runs
from vipetsc.io.store import RunMemory
from vipetsc.lattice import four_band, max_group_velocity


@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_the_ledger_has_the_dashpots(engine):
    memory = RunMemory(MPI.COMM_SELF)
    damping = {"mass": 10.0, "stiffness": 1e-5}
    assert simulate(small_case(lattice={"damping": damping}, time={"engine": engine, "end": 0.02}), memory).complete

    upper, lower = runs.ledger(memory.dataset, None).axes
    drawn = {line.get_label(): np.asarray(line.get_ydata()) for line in upper.lines}
    assert drawn["dissipated in dashpots"][-1] > 0.01 * drawn["work of the drive"][-1]

    residual = np.asarray(lower.lines[0].get_ydata())
    if engine == "ts":
        assert residual.max() < 1e-8
    else:
        assert np.isnan(residual).all()
        assert any("balance" in text.get_text() for text in lower.texts)


def test_bands_of_a_damped_cell_show_its_decay():
    cell = small_case(lattice={"damping": {"loss": {"2": 0.02}}}).lattice.unit_cell()
    *_, decay = runs.bands(cell, 1000.0).axes
    rates, omega = (np.asarray(values) for values in decay.lines[0].get_data())
    _, frequency, speed = max_group_velocity(cell, 2)
    there = np.interp(frequency / 1e3, omega, rates)

    assert there == pytest.approx(0.01 * frequency / speed, rel=1e-2)  # zeta omega / v_g
    assert rates[np.argmin(np.abs(omega - 0.65))] > 20 * there  # in a gap
    assert len(runs.bands(four_band(), 1000.0).axes) == 2


def impacts_of(sites: int, episodes: int, loss: float = 0.0):
    number = np.arange(episodes)
    logged = {"site": number % sites + 1, "side": np.where(number % 2, 1, -1), "onset": (number + 0.5) / episodes}
    logged |= {"approach_velocity": 1.0 + number, "loss": np.full(episodes, loss)}
    data = {f"impacts/{name}": ("episode", values) for name, values in logged.items()}
    data |= {"sites/cell": ("site", 10 * np.arange(1, sites + 1)), "time": [0.0, 1.0]}
    return xr.Dataset(data, attrs={"case": small_case().to_toml()})


@pytest.mark.slow
def test_impacts_that_markers_do_not_tell_apart_are_a_map():
    few = impact_panels.impacts(impacts_of(5, 20, 1e-6), None).axes
    assert len(few[0].collections) == 2
    assert not few[0].images
    assert few[1].get_title() == "(b) Loss, episodes"

    many = impact_panels.impacts(impacts_of(59, 35_400), None).axes
    (image,) = many[0].images
    largest = np.ma.filled(image.get_array(), np.nan)
    assert largest.shape == (59, impact_panels.MAP_COLUMNS)
    assert not many[0].collections

    at = 4000  # of site 48, as is number 3941 in the same column
    assert largest[at % 59, int((at + 0.5) / 35_400 * impact_panels.MAP_COLUMNS)] == 1.0 + at
    assert len(many[0].get_yticks()) <= 13
    assert many[0].get_yticklabels()[1].get_text() == "60"
    assert many[1].get_title() == "(b) Episodes"
    assert {p.get_width() for p in many[1].patches} == {600}

    pooled = impact_panels.impacts(impacts_of(1000, 3000), None).axes[0].images[0]
    assert len(pooled.get_array()) <= impact_panels.MAP_ROWS


def test_contacts_that_touch_from_the_beginning_show_their_indentation():
    """Of three beads: the second goes towards the third by 2e-6 m, the first and the second come apart."""
    cell = {"lattice": {"cells": 3, "ends": "free", "cell": {"masses": [1e-3]}}, "drive": {"frequency": 1e3}}
    contacts = {"sites": [1, 2], "next_cell": True, "side": "minus", "clearance": 0.0, "stiffness": 1e9}
    case = Case.from_table(cell | {"contacts": contacts, "time": {"end": 1.0, "sample_interval": 0.1}})
    u = np.zeros((11, 3, 1))
    u[5, 1] = 2e-6
    data = {**impacts_of(2, 2).drop_vars("time"), "impacts/force": ("episode", [0.0, 3.0])}
    data = xr.Dataset(
        {**data, "time": np.arange(11) / 10, "cell": [1, 2, 3], "displacement": (("time", "cell", "dof"), u)}
    )
    depth = panels.indentations(data, case.model())

    assert depth[1, 5] == 2e-6
    assert np.count_nonzero(depth) == 1

    raster, bars, *_ = impact_panels.impacts(data.assign_attrs(case=case.to_toml()), None).axes
    assert raster.get_title() == "(a) Indentation"
    assert [bar.get_width() for bar in bars.patches] == [0.0, 3.0]
