"""Masses, springs and dashpots of the cells of a lattice in which not all are as the reference cell."""

import hashlib
from dataclasses import dataclass, fields
from functools import cached_property
from typing import NamedTuple

import numpy as np


class Coefficients(NamedTuple):
    """Masses, springs and dashpots of consecutive cells; a spring to the next cell belongs to the one it begins in.

    ``masses`` (cell, dof) in kg; ``grounding`` (cell, dof) in N s/m to ground; ``stiffness`` (cell, spring) in N/m;
    ``damping`` (cell, spring) in N s/m parallel to the springs.
    """

    masses: np.ndarray
    grounding: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray


class SpringTerms(NamedTuple):
    """Quadratic and cubic parts of the springs of consecutive cells; ``Coefficients`` has their linear parts.

    ``quadratic`` (cell, spring) in N/m^2, ``cubic`` (cell, spring) in N/m^3.
    """

    quadratic: np.ndarray
    cubic: np.ndarray


@dataclass(frozen=True, eq=False)
class Variation:
    """The arrays of ``Coefficients`` and ``SpringTerms`` over all cells, None where all are as the reference cell.

    They are read-only. Two variations are equal if their arrays are, bit for bit.
    """

    masses: np.ndarray | None = None
    grounding: np.ndarray | None = None
    stiffness: np.ndarray | None = None
    damping: np.ndarray | None = None
    quadratic: np.ndarray | None = None
    cubic: np.ndarray | None = None

    def __post_init__(self) -> None:
        for name, array in self.items():
            # A digest stands for the arrays in caches, and would not know of a change.
            copy = np.array(array, float)
            copy.flags.writeable = False
            object.__setattr__(self, name, copy)

    def items(self) -> list[tuple[str, np.ndarray]]:
        """Return names and arrays (cell, ...) of what differs."""
        arrays = [(f.name, getattr(self, f.name)) for f in fields(self)]
        return [(name, array) for name, array in arrays if array is not None]

    @cached_property
    def _digest(self) -> bytes:
        """Digest of all arrays: chains are keys of caches, which compare them at each look-up."""
        return hashlib.sha256(b"".join(name.encode() + array.tobytes() for name, array in self.items())).digest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Variation) and self._digest == other._digest

    def __hash__(self) -> int:
        return hash(self._digest)
