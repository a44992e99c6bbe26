"""The lattice as PETSc sees it: a right-hand side on a ghosted Vec, registered natively where possible."""

from __future__ import annotations

import ctypes

from petsc4py import PETSc

import numpy as np

from vipetsc.case import Model
from vipetsc.dynamics.layout import Layout
from vipetsc.dynamics.records import create_context, create_record
from vipetsc.dynamics.ts import native
from vipetsc.dynamics.ts.right_hand_side import observe, right_hand_side


class LatticeOperator:
    """Right-hand side and relative motions of the owned part of a lattice.

    ``lattice`` is its record; the impact tracker sets the modes and approach velocities of its ``contacts``.
    """

    def __init__(self, model: Model, layout: Layout) -> None:
        self.layout = layout
        self.lattice = create_record(model, layout)

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
