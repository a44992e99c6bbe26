"""A branch in memory: its points in order, special ones in their places, and how it ended."""

from dataclasses import dataclass, field
from typing import Any, Generic

import numpy as np
import xarray as xr

from vipetsc.endings import NOT_FINISHED, Ended
from vipetsc.io.branch_kinds import ORBITS, RESPONSES
from vipetsc.io.netcdf import Variables
from vipetsc.modes.problem import S

# The codes of normal modes and of responses; a file's own attribute ``flag_meanings`` is what it is read by.
KINDS = ("regular", "fold-energy", "fold-frequency", "branch-point", "symmetry-breaking", "period-doubling", "grazing")
RESPONSE_KINDS = ("regular", "fold", "neimark-sacker", "period-doubling", "branch-point")


@dataclass(eq=False)
class Branch(Generic[S]):
    """Points of a branch of one ``kind`` (``io.branch_kinds``); with ``next_step`` and ``case`` it can go on later.

    ``dofs`` counts the displacements (or pairs) for which a point has unknowns. ``next_step`` is the arclength of the
    step after the last point, 0 without points. ``about`` are further attributes of its file, ``extra`` further
    variables: orbits.

    ``ended`` is how the branch has ended: it is ``complete`` if nothing is left to follow, since it has left its range
    or met itself. One that failed, was stopped or has used up its points is not complete. ``findings`` are further
    sentences: retracing, return to the linear mode, special points that are not located. ``missing`` are
    sentences about orbits that the case asks for and the branch does not have. Both are the attribute ``warnings`` of
    the file.
    """

    name: str
    case: str
    dofs: int
    kind: str = ORBITS
    points: list[S] = field(default_factory=list)
    next_step: float = 0.0
    ended: Ended = NOT_FINISHED
    findings: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    about: dict[str, Any] = field(default_factory=dict)
    extra: Variables = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """Whether nothing is left to follow."""
        return self.ended.ending.is_final

    def regular(self) -> list[S]:
        """Return the points of the continuation itself."""
        return [p for p in self.points if p.kind == "regular"]

    def is_kind(self, kind: str) -> np.ndarray:
        """Return whether each point is of that kind (points,)."""
        return np.array([p.kind == kind for p in self.points], bool)

    def column(self, name: str) -> np.ndarray:
        """Return one quantity of every point (points, ...)."""
        return np.array([getattr(p, name) for p in self.points])


def kinds_of(branch_kind: str) -> tuple[str, ...]:
    """Return kinds of points on a branch of that kind, in the order of their codes."""
    if branch_kind == RESPONSES:
        return RESPONSE_KINDS
    return KINDS


def kinds_in(branch: Branch[Any]) -> list[str]:
    """Return kinds of points on a branch, in the order of their codes: those of its method, then chosen values."""
    names = dict.fromkeys([*kinds_of(branch.kind), *(point.kind for point in branch.points)])
    return list(names)


def stored_kinds(data: xr.Dataset) -> list[str]:
    """Return the kind of every point in a branch file."""
    names = np.array(data["kind"].attrs["flag_meanings"].split())
    return [str(name) for name in names[data["kind"].values]]
