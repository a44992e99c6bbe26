"""The section [initial]: modes, packets and states of files to which it resolves, and values that are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from scipy.linalg import eigvalsh

from vipetsc.case import Case, CaseError, Sweep
from vipetsc.io.netcdf import variable, write_netcdf
from vipetsc.io.state import State
from vipetsc.lattice import Chain, Spring, UnitCell, bloch, four_band
from vipetsc.lattice.modes import mode_frequency, mode_shape, number_near
from vipetsc.lattice.packet import gaussian_packet
from vipetsc.studies.linear_run import linear_case

PACKET = {"kind": "packet", "band": 2, "wavenumber": "pi/2", "cell": 12, "width": 2, "energy": 1e-3}
FOUR_BAND = {"preset": "four-band", "cells": 24}
TABLE = {"name": "t", "lattice": FOUR_BAND, "contacts": {"sites": 0}}


def case_with(**sections: dict[str, Any]) -> Case:
    """Return the case of a lattice of 24 cells without contacts, with these sections."""
    return Case.from_table(TABLE | sections)


@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
def test_modes_solve_the_eigenvalue_problem(ends):
    """Modes, found one by one by their numbers, are those of dense matrices, also pairs of one frequency on a ring."""
    chain = Chain(four_band(), 50, ends)
    numbers = range(1, 201)
    frequencies = np.array([mode_frequency(chain, number) for number in numbers])
    shapes = np.array([mode_shape(chain, number).ravel() for number in numbers])

    stiffness = chain.stiffness_matrix()
    masses = chain.masses()
    squares = eigvalsh(stiffness.toarray(), np.diag(masses))
    assert frequencies**2 == pytest.approx(squares, rel=0, abs=1e-13 * squares[-1])
    residual = shapes @ stiffness - frequencies[:, None] ** 2 * masses * shapes
    assert np.abs(residual).max() < 1e-9 * frequencies[-1] ** 2 * masses.max()
    assert np.abs(shapes).max(axis=1) == pytest.approx(1.0)
    # Shapes are independent: together they span all motions.
    assert np.linalg.matrix_rank(shapes, tol=1e-6) == 200
    # A lattice that is not fixed moves as a whole.
    assert (frequencies[0] == 0) == (ends != "fixed")

    for omega in (1.0, 890.0, 1300.0, 2200.0, 9000.0):
        distance = np.abs(frequencies - omega)
        assert distance[number_near(chain, omega) - 1] == pytest.approx(distance.min(), abs=1e-8)


LONG = 20_000
MASS = 0.02
STIFFNESS = 5e4


@pytest.mark.parametrize("number", [2, 9_999, 19_999])
@pytest.mark.parametrize("ends", ["fixed", "free"])
def test_modes_of_a_long_chain_are_those_in_closed_form(ends, number):
    """A chain of equal masses has omega = 2 sqrt(k/m) sin(phase/2), with nodes at walls and antinodes at free ends."""
    chain = Chain(UnitCell((MASS,), (Spring(0, 0, STIFFNESS, offset=1),), 0, 0), LONG, ends)
    if ends == "fixed":
        phase = np.pi * number / (LONG + 1)
        shape = np.sin(phase * np.arange(1, LONG + 1))
    else:
        phase = np.pi * (number - 1) / LONG
        shape = np.cos(phase * (np.arange(LONG) + 0.5))
    omega = 2 * np.sqrt(STIFFNESS / MASS) * np.sin(phase / 2)

    # The error of omega^2 is the rounding of the largest one, 4 k/m.
    assert mode_frequency(chain, number) ** 2 == pytest.approx(omega**2, rel=0, abs=1e-14 * STIFFNESS / MASS)
    assert number_near(chain, omega * (1 + 1e-7 / number)) == number
    found = mode_shape(chain, number).ravel()
    scaled = found * (shape @ found) / (found @ found)
    assert np.abs(scaled - shape).max() < 1e-6


@pytest.mark.parametrize("ends", ["fixed", "free"])
def test_a_case_may_name_the_mode_near_a_frequency(ends):
    """``near`` selects the mode whose frequency is nearest, also among 20,000."""
    spring = {"start": 1, "end": 1, "stiffness": STIFFNESS, "next_cell": True}
    case = case_with(
        lattice={"cell": {"masses": [MASS], "springs": [spring]}, "cells": LONG, "ends": ends},
        initial={"kind": "mode", "near": 300.0, "amplitude": 1e-3},
        time={"end": 0.01},
    )
    # The spacing of the modes is largest at low frequencies; half of it is pi/40,000 sqrt(k/m) = 0.12 rad/s.
    assert case.initial.frequency == pytest.approx(300, abs=0.2)
    assert case.initial.number == number_near(case.model().chain, 300.0)


def test_a_packet_is_a_gaussian_of_the_width_and_amplitude_asked():
    """A packet with the width s has the envelope exp(-x^2/(2 s^2)): its square has the deviation s/sqrt(2)."""
    packet = gaussian_packet(four_band(), band=2, kappa=1.2, centre=500, width=20.0)
    u, v = packet.on(Chain(four_band(), 1000), 0, 1000)
    envelope = np.hypot(u, v / bloch(four_band(), 1.2).frequency[1]).max(axis=1)
    x = np.arange(1000) - 500
    # The waves of the packet differ somewhat in frequency and shape.
    assert envelope.max() == pytest.approx(1.0, rel=0.02)
    assert np.sqrt(np.average(x**2, weights=envelope**2)) == pytest.approx(20 / np.sqrt(2), rel=0.02)
    assert np.average(x, weights=envelope**2) == pytest.approx(0, abs=0.1)


def test_without_a_drive_the_frequency_and_the_cell_are_those_of_the_motion():
    """A case with a packet and no drive has its frequency, cell and scale, and ends after a traverse of the lattice."""
    case = case_with(initial=PACKET)
    assert (case.drive.amplitude, case.drive.cell) == (0.0, 12)
    assert case.drive.frequency is None
    assert case.initial.frequency == pytest.approx(bloch(four_band("calibrated"), np.pi / 2).frequency[1])
    assert case.model().drive.frequency == case.wave_frequency == case.initial.frequency
    assert case.initial.energy is None
    assert case.warnings() == []

    model = case.model()
    assert model.scale == case.initial.amplitude
    assert model.drive.duration == 0.0
    # A default end is the last whole number of sample intervals before the traverse.
    interval = case.time.sample_interval
    assert case.time.end == pytest.approx(int(24 / model.speed / interval) * interval, rel=1e-12)
    assert linear_case(case).initial == case.initial


def test_members_of_a_sweep_begin_in_motion():
    """Four times the energy of a packet is twice its amplitude."""
    table = TABLE | {"initial": PACKET | {"cell": 5}, "sweep": {"initial": {"energy": [1e-3, 4e-3]}}}
    plan = Sweep.from_table(table)
    assert plan.case(1).initial.amplitude == pytest.approx(2 * plan.case(0).initial.amplitude)


def put_branch(path: Path, size: float = 1e-4) -> None:
    """Write two orbits of the cells 3 and 4 as branches keep them; displacements are 0 to 15 times ``size`` in m."""
    dims = ("states/orbit", "states/cell", "states/dof")
    u = np.arange(16.0).reshape(2, 2, 4) * size
    data = {
        "states/orbit": variable("states/orbit", [1, 2], "1", "orbit"),
        "states/cell": variable("states/cell", [3, 4], "1", "cell"),
        "states/dof": variable("states/dof", [1, 2, 3, 4], "1", "dof"),
        "states/displacement": variable(dims, u, "m", "displacement"),
        "states/velocity": variable(dims, 0 * u, "m", "velocity"),
        "states/period": variable("states/orbit", [0.004, 0.005], "s", "period"),
    }
    write_netcdf(path, xr.Dataset(data))


@pytest.fixture
def branch(tmp_path):
    """Return the file of a branch with two orbits."""
    path = tmp_path / "branch-a.h5"
    put_branch(path)
    return path


def test_a_run_may_begin_with_an_orbit_of_a_branch(branch):
    """A case that begins with an orbit has its frequency, its amplitude and the cell that moves most."""
    case = case_with(initial={"kind": "file", "path": str(branch), "orbit": 1})
    assert case.initial.frequency == pytest.approx(2 * np.pi / 0.004)
    # The cell that moves most is the fourth, by 7 times the size.
    assert case.drive.cell == 4
    assert case.initial.amplitude == pytest.approx(7e-4)
    assert case.initial.orbit == 1
    assert len(case.initial.sha256) == 64
    assert Case.from_toml(case.to_toml()) == case

    # The last orbit is the default.
    assert case_with(initial={"kind": "file", "path": str(branch)}).initial.orbit == 2
    u, _ = State.read(branch, orbit=2).on(2, 4)
    assert u[1, 3] == pytest.approx(15e-4)


@pytest.mark.parametrize(
    ("displacement", "velocity"),
    [("cell", "cell"), ("cell dof", "cell"), ("cell dof", "cell row"), ("row dof", "row dof")],
)
def test_a_state_of_other_dimensions_is_refused(tmp_path, displacement, velocity):
    """Displacement and velocity are over cells and masses, also where each cell has one mass; else it is no state."""
    path = tmp_path / "state.h5"
    sizes = {"cell": 3, "dof": 4, "row": 2}
    data = {dim: variable(dim, np.arange(1, size + 1), "1", dim) for dim, size in sizes.items()}
    for name, dims in (("displacement", displacement.split()), ("velocity", velocity.split())):
        data[name] = variable(dims, np.ones([sizes[dim] for dim in dims]), "m", name)
    write_netcdf(path, xr.Dataset(data))
    with pytest.raises(CaseError, match=r"state\.h5 contains no state: its displacement .* not over \(cell, dof\)"):
        case_with(initial={"kind": "file", "path": str(path), "frequency": 100.0})


@pytest.mark.parametrize(
    ("sites", "join", "is_at_rest"),
    [
        ([3], {}, False),
        ([5], {}, True),
        # The resonator of a contact with the next cell moves where the host is at rest.
        ([2], {"pair": [2, 1], "next_cell": True}, False),
        ([1], {"pair": [2, 1], "next_cell": True}, True),
    ],
)
def test_a_lossy_stop_without_clearance_is_refused_where_the_state_is_at_rest(branch, sites, join, is_at_rest):
    """A stop with losses and no clearance is refused at rest: its force divides by the approach velocity, then zero."""
    contacts = {"sites": sites, "clearance": 0.0, "side": "plus", "restitution": 0.7, "stiffness": 1e6} | join
    changes = {"contacts": contacts, "initial": {"kind": "file", "path": str(branch)}}
    if is_at_rest:
        with pytest.raises(CaseError, match="touches its stop at rest"):
            case_with(**changes)
    else:
        assert Case.from_toml(case_with(**changes).to_toml())
