"""Kinds of points on branches, by the codes of the variable ``kind`` in their files."""

from typing import Any

import numpy as np
import xarray as xr

from vipetsc.io.branch_kinds import RESPONSES
from vipetsc.modes.branches.branch import Branch

# The codes of normal modes and of responses; a file's own attribute ``flag_meanings`` is what it is read by.
KINDS = ("regular", "fold-energy", "fold-frequency", "branch-point", "symmetry-breaking", "period-doubling", "grazing")
RESPONSE_KINDS = ("regular", "fold", "neimark-sacker", "period-doubling", "branch-point")


def kinds_of(branch_kind: str) -> tuple[str, ...]:
    """Kinds of points on a branch of that kind, in the order of their codes."""
    if branch_kind == RESPONSES:
        return RESPONSE_KINDS
    return KINDS


def kinds_in(branch: Branch[Any]) -> list[str]:
    """Kinds of points on a branch, in the order of their codes: those of its method, then chosen values."""
    names = dict.fromkeys([*kinds_of(branch.kind), *(point.kind for point in branch.points)])
    return list(names)


def stored_kinds(data: xr.Dataset) -> list[str]:
    """The kind of every point in a branch file."""
    names = np.array(data["kind"].attrs["flag_meanings"].split())
    return [str(name) for name in names[data["kind"].values]]
