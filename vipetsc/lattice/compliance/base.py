"""What compliances of a chain have in common: their loads, and the signs of the forces at its contacts."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.lattice.chain import Chain
from vipetsc.lattice.elements import contacts, incidence, masses_of
from vipetsc.lattice.topology import WALL


class ComplianceError(ValueError):
    """A lattice has no compliance at a frequency, or none that its modes represent."""


@dataclass(frozen=True)
class ChainCompliance(ABC):
    """Compliance of the contact pairs of a ``chain``.

    Relative displacements w = u_resonator - u_host of the pairs follow from pairs of opposite forces, and from forces
    on single masses at the ``points``, which are (cell, mass) from 0.
    """

    chain: Chain
    points: tuple[tuple[int, int], ...] = ()

    @abstractmethod
    def response(self, omegas: ArrayLike) -> np.ndarray:
        """Return relative displacements (omega, pair, pair and point) in m/N at ``omegas`` in rad/s.

        Frequencies lie on or below the real axis. At real ones it is real for a finite lattice without dashpots.
        """

    def at(self, omegas: ArrayLike) -> np.ndarray:
        """Return the compliance (omega, pair, pair) in m/N, see ``response``."""
        return self.response(omegas)[:, :, : self.pairs]

    @property
    def pairs(self) -> int:
        """Number of pairs: all contacts, and further elements if there are any."""
        return len(self._elements)

    @property
    def _elements(self) -> list[tuple[int, int]]:
        """The pairs of masses between which forces act."""
        return contacts(self.chain).mass_pairs()

    @property
    def loaded_cells(self) -> list[int]:
        """The cells whose masses are rows of ``loads``."""
        return list(range(self.chain.cells))

    @cached_property
    def loads(self) -> np.ndarray:
        """Unit loads (dofs, pairs and points): columns that pick a relative displacement, or one of a mass."""
        dofs = self.chain.cell.dofs
        of_points = [(WALL, cell * dofs + mass) for cell, mass in self.points]
        return incidence([*self._elements, *of_points], masses_of(self.loaded_cells, dofs))

    def signed(self, forces: ArrayLike) -> np.ndarray:
        """Return factors (pairs and points,) of ``loads`` for ``forces`` in N.

        Forces of pairs come first and pull back (-F on the resonator, F on the host), then those on the points, if
        there are any.
        """
        given = np.asarray(forces, complex)
        return np.concatenate([-given[: self.pairs], given[self.pairs :]])
