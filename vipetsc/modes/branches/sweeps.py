"""Slow sweeps of the parameter along a curve of steady states, with their jumps between stable states."""

from typing import NamedTuple

import numpy as np


class ParameterSweep(NamedTuple):
    """States of a curve in order: the ``parameter``, which the sweep lets grow, a ``size``, and the ``stable`` ones.

    Of several stable states with one parameter the sweep jumps to that whose size is nearest.
    """

    parameter: np.ndarray
    size: np.ndarray
    stable: np.ndarray


def with_stable_folds(stable: np.ndarray, fold: np.ndarray) -> np.ndarray:
    """Mask (state,) of the states that a sweep reaches: the ``stable`` ones and folds with a stable neighbour.

    ``stable`` and ``fold`` (state,) mark the states of a curve, in its order.
    """
    neighbour = np.append(stable[1:], False) | np.insert(stable[:-1], 0, False)
    return stable | (fold & neighbour)


def swept(sweep: ParameterSweep, start: int | None = None) -> list[int]:
    """Numbers of the states that a slow sweep passes from ``start``, else from the first stable state.

    At a fold, or where a state becomes unstable, it jumps to a stable state with the parameter's value; it ends where
    there is none.
    """
    if not sweep.stable.any():
        return []
    if start is None:
        start = int(np.argmin(np.where(sweep.stable, sweep.parameter, np.inf)))
    path = [start]
    passed = {start}
    while True:
        i = path[-1]
        ahead = _neighbours_ahead(sweep, i, passed) or _states_across(sweep, i, passed)
        if not ahead:
            return path
        path.append(min(ahead, key=lambda j: abs(sweep.size[j] - sweep.size[i])))
        passed.add(path[-1])


def _neighbours_ahead(sweep: ParameterSweep, i: int, passed: set[int]) -> list[int]:
    """Stable neighbours of state ``i`` on the curve with a larger parameter."""
    # On a branch beyond a fold the parameter grows towards the state before: both neighbours count.
    p = sweep.parameter
    ahead = []
    for j in (i - 1, i + 1):
        if 0 <= j < len(p) and j not in passed and p[j] > p[i] and sweep.stable[j]:
            ahead.append(j)
    return ahead


def _states_across(sweep: ParameterSweep, i: int, passed: set[int]) -> list[int]:
    """States to which a sweep may jump from state ``i``: ends of stable steps of the curve that pass its parameter."""
    # A step between a stable and an unstable state leaves open where on it stability ends.
    p = sweep.parameter
    ahead = []
    for j in range(len(p) - 1):
        low, high = sorted((j, j + 1), key=p.__getitem__)
        passes = p[low] <= p[i] < p[high]
        if passes and sweep.stable[low] and sweep.stable[high] and not {low, high} & passed:
            ahead.append(high)
    return ahead
