"""Linear modes of a lattice near a frequency, by SLEPc where there is one: everything else runs without it.

K x = Om^2 M x by Krylov-Schur iteration on (K - s M)^-1 M (Stewart 2001), s the square of the frequency asked. The
factors are those of a direct solver, whose cost grows as the cells: the matrix is a band.
"""

from typing import Any, NamedTuple

from petsc4py import PETSc

import numpy as np

from vipetsc.case import CaseError
from vipetsc.case.section import Problem
from vipetsc.dynamics.matrices import LatticeMatrices

# Direct solvers, of which the first that PETSc has is taken. MUMPS takes ten times as long for a band.
ON_ONE_RANK = ("superlu", "petsc")
ON_SEVERAL = ("superlu_dist", "mumps")
# Relative error of an eigenvalue 1/(Om^2 - s). With 1e-7 residuals of twelve modes of 300 and 3000 cells are 1e-11 in
# place of 6e-15 at most, with 1e-13 they are as small; neither changes a frequency by more than rounding, or the time.
TOLERANCE = 1e-11
# Most restarts of a search. A search for further copies of a mode may take as many; it ends as soon as one mode has
# converged, mostly one farther away. With 4 restarts it gave up near the edge of a band, where modes crowd, and copies
# of ring modes were missing.
RESTARTS = 60
# The number s is less than the square of the frequency asked by this fraction of the largest Om^2 at most; in a long
# lattice by the second fraction of the mean distance of its modes, so that those nearest to s are those nearest to the
# frequency.
LARGEST_SHIFT = 1e-6
SHIFT_OF_SPACING = 1e-2


class NearModes(NamedTuple):
    """Modes by their ``frequency`` (mode) in rad/s; ``shapes`` (mode, cell, dof) in 1/sqrt(kg) of the rank's cells.

    ``residual`` (mode) is the norm of K x - Om^2 M x over the largest Om^2 and that of M x.
    """

    frequency: np.ndarray
    shapes: np.ndarray
    residual: np.ndarray


def load_slepc() -> Any:
    """Return the module ``slepc4py.SLEPc``, which begins with PETSc's options; raises CaseError where it is missing."""
    try:
        from slepc4py import SLEPc
    # ValueError: it was built for another version of numpy.
    except (ImportError, ValueError) as error:
        remedy = "is needed only for modes of long lattices and multipliers of whole lattices"
        how = "apt install slepc-dev python3-slepc4py; conda-forge: slepc4py; it must belong to the PETSc of petsc4py"
        raise CaseError([Problem("slepc4py", None, f"{remedy} ({error}); Debian: {how}")], "this machine") from None
    return SLEPc


def modes_near(matrices: LatticeMatrices, count: int, near: float) -> NearModes:
    """Return the ``count`` modes nearest to ``near`` in rad/s, lowest first; all ranks must call it.

    After them further ones are sought, until none is nearer: a Krylov space may miss copies of a mode. Raises CaseError
    where modes lie so close, as at the edge of a band, that not all can be separated.
    """

    def distance(value: complex) -> float:
        return float(abs(np.sqrt(max(value.real, 0.0)) - near))

    # A generalised Hermitian problem, K and M being symmetric and M positive definite.
    eps = load_slepc().EPS().create(matrices.comm)
    eps.setOperators(matrices.stiffness, matrices.mass)
    eps.setProblemType(eps.ProblemType.GHEP)
    # The modes nearest in Om are not those nearest in Om^2, which are lower ones.
    eps.setWhichEigenpairs(eps.Which.USER)
    eps.setEigenvalueComparison(lambda one, other, *_: int(np.sign(distance(one) - distance(other))))
    # Without a shift K - s M would be singular where the frequency is exactly that of a mode. The shift must not be too
    # small either: the iterated matrix has the eigenvalues 1/(Om^2 - s), in units of 1 / largest Om^2 up to 1 / shift
    # of a mode at the frequency and about 1 of those far from it, whose relative errors by rounding grow by as much.
    shift = min(LARGEST_SHIFT, SHIFT_OF_SPACING / matrices.size)
    eps.setTarget(near**2 - shift * matrices.largest)
    _solve_directly(eps.getST())

    pairs: list[tuple[float, PETSc.Vec]] = []
    wanted = count
    while wanted:
        # SLEPc wants one vector more than modes, if there is one, also where the last mode alone is left.
        left = max(matrices.size - len(pairs), min(wanted + 1, matrices.size))
        eps.setDimensions(wanted, min(max(3 * wanted, 20), left))
        eps.setTolerances(TOLERANCE, RESTARTS)
        eps.setDeflationSpace([vector for _, vector in pairs])
        eps.solve()

        before = len(pairs)
        farthest = max((distance(value) for value, _ in pairs), default=np.inf)
        for i in range(min(eps.getConverged(), wanted)):
            vector = matrices.vector()
            value = eps.getEigenpair(i, vector).real
            # In a later search only a mode that is nearer than the farthest one so far can be one that was missed.
            if distance(value) < farthest:
                pairs.append((value, vector))
        if not before and len(pairs) < count:
            remedy = f"only {len(pairs)} of {count} modes are found, the others lie too close; change --modes or --near"
            raise CaseError([Problem("--near", near, remedy)])
        # From then on one at a time, until none is nearer than those that there are.
        found_more = len(pairs) > before
        wanted = int(found_more and len(pairs) < matrices.size)
    eps.destroy()

    nearest = sorted(pairs, key=lambda pair: distance(pair[0]))[:count]
    modes = [_mode(matrices, value, vector) for value, vector in sorted(nearest, key=lambda pair: pair[0])]
    frequency, shapes, residual = zip(*modes, strict=True)
    return NearModes(np.array(frequency), np.array(shapes), np.array(residual))


def _solve_directly(st: Any) -> None:
    """Let the spectral transformation ``st`` invert with a direct solver."""
    st.setType("sinvert")
    solvers = ON_ONE_RANK
    if st.comm.size > 1:
        solvers = ON_SEVERAL
    solver = next((name for name in solvers if name == "petsc" or PETSc.Sys.hasExternalPackage(name)), None)
    ksp = st.getKSP()
    ksp.setType("preonly")
    preconditioner = ksp.getPC()
    if solver is None:
        # Each rank factors the whole matrix by PETSc's own solver, which is for one: slower, but always there.
        preconditioner.setType("redundant")
        return
    preconditioner.setType("lu")
    preconditioner.setFactorSolverType(solver)


def _mode(matrices: LatticeMatrices, value: float, vector: PETSc.Vec) -> tuple[float, np.ndarray, float]:
    """Return frequency, shape and residual of a mode."""
    residual = matrices.stiffness * vector
    momentum = matrices.mass * vector
    shape = vector.array_r.reshape(-1, matrices.chain.cell.dofs) / np.sqrt(vector.dot(momentum))
    residual.axpy(-value, momentum)
    # A lattice with free ends moves as a whole: its square frequency is zero up to rounding, of either sign.
    frequency = 0.0
    if value >= 1e-12 * matrices.largest:
        frequency = float(np.sqrt(value))
    return frequency, shape, residual.norm() / (matrices.largest * momentum.norm())
