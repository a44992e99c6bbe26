"""Shooting for whole lattices: Newton's method with GMRES, whose products come from the linearised flow.

The equations and maps are those of ``shooting``; initial values and residuals are known to all ranks, the flow and the
vectors of Krylov's spaces are shared. Without contact the quarter map is cos(Omega T/4) on the modes of the lattice,
whose size is bounded from below for a breather between the bands, and contacts change it by a matrix of low rank:
GMRES needs few products, and no preconditioner (options of PETSc begin with ``nnm_``).
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from scipy.sparse import diags, spmatrix
from scipy.sparse.linalg import splu

from vipetsc.lattice import Chain
from vipetsc.modes.balance.breather import describing
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.lattice.lattice_flow import LatticeArc, LatticeFlow
from vipetsc.modes.newton import BorderedNewton
from vipetsc.modes.point import Point
from vipetsc.modes.problem import StartError
from vipetsc.modes.shooting.shooting import Chart, Shooting, ShootingMap
from vipetsc.modes.system import System

# Residual of GMRES over the right side, its vectors before a restart, its products.
RTOL, RESTART, MOST_PRODUCTS = 1e-10, 200, 600
REMEDY = "choose another nnm.start_frequency, between the pass bands"


class Diagonal:
    """The chart of lattices: initial values over the largest one, period over its value, without dense matrices."""

    def __init__(self, x: np.ndarray, period: float) -> None:
        self.size, self.period = float(np.abs(x).max()), period
        self._scale = np.append(np.full(len(x), self.size), period)

    def encode(self, x: np.ndarray, period: float) -> np.ndarray:
        """The unknowns of initial values and period."""
        return np.append(x, period) / self._scale

    def decode(self, xi: np.ndarray) -> tuple[np.ndarray, float]:
        """Initial values and period."""
        return xi[:-1] * self.size, float(xi[-1] * self.period)

    def derivative(self, xi: np.ndarray) -> spmatrix:
        """d(x, period)/d xi."""
        return diags(self._scale, format="csc")


class KrylovNewton(BorderedNewton):
    """Newton's method with GMRES: ``product`` (xi, vector) is the derivative at xi times a vector.

    Rank r has the unknowns ``cuts[r]`` to ``cuts[r + 1]``.
    """

    def __init__(
        self,
        function: Callable[[np.ndarray], np.ndarray],
        product: Callable[[np.ndarray, np.ndarray], np.ndarray],
        cuts: list[int],
        comm: MPI.Comm,
        **limits: float,
    ) -> None:
        self._product, self._comm, self._ranges = product, comm, [*pairwise(cuts)]
        super().__init__(function, lambda xi: xi, cuts[-1], **limits)  # type: ignore[arg-type]

    def _allocate(self, size: int) -> tuple[PETSc.Vec, PETSc.Mat]:
        first, stop = self._ranges[self._comm.rank]
        sizes = (stop - first, size)
        shell = PETSc.Mat().createPython((sizes, sizes), self, comm=self._comm)
        shell.setUp()
        return PETSc.Vec().createMPI(sizes, comm=self._comm), shell

    def _configure(self, ksp: PETSc.KSP) -> None:
        ksp.setType("gmres")
        ksp.setGMRESRestart(RESTART)
        ksp.setTolerances(rtol=RTOL, max_it=MOST_PRODUCTS)
        ksp.getPC().setType("none")

    def _local(self, array: np.ndarray) -> np.ndarray:
        return array[slice(*self._ranges[self._comm.rank])]

    def _whole(self, vector: PETSc.Vec) -> np.ndarray:
        return np.concatenate(self._comm.allgather(vector.getArray(readonly=True).copy()))

    def _jacobian(self, snes: PETSc.SNES, x: PETSc.Vec, matrix: PETSc.Mat, _: PETSc.Mat) -> None:
        self._at = self._whole(x)
        matrix.assemble()

    def mult(self, matrix: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The bordered derivative times ``x``."""
        change = self._whole(x)
        y.setArray(self._local(np.append(self._product(self._at, change), self._row[0] @ change)))

    def across(self, xi: np.ndarray, row: np.ndarray) -> np.ndarray:
        """The vector (size,) on which the derivative at ``xi`` vanishes and ``row`` does not, of unit length."""
        self._at, self._row = xi, (row, 0.0)
        ksp = self._snes.getKSP()
        ksp.setOperators(self._snes.getJacobian()[0])
        right, x = self._xi.duplicate(), self._xi.duplicate()
        right.setArray(self._local(np.append(np.zeros(len(xi) - 1), 1.0)))
        ksp.solve(right, x)
        vector = self._whole(x)
        return vector / np.linalg.norm(vector)


class LatticeShooting(Shooting):
    """Periodic orbits of the lattice ``chain`` with the contact ``law``, on all ranks of ``comm`` together."""

    dense = False

    def __init__(
        self, system: System, chain: Chain, shooting_map: ShootingMap, comm: MPI.Comm, tolerance: float, max_newton: int
    ) -> None:
        self.comm, self.lattice_flow = comm, LatticeFlow(chain, system.contacts[0].law, comm)
        self._current: LatticeArc | None = None
        flow: Any = self.lattice_flow
        flow.system = system
        super().__init__(flow, shooting_map, tolerance, max_newton)

    def _create_newton(self, size: int, max_newton: int) -> BorderedNewton:
        layout = self.lattice_flow.layout
        cuts = [*(layout.ranges[:, 0] * layout.dofs).tolist(), size]
        limits = {"tolerance": self.tolerance, "max_newton": max_newton}
        return KrylovNewton(self._function, self._derivative, cuts, self.comm, **limits)

    def chart(self, name: str, x: np.ndarray, period: float, **options: bool) -> Any:
        """The one of lattices, whatever its ``name``."""
        return Diagonal(x, period)

    def arc(self, x: np.ndarray, period: float) -> Any:
        """The arc from initial values ``x``; the one before can no longer move variations."""
        start = np.zeros(2 * self.system.dofs)
        start[self.free] = x
        if self._current is not None:
            self._current.engine.destroy()
            self._current = None
        self._current = self.lattice_flow.arc(self.lattice_flow.share(start), self.map.fraction * period)
        return self._current

    def residual(self, arc: Any) -> np.ndarray:
        """What should vanish at the arc's end (n,)."""
        return self.lattice_flow.whole(arc.end)[self._zero]

    def _derivative(self, xi: np.ndarray, change: np.ndarray) -> np.ndarray:
        """The derivative of the scaled equations at ``xi`` times a ``change`` of the unknowns."""
        arc: Any = self._arc(xi)
        n, moved = self.system.dofs, np.zeros(2 * self.system.dofs)
        step = self._chart.derivative(xi) @ change
        moved[self.free] = step[:-1]
        end = self.lattice_flow.whole(arc.end)
        rate = end[n:] if self.map.end == "centre" else -self.system.forces(end[:n]) / self.system.masses
        moved = self.lattice_flow.whole(arc.move(self.lattice_flow.share(moved[None])))[0]
        return (moved[self._zero] + self.map.fraction * rate * step[-1]) / self._chart.size

    def tangent(self, xi: np.ndarray, reference: np.ndarray) -> np.ndarray:
        """Unit tangent (n + 1,) at the last attempt's ``xi``, turned towards ``reference``."""
        assert isinstance(self._newton, KrylovNewton)
        return self._newton.across(xi, reference)

    def null_vector(self, chart: Chart, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Singular values are not known: ones in their place; the null vector."""
        self._chart, self._last = chart, None
        row = np.append(xi[:-1], 0.0)
        return np.ones(len(xi) - 1), self.tangent(xi, row / np.linalg.norm(row))

    def breather(self, omega: float) -> Point:
        """The orbit of a frequency ``omega`` in rad/s, between the bands, in which the first site touches.

        The guess is a describing function, as for condensed motions. Raises ContinuationError if there is none,
        StartError if Newton's method does not converge from there.
        """
        system, period = self.system, 2 * np.pi / omega
        row, pair = system.contact_rows[0], system.contacts[0]
        field = splu((system.stiffness - omega**2 * diags(system.masses)).tocsc()).solve(row)  # of 1 N, in m
        x = field * (describing(SiteForces([(pair.law, pair.clearance)]), 0, row @ field, omega) / (row @ field))
        chart = self.chart("relative", x, period)
        row = np.append(np.zeros(system.dofs), 1.0)
        attempt = self.solve(chart, chart.encode(x, period), row, 1.0)
        if not attempt.converged:
            why = f"({attempt.reason}; residuals {attempt.residuals})"
            raise StartError(f"no breather of {omega:g} rad/s is found {why}: {REMEDY}")
        return Point.of(self, attempt, chart)
