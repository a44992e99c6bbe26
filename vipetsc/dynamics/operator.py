"""The lattice as PETSc sees it: a right-hand side on a ghosted Vec, registered natively where possible."""

from __future__ import annotations

import ctypes

from petsc4py import PETSc

import numpy as np

from vipetsc.case import Model
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.records import create_context, create_record
from vipetsc.dynamics.ts import kernel, native
from vipetsc.dynamics.ts.right_hand_side import observe, right_hand_side
from vipetsc.lattice import Hertz


class LatticeOperator:
    """Right-hand side and relative motions of the owned part of a lattice.

    ``lattice`` is its record; the impact tracker sets the modes and approach velocities of its ``contacts``.
    """

    def __init__(self, model: Model, layout: Layout) -> None:
        self.layout = layout
        self.lattice = create_record(model, layout)
        self.q, self.p = _block(model, layout)
        sites = slice(0, len(layout.sites))
        self.mode = self.q[self.q[kernel.SITE_MODE] :][sites]
        self.approach = self.p[self.q[kernel.APPROACH] :][sites]

    def register(self, ts: PETSc.TS, use_native: bool = True) -> str:
        """Make this the right-hand side of ``ts``; returns "native" or "python", which give the same bits."""
        if not use_native:
            ts.setRHSFunction(self)
            return "python"
        callback, context = native.compile_callback(), create_context(self.lattice)
        ts.setAttr("callback", (callback, context, self))  # PETSc holds bare pointers: all must live as long as ts
        error = native.petsc_library().TSSetRHSFunction(
            ctypes.c_void_p(ts.handle),
            None,
            ctypes.c_void_p(callback.address),
            ctypes.c_void_p(context.ctypes.data),
        )
        if error:
            raise RuntimeError(f"TSSetRHSFunction failed with PETSc error {error}")
        return "native"

    def __call__(self, ts: PETSc.TS, t: float, u: PETSc.Vec, f: PETSc.Vec) -> None:
        """Evaluate as petsc4py calls it."""
        self.exchange(u)
        with u.localForm() as local:
            right_hand_side(t, local.array, f.array, self.lattice)

    def observe(self, t: float, state: PETSc.Vec, motion: np.ndarray) -> None:
        """Relative motion (sites, 3) of all owned sites at time t; fetches ghosts, so all ranks must call it."""
        self.exchange(state)
        with state.localForm() as local:
            observe(t, local.array, self.lattice, motion)

    def exchange(self, u: PETSc.Vec) -> None:
        """Fetch the neighbouring cells' displacements into the ghosts of ``u``."""
        if self.lattice.shape.exchange:
            u.ghostUpdate(PETSc.InsertMode.INSERT_VALUES, PETSc.ScatterMode.FORWARD)


def _block(model: Model, layout: Layout) -> tuple[np.ndarray, np.ndarray]:
    cell, contact, drive = model.chain.cell, model.contact, model.drive
    couplings = cell.couplings()
    masses = [c[0] for c in couplings]
    sites = layout.sites
    integers = {
        kernel.FIRST: np.searchsorted(masses, np.arange(cell.dofs + 1)),
        kernel.OFFSET: [c[1] for c in couplings],
        kernel.OTHER: [c[2] for c in couplings],
        kernel.SPRING_START: [s.start for s in cell.springs],
        kernel.SPRING_END: [s.end for s in cell.springs],
        kernel.SPRING_NEXT: [s.next_cell for s in cell.springs],
        kernel.SITE_CELL: [model.chain.sites[i] - layout.start for i in sites],
        kernel.SITE_MODE: [kernel.FREE] * len(sites),
    }
    floats = {
        kernel.STIFFNESS: [c[3] for c in couplings],
        kernel.INVERSE_MASS: [1 / m for m in cell.masses],
        kernel.SPRING_STIFFNESS: [s.stiffness for s in cell.springs],
        kernel.CLEARANCE: [model.chain.clearances[i] for i in sites],
        kernel.APPROACH: [1.0] * len(sites),
        kernel.DRIVE: [drive.window_amplitude, drive.frequency, drive.cycles, drive.duration],
        kernel.CONTACT: [contact.stiffness, contact.damping],
    }
    words = kernel.HEADER + sum(len(table) for table in (integers | floats).values())
    q = np.zeros(words, np.int64)
    p = q.view(np.float64)
    at = kernel.HEADER
    for view, tables in ((q, integers), (p, floats)):
        for key, table in tables.items():
            q[key] = at
            view[at : at + len(table)] = table
            at += len(table)

    left, right = layout.neighbours()
    ghosts = [side for side in (left, right) if side is not None]
    free = model.chain.ends == "free"
    n, d = layout.owned, cell.dofs
    header = {
        kernel.WORDS: words,
        kernel.OWNED: layout.size,
        kernel.GHOSTED: layout.size + d * len(ghosts),
        kernel.EXCHANGE: layout.comm.size > 1 or layout.periodic,
        kernel.CELLS: n,
        kernel.DOFS: d,
        kernel.SPRINGS: len(cell.springs),
        kernel.SITES: len(sites),
        kernel.WORK: layout.work,
        kernel.DISSIPATED: layout.dissipated,
        kernel.DRIVEN: (d + model.drive_mass) * n + model.drive_cell - layout.start if layout.owns_drive else -1,
        kernel.LEFT_GHOST: -1 if left is None else layout.size,
        kernel.RIGHT_GHOST: -1 if right is None else layout.size + d * (left is not None),
        kernel.LEFT_FREE: free and left is None,
        kernel.RIGHT_FREE: free and right is None,
        kernel.HOST: cell.host,
        kernel.RESONATOR: cell.resonator,
        kernel.HERTZ: contact.law is Hertz,
        kernel.CLIP: contact.adhesion == "clip",
    }
    for key, value in header.items():
        q[key] = int(value)
    return q, p
