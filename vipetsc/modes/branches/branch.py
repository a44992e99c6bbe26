"""A branch in memory: its points in order, special ones in their places, and how it ended."""

from dataclasses import dataclass, field
from typing import Any, Generic

import numpy as np

from vipetsc.io.branch_kinds import ORBITS
from vipetsc.io.netcdf import Variables
from vipetsc.modes.problem import S


@dataclass(eq=False)
class Branch(Generic[S]):
    """Points of a branch of one ``kind`` (``io.branch_kinds``); with ``next_step`` and ``case`` it can go on later.

    ``dofs`` counts the displacements (or places) for which a point has unknowns. ``findings`` are sentences about the
    branch: jumps, retracing, return to the linear mode; ``about`` are further attributes of its file, ``extra`` further
    variables: orbits, comparisons with other flows.
    """

    name: str
    case: str
    dofs: int
    kind: str = ORBITS
    points: list[S] = field(default_factory=list)
    next_step: float = 0.0
    complete: bool = False
    ending: str = "not finished"
    findings: list[str] = field(default_factory=list)
    about: dict[str, Any] = field(default_factory=dict)
    extra: Variables = field(default_factory=dict)

    def regular(self) -> list[S]:
        """The points of the continuation itself."""
        return [p for p in self.points if p.kind == "regular"]

    def is_kind(self, kind: str) -> np.ndarray:
        """Whether each point is of that kind (points,)."""
        return np.array([p.kind == kind for p in self.points], bool)

    def column(self, name: str) -> np.ndarray:
        """One quantity of every point (points, ...)."""
        return np.array([getattr(p, name) for p in self.points])
