"""Vectors of cells in the processor's registers, for sums that no compiler keeps there: many terms, many rows.

A product is rounded before it is added, lane by lane, as in a loop over the cells: results do not depend on ``LANES``.
"""

from typing import Any

from llvmlite import binding, ir
from numba import types
from numba.extending import intrinsic, models, register_model

# The sums of four rows, which ``apply_propagator`` forms together, then take half of the processor's registers: 16 of
# the 32 with 8 floats each of AVX-512, 8 of the 16 with 4 floats each of AVX2.
LANES = 32 if binding.get_host_cpu_features().get("avx512f") else 8
_DOUBLES = ir.VectorType(ir.DoubleType(), LANES)


class _Vector(types.Type):
    """``LANES`` floats."""

    def __init__(self) -> None:
        super().__init__("Vector")


@register_model(_Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _DOUBLES)


def _address(context: Any, builder: Any, kind: Any, array: Any, i: Any) -> Any:
    """Address of element ``i`` of a contiguous array."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [i]), _DOUBLES.as_pointer())


def _zeros(typing_context: Any) -> Any:
    """A vector of zeros."""
    return _Vector()(), lambda *_: _DOUBLES(None)


def _add(typing_context: Any, a: Any, b: Any) -> Any:
    """The sum of two vectors."""
    return a(a, b), lambda context, builder, signature, arguments: builder.fadd(*arguments)


def _add_product(typing_context: Any, total: Any, factor: Any, x: Any, i: Any) -> Any:
    """The vector ``total`` + ``factor`` times x[i : i + LANES], which must lie within ``x``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        before, number, array, begin = arguments
        cells = builder.load(_address(context, builder, x, array, begin), align=8)
        first = builder.insert_element(_DOUBLES(ir.Undefined), number, ir.IntType(32)(0))
        lanes = ir.VectorType(ir.IntType(32), LANES)(None)
        factors = builder.shuffle_vector(first, _DOUBLES(ir.Undefined), lanes)
        return builder.fadd(before, builder.fmul(factors, cells))

    return total(total, types.float64, x, types.intp), generate


def _store(typing_context: Any, vector: Any, out: Any, i: Any) -> Any:
    """out[i : i + LANES] = ``vector``; they must lie within ``out``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        value, array, begin = arguments
        builder.store(value, _address(context, builder, out, array, begin), align=8)
        return context.get_dummy_value()

    return types.void(vector, out, types.intp), generate


def _prefetch(typing_context: Any, x: Any, i: Any) -> Any:
    """Bring x[i : i + LANES] into the cache; it may lie beyond the end of ``x``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        flag = ir.IntType(32)
        # To be read; to be kept in all levels of the cache; data, not instructions.
        flags = flag(0), flag(3), flag(1)
        address = ir.IntType(8).as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [address, flag, flag, flag])
        function = builder.module.declare_intrinsic("llvm.prefetch", [address], kind)
        for cell in range(0, LANES, 8):  # a line of the cache has 64 bytes
            place = builder.add(arguments[1], ir.IntType(64)(cell))
            line = builder.bitcast(_address(context, builder, x, arguments[0], place), address)
            builder.call(function, [line, *flags])
        return context.get_dummy_value()

    return types.void(x, types.intp), generate


zeros: Any = intrinsic(_zeros)
add: Any = intrinsic(_add)
add_product: Any = intrinsic(_add_product)
store: Any = intrinsic(_store)
prefetch: Any = intrinsic(_prefetch)
