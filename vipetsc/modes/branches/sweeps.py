"""Slow sweeps of the parameter along a curve of steady states, with their jumps between stable states."""

from typing import NamedTuple

import numpy as np

from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.response.state import Response
from vipetsc.spectra.responses import LAYOUT, OUTPUTS, Stored


class ParameterSweep(NamedTuple):
    """States of a curve in order: the ``parameter``, which the sweep lets grow, a ``size``, and the ``stable`` ones.

    Of several stable states with one parameter the sweep jumps to that whose size is nearest.
    """

    parameter: np.ndarray
    size: np.ndarray
    stable: np.ndarray


def with_stable_folds(stable: np.ndarray, fold: np.ndarray) -> np.ndarray:
    """Return mask (state,) of the states that a sweep reaches: the ``stable`` ones and folds with a stable neighbour.

    ``stable`` and ``fold`` (state,) mark the states of a curve, in its order.
    """
    neighbour = np.append(stable[1:], False) | np.insert(stable[:-1], 0, False)
    return stable | (fold & neighbour)


def swept(sweep: ParameterSweep, start: int | None = None) -> list[int]:
    """Return numbers of the states that a slow sweep passes from ``start``, else from the first stable state.

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
    """Return stable neighbours of state ``i`` on the curve with a larger parameter."""
    # On a branch beyond a fold the parameter grows towards the state before: both neighbours count.
    p = sweep.parameter
    ahead = []
    for j in (i - 1, i + 1):
        if 0 <= j < len(p) and j not in passed and p[j] > p[i] and sweep.stable[j]:
            ahead.append(j)
    return ahead


def _states_across(sweep: ParameterSweep, i: int, passed: set[int]) -> list[int]:
    """Return the states to which a sweep may jump from state ``i``: ends of stable steps that pass its parameter."""
    # A step between a stable and an unstable state leaves open where on it stability ends.
    p = sweep.parameter
    ahead = []
    for j in range(len(p) - 1):
        low, high = sorted((j, j + 1), key=p.__getitem__)
        passes = p[low] <= p[i] < p[high]
        if passes and sweep.stable[low] and sweep.stable[high] and not {low, high} & passed:
            ahead.append(high)
    return ahead


def outputs_of(branch: Branch[Response]) -> dict[str, Stored]:
    """Return the outputs that the states of a curve have."""
    if not branch.points:
        return {}
    present = branch.points[0].measured.outputs
    return {name: stored for name, stored in OUTPUTS.items() if name in present}


def measure(branch: Branch[Response], stored: str) -> np.ndarray:
    """Return a measure or an output (state, ...) of every state, by its name in the file."""
    if stored in OUTPUTS:
        return np.array([p.measured.outputs[stored] for p in branch.points])
    if stored == "harmonics":
        return np.array([p.measured.harmonics.real for p in branch.points])
    if stored == "harmonics_imaginary":
        return np.array([p.measured.harmonics.imag for p in branch.points])
    if stored == "share":
        return np.array([p.measured.fractions for p in branch.points])
    return np.array([getattr(p.measured, stored) for p in branch.points])


def parameter_values(branch: Branch[Response]) -> np.ndarray:
    """Return the value (point,) of the parameter that varies along a curve."""
    over = str(branch.about["over"])
    if over in LAYOUT:
        return measure(branch, over)
    return measure(branch, "parameter")  # a key of the case


def sweep_up(branch: Branch[Response]) -> list[int]:
    """Return states that a slow growth of the parameter passes, from the first stable one."""
    return swept(_sweep(branch, 1))


def sweep_down(branch: Branch[Response]) -> list[int]:
    """Return states that a slow fall of the parameter passes, from the last of the sweep up."""
    passed = sweep_up(branch)
    if not passed:
        return []
    return swept(_sweep(branch, -1), passed[-1])


def _sweep(branch: Branch[Response], sign: int) -> ParameterSweep:
    """Return the states of a curve for a sweep up (``sign`` 1) or down (-1)."""
    # With the sign a sweep down is one up as well; -1 unstable perturbations mean that stability is undecided.
    stable = measure(branch, "unstable") == 0
    fold = branch.is_kind("fold")
    parameter = sign * parameter_values(branch)
    # The first contact stands for the state; without contacts the first spring that is not linear. A linear lattice has
    # one state at each value of the parameter.
    size = np.zeros(len(parameter))
    if branch.dofs:
        size = measure(branch, "largest")[:, 0]
    elif "largest_elongation" in outputs_of(branch):
        size = measure(branch, "largest_elongation")[:, 0]
    return ParameterSweep(parameter, size=size, stable=with_stable_folds(stable, fold))
