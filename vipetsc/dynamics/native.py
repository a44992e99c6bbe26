"""Functions of PETSc for compiled code, which has no petsc4py; handles and pointers are int64."""

import ctypes
from collections.abc import Callable
from functools import cache
from typing import Any

from llvmlite import binding
from numba.core.types import Array, ExternalFunction, int32, int64
from numba.extending import intrinsic
from numba.np.arrayobj import make_array, populate_array

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


def _array_at(typing_context: Any, address: Any, length: Any, dtype: Any) -> tuple[Any, Callable]:
    """The array (length,) of a ``dtype`` at an int64 address; numba's carray is compiled anew for each dtype."""
    kind = Array(dtype.dtype, 1, "C")

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        size = context.get_constant(int64, context.get_abi_sizeof(context.get_data_type(kind.dtype)))
        array = make_array(kind)(context, builder)
        data = builder.inttoptr(arguments[0], array.data.type)
        populate_array(array, data=data, shape=[arguments[1]], strides=[size], itemsize=size, meminfo=None)
        return array._getvalue()

    return kind(int64, int64, dtype), generate


array_at: Any = intrinsic(_array_at)
