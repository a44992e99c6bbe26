"""Contents of branch files that depend on the kind of branch: one layout for each kind."""

from typing import Any, NamedTuple, Protocol

import numpy as np
import xarray as xr

from vipetsc.io.netcdf import Variables, variable
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.kinds import stored_kinds
from vipetsc.modes.branches.regions import quantity, regions, slope_laws, tongues
from vipetsc.modes.point import OF_LOSSES, QUANTITIES, Point
from vipetsc.modes.problem import S
from vipetsc.modes.stability import UNSTABLE_BEYOND

REGION = "region of the backbone: 1 linear, 2 grazing, 3 vibro-impact, 4 smooth limit; 0 unknown"
MULTIPLIERS = {
    "multiplier": "largest Floquet multipliers, real part; NaN where fewer converged",
    "multiplier_imaginary": "largest Floquet multipliers, imaginary part",
    "multiplier_residual": "residual of the multiplier's vector over its size",
}


class Table(NamedTuple):
    """A branch as CSV: names of columns, and rows of text."""

    names: list[str]
    rows: list[list[str]]

    def __str__(self) -> str:
        return "\n".join(",".join(row) for row in [self.names, *self.rows]) + "\n"


class BranchLayout(Protocol[S]):
    """Storage of the points of one kind of branch."""

    @property
    def noun(self) -> str:
        """Name of such a branch in texts: branch or curve."""

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of variables or attributes that a file must have."""

    def variables(self, branch: Branch[S]) -> Variables:
        """Variables of a branch's file, without its points' numbers and kinds."""

    def attributes(self, branch: Branch[S]) -> dict[str, Any]:
        """Attributes of a branch's file that follow from its points."""

    def table(self, branch: Branch[S]) -> Table:
        """The table of a branch for CSV."""

    def points(self, data: xr.Dataset) -> list[S]:
        """The points of a file."""

    def dofs(self, data: xr.Dataset) -> int:
        """``Branch.dofs`` of the branch in a file."""


def orbit_variables(branch: Branch[Point]) -> Variables:
    """Variables of all branches of normal modes: the quantities, the regions and the largest multipliers."""
    data = {"region": variable("point", regions(branch).astype(np.int64), "1", REGION)}
    for name, (stored, _, units, text) in QUANTITIES.items():
        data[stored] = variable("point", quantity(branch, name), units, text)
    data["multiplier_max"].attrs["unstable_beyond"] = UNSTABLE_BEYOND
    return data | _losses(branch) | _multipliers(branch.points)


def loss_columns(branch: Branch[Point]) -> list[str]:
    """Names of the ``OF_LOSSES`` that points of a branch have."""
    return [name for name in OF_LOSSES if np.isfinite(branch.column(name).astype(float)).any()]


def _losses(branch: Branch[Point]) -> Variables:
    """Variables of what dissipation takes; none if nothing dissipates."""
    names = loss_columns(branch)
    return {name: variable("point", branch.column(name).astype(float), *OF_LOSSES[name]) for name in names}


def orbit_attributes(branch: Branch[Point]) -> dict[str, Any]:
    """Attributes of all branches of normal modes: power laws of the slope, and number of tongues passed."""
    return {"next_step": branch.next_step, "fits": slope_laws(branch), "tongues": len(tongues(branch))}


def quantities(data: xr.Dataset) -> list[dict[str, Any]]:
    """``QUANTITIES``, kind and multipliers of every point in a file of normal modes, by the fields of ``Point``."""
    columns = {name: data[stored].values.tolist() for name, (stored, *_) in QUANTITIES.items()}
    del columns["frequency"]  # a property of ``Point``, which follows from the period
    columns["kind"] = stored_kinds(data)
    for name in OF_LOSSES.keys() & data.data_vars.keys() - {"damping_ratio"}:  # a property of ``Point``
        columns[name] = data[name].values.tolist()
    if "multiplier" in data:
        columns["multipliers"] = _stored_multipliers(data)
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _multipliers(points: list[Point]) -> Variables:
    """Variables of the points' largest multipliers; none if no point has any."""
    most = max((len(p.multipliers) for p in points), default=0)
    if not most:
        return {}
    largest = np.full((len(points), most, 2), np.nan, complex)
    for row, p in zip(largest, points, strict=True):
        row[: len(p.multipliers)] = p.multipliers

    axes = "point", "multiplier_number"
    numbers = np.arange(1, most + 1)
    parts = largest[..., 0].real, largest[..., 0].imag, largest[..., 1].real
    data = {"multiplier_number": variable("multiplier_number", numbers, "1", "number of a multiplier, largest first")}
    for part, (name, text) in zip(parts, MULTIPLIERS.items(), strict=True):
        data[name] = variable(axes, part, "1", text)
    return data


def _stored_multipliers(data: xr.Dataset) -> list[np.ndarray]:
    """The converged multipliers of every point of a file, and their residuals."""
    real, imaginary, residual = (data[name].values for name in MULTIPLIERS)
    rows = np.stack([real + 1j * imaginary, residual], axis=-1)
    return [row[np.isfinite(row[:, 0])] for row in rows]
