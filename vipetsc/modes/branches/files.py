"""The format of branch files: variables and attributes of all kinds of branches, and each kind's layout."""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from vipetsc.io.atomic import write_text
from vipetsc.io.branch_kinds import CONDENSED, ORBITS, RESPONSES, kind_of_file
from vipetsc.io.netcdf import open_netcdf, variable, write_netcdf
from vipetsc.modes.branches.branch import Branch
from vipetsc.modes.branches.condensed_layout import CondensedLayout
from vipetsc.modes.branches.kinds import kinds_in
from vipetsc.modes.branches.layout import BranchLayout
from vipetsc.modes.branches.orbit_layout import OrbitLayout
from vipetsc.modes.branches.response_layout import ResponseLayout

LAYOUTS: dict[str, BranchLayout[Any]] = {
    ORBITS: OrbitLayout(),
    CONDENSED: CondensedLayout(),
    RESPONSES: ResponseLayout(),
}


def write_branch(branch: Branch[Any], folder: Path, about: dict[str, Any]) -> None:
    """Write ``branch-<name>.h5`` and ``.csv``, each complete or as it was; ``about`` are further attributes."""
    sys.audit("vipetsc.save", branch.name)
    # The HDF5 file last: it says whether a branch is complete, and what is complete is not written again.
    write_text(folder / f"branch-{branch.name}.csv", str(LAYOUTS[branch.kind].table(branch)))
    write_netcdf(folder / f"branch-{branch.name}.h5", to_dataset(branch).assign_attrs(about))


def restore_table(branch: Branch[Any], folder: Path) -> None:
    """Write the ``.csv`` of a branch whose HDF5 file is there if somebody has removed it."""
    path = folder / f"branch-{branch.name}.csv"
    if not path.exists():
        write_text(path, str(LAYOUTS[branch.kind].table(branch)))


def to_dataset(branch: Branch[Any]) -> xr.Dataset:
    """The branch as the dataset of its file."""
    layout = LAYOUTS[branch.kind]

    # Codes are stored with their meanings, by which they are read: lists of kinds may grow.
    names = kinds_in(branch)
    kinds = np.array([names.index(p.kind) for p in branch.points], np.int8)
    flags = {"flag_values": np.arange(len(names), dtype=np.int8), "flag_meanings": " ".join(names)}

    data = {
        "point": variable("point", np.arange(len(branch.points)), "1", f"place along the {layout.noun}"),
        "kind": variable("point", kinds, "1", "kind of point", **flags),
        **layout.variables(branch),
        **branch.extra,
    }

    attributes = {
        "name": branch.name,
        "case": branch.case,
        "branch_kind": branch.kind,
        "complete": int(branch.complete),
        "ending": branch.ending,
        "warnings": json.dumps(branch.findings),
        **branch.about,
        **layout.attributes(branch),
    }
    return xr.Dataset(data, attrs=attributes)


def read_branch(path: Path) -> Branch[Any]:
    """The branch in an HDF5 file, without its ``extra``; raises OSError or ValueError if it holds none."""
    # The kind comes first: what a file must have depends on it, and a message about what it lacks should be right.
    kind = kind_of_file(path, ("tangent",))
    layout = LAYOUTS[kind]
    with open_netcdf(path, "branch", layout.needs) as file:
        data = file.load()
    about = data.attrs
    points = layout.points(data)
    next_step = about.get("next_step")
    if next_step is None:
        # Files of responses have the next step at each point, and none for the branch.
        next_step = float(data["next_step"].values[-1])
    return Branch(
        name=str(about["name"]),
        case=str(about["case"]),
        dofs=layout.dofs(data),
        kind=kind,
        points=points,
        next_step=float(next_step),
        complete=bool(about["complete"]),
        ending=str(about["ending"]),
        findings=json.loads(about.get("warnings", "[]")),
        about={name: str(about[name]) for name in ("over", "unit") if name in about},
    )
