"""The length of a linear step, and which lattices such steps do not suit; known before any kernel is loaded.

The step H is a sample interval over a whole number: long, because a step costs the same whatever its length, but not so
long that many sites feel one another within it.
"""

from functools import lru_cache

import numpy as np

from vipetsc.case import Model
from vipetsc.dynamics.propagator.groups import group_dofs
from vipetsc.dynamics.propagator.series import StepSeries
from vipetsc.lattice import ToneBurst

# The terms (omega H)^k / k! grow before they fall, to 5.5 at this omega H, and their rounding with them.
LARGEST_OMEGA_H = 3.2
# Steps a sample interval may be cut into.
MOST_PARTS = 16
# Sites of one cluster beyond which plain time stepping costs less.
MOST_SITES = 32
# Rough costs in us that decide the step's length.
STEP_COST = 20.0  # of a step
CELL_COST = 0.03  # of a cell in a step
SITE_COST = 10.0  # of a sample's contacts, for each site of a cluster
# The series is cut off at this fraction of the run's relative tolerance, or where rounding makes it as large.
SERIES_TOLERANCE = 1e-4
LEAST_TOLERANCE = 1e-15


@lru_cache(maxsize=4)
def step_series(model: Model) -> StepSeries | None:
    """The step that divides the sample interval and fits the lattice at the least cost; None if there is none.

    Long steps are few, but sites that feel one another within a step must be followed together.
    """
    tolerance = max(SERIES_TOLERANCE * model.rtol, LEAST_TOLERANCE)
    bursts = [drive.waveform.highest for drive in model.drives if isinstance(drive.waveform, ToneBurst)]
    fastest = max(bursts, default=0.0)

    best = None
    least = np.inf
    for parts in range(1, MOST_PARTS + 1):
        # The cost of the steps alone grows from here on.
        cost = parts * (STEP_COST + CELL_COST * model.chain.cells)
        if cost >= least:
            break
        series = StepSeries(model.chain, model.sample_interval / parts, tolerance)
        too_long = max(series.omega_max_h, fastest * series.interval) > LARGEST_OMEGA_H
        if too_long or model.chain.cells < series.width:
            continue

        # Every DoF of a cluster is moved by every other one: the mean size of a DoF's cluster.
        sizes = np.diff(group_dofs(model, series.reach).first)
        cost += SITE_COST * float((sizes**2).sum() / sizes.sum())
        if cost < least:
            best = series
            least = cost
    return best


def _no_step(model: Model) -> str:
    """Why not even the shortest step suits ``model``: too few cells for its band, or waves too fast for its series."""
    tolerance = max(SERIES_TOLERANCE * model.rtol, LEAST_TOLERANCE)
    series = StepSeries(model.chain, model.sample_interval / MOST_PARTS, tolerance)
    step = f"a step of {series.interval:.3g} s, time.sample_interval over {MOST_PARTS},"
    if model.chain.cells < series.width:
        return f"{model.chain.cells} cells are fewer than the {series.width} cells that {step} couples"

    bursts = [drive.waveform.highest for drive in model.drives if isinstance(drive.waveform, ToneBurst)]
    fastest = max([series.omega_max_h / series.interval, *bursts])
    return f"{step} is too long for {fastest:.5g} rad/s, of the drive or the lattice"


def refusal(model: Model) -> str | None:
    """Why linear steps do not suit ``model``: springs that are not linear, too few cells, too many sites close by."""
    if not model.chain.is_linear:
        return "its steps require linear springs, but some springs have a quadratic or cubic part"
    series = step_series(model)
    if series is None:
        return _no_step(model)

    numbers, first = group_dofs(model, series.reach)
    counts = np.add.reduceat(numbers >= 0, first[:-1], dtype=np.int64)
    largest = int(counts.argmax())
    if counts[largest] <= MOST_SITES:
        return None
    cells = sorted(model.chain.sites[i] + 1 for i in numbers[first[largest] :][: counts[largest]])
    return (
        f"{len(cells)} sites between cells {cells[0]} and {cells[-1]} lie within {series.reach} cells of one"
        f" another (at most {MOST_SITES} may)"
    )
