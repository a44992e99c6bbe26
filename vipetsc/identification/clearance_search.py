"""Search, by other values of the clearances, for contacts that the model lacks or should not have.

The misfit does not depend on a clearance that is larger than the motion, and its valley of values without contact is
apart from those of values with contact: no derivative leads from one to the other. Clearances are therefore tried one
by one at some fractions of the largest motion without their stop.
"""

from collections.abc import Sequence

import numpy as np

from vipetsc.case import CaseError
from vipetsc.case.identify import IdentifyCase
from vipetsc.case.sought import SoughtParameter, differs_by_side
from vipetsc.identification.misfit import Misfit
from vipetsc.identification.motion import MotionError

# Clearances that are tried, over the largest motion without the stop. The first is out of reach, so that nothing
# touches. At the second the first impact grazes. The others are further in: a fit that begins at a graze may not reach
# a valley there.
OF_REACH = (1.02, 0.98, 0.8, 0.6, 0.4)
# A contact that lowers the sum of squares over the noise by less than this is not needed: one datum's worth of noise.
NEEDED = 1.0
# Sides on which a clearance has its stops: 0 is that of w > 0, 1 that of w < 0.
SIDES = {"clearance": [0], "clearance_minus": [1]}


def reached_by(misfit: Misfit, z: np.ndarray, ends: Sequence[float]) -> np.ndarray:
    """The largest w and -w (site, 2) in m of any record in the model up to ``ends``; NaN where a stop is met.

    ``z`` (coordinate,) are the model's coordinates, ``ends`` (record,) times of the records' clocks in s. Raises
    CaseError, MotionError.
    """
    largest = np.zeros((len(misfit.plan.base.model().chain.sites), 2))
    for number, (table, end) in enumerate(zip(misfit.plan.options.records, ends, strict=True)):
        if table.contact and (misfit.records[number].times <= end).any():
            response = misfit.motion(z, number, end)
            largest = np.maximum(largest, response.reached)
            sides = (response.side < 0).astype(int)
            # It stays NaN, whatever later records reach: the maximum of NaN and a number is NaN.
            largest[response.site, sides] = np.nan
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

    # A site with a stop on one side has an infinite gap on the other. The largest of values with a NaN is NaN: one stop
    # that is met is enough.
    towards = [reached[i, side] for i in parameter.members for side in sides if np.isfinite(gaps[i, side])]
    return float(np.max(towards, initial=0.0))


def motion_without(misfit: Misfit, z: np.ndarray, number: int, ends: Sequence[float], highest: np.ndarray) -> float:
    """The largest motion in m towards the stops of a clearance, where the record does not need them; else NaN.

    The record is explained as well with the clearance ``number`` at its upper bound in ``highest`` (coordinate,) as at
    ``z`` (coordinate,), where a contact may just graze. The result is NaN for other parameters than clearances.
    """
    parameter = misfit.plan.parameters[number]
    if parameter.quantity not in SIDES:
        return np.nan
    free = z.copy()
    free[number] = highest[number]
    if misfit.cost(free, ends) > misfit.cost(z, ends) + NEEDED:
        return np.nan
    return largest_towards(misfit.plan, parameter, reached_by(misfit, free, ends))


def other_contacts(misfit: Misfit, z: np.ndarray, ends: Sequence[float], highest: np.ndarray) -> np.ndarray | None:
    """The coordinates (coordinate,) with those clearances, of the ones tried, that lower the misfit; None if none does.

    The search begins at ``z`` (coordinate,), with windows up to ``ends`` (record,) in s; ``highest`` (coordinate,) are
    the upper bounds.
    """
    best = None
    least = misfit.cost(z, ends)
    for number, parameter in enumerate(misfit.plan.parameters):
        if parameter.quantity not in SIDES:
            continue
        # As far away as it may be: the motion without this stop.
        free = z.copy()
        free[number] = highest[number]
        for moved in _clearances_tried(misfit, z, free, number, ends):
            cost = misfit.cost(moved, ends)
            if cost < least:
                best = moved
                least = cost
        # The next clearance is tried together with what has lowered the misfit so far.
        if best is not None:
            z = best
    return best


def _clearances_tried(
    misfit: Misfit, z: np.ndarray, free: np.ndarray, number: int, ends: Sequence[float]
) -> list[np.ndarray]:
    """The coordinates ``z`` (coordinate,) with other values of the clearance ``number``, a list of arrays.

    The values are fractions of the motion at ``free`` (coordinate,), where the clearance is at its upper bound.
    """
    parameter = misfit.plan.parameters[number]
    # A case or a motion that is impossible without this stop says nothing of other clearances.
    try:
        reached = reached_by(misfit, free, ends)
    except (CaseError, MotionError):
        return []

    # A stop that is met even at its upper bound has NaN: how far the motion without it would go is unknown. Comparisons
    # with NaN are false, and nothing is tried.
    beyond = largest_towards(misfit.plan, parameter, reached)
    tried = []
    for fraction in OF_REACH:
        if parameter.low <= fraction * beyond <= parameter.high:
            moved = z.copy()
            moved[number] = parameter.to_coordinate(fraction * beyond)
            tried.append(moved)
    return tried
