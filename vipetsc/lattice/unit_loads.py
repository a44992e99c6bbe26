"""Unit loads of contact pairs and of single masses: columns that also pick their motions."""

from collections.abc import Sequence

import numpy as np

from vipetsc.lattice.chain import Chain


def unit_loads(
    chain: Chain, resonator_cells: Sequence[int], points: Sequence[tuple[int, int]], cells: Sequence[int]
) -> np.ndarray:
    """Loads (dofs of ``cells``, pairs and points) of 1 N: each column picks a relative displacement, or one of a mass.

    The contact pairs of ``chain`` have 1 at the resonator, in one of the ``resonator_cells``, and -1 at the host;
    ``points`` are (cell, mass) from 0. All loaded masses are in the ``cells``, whose dofs follow each other.
    """
    d = chain.cell.dofs
    pairs = len(chain.sites)
    first_row = {number: i * d for i, number in enumerate(cells)}

    loads = np.zeros((len(cells) * d, pairs + len(points)))
    places = zip(chain.sites, resonator_cells, chain.contact_pairs, strict=True)
    for j, (site, resonator_cell, pair) in enumerate(places):
        loads[first_row[resonator_cell] + pair.resonator, j] = 1
        # The ground does not move.
        if pair.host >= 0:
            loads[first_row[site] + pair.host, j] = -1
    for j, (number, mass) in enumerate(points, pairs):
        loads[first_row[number] + mass, j] = 1
    return loads
