"""Functions of PETSc for compiled code, which has no petsc4py; handles and pointers are int64."""

import ctypes
from collections.abc import Callable
from functools import cache
from typing import Any

from llvmlite import binding
from numba.core.types import ExternalFunction, int32, int64, voidptr
from numba.extending import intrinsic

from vipetsc.dynamics.petsc_library import petsc_library

# PETSc's values of the InsertMode and of the ScatterMode with which cells are exchanged.
INSERT_VALUES = 1
FORWARD = 0

external: Any = ExternalFunction
# f(Vec, PetscScalar **), and f(Vec, PetscInt *) for the size.
get_read, restore_read, get_write, restore_write, local_size = _vectors = [
    external(f"Vec{name}", int32(int64, int64))
    for name in ("GetArrayRead", "RestoreArrayRead", "GetArrayWrite", "RestoreArrayWrite", "GetLocalSize")
]
# f(Vec, InsertMode, ScatterMode).
ghosts_begin, ghosts_end = _ghosts = [
    external(f"VecGhostUpdate{part}", int32(int64, int32, int32)) for part in ("Begin", "End")
]
# f(VecScatter, Vec, Vec, InsertMode, ScatterMode).
scatter_begin, scatter_end = _scatters = [
    external(f"VecScatter{part}", int32(int64, int64, int64, int32, int32)) for part in ("Begin", "End")
]


@cache
def bind_symbols() -> None:
    """Let compiled code be linked to these functions, as it must even where it calls none of them.

    Raises AttributeError where PETSc hides its symbols.
    """
    for function in (*_vectors, *_ghosts, *_scatters):
        address = ctypes.cast(getattr(petsc_library(), function.symbol), ctypes.c_void_p).value
        binding.add_symbol(function.symbol, address)


def _pointer_of(typing_context: Any, address: Any) -> tuple[Any, Callable]:
    """An int64 address as a void pointer."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(voidptr))

    return voidptr(int64), generate


pointer: Any = intrinsic(_pointer_of)
