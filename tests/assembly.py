"""Stiffness and damping matrices assembled spring by spring, for comparison with those of the package."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vipetsc.lattice import Chain


def assembled(chain: Chain, per_cell: np.ndarray, of_reference: Sequence[float]) -> np.ndarray:
    """The matrix (dof, dof), cell by cell, of a lattice's springs or dashpots, assembled one by one.

    ``per_cell`` (cell, spring) are their coefficients in N/m or N s/m. Springs from the wall on the left belong to no
    cell: they have the coefficients ``of_reference`` (spring,) of the reference cell.
    """
    n = chain.cells
    d = chain.cell.dofs
    matrix = np.zeros((n * d, n * d))
    for left in range(-1, n):
        for number, spring in enumerate(chain.cell.springs):
            right = left + spring.offset
            if chain.ends == "periodic":
                right = right % n
            # The wall on the left, cell -1, holds springs of fixed ends to the first cell only.
            if left < 0 and (chain.ends == "periodic" or not spring.offset):
                continue
            is_inside = left >= 0 and right < n
            if chain.ends == "free" and not is_inside:
                continue

            row = np.zeros(n * d)
            if right < n:
                row[right * d + spring.end] += 1
            if left >= 0:
                row[left * d + spring.start] -= 1
            coefficient = per_cell[left, number] if left >= 0 else of_reference[number]
            matrix += coefficient * np.outer(row, row)
    return matrix


def assembled_stiffness(chain: Chain) -> np.ndarray:
    """The stiffness matrix (dof, dof) in N/m of a lattice of equal cells; walls hold the end springs of fixed ends."""
    stiffness = [spring.stiffness for spring in chain.cell.springs]
    return assembled(chain, np.tile(stiffness, (chain.cells, 1)), stiffness)
