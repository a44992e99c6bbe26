"""Compiled solution of small linear systems.

Numba's ``np.linalg.solve`` takes 4 s to compile: it copies, checks and words its errors by functions for all kinds of
arrays. The systems of ``tangent_kernels`` have eight unknowns for each closed site.
"""

import numpy as np

from vipetsc.compiled import kernel


@kernel
def solve_in_place(matrix: np.ndarray, right: np.ndarray) -> None:
    """Solve ``matrix`` (row, unknown) times x = ``right`` (row, column) for x, which replaces ``right``.

    Gaussian elimination with partial pivoting (Golub and Van Loan, Matrix Computations, 4th ed., sec. 3.4). The
    ``matrix`` is overwritten; of a singular one the result is not finite.
    """
    size = matrix.shape[0]
    for k in range(size):
        pivot = k
        for i in range(k + 1, size):
            if abs(matrix[i, k]) > abs(matrix[pivot, k]):
                pivot = i
        if pivot != k:
            _swap(matrix[k], matrix[pivot])
            _swap(right[k], right[pivot])

        for i in range(k + 1, size):
            factor = matrix[i, k] / matrix[k, k]
            _subtract_multiple(matrix[i, k:], matrix[k, k:], factor)
            _subtract_multiple(right[i], right[k], factor)

    for k in range(size - 1, -1, -1):
        for i in range(k + 1, size):
            _subtract_multiple(right[k], right[i], matrix[k, i])
        for j in range(right.shape[1]):
            right[k, j] /= matrix[k, k]


@kernel
def _swap(first: np.ndarray, second: np.ndarray) -> None:
    """Exchange the numbers of two rows."""
    for j in range(first.size):
        number = first[j]
        first[j] = second[j]
        second[j] = number


@kernel
def _subtract_multiple(row: np.ndarray, other: np.ndarray, factor: float) -> None:
    """Subtract a multiple of the ``other`` row from a ``row``."""
    for j in range(row.size):
        row[j] -= factor * other[j]
