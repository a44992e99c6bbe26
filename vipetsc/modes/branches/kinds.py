"""Kinds of points on branches, by the codes of the variable ``kind`` in their files."""

import numpy as np
import xarray as xr

from vipetsc.io.branch_kinds import RESPONSES

# The codes of normal modes and of responses; a file's own attribute ``flag_meanings`` is what it is read by.
KINDS = ("regular", "fold-energy", "fold-frequency", "branch-point", "symmetry-breaking", "period-doubling", "grazing")
RESPONSE_KINDS = ("regular", "fold", "neimark-sacker", "period-doubling", "branch-point")


def kinds_of(branch_kind: str) -> tuple[str, ...]:
    """Kinds of points on a branch of that kind, in the order of their codes."""
    if branch_kind == RESPONSES:
        return RESPONSE_KINDS
    return KINDS


def stored_kinds(data: xr.Dataset) -> list[str]:
    """The kind of every point in a branch file."""
    names = np.array(data["kind"].attrs["flag_meanings"].split())
    return [str(name) for name in names[data["kind"].values]]
