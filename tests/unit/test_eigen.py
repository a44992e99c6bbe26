"""Guards of the search for modes near a frequency: the direct solver, SLEPc, copies of modes, rigid motions."""

from __future__ import annotations

import sys
from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest

from vipetsc.case import CaseError
from vipetsc.dynamics import eigen
from vipetsc.dynamics.eigen import load_slepc, modes_near
from vipetsc.dynamics.matrices import LatticeMatrices
from vipetsc.lattice import Chain, Spring, UnitCell
from vipetsc.studies.linear_modes import first_largest

pytestmark = pytest.mark.parallel(1)

# Two masses a cell whose matrices are whole numbers: sums and products of them have no rounding.
WHOLE = UnitCell((1.0, 1.0), (Spring(0, 0, 1.0, offset=1), Spring(0, 1, 1.0)), host=0, resonator=1)


class RecordingTransformation:
    """A spectral transformation that records its type and the solver that is set for it."""

    def __init__(self, ranks: int) -> None:
        self.comm = SimpleNamespace(size=ranks)
        self.type = ""
        self.solver = ""

    def setType(self, name: str) -> None:
        self.type = name

    def getKSP(self) -> RecordingTransformation:
        return self

    def getPC(self) -> RecordingTransformation:
        return self

    def setFactorSolverType(self, name: str) -> None:
        self.solver = name


def pretend_packages(monkeypatch, packages: set[str]) -> None:
    """Make the search see a PETSc with these external packages."""
    system = SimpleNamespace(hasExternalPackage=lambda name: name in packages)
    monkeypatch.setattr(eigen, "PETSc", SimpleNamespace(Sys=system))


@pytest.mark.parametrize(
    ("ranks", "packages", "solver"),
    [
        # PETSc's own solver is always there, for one rank.
        (1, set(), "petsc"),
        (1, {"superlu", "mumps"}, "superlu"),
        (1, {"superlu_dist", "mumps"}, "petsc"),
        (2, {"superlu", "superlu_dist", "mumps"}, "superlu_dist"),
        (2, {"superlu", "mumps"}, "mumps"),
    ],
)
def test_the_first_direct_solver_that_petsc_has_is_taken(monkeypatch, ranks, packages, solver):
    """The direct solver is the first of a list, for one rank or several, that PETSc was built with."""
    pretend_packages(monkeypatch, packages)
    transformation = RecordingTransformation(ranks)
    eigen._solve_directly(transformation)
    assert transformation.solver == solver


@pytest.mark.parametrize("built_for_another_numpy", [False, True])
def test_a_machine_without_slepc_is_refused_with_what_to_install(monkeypatch, tmp_path, built_for_another_numpy):
    if built_for_another_numpy:
        (tmp_path / "slepc4py.py").write_text('raise ValueError("numpy.dtype size changed")')
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.delitem(sys.modules, "slepc4py", raising=False)
    else:
        # An entry None in sys.modules makes the import fail.
        monkeypatch.setitem(sys.modules, "slepc4py", None)
    with pytest.raises(CaseError, match=r"slepc4py: is needed only for modes of long lattices .*apt install slepc-dev"):
        load_slepc()


def matrices_of(ends: str, cells: int = 12) -> LatticeMatrices:
    return LatticeMatrices(Chain(WHOLE, cells, ends), MPI.COMM_SELF)


@pytest.mark.parametrize("ends", ["free", "periodic"])
def test_a_frequency_asked_for_may_be_exactly_that_of_a_mode(ends):
    """The rigid motion is found at its frequency 0, where the matrix of whole numbers is exactly singular."""
    matrices = matrices_of(ends)
    modes = modes_near(matrices, 1, 0.0)
    assert modes.frequency.tolist() == [0.0]
    assert np.ptp(modes.shapes) < 1e-9 * np.abs(modes.shapes).max()
    matrices.destroy()


def test_the_lowest_frequency_of_a_fixed_lattice_is_not_taken_for_zero():
    """The lowest mode of a fixed lattice of n cells has omega = pi/(n + 1) (k/m)^(1/2), with the mass m of a cell."""
    # A cell has the mass 2 and the spring 1: omega^2 = (pi/401)^2/2 is 6e-6 of the largest omega^2, far above rounding.
    matrices = matrices_of("fixed", 400)
    (frequency,) = modes_near(matrices, 1, 0.0).frequency
    assert frequency == pytest.approx(np.pi / 401 / np.sqrt(2), rel=1e-4)
    matrices.destroy()


def test_both_copies_of_a_mode_of_a_ring_are_found():
    """Waves to the left and to the right have one frequency; a Krylov space may miss one of these two modes."""
    matrices = matrices_of("periodic")
    modes = modes_near(matrices, 3, 0.0)
    assert modes.frequency[0] == 0.0
    assert modes.frequency[1] == pytest.approx(modes.frequency[2], rel=1e-9)
    # The two modes are different motions.
    overlap = np.sum(modes.shapes[1] * modes.shapes[2])
    assert abs(overlap) < 1e-8
    matrices.destroy()


def test_all_modes_but_one_may_be_asked_for():
    """All modes but one are found, though the search for further copies has one dimension left."""
    matrices = matrices_of("fixed", 4)
    count = matrices.mass.getSize()[0] - 1
    modes = modes_near(matrices, count, 0.5)
    assert len(modes.frequency) == count
    assert modes.residual.max() < 1e-9
    matrices.destroy()


def test_of_two_places_that_are_equal_but_for_rounding_the_first_one_counts():
    """The first of two places that are equal but for rounding counts, so that rounding decides no place or sign."""
    values = np.array([[0.2, 1.0, 0.5, 1.0 + 1e-14], [1.0 + 1e-14, 0.1, 1.0, 0.0], [0.0, 0.1, 0.9, 1.0]])
    assert first_largest(values).tolist() == [1, 0, 3]
