"""The lattice as PETSc sees it: a right-hand side on a ghosted Vec, registered natively where possible."""

from __future__ import annotations

import ctypes

from petsc4py import PETSc

import numpy as np

from vipetsc.case import Model
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.ts import kernel, native
from vipetsc.lattice import Hertz


class LatticeOperator:
    """Right-hand side, energies and relative motions of the owned part of a lattice.

    ``q`` and ``p`` are the kernel's block seen as integers and as floats; ``mode``, ``approach`` and
    ``clearance`` are views of it, one entry an owned site, which the impact tracker writes.
    """

    def __init__(self, model: Model, layout: Layout) -> None:
        self.layout = layout
        self.q, self.p = _block(model, layout)
        sites = slice(0, len(layout.sites))
        self.mode = self.q[self.q[kernel.SITE_MODE] :][sites]
        self.approach = self.p[self.q[kernel.APPROACH] :][sites]
        self.clearance = self.p[self.q[kernel.CLEARANCE] :][sites]

    def register(self, ts: PETSc.TS, use_native: bool = True) -> str:
        """Make this the right-hand side of ``ts``; returns "native" or "python", which give the same bits."""
        if use_native:
            callback = native.compile_callback()
            ts.setAttr("callback", (callback, self))  # PETSc holds bare pointers: both must live as long as ts
            error = native.petsc_library().TSSetRHSFunction(
                ctypes.c_void_p(ts.handle),
                None,
                ctypes.c_void_p(callback.address),
                ctypes.c_void_p(self.q.ctypes.data),
            )
            if error:
                raise RuntimeError(f"TSSetRHSFunction failed with PETSc error {error}")
            return "native"
        ts.setRHSFunction(self)
        return "python"

    def __call__(self, ts: PETSc.TS, t: float, u: PETSc.Vec, f: PETSc.Vec) -> None:
        """Evaluate as petsc4py calls it."""
        self.exchange(u)
        with u.localForm() as local:
            kernel.right_hand_side(t, local.array, f.array, self.q, self.p)

    def exchange(self, u: PETSc.Vec) -> None:
        """Fetch the neighbouring cells' displacements into the ghosts of ``u``."""
        if self.q[kernel.EXCHANGE]:
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
