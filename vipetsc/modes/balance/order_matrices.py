"""Matrices of Hill's method, whose rows and columns are orders of perturbations and pairs: G, J and I + G J.

The compliance G (..., order, pair, pair) moves each order by itself; the forces' derivative J (..., order pair, order
pair) has a row and a column for every pair at every order, pairs of one order side by side.
"""

import numpy as np

# Pairs up to which determinants are those of all of them, though no force may act on some (``hill``).
FEW_PAIRS = 3


def of_pairs(g: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """G (..., order, pair, pair) between some of the ``pairs``."""
    if len(pairs) == g.shape[-1]:
        return g
    return g[..., pairs[:, None], pairs]


def flat(jacobian: np.ndarray) -> np.ndarray:
    """J (..., pair, order, order) as a matrix (..., order pair, order pair)."""
    *several, pairs, rows, columns = jacobian.shape
    if pairs == 1:
        return jacobian[..., 0, :, :]
    out = np.zeros((*several, rows, pairs, columns, pairs), jacobian.dtype)
    for i in range(pairs):
        out[..., i, :, i] = jacobian[..., i, :, :]
    return out.reshape(*several, rows * pairs, columns * pairs)


def plus_one(g: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """1 + G J of G (..., order, pair, pair), which is diagonal in the orders, and J (..., order pair, order pair)."""
    out = product_of(g, matrix)
    diagonal = np.arange(out.shape[-1])
    out[..., diagonal, diagonal] += 1.0
    return out


def product_of(g: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """G J of G (..., order, pair, pair), which is diagonal in the orders, and J (..., order pair, columns)."""
    count, pairs = g.shape[-3:-1]
    rows = matrix.reshape(*matrix.shape[:-2], count, pairs, -1)
    # Of one pair each order has one number, for which a product of matrices would take twice as long.
    if pairs == 1:
        product = g * rows
    else:
        product = np.matmul(g, rows)
    return product.reshape(*product.shape[:-3], count * pairs, -1)
