"""Files of branches of periodic orbits by shooting."""

from typing import Any

import numpy as np
import xarray as xr

from vipetsc.io.netcdf import Variables, variable
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.layout import Table, loss_columns, orbit_attributes, orbit_variables, quantities
from vipetsc.modes.branches.regions import regions
from vipetsc.modes.point import Point


class OrbitLayout:
    """Initial values, tangents and half-traces of orbits."""

    noun = "branch"
    needs = ("point", "tangent", "half_trace", "next_step")

    def variables(self, branch: Branch[Point]) -> Variables:
        """Variables of a branch's file."""
        count = len(branch.points)
        n = branch.dofs
        pairs = _pairs(branch)
        x = branch.column("x").reshape(count, n)
        tangent = branch.column("tangent").astype(float).reshape(count, n + 1)
        traces = branch.column("half_traces").astype(complex).reshape(count, pairs)

        at_rest = "initial displacement (velocity in m/s for maps from the centre)"
        return orbit_variables(branch) | {
            "dof": variable("dof", np.arange(1, n + 1), "1", "degree of freedom, from 1"),
            "pair": variable("pair", np.arange(1, pairs + 1), "1", "pair of multipliers, without the trivial one"),
            "initial": variable(("point", "dof"), x, "m", at_rest),
            "tangent": variable(("point", "dof"), tangent[:, :-1], "m", "tangent of the branch: initial values"),
            "tangent_period": variable("point", tangent[:, -1], "s", "tangent of the branch: period"),
            "half_trace": variable(("point", "pair"), traces.real, "1", "Floquet half-trace, real part"),
            "half_trace_imaginary": variable(("point", "pair"), traces.imag, "1", "Floquet half-trace, imaginary part"),
        }

    def attributes(self, branch: Branch[Point]) -> dict[str, Any]:
        """Attributes of a branch's file that follow from its points."""
        return orbit_attributes(branch)

    def table(self, branch: Branch[Point]) -> Table:
        """The table of a branch for CSV, with numbers in full precision."""
        traces = [f"half_trace_{i + 1}" for i in range(_pairs(branch))]
        if branch.dofs == 2:
            traces = ["half_trace"]
        names = ["energy", "frequency", "period", *(f"x{i + 1}" for i in range(branch.dofs)), *traces]
        losses = loss_columns(branch)
        names += ["multiplier_max", "slope", *losses, "contacts", "region", "kind"]
        rows = []
        for p, region in zip(branch.points, regions(branch), strict=True):
            numbers = [p.energy, p.frequency, p.period, *p.x.tolist(), *p.half_traces.tolist(), p.multiplier, p.slope]
            numbers += [getattr(p, name) for name in losses]
            rows.append([*map(repr, numbers), str(p.episodes), str(region), p.kind])
        return Table(names, rows)

    def points(self, data: xr.Dataset) -> list[Point]:
        """The points of a file."""
        traces = data["half_trace"].values + 1j * data["half_trace_imaginary"].values
        tangents = np.column_stack([data["tangent"].values, data["tangent_period"].values])
        points = []
        for fields, x, tangent, c in zip(quantities(data), data["initial"].values, tangents, traces, strict=True):
            # Half-traces are real but where two pairs have met: their array keeps its type through a file.
            if not np.any(c.imag != 0):
                c = c.real
            points.append(Point(**fields, x=x, tangent=tangent, half_traces=c))
        return points

    def dofs(self, data: xr.Dataset) -> int:
        """Number of displacements of the orbits in a file."""
        return int(data.sizes["dof"])


def _pairs(branch: Branch[Point]) -> int:
    """Number of half-traces of an orbit; a whole lattice's orbit has none."""
    if not branch.points:
        return branch.dofs - 1
    return len(branch.points[0].half_traces)
