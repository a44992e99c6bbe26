"""Shooting for whole lattices: Newton's method with GMRES, whose products come from the linearised flow.

The equations and maps are those of ``shooting``. Every rank has all initial values and residuals; the flow and the
vectors of Krylov's spaces are distributed. Without contact the quarter map is cos(Omega T/4) on the modes of the
lattice, whose size is bounded from below for a breather between the bands, and contacts change it by a matrix of low
rank: GMRES needs few products, and no preconditioner (options of PETSc begin with ``nnm_``).
"""

from collections.abc import Sequence
from itertools import pairwise
from types import SimpleNamespace
from typing import Protocol

from mpi4py import MPI
from petsc4py import PETSc

import numpy as np
from scipy.sparse import diags
from scipy.sparse.linalg import splu

from vipetsc.lattice import Chain
from vipetsc.modes.balance.conservative import PairCompliance, describing_motion
from vipetsc.modes.balance.harmonics import SiteForces
from vipetsc.modes.flow import ShootingMap
from vipetsc.modes.lattice.lattice_flow import LatticeArc, LatticeFlow
from vipetsc.modes.newton import BorderedNewton, Equations
from vipetsc.modes.point import Point
from vipetsc.modes.problem import ContinuationError, StartError
from vipetsc.modes.shooting import Chart, ShootingEquations, ShootingFrame
from vipetsc.modes.system import System

# Residual of GMRES over the right side. Newton's steps to a breather take 140 to 165 products in all; with 1e-8 they
# are a tenth fewer, with 1e-12 a tenth more, and the orbit is the same.
RTOL = 1e-10
# Vectors of GMRES before a restart: 25 take up to twice as many products, and 50 need no restart in short lattices.
RESTART = 200
# Products of one solution at most, more than ten times what it needs: a derivative that takes more is nearly singular.
MOST_PRODUCTS = 600
# Squared frequency, over that of a breather, at which displacements count as static. It moves the first guess alone:
# with 1e-8 and 1e-4 products and orbits are the same.
STATIC = 1e-6
REMEDY = "choose another nnm.start_frequency, between the pass bands"


class Diagonal(Chart):
    """The chart of lattices, without dense matrices: all initial values over the largest one, and T/T_0."""

    def __init__(self, x: np.ndarray, period: float) -> None:
        self.size = float(np.abs(x).max())
        self.period = period
        self._scale = np.append(np.full(len(x), self.size), period)

    def encode(self, x: np.ndarray, period: float) -> np.ndarray:
        """The unknowns (n + 1,) of initial values ``x`` (n,) and period."""
        return np.append(x, period) / self._scale

    def decode(self, xi: np.ndarray) -> tuple[np.ndarray, float]:
        """Initial values (n,) and period in s at the unknowns ``xi`` (n + 1,)."""
        return xi[:-1] * self.size, float(xi[-1] * self.period)

    def to_changes(self, xi: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Changes of (x, period) that follow from ``changes`` (n + 1,) of the unknowns at ``xi``."""
        return self._scale * changes

    def to_unknowns(self, xi: np.ndarray, changes: np.ndarray) -> np.ndarray:
        """Changes of the unknowns at ``xi`` from which the ``changes`` (n + 1,) or (n + 1, m) of (x, period) follow."""
        return (changes.T / self._scale).T


class KrylovEquations(Equations, Protocol):
    """Equations that give the products of their derivative with vectors, and not its matrix."""

    def product(self, xi: np.ndarray, change: np.ndarray) -> np.ndarray:
        """The product (n,) of the residual's derivative at ``xi`` with a ``change`` (n + 1,) of the unknowns."""


class KrylovNewton(BorderedNewton[KrylovEquations]):
    """Newton's method with GMRES; rank r of ``comm`` has the unknowns ``cuts[r]`` to ``cuts[r + 1]``."""

    def __init__(self, cuts: list[int], comm: MPI.Comm, max_newton: int) -> None:
        self._comm = comm
        self._ranges = [*pairwise(cuts)]
        self._at: np.ndarray  # where the derivative is taken, from one assembly to the next
        super().__init__(cuts[-1], max_newton)

    def _allocate(self, size: int) -> tuple[PETSc.Vec, PETSc.Mat]:
        first, stop = self._ranges[self._comm.rank]
        sizes = (stop - first, size)
        products = SimpleNamespace(mult=self._errors.keep(self._multiply))
        shell = PETSc.Mat().createPython((sizes, sizes), products, comm=self._comm)
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

    def _differentiate(self, snes: PETSc.SNES, x: PETSc.Vec, matrix: PETSc.Mat, _: PETSc.Mat) -> None:
        self._at = self._whole(x)
        matrix.assemble()

    def _multiply(self, matrix: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Set ``y`` to the bordered derivative times ``x``."""
        change = self._whole(x)
        product = self._equations.product(self._at, change)
        y.setArray(self._local(np.append(product, self._row[0] @ change)))

    def null_vector(self, equations: KrylovEquations, xi: np.ndarray, row: np.ndarray) -> np.ndarray:
        """The vector (size,) on which the derivative at ``xi`` vanishes and ``row`` does not, of unit length.

        Raises LinAlgError on all ranks where GMRES does not find it, as where there are several.
        """
        self._equations = equations
        self._at = xi
        self._row = row, 0.0
        ksp = self._snes.getKSP()
        ksp.setOperators(self._snes.getJacobian()[0])
        right = self._xi.duplicate()
        x = self._xi.duplicate()
        right.setArray(self._local(np.append(np.zeros(len(xi) - 1), 1.0)))
        with self._errors.raised_after():
            ksp.solve(right, x)
        if ksp.getConvergedReason() < 0:
            raise np.linalg.LinAlgError(f"GMRES ends with a residual of {ksp.getResidualNorm():.1e}")
        vector = self._whole(x)
        return vector / np.linalg.norm(vector)


class LatticeFrame(ShootingFrame[LatticeArc]):
    """Shooting equations of a lattice at and near one orbit, with products of their derivative."""

    problem: "LatticeShooting"
    chart: Diagonal

    def product(self, xi: np.ndarray, change: np.ndarray) -> np.ndarray:
        """The product (n,) of the residual's derivative at ``xi`` with a ``change`` (n + 1,) of the unknowns."""
        problem = self.problem
        arc = self.arc(xi)
        # A product takes as many steps as the arc itself.
        problem.limits.count(arc.steps)
        step = self.chart.to_changes(xi, change)
        start = problem.flow.scatter(problem.start(step[:-1])[None])
        moved = problem.flow.gather(arc.move(start))[0]
        rate = problem.map.fraction * problem.end_rate(arc)
        return (moved[problem.zero] + rate * step[-1]) / self.unit

    def tangent_at(self, xi: np.ndarray) -> np.ndarray:
        """The unit tangent (n + 1,) at a solution ``xi`` (n + 1,), on the side of the frame's own.

        Raises LinAlgError where it is not found.
        """
        return self.problem.newton.null_vector(self, xi, self.tangent)


class LatticeShooting(ShootingEquations[LatticeArc]):
    """Periodic orbits of the lattice ``chain`` and its ``system``, on all ranks of ``comm`` together."""

    newton: KrylovNewton
    guards = frozenset({"turn_relative"})

    def __init__(
        self, system: System, chain: Chain, shooting_map: ShootingMap, comm: MPI.Comm, tolerance: float, max_newton: int
    ) -> None:
        super().__init__(system, shooting_map, tolerance)
        self.flow = LatticeFlow(chain, [pair.stops for pair in system.contacts], comm)
        self.limits = self.flow.limits
        layout = self.flow.layout
        # The last part ends with the period, the one unknown that belongs to no cell.
        cuts = [*(layout.ranges[:, 0] * layout.dofs).tolist(), system.dofs + 1]
        self.newton = KrylovNewton(cuts, comm, max_newton)

    def _integrate(self, start: np.ndarray, period: float) -> LatticeArc:
        if self._latest is not None:
            # The engine of an arc holds the whole orbit in memory: that of the arc before is freed first. Variations
            # can no longer be mapped along that arc.
            self._latest[2].engine.destroy()
            self._latest = None
        return self.flow.arc(self.flow.scatter(start), self.map.fraction * period)

    def end(self, arc: LatticeArc) -> np.ndarray:
        """The state (2n,) at an arc's end."""
        return self.flow.gather(arc.end)

    def stability(self, arc: LatticeArc) -> tuple[np.ndarray, float]:
        """No half-traces, and NaN for the multiplier: they need the matrix of an orbit (``floquet`` does without)."""
        return np.empty(0), np.nan

    def frame_at(self, chart: str, x: np.ndarray, period: float, tangent: np.ndarray) -> LatticeFrame:
        """The frame at any initial values ``x`` (n,) and period in s, in the chart of lattices whatever the ``chart``.

        ``tangent`` (n + 1,) is d(x, period) along the branch, of any length, or empty.
        """
        return LatticeFrame(self, Diagonal(x, period), x, period, tangent)

    def relative_chart(self, x: np.ndarray, period: float) -> Diagonal:
        """The chart of lattices for initial values ``x`` (n,)."""
        return Diagonal(x, period)

    def null_vector(self, start: Point) -> np.ndarray:
        """Tangent d(x, period) at a corrected orbit, of either sign.

        A second null vector may not be seen; raises ContinuationError where GMRES does not find the first one.
        """
        frame = self.frame_at("relative", start.x, start.period, np.empty(0))
        row = np.append(frame.xi[:-1], 0.0)
        try:
            null = self.newton.null_vector(frame, frame.xi, row / np.linalg.norm(row))
        except np.linalg.LinAlgError as error:
            raise ContinuationError(f"{start.describe()} has no unique tangent: {error}") from error
        return frame.chart.to_changes(frame.xi, null)

    def breather(self, omega: float, sites: Sequence[int] = (1,)) -> Point:
        """The orbit of a frequency ``omega`` in rad/s, between the bands, in which ``sites`` touch.

        ``sites`` are numbers from 1; a negative number is that of a site which moves half a period later. The first
        guess is the motion by describing functions, as for condensed motions (``balance.conservative``). Raises
        ContinuationError if there is none, StartError if Newton's method does not converge from it.
        """
        system = self.system
        # Their solutions are displacements by a force of 1 N, in m. In a lattice that nothing holds a static force
        # would have none: a little inertia takes the place of walls.
        dynamic = splu((system.stiffness - omega**2 * diags(system.masses)).tocsc())
        static = splu((system.stiffness + STATIC * omega**2 * diags(system.masses)).tocsc())
        x = np.zeros(system.dofs)
        for number in sites:
            row = system.contact_rows[abs(number) - 1]
            stops = system.contacts[abs(number) - 1].stops
            moved = dynamic.solve(row)
            pressed = static.solve(row)
            g = PairCompliance(static=float(row @ pressed), dynamic=float(row @ moved))
            mean, amplitude = describing_motion(SiteForces([stops]), 0, g, omega)
            x += moved * (np.sign(number) * amplitude / g.dynamic) + pressed * (mean / g.static)

        frame = self.frame_at("relative", x, 2 * np.pi / omega, np.empty(0))
        keep_period = np.append(np.zeros(system.dofs), 1.0)
        attempt = frame.solve(frame.xi, keep_period, 1.0)
        if not attempt.converged:
            why = f"({attempt.reason}; residuals {attempt.residuals})"
            raise StartError(f"no breather of {omega:g} rad/s is found {why}: {REMEDY}")
        return frame.measures(attempt)
