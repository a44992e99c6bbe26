"""Distributed matrices of stiffness and mass, and linear modes near a frequency, on any number of ranks."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
import xarray as xr
from scipy.linalg import eigvalsh

from tests.conftest import small_case
from vipetsc.case import CaseError
from vipetsc.dynamics import eigen
from vipetsc.dynamics.eigen import modes_near
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.matrices import LatticeMatrices
from vipetsc.dynamics.ts.integrator import Integrator
from vipetsc.lattice import Chain, Spring, UnitCell, four_band
from vipetsc.lattice.modes import mode_frequency, mode_shape
from vipetsc.studies.linear_modes import find_modes

COMM = MPI.COMM_WORLD
# Masses and stiffnesses are whole numbers, whose sums are exact in any order.
WHOLE = UnitCell((1.0, 2.0, 4.0), (Spring(0, 0, 3.0, True), Spring(0, 1, 5.0), Spring(2, 1, 7.0, True)), 0, 1)


def stencil(chain: Chain, u: np.ndarray) -> np.ndarray:
    """-M u'' (cell, dof) of this rank's cells, from the right-hand side that PETSc calls."""
    model = small_case(drive={"amplitude": 1e-3}).model()
    model = replace(model, chain=chain, drives=(replace(model.drives[0], mass=0),))
    layout = Layout(model, COMM)
    engine = Integrator(model, layout)
    layout.place(np.hstack([u, 0 * u])[layout.start : layout.stop], 0.0, engine.state.array)
    rate = engine.state.duplicate()
    engine.ts.computeRHSFunction(0.0, engine.state, rate)
    engine.destroy()

    # Rates of displacements come first, then those of velocities; each part is ordered mass by mass.
    d = layout.dofs
    n = layout.owned
    acceleration = rate.array[d * n : 2 * d * n].reshape(d, n).T
    return -acceleration * np.asarray(chain.cell.masses)


@pytest.mark.parallel([1, 2, 3])
@pytest.mark.parametrize(("ends", "cells"), [("fixed", 25), ("free", 3), ("periodic", 2), ("periodic", 25)])
@pytest.mark.parametrize(("cell", "rounding"), [(WHOLE, 0), (four_band(), 1e-10)], ids=["whole", "four-band"])
def test_the_matrix_and_the_stencil_are_one_stiffness(ends, cells, cell, rounding):
    """K u by the matrix is -M u'' by the right-hand side: exactly in whole numbers, otherwise to rounding errors."""
    rng = np.random.default_rng(3)
    u = rng.standard_normal((cells, cell.dofs))
    if cell is WHOLE:
        u = np.round(99 * u)
    chain = Chain(cell, cells, ends)
    matrices = LatticeMatrices(chain, COMM)
    own = u[matrices.start : matrices.stop]

    force = (matrices.stiffness * matrices.vector(own)).array_r.reshape(own.shape)
    assert np.abs(force - stencil(chain, u)).max(initial=0) <= rounding

    momentum = (matrices.mass * matrices.vector(own)).array_r.reshape(own.shape)
    assert np.array_equal(momentum, own * np.asarray(cell.masses))

    # The matrix was allocated with exactly the entries that it needs.
    assert matrices.stiffness.getInfo()["nz_unneeded"] == 0
    matrices.destroy()


@pytest.mark.parallel([1, 2])
@pytest.mark.parametrize(
    ("ends", "cells", "near", "count"),
    [
        ("free", 40, 0.0, 3),
        ("periodic", 60, 1000.0, 7),
        ("fixed", 3, 900.0, 12),
        # The mode at 445 rad/s is nearer in the squared frequency, and another one in the frequency.
        ("fixed", 1, 668.0, 1),
        # Modes of a ring come in pairs of one frequency; at the edge of a band the solver needs many restarts for them.
        ("periodic", 60, 1850.0, 3),
    ],
)
def test_modes_near_a_frequency_are_those_of_the_lattice_with_all_their_copies(ends, cells, near, count):
    """Frequencies are those of the closed form, with their multiplicity, and shapes are mass-orthonormal."""
    chain = Chain(four_band("calibrated"), cells, ends)
    matrices = LatticeMatrices(chain, COMM)
    starts = []
    vector = matrices.vector

    def counted(*cells):
        starts.append(cells)
        return vector(*cells)

    matrices.vector = counted
    modes = modes_near(matrices, count, near)

    # After ``count`` modes the search looks for missed ones, and ends with the first mode that is not nearer.
    assert len(starts) <= count + 3
    every = np.array([mode_frequency(chain, number) for number in range(1, matrices.size + 1)])
    nearest = np.sort(every[np.argsort(np.abs(every - near), kind="stable")[:count]])
    assert modes.frequency == pytest.approx(nearest, rel=1e-9, abs=1e-3)
    assert modes.residual.max() < 1e-9

    flat = modes.shapes.reshape(count, -1)
    masses = np.tile(chain.cell.masses, matrices.stop - matrices.start)
    gram = COMM.allreduce((flat * masses) @ flat.T)
    assert gram == pytest.approx(np.eye(count), abs=1e-8)
    matrices.destroy()


@pytest.mark.parallel([3])
def test_modes_of_one_frequency_span_the_same_motions_on_any_number_of_ranks():
    """On a ring, waves in both directions have one frequency: their modes span the motions that those of one rank do.

    The modes themselves are any two such motions, and may differ.
    """
    chain = Chain(four_band("calibrated"), 12, "periodic")
    found = []
    for comm in (COMM, MPI.COMM_SELF):
        matrices = LatticeMatrices(chain, comm)
        # The motion of the ring as a whole, and two pairs of waves.
        modes = modes_near(matrices, 5, 0.0)
        found.append((modes.frequency, np.concatenate(comm.allgather(modes.shapes), axis=1).reshape(5, -1)))
        matrices.destroy()

    (frequency, shapes), (frequency_alone, shapes_alone) = found
    assert frequency == pytest.approx(frequency_alone, rel=1e-9, abs=1e-3)
    for first in (1, 3):
        pair = slice(first, first + 2)
        assert np.ptp(frequency[pair]) < 1e-6 * frequency[first]
        projector = shapes[pair].T @ shapes[pair]
        projector_alone = shapes_alone[pair].T @ shapes_alone[pair]
        assert projector == pytest.approx(projector_alone, abs=1e-6 * np.abs(projector_alone).max())


@pytest.mark.parallel([1, 2])
def test_the_edge_modes_of_the_lattice_and_their_file(folder):
    """The file of modes tells two edge modes of one frequency, in a gap, from a bulk mode of the closed form."""
    case = small_case(lattice={"cells": 100}, contacts={"sites": [30]})
    found = find_modes(case, 3, 2034.0, folder, COMM)
    assert (found is None) == (COMM.rank > 0)
    COMM.Barrier()

    with xr.open_dataset(folder / "modes.h5", engine="h5netcdf") as data:
        assert data["frequency"].values[:2] == pytest.approx(2034.8251, abs=1e-4)
        assert data["kind"].values.tolist() == ["edge", "edge", "bulk"]
        assert data["band"].values.tolist() == [0, 0, 3]
        # Deep in the gap an edge mode occupies a cell or two at one end, or at both ends: as the frequencies are equal,
        # any combination is a mode.
        assert data["participation"].values[:2].max() < 4 < 50 < data["participation"].values[2]
        assert (data["left"] + data["right"]).values[:2] == pytest.approx(1.0, abs=1e-6)

        # The third mode is one of the closed form.
        bulk = mode_shape(Chain(four_band("calibrated"), 100), 202)
        shape = data["shape"].values[2]
        assert np.abs(shape / np.abs(shape).max()) == pytest.approx(np.abs(bulk), abs=1e-6)


@pytest.mark.parallel([1])
def test_where_energy_is_counts_with_the_masses_of_each_cell(folder):
    """With cells that differ, modes are those of the dense matrices, and fractions of energy use each cell's masses."""
    profiles = {"masses[1]": [0.005, 0.02], "springs[2].stiffness": [1e4, 3e4]}
    case = small_case(lattice={"cells": 2, "profiles": profiles}, contacts={"sites": [1]})
    data = find_modes(case, 8, 900.0, folder, COMM)

    chain = case.model().chain
    stiffness = chain.stiffness_matrix().toarray()
    masses = chain.masses()
    assert data["frequency"].values ** 2 == pytest.approx(eigvalsh(stiffness, np.diag(masses)), rel=1e-9)
    # The outer tenth of two cells at either end is one cell: together they hold the whole energy.
    assert (data["left"] + data["right"]).values == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parallel([1])
def test_contacts_that_are_pressed_at_rest_are_springs_of_small_motions(folder):
    """A pressed Hertzian contact is a spring of the slope 3/2 k d^(1/2) at the indentation d; an open one is none."""
    pressed = 1e-4
    contacts = {
        "sites": [3, 7, 12, 9],
        "clearance": [2e-4, 2e-4, 2e-4, 5e-4],
        "precompression": 3e-4,
        "side": "plus",
        "restitution": 1.0,
        "each": {"pair": [[1, 2], [0, 3], [1, 1], [1, 2]], "next_cell": [False, False, True, False]},
    }
    case = small_case(lattice={"cells": 12, "ends": "periodic"}, contacts=contacts)
    data = find_modes(case, 48, 900.0, folder, COMM)

    stiffness = case.model().chain.stiffness_matrix().toarray()
    spring = 1.5 * case.contacts.stiffness * np.sqrt(pressed)
    # Hosts and resonators by the number of their mass, four to a cell; None is the ground.
    for host, resonator in ((8, 9), (None, 26), (44, 0)):
        ends = np.zeros(48)
        ends[resonator] = 1.0
        if host is not None:
            ends[host] = -1.0
        stiffness += spring * np.outer(ends, ends)
    squares = eigvalsh(stiffness, np.diag(case.model().chain.masses()))
    assert data["frequency"].values ** 2 == pytest.approx(squares, rel=1e-8, abs=1e-8 * squares.max())
    assert squares.max() > 1.1 * mode_frequency(Chain(four_band("calibrated"), 12, "periodic"), 48) ** 2


@pytest.mark.parallel([1])
def test_modes_that_cannot_be_found_are_refused(monkeypatch, folder):
    """Impossible requests, a contact that just touches, and a search without convergence are refused."""
    case = small_case()
    # 24 cells have 96 modes.
    for count, near, key in ((0, 1.0, "--modes"), (97, 1.0, "--modes"), (2, -1.0, "--near")):
        with pytest.raises(CaseError, match=key):
            find_modes(case, count, near, folder, COMM)

    # The first site has a clearance, the second one none.
    contacts = {"sites": [5, 9], "side": "plus", "clearance": [1e-4, 0.0], "restitution": 1.0}
    with pytest.raises(CaseError, match=r"clearance = \[0.0001, 0.0\]: site 2 touches .* no motion about it is linear"):
        find_modes(small_case(contacts=contacts), 2, 1.0, folder, COMM)

    monkeypatch.setattr(eigen, "RESTARTS", 1)
    long = LatticeMatrices(Chain(four_band("calibrated"), 2000), COMM)
    with pytest.raises(CaseError, match="of 6 modes are found"):
        modes_near(long, 6, 2034.0)
    assert not (folder / "modes.h5").exists()
