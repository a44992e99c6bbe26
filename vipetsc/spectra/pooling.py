"""Blocks of an array's rows: as many as fit into memory together, or as many as make one row of a map."""

from collections.abc import Iterator

import numpy as np


def blocks(count: int, size: float, memory: float) -> Iterator[slice]:
    """Return slices of ``count`` items of ``size`` bytes each: one item, or as many as ``memory`` bytes hold."""
    together = int(max(min(memory / size, count), 1))
    return (slice(first, min(first + together, count)) for first in range(0, count, together))


def block_sums(values: np.ndarray, size: int, axis: int) -> np.ndarray:
    """Return sums of each ``size`` consecutive ``values`` along ``axis``, (..., block, ...)."""
    return np.add.reduceat(values, np.arange(0, values.shape[axis], size), axis=axis)


def block_means(values: np.ndarray, size: int, axis: int) -> np.ndarray:
    """Return means of each ``size`` consecutive ``values`` along ``axis``, (..., block, ...)."""
    shape = [1] * values.ndim
    shape[axis] = -1
    counts = block_sums(np.ones(values.shape[axis]), size, 0)
    return block_sums(values, size, axis) / counts.reshape(shape)
