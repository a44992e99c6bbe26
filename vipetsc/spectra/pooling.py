"""Blocks of an array's rows: as many as fit into memory together, or as many as make one row of a map."""

from collections.abc import Iterator

import numpy as np


def blocks(count: int, size: float, memory: float) -> Iterator[slice]:
    """Slices of ``count`` items of ``size`` bytes each: one item, or as many as take ``memory`` bytes at most."""
    together = int(max(min(memory / size, count), 1))
    return (slice(first, min(first + together, count)) for first in range(0, count, together))


def block_sums(values: np.ndarray, size: int, axis: int) -> np.ndarray:
    """Sums of each ``size`` consecutive ``values`` along ``axis``, (..., block, ...); the last may be shorter."""
    return np.add.reduceat(values, np.arange(0, values.shape[axis], size), axis=axis)


def block_means(values: np.ndarray, size: int, axis: int) -> np.ndarray:
    """Means of each ``size`` consecutive ``values`` along ``axis``, (..., block, ...); the last may be shorter."""
    shape = [1] * values.ndim
    shape[axis] = -1
    counts = block_sums(np.ones(values.shape[axis]), size, 0)
    return block_sums(values, size, axis) / counts.reshape(shape)
