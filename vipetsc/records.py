"""Records for compiled code: a named tuple of numbers, arrays and further records, behind one pointer.

Numba passes a named tuple as one argument for each number in it, seven for an array, and compiles each of them at every
call. A kernel that is given a ``Record`` gets one pointer instead, and reads a field where it uses it, by the same
words: ``record.field``. The memory holds numbers, and of an array its address and its shape. It does not change while
the record lives; the numbers in its arrays do.

A numba type of our own, by the documented interface for extensions (``numba.extending``). Compiling the propagator for
its first run takes 58 s of CPU, with named tuples 79 s. Sixteen small kernels with forty arrays: named tuple 7.2 s,
structured array of addresses 3.9 s, records 5.5 s, ``structref`` 2.8 s, which counts references at each access. Steps
of the propagator take 4 % more CPU than with tuples, those of ``ts`` 5 %; all results have the same bits.
"""

import hashlib
import operator
from functools import cache
from typing import Any, NamedTuple

import numba
import numpy as np
from numba import types
from numba.extending import (
    NativeValue,
    intrinsic,
    models,
    overload,
    overload_attribute,
    register_model,
    typeof_impl,
    unbox,
)

WORD = 8  # bytes of a number, an address or a length


class Field(NamedTuple):
    """A field of a record: its ``name``, its type in compiled code, and its first word among those of the record."""

    name: str
    kind: Any
    place: int


class RecordType(types.Type):
    """The type of records with these ``fields``, which take ``length`` words of memory."""

    def __init__(self, title: str, fields: tuple[Field, ...], length: int) -> None:
        self.fields = fields
        self.length = length
        # The name tells types apart, and is part of the names of all functions that take such a record: it is short.
        digest = hashlib.sha256(repr([(field.name, str(field.kind)) for field in fields]).encode()).hexdigest()
        super().__init__(name=f"{title}-{digest[:16]}")

    def field(self, name: str) -> Field | None:
        """Return the field with a ``name``, None if there is none."""
        return next((field for field in self.fields if field.name == name), None)


@register_model(RecordType)
class _RecordModel(models.OpaqueModel):
    """A pointer."""


class Record:
    """A named tuple, the ``source``, for compiled code; fields are also read here, as those of the tuple are."""

    def __init__(self, source: Any) -> None:
        self.source = source
        self.type = record_type(source)
        self.memory = np.zeros(self.type.length, np.int64)
        _fill(self.memory, self.type, source)
        self.address = self.memory.ctypes.data

    def __getattr__(self, name: str) -> Any:
        return getattr(self.source, name)

    def _replace(self, **changes: Any) -> "Record":
        return Record(self.source._replace(**changes))


class PartRecords(Record):
    """Records of consecutive parts of the arrays of ``whole``; compiled code selects one by its number: ``parts[c]``.

    ``bounds`` gives for some of its arrays where the parts begin and where they end (part,) along the first axis; other
    fields are the same in all. A named tuple in ``whole`` has a dictionary of this kind in ``bounds``.
    """

    def __init__(self, whole: Record, count: int, bounds: dict[str, Any]) -> None:
        self.source = whole.source
        self.type = whole.type
        self.memory = np.tile(whole.memory, (max(count, 1), 1))
        _restrict(self.memory[:count], self.type, self.source, bounds)
        self.address = self.memory.ctypes.data


def record_type(values: Any) -> RecordType:
    """Return the type of the record of a named tuple, and of all others with fields of the same types."""
    fields = []
    length = 0
    for name, value in zip(values._fields, values, strict=True):
        if isinstance(value, Record):
            value = value.source
        if isinstance(value, tuple):
            kind: Any = record_type(value)
            size = kind.length
        elif isinstance(value, np.ndarray):
            kind = _array_type(value.dtype, value.ndim)
            size = 1 + value.ndim
        else:
            kind = _number_type(value)
            size = 1
        fields.append(Field(name, kind, length))
        length += size
        _declare(name)
    return _record_type(type(values).__name__, tuple(fields), length)


# A run makes some twenty records, and a fit a thousand runs: types are made once.
_record_type = cache(RecordType)


@cache
def _array_type(dtype: np.dtype, dimensions: int) -> Any:
    """Return the type of an array of so many ``dimensions`` in a record."""
    return types.Array(numba.from_dtype(dtype), dimensions, "C")


def _number_type(value: Any) -> Any:
    """Return the type of a number or truth value in a record."""
    if isinstance(value, bool | np.bool_):
        return types.boolean
    if isinstance(value, float):
        return types.float64
    return types.int64


def _fill(memory: np.ndarray, kind: RecordType, values: Any) -> None:
    """Write ``values`` to the words ``memory`` of a record."""
    for field, value in zip(kind.fields, values, strict=True):
        part = memory[field.place :]
        if isinstance(value, Record):
            value = value.source
        if isinstance(value, tuple):
            _fill(part, field.kind, value)
        elif isinstance(value, np.ndarray):
            if not value.flags.c_contiguous:
                raise ValueError(f"{type(values).__name__}.{field.name} is not contiguous")
            part[0] = value.ctypes.data
            part[1 : 1 + value.ndim] = value.shape
        elif isinstance(value, float):
            part[:1].view(np.float64)[0] = value
        else:
            part[0] = value


def _restrict(memory: np.ndarray, kind: RecordType, values: Any, bounds: dict[str, Any]) -> None:
    """Restrict the arrays of records ``memory`` (part, word) to the ``bounds`` of ``PartRecords``."""
    for name, bound in bounds.items():
        field = kind.field(name)
        assert field is not None, name
        value = getattr(values, name)
        if isinstance(bound, dict):
            _restrict(memory[:, field.place :], field.kind, value, bound)
            continue
        begin, end = bound
        memory[:, field.place] += begin * value.strides[0]
        memory[:, field.place + 1] = end - begin


@typeof_impl.register(Record)
def _typeof(record: Record, context: Any) -> RecordType:
    return record.type


@unbox(RecordType)
def _unbox(kind: RecordType, record: Any, c: Any) -> NativeValue:
    number = c.pyapi.object_getattr_string(record, "address")
    address = c.unbox(types.int64, number).value
    c.pyapi.decref(number)
    return NativeValue(c.builder.inttoptr(address, c.context.get_value_type(kind)))


@intrinsic
def record_at(typing_context: Any, address: Any, kind: Any) -> Any:
    """Return the record of a ``kind`` at an int64 ``address``."""
    result = kind.instance_type

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.inttoptr(arguments[0], context.get_value_type(result))

    return result(types.int64, kind), generate


def _word(context: Any, builder: Any, record: Any, place: Any, kind: Any) -> Any:
    """Return the word of a ``record`` at a ``place``, as a value of a ``kind``."""
    pointer = builder.bitcast(record, context.get_value_type(types.CPointer(kind)))
    word = builder.load(builder.gep(pointer, [context.get_constant(types.int64, place)], inbounds=True))
    # Nothing writes to a record: the optimiser may read a field before a loop instead of in it.
    word.set_metadata("invariant.load", builder.module.add_metadata([]))
    return word


@intrinsic(prefer_literal=True)
def _nested(typing_context: Any, record: Any, name: Any) -> Any:
    """Return the record in the field ``name`` of another one."""
    field = record.field(name.literal_value)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        offset = context.get_constant(types.int64, WORD * field.place)
        return builder.gep(arguments[0], [offset], inbounds=True)

    return field.kind(record, name), generate


@intrinsic(prefer_literal=True)
def _number(typing_context: Any, record: Any, name: Any) -> Any:
    """Return the number in the field ``name`` of a record."""
    field = record.field(name.literal_value)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        if field.kind == types.boolean:
            word = _word(context, builder, arguments[0], field.place, types.int64)
            return builder.icmp_signed("!=", word, context.get_constant(types.int64, 0))
        return _word(context, builder, arguments[0], field.place, field.kind)

    return field.kind(record, name), generate


@intrinsic(prefer_literal=True)
def _address(typing_context: Any, record: Any, name: Any) -> Any:
    """Return the address of the array in the field ``name`` of a record, for ``numba.carray``."""
    field = record.field(name.literal_value)
    kind = types.CPointer(field.kind.dtype)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        word = _word(context, builder, arguments[0], field.place, types.int64)
        return builder.inttoptr(word, context.get_value_type(kind))

    return kind(record, name), generate


@intrinsic(prefer_literal=True)
def _shape(typing_context: Any, record: Any, name: Any) -> Any:
    """Return the shape of the array in the field ``name`` of a record."""
    field = record.field(name.literal_value)
    kind = types.UniTuple(types.int64, field.kind.ndim)

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        places = range(field.place + 1, field.place + 1 + field.kind.ndim)
        lengths = [_word(context, builder, arguments[0], place, types.int64) for place in places]
        return context.make_tuple(builder, kind, lengths)

    return kind(record, name), generate


@cache
def _declare(name: str) -> None:
    """Let compiled code read the field ``name`` of records."""

    @overload_attribute(RecordType, name)
    def read(record):  # type: ignore[no-untyped-def]
        field = record.field(name)
        if field is None:
            return None
        if isinstance(field.kind, RecordType):
            return lambda record: _nested(record, name)
        if isinstance(field.kind, types.Array):
            return lambda record: numba.carray(_address(record, name), _shape(record, name))
        return lambda record: _number(record, name)


@intrinsic
def _part(typing_context: Any, parts: Any, c: Any) -> Any:
    """Return record ``c`` of those that lie one after another."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        size = context.get_constant(types.int64, WORD * parts.length)
        return builder.gep(arguments[0], [builder.mul(arguments[1], size)], inbounds=True)

    return parts(parts, types.int64), generate


@overload(operator.getitem)
def _select(parts, c):  # type: ignore[no-untyped-def]
    if isinstance(parts, RecordType) and isinstance(c, types.Integer):
        return lambda parts, c: _part(parts, c)
    return None
