"""The right-hand side as a C function pointer that PETSc calls without entering Python."""

import ctypes
from collections.abc import Callable
from typing import Any, get_type_hints

from petsc4py import PETSc

import numpy as np
from llvmlite import binding
from numba import carray, types
from numba.core.ccallback import CFunc
from numba.extending import intrinsic

from vipetsc.compiled import cfunc
from vipetsc.contact.law import SITE, Contacts, ForceLaw
from vipetsc.dynamics.layout import COUPLING, MASS, SPRING, Burst, LatticeRecord, Shape
from vipetsc.dynamics.ts.right_hand_side import right_hand_side

_TABLES = ("masses", "couplings", "springs", "site_cells", "sites")


def _c_struct(record: type) -> np.dtype:
    """The fields of a record of numbers, in their order."""
    return np.dtype(list(get_type_hints(record).items()), align=True)


CONTEXT = np.dtype(
    [
        ("array", np.int64),  # receives the address of a vector's array; first, so that its address is the context's
        ("shape", _c_struct(Shape)),
        ("law", _c_struct(ForceLaw)),
        ("burst", _c_struct(Burst)),
        ("address", np.dtype([(name, np.int64) for name in _TABLES])),
        ("length", np.dtype([(name, np.int64) for name in _TABLES])),
    ],
    align=True,
)
"""A ``LatticeRecord`` behind one pointer: its values, and the addresses and lengths of its tables."""


# Functions of PETSc for compiled code; handles and pointers are int64.
_external: Any = types.ExternalFunction
_ghosts_begin, _ghosts_end = (
    _external(f"VecGhostUpdate{part}", types.int32(types.int64, types.int32, types.int32)) for part in ("Begin", "End")
)
_get_read, _restore_read, _get_write, _restore_write = (
    _external(f"Vec{verb}Array{access}", types.int32(types.int64, types.int64))
    for access in ("Read", "Write")
    for verb in ("Get", "Restore")
)


def petsc_library() -> ctypes.CDLL:
    """The PETSc that petsc4py is linked to: its extension module's handle also finds PETSc's symbols."""
    return ctypes.CDLL(PETSc.__file__)


def _pointer_of(typing_context: Any, address: Any) -> tuple[Any, Callable]:
    """An int64 address as a void pointer."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generate


_pointer: Any = intrinsic(_pointer_of)


def _callback(ts: int, t: float, u: int, f: int, address: int) -> int:
    context: Any = carray(_pointer(address), (1,), CONTEXT)[0]
    shape = context.shape
    error = (_ghosts_begin(u, 1, 0) or _ghosts_end(u, 1, 0)) if shape.exchange else 0
    error = error or _get_read(u, address)
    if error != 0:
        return error
    state = context.array
    error = _get_write(f, address)
    if error != 0:
        return error
    at, size = context.address, context.length
    lattice = LatticeRecord(
        shape,
        carray(_pointer(at.masses), (size.masses,), MASS),
        carray(_pointer(at.couplings), (size.couplings,), COUPLING),
        carray(_pointer(at.springs), (size.springs,), SPRING),
        carray(_pointer(at.site_cells), (size.site_cells,), np.int64),
        Contacts(context.law, carray(_pointer(at.sites), (size.sites,), SITE)),
        context.burst,
    )
    rate = carray(_pointer(context.array), (shape.owned,), np.float64)
    right_hand_side(t, carray(_pointer(state), (shape.ghosted,), np.float64), rate, lattice)
    error = _restore_write(f, address)
    if error != 0:
        return error
    context.array = state
    return _restore_read(u, address)


def compile_callback() -> CFunc:
    """``PetscErrorCode f(TS, PetscReal t, Vec u, Vec f, void *context)``, compiled or taken from numba's cache.

    ``context`` is the address of a ``CONTEXT`` record. Raises AttributeError where PETSc hides its symbols.
    """
    library = petsc_library()
    for function in (_ghosts_begin, _ghosts_end, _get_read, _restore_read, _get_write, _restore_write):
        address = ctypes.cast(getattr(library, function.symbol), ctypes.c_void_p).value
        binding.add_symbol(function.symbol, address)
    return cfunc("i4(i8, f8, i8, i8, i8)")(_callback)


def register(ts: PETSc.TS, lattice: LatticeRecord) -> None:
    """Make the lattice's right-hand side that of ``ts``, on the states of ``Layout.create_vector``."""
    callback, context = compile_callback(), np.zeros(1, CONTEXT)
    tables = lattice._asdict() | {"sites": lattice.contacts.sites}
    context["shape"], context["law"], context["burst"] = lattice.shape, lattice.contacts.law, lattice.burst
    context["address"] = tuple(tables[name].ctypes.data for name in _TABLES)
    context["length"] = tuple(tables[name].size for name in _TABLES)
    ts.setAttr("callback", (callback, context, lattice))  # PETSc holds bare pointers: all must live as long as ts
    pointers = (ctypes.c_void_p(p) for p in (ts.handle, None, callback.address, context.ctypes.data))
    error = petsc_library().TSSetRHSFunction(*pointers)
    if error:
        raise RuntimeError(f"TSSetRHSFunction failed with PETSc error {error}")
