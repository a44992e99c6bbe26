"""Functions of PETSc for compiled code, which has no petsc4py; handles and pointers are int64."""

import ctypes
from collections.abc import Callable, Iterable
from typing import Any

from petsc4py import PETSc

from llvmlite import binding
from numba import types
from numba.extending import intrinsic

external: Any = types.ExternalFunction
get_read, restore_read, get_write, restore_write = (
    external(f"Vec{verb}Array{access}", types.int32(types.int64, types.int64))
    for access in ("Read", "Write")
    for verb in ("Get", "Restore")
)


def petsc_library() -> ctypes.CDLL:
    """The PETSc that petsc4py is linked to: its extension module's handle also finds PETSc's symbols."""
    return ctypes.CDLL(PETSc.__file__)


def bind_symbols(functions: Iterable[Any]) -> None:
    """Let compiled code call external ``functions`` of PETSc; raises AttributeError where it hides its symbols."""
    for function in functions:
        address = ctypes.cast(getattr(petsc_library(), function.symbol), ctypes.c_void_p).value
        binding.add_symbol(function.symbol, address)


def _pointer_of(typing_context: Any, address: Any) -> tuple[Any, Callable]:
    """An int64 address as a void pointer."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(types.voidptr))

    return types.voidptr(types.int64), generate


pointer: Any = intrinsic(_pointer_of)
