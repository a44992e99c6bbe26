"""The right-hand side as a C function pointer that PETSc calls without entering Python."""

from __future__ import annotations

import ctypes

from petsc4py import PETSc

import numba
import numpy as np
from llvmlite import binding
from numba import types
from numba.extending import intrinsic

from vipetsc.dynamics.ts import kernel

_CALLS = {
    "VecGhostUpdateBegin": types.int32(types.int64, types.int32, types.int32),
    "VecGhostUpdateEnd": types.int32(types.int64, types.int32, types.int32),
    "VecGetArrayRead": types.int32(types.int64, types.int64),
    "VecRestoreArrayRead": types.int32(types.int64, types.int64),
    "VecGetArrayWrite": types.int32(types.int64, types.int64),
    "VecRestoreArrayWrite": types.int32(types.int64, types.int64),
}


def petsc_library() -> ctypes.CDLL:
    """The PETSc that petsc4py is linked to: its extension module's handle also finds PETSc's symbols."""
    return ctypes.CDLL(PETSc.__file__)


@intrinsic
def _pointer(typing_context, address):
    """An int64 address as a void pointer."""

    def generate(context, builder, signature, arguments):
        return builder.inttoptr(arguments[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generate


def compile_callback() -> numba.core.ccallback.CFunc:
    """``PetscErrorCode f(TS, PetscReal t, Vec u, Vec f, void *block)``, compiled or taken from numba's cache.

    ``block`` is the address of the kernel's words; the header holds their number and a slot that receives array
    pointers. Raises AttributeError where PETSc hides its symbols.
    """
    library = petsc_library()
    for name in _CALLS:
        binding.add_symbol(name, ctypes.cast(getattr(library, name), ctypes.c_void_p).value)
    begin, end, get, restore, get_write, restore_write = (types.ExternalFunction(n, s) for n, s in _CALLS.items())
    words, exchange, slot, owned, ghosted = (
        kernel.WORDS,
        kernel.EXCHANGE,
        kernel.SLOT,
        kernel.OWNED,
        kernel.GHOSTED,
    )
    rhs, header = kernel.right_hand_side, kernel.HEADER

    @numba.cfunc("i4(i8, f8, i8, i8, i8)", cache=True)
    def callback(ts, t, u, f, block):
        head = numba.carray(_pointer(block), (header,), np.int64)
        q = numba.carray(_pointer(block), (head[words],), np.int64)
        p = numba.carray(_pointer(block), (head[words],), np.float64)
        if q[exchange] == 1:
            error = begin(u, 1, 0)
            if error == 0:
                error = end(u, 1, 0)
            if error != 0:
                return error
        pointer = block + 8 * slot
        error = get(u, pointer)
        if error != 0:
            return error
        at_u = q[slot]
        y = numba.carray(_pointer(at_u), (q[ghosted],), np.float64)
        error = get_write(f, pointer)
        if error != 0:
            return error
        at_f = q[slot]
        rhs(t, y, numba.carray(_pointer(at_f), (q[owned],), np.float64), q, p)
        error = restore_write(f, pointer)
        if error != 0:
            return error
        q[slot] = at_u
        return restore(u, pointer)

    return callback
