"""Named tuples in compiled code: they are passed by address, and assignments to variables act as in Python."""

import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest

from vipetsc.kernel import EntryCompiler, Kernel

# The decorator of ``vipetsc.compiled`` keeps kernels of the package alone, hence tests have their own.
entry = numba.njit(error_model="numpy", pipeline_class=EntryCompiler)


def kernel(function: Callable[..., Any], disjoint: bool = False) -> Kernel:
    """Return the kernel of a ``function``."""
    return Kernel(function, entry, {"error_model": "numpy"}, disjoint)


class Inner(NamedTuple):
    numbers: np.ndarray
    scale: float


class Outer(NamedTuple):
    inner: Inner
    counts: np.ndarray
    name: int


# Only the package's own tuples are passed by address.
Inner.__module__ = Outer.__module__ = "vipetsc"


def outer(value: float, name: int) -> Outer:
    """Return a tuple whose numbers are ``value`` and its double."""
    return Outer(inner=Inner(np.array([value, 2.0 * value]), scale=value), counts=np.zeros(1, np.int64), name=name)


@kernel
def weigh(record: Outer, weight: float) -> float:
    """Return a number that depends on every field of ``record``, and count the call in it."""
    record.counts[0] += 1
    return weight * record.inner.scale * record.inner.numbers[1] + record.name


@kernel
def weigh_inner(inner: Inner) -> float:
    return inner.scale + inner.numbers[0]


@entry
def scaled(record: Outer, factor: float) -> Outer:
    """Return a new tuple with scaled numbers, which has the array of counts of ``record``."""
    return Outer(Inner(record.inner.numbers * factor, record.inner.scale), record.counts, record.name + 1)


def replace_in_loop(first: Outer, second: Outer) -> tuple[float, float]:
    """Exchange two variables that are tuples in a loop, while other variables keep their earlier values and fields."""
    current = first
    other = second
    total = 0.0
    kept = 0.0
    for i in range(5):
        before = current
        inner = current.inner
        current = other
        other = before
        # The terms use the earlier tuple, its field, and the present tuple.
        total += 100.0 * weigh(before, 1.0 + i) + 10.0 * weigh_inner(inner) + weigh(current, 2.0)
        kept = kept * 3.0 + inner.scale + before.name
    return total, kept


replace = entry(replace_in_loop)
replace_without_references = numba.njit(error_model="numpy", _nrt=False, pipeline_class=EntryCompiler)(replace_in_loop)


@entry
def replace_argument(record: Outer, times: int) -> float:
    """Assign new tuples to an argument."""
    total = 0.0
    for _ in range(times):
        total = 10.0 * total + weigh(record, 1.0)
        record = scaled(record, 3.0)
    return total + record.inner.numbers[0]


@entry
def choose(first: Outer, second: Outer, takes_first: bool) -> float:
    """Use fields of a tuple that a condition chooses, and that tuple as an argument."""
    inner = (first if takes_first else second).inner
    if takes_first:
        late = second.inner
    total = weigh(first if takes_first else second, 2.0) + 10.0 * (first.inner if takes_first else second.inner).scale
    if takes_first:
        total += 100.0 * late.numbers[1]
    return total + weigh_inner(inner)


@entry
def give_back(record: Outer) -> Inner:
    """Return a field of an argument, to which both refer afterwards."""
    part = record.inner
    same = part
    return same


@pytest.mark.parametrize(
    ("function", "arguments"),
    [(replace, ()), (replace_without_references, ()), (replace_argument, (4,)), (choose, (True,)), (choose, (False,))],
)
def test_values_are_those_of_python(function, arguments):
    """The compiled function has the results of Python: its values, and the counts in the tuples' arrays."""
    results = []
    for call in (function, function.py_func):
        records = [outer(3.0, 5)]
        if function is not replace_argument:
            records.append(outer(0.25, 7))
        values = call(*records, *arguments)
        results.append((values, [int(record.counts[0]) for record in records]))
    assert results[0] == results[1]


def test_a_part_of_an_argument_can_be_given_back():
    record = outer(3.0, 5)
    part = give_back(record)
    assert part.numbers is record.inner.numbers
    del record
    assert part.numbers.tolist() == [3.0, 6.0]


def arguments_of(function: Kernel) -> list[str]:
    """Return LLVM's declarations of a kernel's arguments, without the first two, numba's result and error."""
    (compiled,) = function.overloads.values()
    declared = str(compiled.library._final_module.get_function(compiled.fndesc.llvm_func_name))
    (definition,) = [line for line in declared.splitlines() if line.startswith("define")]
    return re.split(r", (?=ptr|i64|double)", definition)[2:]


def test_a_tuple_of_arrays_is_one_argument():
    """A kernel takes a tuple as one pointer, whereas numba passes seven numbers for an array by itself."""
    replace_argument(outer(3.0, 5), 1)
    record, weight = arguments_of(weigh)
    assert record.startswith("ptr noalias")
    assert weight.startswith("double")


def add_product(out: np.ndarray, x: np.ndarray, factors: np.ndarray) -> None:
    """Add products to eight sums, each in the order of the factors."""
    for k in range(factors.size):
        for i in range(8):
            out[i] += factors[k] * x[i]


add_apart = kernel(add_product, disjoint=True)


@entry
def call_add_apart(out: np.ndarray, x: np.ndarray, factors: np.ndarray) -> None:
    add_apart(out, x, factors)


def test_disjoint_arrays_are_marked_so():
    """A kernel with disjoint arrays has them declared ``noalias``, and its sums have the bits of Python's."""
    x = np.sqrt(np.arange(8.0))
    factors = np.cbrt(np.arange(1.0, 6.0))
    sums = np.linspace(0.0, 1.0, 8)
    expected = sums.copy()
    call_add_apart(sums, x, factors)
    add_product(expected, x, factors)
    assert sums.tobytes() == expected.tobytes()

    addresses = [argument for argument in arguments_of(add_apart) if argument.startswith("ptr")]
    assert len(addresses) == 9
    assert all("noalias" in address for address in addresses)
