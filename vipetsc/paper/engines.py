"""Comparison of both engines: a sample of a sweep's members simulated by ``ts``, compared with the sweep.

A sweep takes the propagator's exact linear steps unless its case says otherwise, the sample takes Runge-Kutta steps.
Where the motion is not chaotic, the measures of a member differ by the errors of the steps alone.
"""

from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from vipetsc.case import Sweep
from vipetsc.case.reading import put
from vipetsc.io.read import axes, open_ensemble, select
from vipetsc.studies.ensemble import AMPLITUDE
from vipetsc.studies.linear_run import FITTED

COMPARED = {name: 1e-3 for name in FITTED} | {"dissipated_fraction": 1e-3}
"""Measures that are compared, and by how much they may differ (1, bit) where the motion is not chaotic.

Of 20 members of the paper's sweeps the 18 that have the same number of contacts by both engines differ by 2e-6 at most.
The other two, whose numbers differ since their motion is chaotic, differ by 2e-6 and 4e-4: this bound is above both.
"""


def sampled(sweep: Sweep, count: int, seed: int) -> Sweep:
    """Return ``count`` members of ``sweep`` for the engine ``ts``, on as many of its curves over the amplitude.

    Curves are drawn from ``seed``, and of the amplitudes, cut into ``count`` equal parts, one in each: few members go
    from no contact to hard contact. They lie on one axis. Raises ValueError if the amplitude does not vary.
    """
    if not any(AMPLITUDE in axis for axis in sweep.axes):
        raise ValueError(f"{sweep.name}: {AMPLITUDE} does not vary, over which members would be drawn")
    random = np.random.default_rng(seed)
    number = np.arange(np.prod(sweep.shape)).reshape(sweep.shape)
    along = next(i for i, axis in enumerate(sweep.axes) if AMPLITUDE in axis)
    # Rows are the sweep's curves, columns their amplitudes, entries the members' numbers.
    curves = np.moveaxis(number, along, -1).reshape(-1, sweep.shape[along])
    count = min(count, len(curves))
    amplitude = ((np.arange(count) + random.random(count)) * curves.shape[1] / count).astype(int)
    chosen = np.sort(random.permutation(curves)[np.arange(count), amplitude])

    # Every key in one group of ``zip``: the members lie on one axis.
    section = sweep.options.model_dump() | {"fields": False, "zip": [[key for axis in sweep.axes for key in axis]]}
    for axis, indices in zip(sweep.axes, np.unravel_index(chosen, sweep.shape), strict=True):
        for key, values in axis.items():
            put(section, key, [values[i] for i in indices])
    return Sweep.from_table(sweep.table | {"name": f"{sweep.name}-ts", "sweep": section}, ["time.engine=ts"])


def agreement(sweep: Path, sample: Path) -> list[dict[str, Any]]:
    """Return differences of the members of ``sample`` from those of ``sweep`` (folders), the largest amplitude last.

    A row has ``amplitude`` in N, contact ``episodes`` of both (sweep, sample) and whether they are the ``same`` number,
    ``differences`` by measure and the ``largest``, and whether the member ``agrees``: none above that of ``COMPARED``.
    A member that failed in either has no differences and does not agree. Raises OSError, or ValueError.
    """
    all_members = open_ensemble(sweep)
    members = open_ensemble(sample)
    (axis,) = axes(members)
    keys = [str(name) for name, item in members.coords.items() if item.dims == (axis,) and name in all_members.coords]
    rows: list[dict[str, Any]] = []
    for i in range(members.sizes[axis]):
        member = members.isel({axis: i})
        same = select(all_members, **{key: member[key].item() for key in keys})
        rows.append(_compared(same, member))
    return sorted(rows, key=lambda row: row["amplitude"])


def _compared(first: xr.Dataset, second: xr.Dataset) -> dict[str, Any]:
    """Return a row of ``agreement``: one member by both engines."""
    # A member that failed has -1, which is no number of contacts.
    episodes = [int(np.nan_to_num(member["contact_episodes"].item(), nan=-1)) for member in (first, second)]
    differences: dict[str, float] = {}
    for name in COMPARED:
        if name in second:
            difference = abs(second[name].item() - first[name].item())
            if np.isfinite(difference):
                differences[name] = difference
    return {
        "amplitude": second["amplitude"].item(),
        "episodes": episodes,
        "same": episodes[0] == episodes[1],
        "differences": differences,
        "largest": max(differences.values(), default=0.0),
        # Without differences nothing was compared: one of the two has failed.
        "agrees": bool(differences) and all(differences[name] <= COMPARED[name] for name in differences),
    }
