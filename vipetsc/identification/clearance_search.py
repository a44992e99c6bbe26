"""Search for contacts that the model lacks or has too many, by other values of the clearances.

No derivative leads from a stop that is not met to one that is, nor out of a contact that the lattice did not have: the
misfit does not depend on a clearance beyond the motion, and has a valley of its own on either side of it. Clearances
are therefore tried one by one at some fractions of the largest motion without their stop.
"""

from collections.abc import Sequence

import numpy as np

from vipetsc.case import CaseError
from vipetsc.case.identify import IdentifyCase
from vipetsc.case.sought import SoughtParameter, differs_by_side
from vipetsc.identification.misfit import Misfit
from vipetsc.identification.motion import MotionError
from vipetsc.identification.precision import EXACT, Tolerances

# Clearances that are tried, over the motion without the stop: out of reach, where the lattice may not have touched,
# just within it, where derivatives begin, and further in.
OF_REACH = (1.02, 0.98, 0.8, 0.6, 0.4)
# Sides, 0 of w > 0, on which a clearance has its stops.
SIDES = {"clearance": [0], "clearance_minus": [1]}


def reached_by(misfit: Misfit, z: np.ndarray, ends: Sequence[float], tolerances: Tolerances = EXACT) -> np.ndarray:
    """The largest w and -w (site, 2) in m of any record in the model up to ``ends``; NaN where a stop is met.

    ``z`` (coordinate,) are the model's coordinates, ``ends`` (record,) times of the records' clocks in s.
    """
    largest = np.zeros((len(misfit.plan.base.model().chain.sites), 2))
    for number, (table, end) in enumerate(zip(misfit.plan.options.records, ends, strict=True)):
        if table.contact and (misfit.records[number].times <= end).any():
            response = misfit.alone(z, number, end, tolerances)
            largest = np.maximum(largest, response.reached)
            touched = response.episodes["site"], (response.episodes["side"] < 0).astype(int)
            largest[touched] = np.nan
    return largest


def largest_towards(plan: IdentifyCase, parameter: SoughtParameter, reached: np.ndarray) -> float:
    """The largest motion in m towards the stops of a clearance if none of them is met, else NaN.

    ``reached`` (site, 2) is that of ``reached_by``. The result is NaN for other parameters than clearances.
    """
    if parameter.quantity not in SIDES:
        return np.nan
    base = plan.base
    gaps = np.array(base.model().gaps or [(gap, gap) for gap in base.model().chain.clearances])
    sides = SIDES[parameter.quantity]
    if parameter.quantity == "clearance" and not differs_by_side(base):
        sides = [0, 1]  # one clearance for both

    # A site with a stop on one side has an infinite gap on the other. One stop that is met makes the result NaN.
    towards = [reached[i, side] for i in parameter.members for side in sides if np.isfinite(gaps[i, side])]
    return float(np.max(towards, initial=0.0))


def other_contacts(
    misfit: Misfit, z: np.ndarray, ends: Sequence[float], highest: np.ndarray, tolerances: Tolerances = EXACT
) -> np.ndarray | None:
    """Coordinates with a clearance within the motion or out of its reach, if that lowers the misfit; else None.

    The search begins at ``z`` (coordinate,), with windows up to ``ends`` (record,) in s; ``highest`` (coordinate,) are
    the upper bounds.
    """
    best = None
    least = misfit.cost(z, ends, tolerances)
    for number, parameter in enumerate(misfit.plan.parameters):
        if parameter.quantity not in SIDES:
            continue
        free = z.copy()
        free[number] = highest[number]
        for moved in _clearances_tried(misfit, z, free, number, ends, tolerances):
            cost = misfit.cost(moved, ends, tolerances)
            if cost < least:
                best = moved
                least = cost
        # The next clearance is tried together with what has lowered the misfit so far.
        if best is not None:
            z = best
    return best


def _clearances_tried(
    misfit: Misfit, z: np.ndarray, free: np.ndarray, number: int, ends: Sequence[float], tolerances: Tolerances
) -> list[np.ndarray]:
    """The coordinates ``z`` with other values of the clearance ``number``, by the motion at ``free``, without stops."""
    parameter = misfit.plan.parameters[number]
    try:
        reached = reached_by(misfit, free, ends, tolerances)
    except (CaseError, MotionError):
        return []

    # NaN for a stop that is met even at its upper bound: how far the motion without it would go is unknown, and no
    # comparison holds.
    beyond = largest_towards(misfit.plan, parameter, reached)
    tried = []
    for fraction in OF_REACH:
        if parameter.low <= fraction * beyond <= parameter.high:
            moved = z.copy()
            moved[number] = parameter.to_coordinate(fraction * beyond)
            tried.append(moved)
    return tried
