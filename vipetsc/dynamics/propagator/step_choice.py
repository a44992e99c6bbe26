"""The length of a linear step, and which lattices such steps do not suit: decided before any kernel is loaded.

The step H is a sample interval over a whole number: long, because a step costs the same whatever its length, but not so
long that many sites feel one another within it. Nonlinear springs act in every step: where they are so many that ``ts``
costs less, linear steps are refused.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from vipetsc.case import Model
from vipetsc.dynamics.propagator.groups import group_dofs, spans_cells
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.lattice import NO_SITES, Chain, ToneBurst, nonlinear_springs
from vipetsc.wording import counted

# The terms (omega H)^k / k! grow before they fall, to 5.5 at this omega H, and their rounding with them.
LARGEST_OMEGA_H = 3.2
# Steps that a sample interval may be cut into. The shortest that were chosen in the lattices below are a sixth of the
# interval, and an eleventh where samples are so far apart that the series does not allow longer ones.
MOST_PARTS = 16
# Sites of one cluster beyond which plain time stepping costs less.
MOST_SITES = 32
# Rough costs in us that decide the step's length. Each of the first three halved or doubled leaves the length as it is
# in every example case (the longest that the series allows) and in 76 of 80 lattices of 300 or 3000 cells with 6 or 20
# sites, 1 to 8 cells apart. In the other four the chosen steps cost at most 1.44 times as much as the best ones if one
# of the numbers is wrong by a factor of two.
STEP_COST = 20.0  # of a step
CELL_COST = 0.03  # of a cell in a step
SITE_COST = 10.0  # of a sample's contacts, for each site of a cluster
# What springs cost over a step of the lattice decides whether ``ts`` is chosen. For 1 to 24 springs, far apart and side
# by side, in 150 cells on a busy machine, runs took 66 us a step (24.5 by the costs above), 6.4 us more for each spring
# and 0.5 us for each pair. Over a step a spring thus costs 0.10 (0.12 by these numbers) and a pair 0.008 (0.033): for
# many springs side by side these numbers choose ``ts`` somewhat early.
SPRING_COST = 3.0  # of a nonlinear spring in a step
PAIR_COST = 0.8  # of a nonlinear spring in a step for each one that it feels, itself among them
# Cost of ``ts``, as fitted to the paper's lattices on one core: seconds of an accepted step of 8vr and of a mass in it,
# and radians of the top band in a step.
TS_STEP = 3.7e-5
TS_MASS = 1.3e-7
RESOLVED = 0.37
# The series of a step is cut off at this fraction of the run's relative tolerance: the errors of 10^4 steps then add up
# to the tolerance at most. Below the second number the rounding of a step is as large.
SERIES_TOLERANCE = 1e-4
LEAST_TOLERANCE = 1e-15


@lru_cache(maxsize=4)
def step_series(model: Model) -> StepSeries | None:
    """Return the step that divides the sample interval and fits the lattice at the least cost; None if there is none.

    Long steps are few, but sites that feel one another within a step must be followed together.
    """
    fastest = _fastest_burst(model)

    best = None
    least = np.inf
    for parts in range(1, MOST_PARTS + 1):
        # The cost of the steps alone grows from here on.
        cost = parts * (STEP_COST + CELL_COST * model.chain.cells)
        if cost >= least:
            break
        series = _series(model, parts)
        if max(series.omega_max_h, fastest * series.interval) > LARGEST_OMEGA_H:
            continue
        if model.chain.cells < series.width:
            # Forces reach least far in the shortest step: where that one does not suit, no other need be looked at.
            if model.chain.cells < _series(model, MOST_PARTS).width:
                return None
            continue

        # Every DoF of a cluster is moved by every other one: the mean size of a DoF's cluster.
        sizes = np.diff(group_dofs(model, series.reach).first)
        cost += SITE_COST * float((sizes**2).sum() / sizes.sum())
        cost += parts * spring_cost(model.chain, series.reach)
        if cost < least:
            best = series
            least = cost
    return best


def _fastest_burst(model: Model) -> float:
    """Return the highest frequency in rad/s of the tone bursts of ``model``; 0 without one."""
    return max((drive.waveform.highest for drive in model.drives if isinstance(drive.waveform, ToneBurst)), default=0.0)


def _series(model: Model, parts: int) -> StepSeries:
    """Return the series over a step of a sample interval over ``parts``, in which springs are linear."""
    # Free motion knows no contacts: members of a sweep that differ in these have one series, and compute it once.
    chain = replace(model.chain.linearised(), sites=NO_SITES)
    return _kept_series(
        chain,
        interval=model.sample_interval / parts,
        tolerance=max(SERIES_TOLERANCE * model.rtol, LEAST_TOLERANCE),
        spans_cells=spans_cells(model.chain),
    )


@lru_cache(maxsize=8)
def _kept_series(chain: Chain, interval: float, tolerance: float, spans_cells: bool) -> StepSeries:
    """Return the series with these values; a series keeps what it computes."""
    return StepSeries(chain=chain, interval=interval, tolerance=tolerance, spans_cells=spans_cells)


def _no_step(model: Model) -> str:
    """Return why not even the shortest step suits ``model``: too few cells for its band, or too fast waves."""
    series = _series(model, MOST_PARTS)
    step = f"a step of {series.interval:.3g} s, time.sample_interval over {MOST_PARTS},"
    fastest = max(series.omega_max_h / series.interval, _fastest_burst(model))
    # Asked first: the width of a series that is far too long overflows.
    if fastest * series.interval > LARGEST_OMEGA_H:
        return f"{step} is too long for {fastest:.5g} rad/s, of the drive or the lattice"
    return f"the lattice has {counted(model.chain.cells, 'cell')}, fewer than the {series.width} that {step} couples"


def refusal(model: Model) -> str | None:
    """Return why linear steps do not suit ``model``: too few cells, too many close sites or nonlinear springs."""
    # The cheapest springs in the longest step: where all springs are nonlinear, no step need be looked for.
    crowd = _too_many_springs(model, 1, LARGEST_OMEGA_H)
    if crowd is not None:
        return crowd
    series = step_series(model)
    if series is None:
        return _no_step(model)
    crowd = _too_many_springs(model, series.reach, series.omega_max_h)
    if crowd is not None:
        return crowd

    groups = group_dofs(model, series.reach)
    is_site = (groups.numbers >= 0) & (groups.numbers < len(model.chain.sites))
    counts = groups.counts(is_site)
    largest = int(counts.argmax())
    if counts[largest] <= MOST_SITES:
        return None
    numbers = groups.numbers[groups.first[largest] :][: counts[largest]]
    cells = sorted(model.chain.sites.cells[numbers] + 1)
    return (
        f"{len(cells)} sites between cells {cells[0]} and {cells[-1]} lie within {series.reach} cells of one"
        f" another (at most {MOST_SITES} may)"
    )


def spring_cost(chain: Chain, reach: int) -> float:
    """Return the cost in us of the nonlinear springs of ``chain`` in a step in which forces reach so many cells."""
    cells = np.sort(nonlinear_springs(chain).cell)
    near = np.searchsorted(cells, cells + reach, "right") - np.searchsorted(cells, cells - reach, "left")
    return SPRING_COST * len(cells) + PAIR_COST * float(near.sum())


def step_seconds(masses: int) -> float:
    """Return CPU time in s of a step of ``ts`` in which so many ``masses`` move."""
    return TS_STEP + TS_MASS * masses


def _too_many_springs(model: Model, reach: int, radians: float) -> str | None:
    """Return why the nonlinear springs of ``model`` make steps of so many ``radians`` dearer than ``ts``, or None."""
    chain = model.chain
    count = len(nonlinear_springs(chain).cell)
    if not count:
        return None
    linear = STEP_COST + CELL_COST * chain.cells
    plain = 1e6 * step_seconds(chain.cells * chain.cell.dofs) * radians / RESOLVED
    ratio = (linear + spring_cost(chain, reach)) / plain
    if ratio <= 1.0:
        return None
    return f"the forces of {count} nonlinear springs in every step would cost {ratio:.2g} times as much as ts"
