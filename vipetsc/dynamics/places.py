"""Contact sites as compiled code sees them: the ends of each in a rank's part of the state, its law and its stops.

A site whose masses are in cells of two ranks is followed by both, from the same numbers to the same bits; the one that
owns the site's cell logs it and has what it dissipates in its ledger.
"""

import numpy as np
from numpy.typing import ArrayLike

from vipetsc.case import Model
from vipetsc.contact.law import create_contacts, hold
from vipetsc.lattice.chain import Chain

END = np.dtype([(name, np.int64) for name in ("u", "v", "cell", "mass")])
"""An end of a site: components of its displacement and velocity, -1 on ground; its owned cell, else -1; its mass."""
PLACE = np.dtype([("host", END), ("resonator", END), ("ledger", np.int64)])
"""A site: its ends, the component of the energy that it dissipates, -1 on a rank that does not own the site."""


def sites_within(chain: Chain, start: int, stop: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Numbers of the sites of the cells ``start`` to ``stop``, and of all that act on a mass there."""
    cells = np.array(chain.sites, np.int64)
    next_cells = (cells + np.array([int(pair.next_cell) for pair in chain.pairs] or [0] * len(cells))) % chain.cells
    owned, felt = ((of >= start) & (of < stop) for of in (cells, next_cells))
    return tuple(np.flatnonzero(owned).tolist()), tuple(np.flatnonzero(owned | felt).tolist())


def site_records(model: Model, numbers: ArrayLike) -> np.ndarray:
    """Sites of dtype ``SITE``, free or held together; a number below 0 is a site without stops."""
    numbers, chain = np.maximum(np.asarray(numbers, np.int64), -1), model.chain
    gaps = np.array(model.gaps or [(gap, gap) for gap in chain.clearances]).reshape(-1, 2)
    laws = [model.laws[i] if model.laws and i >= 0 else model.contact for i in numbers]
    masses = np.array([*chain.reduced_masses(), chain.cell.reduced_mass])
    gaps = np.vstack([gaps, [[np.inf] * 2]])
    sites = create_contacts(laws, gaps[numbers], masses[numbers], model.scale)
    joins = np.array([*(pair.next_cell for pair in chain.contact_pairs), False])
    least = gaps[numbers].min(axis=1)
    lasts = (least < 0) | ((least == 0) & joins[numbers] & (sites["damping"] == 0))
    hold(sites, laws, lasts, model.scale * model.drive.frequency)
    return sites
