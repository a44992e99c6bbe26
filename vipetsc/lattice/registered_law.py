"""Elastic laws of users' modules, compiled: C functions, which shipped kernels call by their addresses.

No kernel is compiled anew for a law: the addresses stand in the record of a contact, in this process alone. DOLFINx
passes the kernels of users' forms to its assemblers likewise.
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.extending import intrinsic

from vipetsc.compiled import c_address, kernel, users_function
from vipetsc.process import announce
from vipetsc.register import MOST_PARAMETERS, LawPart

# Of x, the stiffness k and four parameters: one for all laws, so that a kernel calls any of them.
SIGNATURE = types.float64(*[types.float64] * 6)
_FUNCTION = types.ExternalFunctionPointer(SIGNATURE, get_pointer=None)


class CompiledLaw(NamedTuple):
    """Addresses of the C functions of a law: of x in m, the stiffness k, and four parameters."""

    force: int
    slope: int
    energy: int


@cache
def compiled_law(part: LawPart) -> CompiledLaw:
    """Return the compiled functions of a law, which is named before; raises ValueError if numba cannot compile it."""
    announce(f"compiling the law {part.name!r} of {part.file}")
    addresses = [_address(function, len(part.parameters)) for function in (part.force, part.slope, part.energy)]
    return CompiledLaw(*addresses)


def _address(function: Callable[..., float], count: int) -> int:
    """Return the address of a ``function`` of x, k and ``count`` parameters, as a C function of ``SIGNATURE``."""
    compiled = users_function(function)

    def call(x, k, a, b, c, d):  # type: ignore[no-untyped-def]
        return compiled(x, k, *(a, b, c, d)[:count])

    try:
        return c_address(call, SIGNATURE)
    # Errors of numba have several classes without a common one.
    except Exception as error:
        name = getattr(function, "py_func", function).__name__
        lines = [line for line in str(error).splitlines() if line.strip()]
        reason = next((line for line in lines if not line.startswith(("Failed in", "During"))), "")
        raise ValueError(f"numba cannot compile its function {name}: {reason}") from error


def evaluate(address: int, stiffness: float, parameters: tuple[float, ...], x: np.ndarray) -> np.ndarray:
    """Return values (...) of the function at an ``address`` at each indentation ``x`` (...) in m."""
    # One signature for all laws: what a law does not take is zero and not read.
    numbers = np.zeros(1 + MOST_PARAMETERS)
    numbers[0] = stiffness
    numbers[1 : 1 + len(parameters)] = parameters
    # ascontiguousarray would give a number a dimension.
    given = np.asarray(x, float, order="C")
    values = np.empty_like(given)
    _fill(address, numbers, given.reshape(-1), values.reshape(-1))
    return values


@intrinsic
def _function_at(typing_context, address):  # type: ignore[no-untyped-def]
    """Return the C function of ``SIGNATURE`` at an ``address``, for compiled code to call."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        return builder.inttoptr(arguments[0], context.get_value_type(_FUNCTION))

    return _FUNCTION(types.int64), generate


@kernel
def call_address(address: int, x: float, k: float, a: float, b: float, c: float, d: float) -> float:
    """Call the C function of ``SIGNATURE`` at an ``address``."""
    function: Any = _function_at(address)
    return function(x, k, a, b, c, d)


@kernel
def _fill(address: int, numbers: np.ndarray, x: np.ndarray, values: np.ndarray) -> None:
    """Set ``values`` to those of the function at an ``address``; ``numbers`` are k and the parameters."""
    for i in range(x.size):
        values[i] = call_address(address, x[i], numbers[0], numbers[1], numbers[2], numbers[3], numbers[4])
