"""Files of branches of condensed motions, by harmonic balance."""

from typing import Any

import numpy as np
import xarray as xr

from vipetsc.io.netcdf import Variables, variable
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.layout import Table, loss_columns, orbit_attributes, orbit_variables, quantities
from vipetsc.modes.branches.regions import regions
from vipetsc.modes.point import Point


class CondensedLayout:
    """Harmonics of the elongations at contacts and springs, and their tangents; ``dofs`` counts these places."""

    noun = "branch"
    needs = ("point", "harmonics", "tangent", "next_step")

    def variables(self, branch: Branch[Point]) -> Variables:
        """Variables of a branch's file: harmonics are zero beyond a point's highest."""
        points = branch.points
        places = branch.dofs
        count = max((len(p.x) // places for p in points), default=0)
        harmonics = np.zeros((len(points), places, count))
        tangent = np.zeros((len(points), places, count))
        tangent_period = np.full(len(points), np.nan)
        for i, p in enumerate(points):
            width = len(p.x) // places
            harmonics[i, :, :width] = p.x.reshape(places, -1)
            if p.tangent.size:
                tangent[i, :, :width] = p.tangent[:-1].reshape(places, -1)
                tangent_period[i] = p.tangent[-1]

        # Points of one branch differ in their number of harmonics, but all have odd ones alone or none does.
        odd = all(p.order % 2 and len(p.x) <= p.order // 2 * places + places for p in points)
        orders = np.arange(count)
        if odd:
            orders = 2 * orders + 1
        elongations = branch.column("elongations").reshape(len(points), places)
        axes = "point", "place", "order"
        kept_text = "number of the last harmonic"
        left_out_text = "estimated size of the neglected harmonics over that of the motion"
        return orbit_variables(branch) | {
            "place": variable("place", np.arange(1, places + 1), "1", "contact, then smooth spring"),
            "order": variable("order", orders, "1", "harmonic of the frequency"),
            "harmonics": variable(axes, harmonics, "m", "cosine of the elongation (of a contact, w)"),
            "tangent": variable(axes, tangent, "m", "tangent of the branch: harmonics"),
            "tangent_period": variable("point", tangent_period, "s", "tangent of the branch: period"),
            "elongation": variable(("point", "place"), elongations, "m", "elongation at phase 0, at rest"),
            "harmonics_kept": variable("point", np.array([p.order for p in points], int), "1", kept_text),
            "truncation": variable("point", np.array([p.truncation for p in points], float), "1", left_out_text),
        }

    def attributes(self, branch: Branch[Point]) -> dict[str, Any]:
        """Attributes of a branch's file that follow from its points."""
        return orbit_attributes(branch)

    def table(self, branch: Branch[Point]) -> Table:
        """The table of a branch for CSV: w1 ... are the elongations in m at phase 0."""
        names = ["energy", "frequency", "period", *(f"w{i + 1}" for i in range(branch.dofs))]
        losses = loss_columns(branch)
        names += ["harmonics", "truncation", "multiplier_max", "slope", *losses, "contacts", "region", "kind"]
        rows = []
        for p, region in zip(branch.points, regions(branch), strict=True):
            numbers = [p.energy, p.frequency, p.period, *p.elongations.tolist()]
            numbers += [p.order, p.truncation, p.multiplier, p.slope]
            numbers += [*(getattr(p, name) for name in losses), p.episodes]
            rows.append([*map(repr, numbers), str(region), p.kind])
        return Table(names, rows)

    def points(self, data: xr.Dataset) -> list[Point]:
        """The points of a file."""
        # Odd harmonics alone begin with the order 1, all of them with 0.
        odd = data["order"].values[:1] == 1
        points = []
        for i, fields in enumerate(quantities(data)):
            order = int(data["harmonics_kept"].values[i])
            count = order + 1
            if odd:
                count = (order + 1) // 2

            # The first point of a branch that has gone no further has no tangent.
            tangent_period = data["tangent_period"].values[i]
            tangent = np.empty(0)
            if np.isfinite(tangent_period):
                tangent = np.append(data["tangent"].values[i, :, :count].ravel(), tangent_period)

            point = Point(
                **fields,
                x=data["harmonics"].values[i, :, :count].ravel(),
                tangent=tangent,
                order=order,
                truncation=float(data["truncation"].values[i]),
                elongations=data["elongation"].values[i],
            )
            points.append(point)
        return points

    def dofs(self, data: xr.Dataset) -> int:
        """Number of contacts and smooth springs of the motions in a file."""
        return int(data.sizes["place"])
