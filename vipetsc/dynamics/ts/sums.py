"""PETSc's VecMAXPY, y += sum of a_j x_j, as TSRK adds its stages, compiled so that y is read and written once.

The order of additions is that of PETSc's own, which passes over y for every four vectors: the results have the same
bits. Factors that are zero, a third of those of 8vr, are left out.
"""

import ctypes
from functools import cache
from typing import Any

from petsc4py import PETSc

import numpy as np

from vipetsc.compiled import cfunc, kernel
from vipetsc.dynamics import native
from vipetsc.dynamics.native import array_at
from vipetsc.dynamics.petsc_library import petsc_library

# PETSc's number of the operation, in the order of its _VecOps.
MAXPY = 14
# Components that are summed at once: those of y stay in the processor's first cache while all vectors are added.
CHUNK = 1024


@kernel
def add_products(y: np.ndarray, factors: np.ndarray, addresses: np.ndarray) -> None:
    """Add to ``y`` (n,) the sum of ``factors`` (j,) times the vectors (n,) at ``addresses`` (j or more,)."""
    count = factors.size
    vectors = np.empty(4, np.int64)
    for begin in range(0, y.size, CHUNK):
        part = y[begin : begin + CHUNK]
        size = part.size
        first = 0
        # PETSc takes the vectors by fours, those that are left over first.
        for stop in range((count - 1) % 4 + 1, count + 1, 4):
            used = 0
            for j in range(first, stop):
                if factors[j] != 0.0:
                    vectors[used] = j
                    used += 1
            first = stop
            if used == 0:
                continue

            a = factors[vectors[0]]
            x0 = array_at(addresses[vectors[0]] + 8 * begin, size, np.float64)
            if used == 1:
                for i in range(size):
                    part[i] += 0.0 + a * x0[i]
                continue
            b = factors[vectors[1]]
            x1 = array_at(addresses[vectors[1]] + 8 * begin, size, np.float64)
            if used == 2:
                for i in range(size):
                    part[i] += 0.0 + a * x0[i] + b * x1[i]
                continue
            c = factors[vectors[2]]
            x2 = array_at(addresses[vectors[2]] + 8 * begin, size, np.float64)
            if used == 3:
                for i in range(size):
                    part[i] += 0.0 + a * x0[i] + b * x1[i] + c * x2[i]
                continue
            d = factors[vectors[3]]
            x3 = array_at(addresses[vectors[3]] + 8 * begin, size, np.float64)
            for i in range(size):
                part[i] += 0.0 + a * x0[i] + b * x1[i] + c * x2[i] + d * x3[i]


def _callback(y: int, count: int, factors: int, vectors: int) -> int:
    """Return function that ``_compile`` compiles: adds ``count`` vectors, each times its factor, to the vector ``y``.

    ``y`` is a handle; ``factors`` and ``vectors`` are the addresses of numbers and of handles. Returns PETSc's error
    code.
    """
    handles = array_at(vectors, count, np.int64)
    # Addresses of the vectors, then of y, then the size of y. ``get_write`` gives the array with y's numbers in it, as
    # PETSc does for all vectors in the memory of this process.
    addresses = np.zeros(count + 2, np.int64)
    at = addresses.ctypes.data
    error = native.local_size(y, at + 8 * (count + 1)) or native.get_write(y, at + 8 * count)
    for j in range(count):
        error = error or native.get_read(handles[j], at + 8 * j)
    if error != 0:
        return error

    target = array_at(addresses[count], addresses[count + 1], np.float64)
    add_products(target, array_at(factors, count, np.float64), addresses)

    for j in range(count):
        error = error or native.restore_read(handles[j], at + 8 * j)
    return error or native.restore_write(y, at + 8 * count)


@cache
def _compile() -> Any:
    """Return ``PetscErrorCode f(Vec y, PetscInt count, const PetscScalar *factors, Vec *vectors)``; it lives on."""
    native.bind_symbols()
    return cfunc(f"i4(i8, i{np.dtype(PETSc.IntType).itemsize}, i8, i8)")(_callback)


def register_sums(vector: PETSc.Vec) -> None:
    """Let ``vector``, and those that are duplicated from it, add in one pass, if PETSc's numbering is as expected."""
    if _is_maxpy():
        _set_operation(vector)


def _set_operation(vector: PETSc.Vec) -> None:
    """Let ``vector`` add by the compiled callback."""
    callback = ctypes.c_void_p(_compile().address)
    error = petsc_library().VecSetOperation(ctypes.c_void_p(vector.handle), ctypes.c_int(MAXPY), callback)
    if error:
        raise RuntimeError(f"VecSetOperation failed with PETSc error {error}")


@cache
def _is_maxpy() -> bool:
    """Return whether the operation set is the one that VecMAXPY calls: ours alone leaves out NaN times zero."""
    y, x, zero = (PETSc.Vec().createSeq(1) for _ in range(3))
    _set_operation(y)
    x.set(np.nan)
    y.maxpy([0.0, 1.0], [x, zero])  # with a factor that is not zero, or PETSc calls nothing
    ours = bool(np.isfinite(y.array_r[0]))
    for vector in (y, x, zero):
        vector.destroy()
    return ours
