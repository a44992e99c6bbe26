"""Orbits of a lattice and variations beside them on any number of ranks: the same bits as on one."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest

from tests.conftest import on_two
from vipetsc.lattice import Chain, Contact, contact_stiffness
from vipetsc.lattice.cell import four_band
from vipetsc.modes.lattice.lattice_flow import LatticeFlow

COMM = MPI.COMM_WORLD


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("restitution", [*on_two(1.0), 0.7])
def test_variations_have_the_same_bits(restitution):
    """Clusters lie across the borders: 18 cells are cut after 9 or after 6 and 12."""
    sites = (5, 8, 9, 12)
    cells = 18
    dofs = 4
    chain = Chain(four_band("calibrated"), cells, "fixed", sites, (10**-2.75,) * len(sites))
    contact = Contact("hertz", contact_stiffness(1e8, 0.005, 0.3), restitution)
    random = np.random.default_rng(3)
    state = 1e-5 * random.standard_normal((2, cells, dofs))
    state[0, sites, 2] += 1.6e-3
    state[1, sites, 2] += 1.0
    changes = random.standard_normal((3, 2, cells, dofs))
    ends = []
    for comm in (COMM, MPI.COMM_SELF):
        flow = LatticeFlow(chain, contact, comm)
        arc = flow.arc(flow.scatter(state.ravel()), 2 * np.pi / 1600)
        assert arc.episodes >= len(sites)
        ends.append((flow.gather(arc.end), flow.gather(arc.move(flow.scatter(changes.reshape(3, -1)))), arc.closed))
        arc.engine.destroy()
    (together, moved, closed), (alone, moved_alone, closed_alone) = ends

    assert together.tobytes() == alone.tobytes()
    assert moved.tobytes() == moved_alone.tobytes()
    assert closed == closed_alone > 0
