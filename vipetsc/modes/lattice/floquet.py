"""Floquet multipliers of a lattice's periodic motion from the action of its monodromy matrix, without that matrix.

The multipliers mu of a conservative motion come in pairs mu, 1/mu. Nearly all of them belong to waves of the lattice
far from the sites and lie on the unit circle. An unstable motion has a few outside, often so near to the circle that
Arnoldi's method converges slowly. SLEPc's Krylov-Schur method (Stewart 2001) is therefore given the power ``POWER`` of
the map, which turns |mu| into |mu|^POWER at no cost in orthogonalisation; the power is odd, so that mu and -mu stay
apart. An odd orbit, u(t + T/2) = -u(t), needs half a period: with the sign reversed that map has the multipliers nu,
and mu = nu^2. The direction of the motion itself, which belongs to a defective multiplier 1, is deflated: the map acts
orthogonally to it.

The space of the vectors that converge is then projected on the map itself (Rayleigh and Ritz), so that each multiplier
has a residual of its own, |M x - nu x| / |x|. Multipliers so near to the circle that they do not converge are left out:
such an instability would not show in a run of a hundred periods. In the norm |x| displacements are multiplied by the
frequency, and displacements and velocities by the root of the mass: its square is twice the energy of a motion of that
frequency without contact.

References
----------
G. W. Stewart, A Krylov-Schur algorithm for large eigenproblems, SIAM J. Matrix Anal. Appl. 23 (2001) 601-614.
"""

import logging
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np

from vipetsc.dynamics.eigen import load_slepc
from vipetsc.modes.lattice.lattice_flow import LatticeArc, LatticeFlow
from vipetsc.modes.newton import CallbackErrors
from vipetsc.modes.point import Point
from vipetsc.modes.system import System

# These numbers decide what converges and at what cost. Each was varied while two multipliers of each of three breathers
# of 14 cells were computed, whose largest multipliers have the sizes 1.046, 1.45 and 10.4. The cost is counted in
# products: maps of one vector.
#
# Power of the map that SLEPc is given; odd, so that mu and -mu stay apart. With 5 the multiplier 1.046 does not
# converge, with 13 it takes a tenth fewer products at a residual of 7e-11 instead of 1e-11, with 51 a quarter more.
POWER = 25
# Tolerance of the Krylov-Schur method: the residual is 3e-9 with 1e-8, and 1e-12 takes a fifth more products.
TOLERANCE = 1e-10
# Restarts bound the cost where fewer multipliers converge than are wanted: products grow in proportion to them. 8 to 32
# restarts find the same multipliers.
RESTARTS = 16
# Vectors of the Krylov space beyond three times the multipliers wanted. From 8 to 32 the multipliers are the same; 8
# take up to a third fewer products, 32 up to three quarters more.
VECTORS = 16
# Number of multipliers where a case asks for them without one (``nnm.multipliers = true``).
MULTIPLIERS = 8
# Size of the random part of the first vector, beside a motion of the contacts of size 1: with it the vector has a part
# in every direction. Values from 1e-4 to 1e-2 cost the same.
NOISE = 1e-3
# PETSc's number of the error "out of memory", which one rank may meet alone.
ONE_RANKS_OWN = 55

logger = logging.getLogger(__name__)


class Monodromy:
    """The linear map of variations over an ``arc``, times ``sign``, for blocks that are scaled by ``scale``.

    ``multiply`` is its power ``POWER``, for a matrix of PETSc.
    """

    def __init__(self, arc: LatticeArc, scale: np.ndarray, sign: int) -> None:
        self.arc = arc
        self.scale = scale
        self.sign = sign

    def apply(self, blocks: np.ndarray) -> np.ndarray:
        """The map once, on blocks (number, 2 dof, owned cell)."""
        return self.sign * self.scale * self.arc.move(blocks / self.scale)

    def multiply(self, matrix: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Set ``y`` to the power of the map times ``x``."""
        block = x.getArray(readonly=True).reshape(1, *self.scale.shape)
        for _ in range(POWER):
            block = self.apply(block)
        y.setArray(block.ravel())


def with_multipliers(
    flow: LatticeFlow, system: System, odd: bool, point: Point, u: np.ndarray, wanted: bool | int
) -> Point:
    """The ``point``, at rest at the displacement ``u`` (n,), with its ``wanted`` largest multipliers; collective.

    If SLEPc fails, the point has no multipliers, ``multiplier`` is NaN, and the log says why.
    """
    # ``True`` asks for multipliers without a number.
    count = int(wanted)
    if wanted is True:
        count = MULTIPLIERS
    try:
        largest = largest_multipliers(flow, system, odd, u, point.period, count)
    except (PETSc.Error, np.linalg.LinAlgError) as error:
        # An error that one rank may have alone ends the program: the other ranks would wait for that rank.
        if getattr(error, "ierr", 0) == ONE_RANKS_OWN:
            raise
        if flow.comm.rank == 0:
            why = "point %d (E = %.9g J) has no multipliers: SLEPc or the evaluation of its vectors failed: %s"
            logger.warning(why, point.index, point.energy, " ".join(str(error).split()))
        return replace(point, multiplier=np.nan)
    return replace(point, multipliers=largest, multiplier=float(np.abs(largest[:, 0]).max(initial=1.0)))


def largest_multipliers(
    flow: LatticeFlow, system: System, odd: bool, u: np.ndarray, period: float, wanted: int
) -> np.ndarray:
    """The ``wanted`` largest multipliers of an orbit from rest at ``u``, or fewer, and their residuals: (number, 2).

    The largest comes first. Raises FlowError where the orbit cannot be followed, CaseError without SLEPc; collective.
    """
    comm = flow.comm
    start = np.append(u, 0 * u)
    omega = 2 * np.pi / period
    duration = period
    sign = 1
    if odd:
        duration = period / 2
        sign = -1
    arc = flow.arc(flow.scatter(start), duration)
    scale = flow.scatter(np.sqrt(np.append(omega**2 * system.masses, system.masses)))

    # The direction of the motion itself, by its acceleration: it starts at rest.
    phase = flow.scatter(np.append(0 * u, -system.forces(u) / system.masses)) * scale
    phase /= np.sqrt(comm.allreduce(float(np.sum(phase**2))))
    noise = NOISE * np.random.default_rng(1).standard_normal(len(start))
    seed = flow.scatter(noise + np.tile(system.contact_rows.sum(axis=0), 2))

    monodromy = Monodromy(arc, scale, sign)
    try:
        basis = _krylov_basis(monodromy, phase, seed, wanted, comm)
        if not len(basis):
            return np.empty((0, 2), complex)
        values, residuals = _ritz(monodromy, basis, phase, comm)
    finally:
        arc.engine.destroy()

    order = np.argsort(-np.abs(values), kind="stable")[:wanted]
    largest = values[order]
    if odd:
        largest = largest**2
    return np.stack([largest, residuals[order].astype(complex)], axis=-1)


def _krylov_basis(monodromy: Monodromy, phase: np.ndarray, seed: np.ndarray, wanted: int, comm: MPI.Comm) -> np.ndarray:
    """Orthonormal blocks (number, 2 dof, owned cell) that hold the eigenvectors of the largest multipliers."""
    slepc = load_slepc()
    shape = phase.shape
    errors = CallbackErrors()
    products = SimpleNamespace(mult=errors.keep(monodromy.multiply))
    shell = PETSc.Mat().createPython(((phase.size, None),) * 2, products, comm=comm)
    shell.setUp()
    deflated = shell.createVecRight()
    deflated.setArray(phase.ravel())
    first = shell.createVecRight()
    first.setArray(seed.ravel())

    eps: Any = slepc.EPS().create(comm)
    eps.setOperators(shell)
    eps.setProblemType(slepc.EPS.ProblemType.NHEP)
    eps.setWhichEigenpairs(slepc.EPS.Which.LARGEST_MAGNITUDE)
    size = shell.getSize()[0]
    eps.setDimensions(min(wanted, size - 2), min(3 * wanted + VECTORS, size - 1))
    eps.setTolerances(TOLERANCE, RESTARTS)
    eps.setDeflationSpace([deflated])
    eps.setInitialSpace([first])
    eps.setOptionsPrefix("multipliers_")
    eps.setFromOptions()
    with errors.raised_after():
        eps.solve()

    blocks = [vector.getArray(readonly=True).reshape(shape).copy() for vector in eps.getInvariantSubspace()]
    for petsc_object in (eps, shell, deflated, first):
        petsc_object.destroy()
    return np.array(blocks).reshape(-1, *shape)


def _ritz(monodromy: Monodromy, basis: np.ndarray, phase: np.ndarray, comm: MPI.Comm) -> tuple[np.ndarray, np.ndarray]:
    """Ritz values (number,) of the map on a basis orthogonal to ``phase``, and their residuals."""

    def products(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray(comm.allreduce(a.reshape(len(a), phase.size) @ b.reshape(len(b), phase.size).T))

    basis = np.linalg.solve(np.linalg.cholesky(products(basis, basis)), basis.reshape(len(basis), phase.size))
    moved = monodromy.apply(basis.reshape(-1, *phase.shape)).reshape(basis.shape)
    moved -= products(moved, phase[None]) * phase.ravel()

    values, vectors = np.linalg.eig(products(basis, moved))
    residual = vectors.T @ moved - values[:, None] * (vectors.T @ basis)
    return values, np.sqrt(comm.allreduce(np.sum(np.abs(residual) ** 2, axis=1)))
