"""The section [initial]: what it resolves to, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy.linalg import eigvalsh

from tests.conftest import small_case
from vipetsc.case import Case, CaseError, LawCase, Sweep
from vipetsc.case.optimise import OptimiseCase
from vipetsc.io.netcdf import variable, write_netcdf
from vipetsc.io.state import State
from vipetsc.lattice import Chain, Spring, UnitCell, bloch, four_band
from vipetsc.lattice.modes import mode_frequency, mode_shape, number_near
from vipetsc.lattice.packet import gaussian_packet
from vipetsc.studies.linear_run import linear_case

PACKET = {"kind": "packet", "band": 2, "wavenumber": "pi/2", "cell": 12, "width": 2, "energy": 1e-3}
TABLE = {"name": "t", "lattice": {"preset": "four-band", "cells": 24}, "contacts": {"sites": 0}}


@pytest.mark.slow
@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
def test_modes_solve_the_eigenvalue_problem(ends):
    """Counted and found one by one, they are those of dense matrices, copies on a ring too."""
    chain = Chain(four_band(), 50, ends)
    stiffness, masses, numbers = chain.stiffness_matrix(), chain.masses(), range(1, 201)
    every = np.array([mode_frequency(chain, number) for number in numbers])
    squares = eigvalsh(stiffness.toarray(), np.diag(masses))
    assert every**2 == pytest.approx(squares, rel=0, abs=1e-13 * squares[-1])
    shapes = np.array([mode_shape(chain, number).ravel() for number in numbers])
    residual = shapes @ stiffness - every[:, None] ** 2 * masses * shapes
    assert np.abs(residual).max() < 1e-9 * every[-1] ** 2 * masses.max()
    assert np.abs(shapes).max(axis=1) == pytest.approx(1.0)
    # They are different ones: together they span all.
    assert np.linalg.matrix_rank(shapes, tol=1e-6) == 200
    assert (every[0] == 0) == (ends != "fixed")
    for omega in (1.0, 890.0, 1300.0, 2200.0, 9000.0):
        away = np.abs(every - omega)
        assert away[number_near(chain, omega) - 1] == pytest.approx(away.min(), abs=1e-8)


@pytest.mark.parametrize("ends", ["fixed", "free"])
def test_modes_of_a_long_chain_are_known_in_closed_form(ends):
    n, m, k = 20_000, 0.02, 5e4
    chain = Chain(UnitCell((m,), (Spring(0, 0, k, next_cell=True),), 0, 0), n, ends)
    for number in (2, 137, 9_999, 19_999):
        phase, x = (np.pi * number / (n + 1), np.arange(1, n + 1)) if ends == "fixed" else (
            np.pi * (number - 1) / n, np.arange(n) + 0.5)  # fmt: skip
        omega, shape = 2 * np.sqrt(k / m) * np.sin(phase / 2), (np.sin if ends == "fixed" else np.cos)(phase * x)
        assert mode_frequency(chain, number) ** 2 == pytest.approx(omega**2, rel=0, abs=1e-14 * k / m)
        assert number_near(chain, omega * (1 + 1e-7 / number)) == number
        found = mode_shape(chain, number).ravel()
        assert np.abs(found * (shape @ found) / (found @ found) - shape).max() < 1e-6
    table = {"cell": {"masses": [m], "springs": [{"start": 1, "end": 1, "stiffness": k, "next_cell": True}]}}
    initial = {"kind": "mode", "near": 300.0, "amplitude": 1e-3}
    lattice = table | {"cells": n, "ends": ends}
    case = Case.from_table({"name": "t", "lattice": lattice, "contacts": {"sites": 0}, "initial": initial,
                            "time": {"end": 0.01}})  # fmt: skip
    assert case.drive.frequency == pytest.approx(300, abs=0.2)
    assert case.initial.number == number_near(chain, 300.0)


def test_a_packet_is_a_gaussian_of_the_width_and_amplitude_asked():
    packet = gaussian_packet(four_band(), 2, 1.2, 500, 20.0)
    u, v = packet.on(Chain(four_band(), 1000), 0, 1000)
    envelope = np.hypot(u, v / bloch(four_band(), 1.2).frequency[1]).max(axis=1)
    assert envelope.max() == pytest.approx(1.0, rel=0.02)
    x = np.arange(1000) - 500
    assert np.sqrt(np.average(x**2, weights=envelope**2)) == pytest.approx(20 / np.sqrt(2), rel=0.02)
    assert np.average(x, weights=envelope**2) == pytest.approx(0, abs=0.1)
    # Cut in two, and around a ring.
    parts = [packet.on(Chain(four_band(), 1000), a, b)[0] for a, b in ((0, 490), (490, 1000))]
    assert np.array_equal(np.concatenate(parts), u)
    ring = packet.on(Chain(four_band(), 1000, "periodic"), 0, 1000)[0]
    assert np.abs(ring - u).max() < 1e-15


def test_nothing_changes_for_a_lattice_at_rest():
    plain = small_case()
    assert small_case(initial={"kind": "zero"}) == plain
    assert small_case(initial={}).to_toml() == plain.to_toml()


def test_without_a_drive_the_frequency_and_the_cell_are_those_of_the_motion():
    case = Case.from_table(TABLE | {"initial": PACKET})
    assert (case.drive.amplitude, case.drive.cell) == (0.0, 12)
    assert case.drive.frequency == pytest.approx(bloch(four_band("calibrated"), np.pi / 2).frequency[1])
    assert case.initial.energy is None
    model = case.model()
    assert model.scale == case.initial.amplitude
    assert model.drive.duration == 0.0
    assert case.time.end == pytest.approx(24 / model.speed)
    assert case.warnings() == []
    driven = Case.from_table(TABLE | {"initial": PACKET, "drive": {"amplitude": 5.0}})
    assert (driven.drive.amplitude, driven.drive.cell) == (5.0, 1)
    assert driven.model().scale > model.scale
    assert linear_case(case).initial == case.initial
    near = Case.from_table(TABLE | {"initial": {"kind": "mode", "near": 2034.0, "energy": 1e-3}})
    assert near.drive.frequency == pytest.approx(2034.8251, abs=1e-4)
    assert near.initial.number == 48


def test_members_of_a_sweep_begin_in_motion():
    table = TABLE | {"initial": PACKET | {"cell": 5}, "sweep": {"initial": {"energy": [1e-3, 4e-3]}}}
    first, second = (Sweep.from_table(table).case(number) for number in (0, 1))
    assert second.initial.amplitude == pytest.approx(2 * first.initial.amplitude)


@pytest.mark.parametrize(
    ("initial", "key", "remedy"),
    [
        ({"kind": "pocket"}, "initial.kind", "did you mean 'packet'"),
        ({"kind": "mode", "energy": 1e-3}, "initial.number", "one of number and near"),
        ({"kind": "mode", "number": 97, "energy": 1.0}, "initial.number", "has 96 modes"),
        ({"kind": "mode", "number": 3}, "initial.amplitude", "one of amplitude and energy"),
        ({"kind": "mode", "number": 3, "amplitude": 1e-3, "width": 3.0}, "initial.width", "another kind"),
        (PACKET | {"amplitude": 1e-3}, "initial.amplitude", "one of"),
        (PACKET | {"band": 5}, "initial.band", "has 4 bands"),
        (PACKET | {"cell": 25}, "initial.cell", "1 to 24"),
        ({k: v for k, v in PACKET.items() if k != "width"}, "initial.width", "missing"),
        ({"kind": "file"}, "initial.path", "missing"),
        ({"kind": "file", "path": "nowhere.h5"}, "initial.path", "cannot be opened"),
    ],
)
def test_refused(initial, key, remedy):
    with pytest.raises(CaseError) as refused:
        Case.from_table(TABLE | {"initial": initial})
    assert [p.key for p in refused.value.problems] == [key]
    assert remedy in str(refused.value)


def test_refused_beside_other_sections():
    with pytest.raises(CaseError, match="must not be zero"):
        Case.from_table(TABLE | {"drive": {"amplitude": 0.0}})
    with pytest.raises(CaseError, match=r"time\.atol"):
        Case.from_table(TABLE | {"initial": PACKET, "time": {"atol": "paper"}})
    with pytest.raises(CaseError, match="frequency of this mode is 0"):
        lattice = {"preset": "four-band", "cells": 24, "ends": "free"}
        Case.from_table(TABLE | {"lattice": lattice, "initial": {"kind": "mode", "number": 1, "amplitude": 1e-3}})
    with pytest.raises(CaseError, match=r"initial\.kind"):
        LawCase.from_table(TABLE | {"initial": PACKET, "drive": {"amplitude": 1.0}, "law": {}})
    search = {"variables": {"clearance": [1e-4, 1e-2]}}
    with pytest.raises(CaseError, match="lattice at rest"):
        OptimiseCase.from_table(
            TABLE | {"initial": PACKET, "contacts": {"sites": [6], "clearance": 1e-3}, "optimise": search}
        )


def put_branch(path, size=1e-4) -> None:
    """Two orbits of cells 3 and 4, as branches keep them."""
    axes = {"states/orbit": 2, "states/cell": 2, "states/dof": 4}
    data = {name: variable(name, np.arange(1, n + 1), "1", name) for name, n in axes.items()}
    data["states/cell"] = variable("states/cell", [3, 4], "1", "cell")
    u = np.arange(16.0).reshape(2, 2, 4) * size
    for name, values in (("displacement", u), ("velocity", 0 * u)):
        data[f"states/{name}"] = variable(tuple(axes), values, "m", name)
    data["states/period"] = variable("states/orbit", [0.004, 0.005], "s", "period")
    write_netcdf(path, xr.Dataset(data))


def test_orbits_of_a_branch(tmp_path):
    path = tmp_path / "branch-a.h5"
    put_branch(path)
    initial = {"kind": "file", "path": str(path), "orbit": 1}
    case = Case.from_table(TABLE | {"initial": initial})
    assert case.drive.frequency == pytest.approx(2 * np.pi / 0.004)
    assert (case.drive.cell, case.initial.orbit, len(case.initial.sha256)) == (4, 1, 64)
    assert case.initial.amplitude == pytest.approx(7e-4)
    assert Case.from_toml(case.to_toml()) == case
    assert Case.from_table(TABLE | {"initial": {"kind": "file", "path": str(path)}}).initial.orbit == 2
    u, _ = State.read(path, orbit=2).on(2, 4)
    assert u[1, 3] == pytest.approx(15e-4)
    for wrong, text in ((initial | {"orbit": 3}, "from 1 to 2, not 3"), (initial | {"time": 0.1}, "no such thing")):
        with pytest.raises(CaseError, match=text):
            Case.from_table(TABLE | {"initial": wrong})
    put_branch(path, size=0.0)
    with pytest.raises(CaseError, match="is at rest"):
        Case.from_table(TABLE | {"initial": initial})
    put_branch(path)
    with pytest.raises(CaseError, match="cells up to 4"):
        Case.from_table(TABLE | {"initial": initial, "lattice": {"preset": "four-band", "cells": 3}})
