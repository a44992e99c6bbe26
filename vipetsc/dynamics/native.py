"""Functions of PETSc for compiled code, which has no petsc4py; handles and pointers are int64."""

from typing import Any

import numba
from numba import types
from numba.extending import intrinsic

from vipetsc.compiled import inlined
from vipetsc.dynamics.petsc_library import petsc_library

# PETSc's values of the InsertMode and of the ScatterMode with which cells are exchanged.
INSERT_VALUES = 1
FORWARD = 0

function: Any = types.ExternalFunction
word = types.int64
error = types.int32
# f(Vec, PetscScalar **), and f(Vec, PetscInt *) for the size.
get_read = function("VecGetArrayRead", error(word, word))
restore_read = function("VecRestoreArrayRead", error(word, word))
get_write = function("VecGetArrayWrite", error(word, word))
restore_write = function("VecRestoreArrayWrite", error(word, word))
local_size = function("VecGetLocalSize", error(word, word))
# f(Vec, InsertMode, ScatterMode).
ghosts_begin = function("VecGhostUpdateBegin", error(word, types.int32, types.int32))
ghosts_end = function("VecGhostUpdateEnd", error(word, types.int32, types.int32))
# f(VecScatter, Vec, Vec, InsertMode, ScatterMode).
scatter_begin = function("VecScatterBegin", error(word, word, word, types.int32, types.int32))
scatter_end = function("VecScatterEnd", error(word, word, word, types.int32, types.int32))


def bind_symbols() -> None:
    """Let compiled code be linked to these functions, as it must even where it calls none of them.

    Raises AttributeError where PETSc hides its symbols.
    """
    library = petsc_library()
    for name in ("VecGetArrayRead", "VecGhostUpdateBegin", "VecScatterBegin"):
        getattr(library, name)


@intrinsic
def _pointer(typing_context: Any, address: Any, dtype: Any) -> Any:
    """Return the int64 ``address`` as a pointer to elements of a ``dtype``."""
    kind = types.CPointer(dtype.dtype)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(kind))

    return kind(types.int64, dtype), generate


@inlined
def array_at(address: int, length: int, dtype: Any) -> Any:
    """Return the array (length,) of a ``dtype`` at an int64 address."""
    return numba.carray(_pointer(address, dtype), (length,))
