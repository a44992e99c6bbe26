"""The engine's rates, motion of sites and energies against assembled matrices; sums of PETSc's stages."""

from __future__ import annotations

import sys
from types import SimpleNamespace

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
import pytest

from tests.conftest import small_case
from vipetsc.case import CaseError
from vipetsc.dynamics import energies, run
from vipetsc.dynamics.energies import ENERGY_SUMS, LARGEST, SPRING, EnergyMeter, add_one
from vipetsc.dynamics.lattice_record import create_record
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.memory import check_scalars
from vipetsc.dynamics.ts.sums import register_sums
from vipetsc.io.store import RunMemory


def test_a_long_lattice_that_is_nowhere_finite_is_beyond_the_sums():
    """Sums of energies that are cut off at ``LARGEST`` saturate; 2^14 of them would add up to 2^64, 0 in 64 bits."""
    model = small_case(lattice={"cells": 2**14, "damping": {"mass": 1.0}}).model()
    layout = Layout(model, MPI.COMM_SELF)
    sums = EnergyMeter(model, layout, create_record(model, layout)).sums(np.full(layout.size, np.nan))
    kinetic, spring, _, _, damping = sums[:, 0] >= LARGEST
    assert kinetic
    assert spring
    assert damping

    sums[:] = 0
    for _ in range(2**14):
        add_one(sums, SPRING, np.nan, 1.0)
    assert sums[1, 0] >= LARGEST


@pytest.mark.parametrize("size", [1, 77])
@pytest.mark.parametrize("count", [1, 7, 13])
def test_stages_are_added_as_petsc_adds_them(size, count):
    """The compiled sum of stages has the bits of PETSc's VecMAXPY, for any number of stages and any size."""
    rng = np.random.default_rng(size + count)
    by_petsc = PETSc.Vec().createMPI(size, comm=MPI.COMM_SELF)
    registered = by_petsc.duplicate()
    register_sums(registered)
    # TSRK's vectors are duplicates.
    compiled = registered.duplicate()
    stages = [compiled.duplicate() for _ in range(count)]
    for vector in stages:
        vector.array[:] = rng.normal(size=size)
    # Some stages have no weight.
    factors = rng.normal(size=count) * (np.arange(count) % 3 != 1)
    start = rng.normal(size=size)
    by_petsc.array[:] = start
    compiled.array[:] = start

    by_petsc.maxpy(factors, stages)
    compiled.maxpy(factors, stages)

    assert compiled.array.tobytes() == by_petsc.array.tobytes()
    assert compiled.array.tobytes() != start.tobytes()

    # A stage without weight is left out, hence its NaN, too; PETSc's own sum would be NaN.
    stages[0].set(np.nan)
    compiled.maxpy([0.0, 1.0], [stages[0], registered])
    assert np.isfinite(compiled.array).all()
    for vector in (by_petsc, compiled, registered, *stages):
        vector.destroy()


@pytest.mark.parametrize(
    ("ranks", "hook", "expected"), [(1, sys.__excepthook__, 0), (2, sys.__excepthook__, 1), (2, print, 0)]
)
def test_a_simulation_on_several_ranks_lets_a_rank_that_raises_end_all(monkeypatch, ranks, hook, expected):
    """``simulate`` installs the hook at its call, on several ranks, and keeps a hook that is not Python's own."""
    installed = []
    monkeypatch.setattr(run, "install_abort_hook", lambda: installed.append(1))
    monkeypatch.setattr(run, "MPI", SimpleNamespace(COMM_WORLD=SimpleNamespace(size=ranks)))
    monkeypatch.setattr(sys, "excepthook", hook)
    with pytest.raises(ValueError, match="cannot be resumed"):
        run.simulate(small_case(), RunMemory(), resume=True)
    assert len(installed) == expected


def test_remainders_are_carried_so_that_those_of_many_cells_do_not_overflow():
    """The sum of remainders of nearly half a unit stays below a unit: those of 2^12 cells would add up to 2^63."""
    energy = 0.5 - 2.0**-40
    sums = np.zeros((ENERGY_SUMS, 2), np.int64)
    for _ in range(3):
        add_one(sums, SPRING, energy, 1.0)
    whole, fine = sums[1].tolist()
    assert 0 <= fine < 2**52
    assert whole + fine / 2**52 == pytest.approx(3 * energy, rel=1e-15)


@pytest.mark.parametrize("ranks", [3, 2**14])
def test_the_sum_over_ranks_does_not_depend_on_their_order_nor_number(ranks):
    """The largest remainders of 2^14 ranks, whose sum has more than the 53 bits of a float, add up exactly."""
    sums = np.zeros((ranks, ENERGY_SUMS, 2), np.int64)
    rng = np.random.default_rng(2)
    sums[:, :, 0] = rng.integers(0, 2**45, (ranks, ENERGY_SUMS))
    sums[:, :, 1] = 2**52 - 1 - rng.integers(0, 7, (ranks, ENERGY_SUMS))
    expected = [sum((whole << 52) + fine for whole, fine in of_rank) for of_rank in sums.swapaxes(0, 1).tolist()]

    found = []
    for order in (slice(None), slice(None, None, -1)):
        total = np.zeros((4 * ENERGY_SUMS, 1))
        for of_rank in sums[order]:
            total += energies.parts(of_rank[None])
        found.append(energies.joined(total)[:, 0])
    # All of them on one rank, which carries whole units out of the remainders as it adds.
    alone = np.array([[divmod(number, 2**52) for number in expected]], np.int64)
    found.append(energies.joined(energies.parts(alone))[:, 0])

    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])
    np.testing.assert_allclose(found[0], [number / 2**52 for number in expected], rtol=3e-16)


@pytest.mark.parametrize("scalar", [np.complex128, np.float32])
def test_a_petsc_of_other_numbers_is_refused_before_it_runs(scalar):
    """Compiled code reads the states of PETSc as real doubles."""
    with pytest.raises(CaseError, match="double precision"):
        check_scalars(scalar)
