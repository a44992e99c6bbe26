"""What lies beyond the ends of a lattice, and which elements it has there."""

import numpy as np
import pytest

from vipetsc.lattice import Chain, Spring, Topology, UnitCell, contacts, nonlinear_springs
from vipetsc.lattice.elements import incidence
from vipetsc.lattice.sites import Pair, sites_at
from vipetsc.lattice.topology import NOTHING, WALL


@pytest.mark.parametrize(
    ("ends", "before", "after"), [("fixed", WALL, WALL), ("free", NOTHING, NOTHING), ("periodic", 4, 0), (None, -1, 5)]
)
def test_what_lies_beyond_the_ends(ends, before, after):
    topology = Topology(5, ends)
    assert topology.neighbour([0, 2, 4], [-1, 1, 1]).tolist() == [before, 3, after]
    assert topology.neighbour(np.arange(5)).tolist() == [*range(5)]


def test_distances_on_a_ring_are_the_shorter_ones():
    assert Topology(5, "periodic").distance(np.arange(5), 4).tolist() == [1, 2, 2, 1, 0]
    assert Topology(5, "fixed").distance(np.arange(5), 4).tolist() == [4, 3, 2, 1, 0]
    assert Topology(5, "periodic").nearest_index([2, 0], 4) == 1
    assert Topology(5, "free").nearest_index([2, 0], 4) == 0
    assert Topology(5).nearest_index([], 4) is None


CUBIC = UnitCell((1.0, 0.5), (Spring(0, 1, 1.0, cubic=1.0), Spring(1, 0, 2.0, offset=1, quadratic=1.0)), 0, 1)


@pytest.mark.parametrize("cells", [1, 2, 3])
@pytest.mark.parametrize("ends", ["fixed", "free", "periodic"])
def test_springs_are_those_of_the_stiffness(ends, cells):
    """All springs of the cell are nonlinear here: their elongations make up the stiffness of the lattice."""
    chain = Chain(CUBIC, cells, ends)
    springs = nonlinear_springs(chain)
    loads = incidence(springs.mass_pairs(), np.arange(2 * cells))
    stiffness = np.array([CUBIC.springs[number].stiffness for number in springs.number])
    np.testing.assert_array_equal((loads * stiffness) @ loads.T, chain.stiffness_matrix().toarray())


def test_contacts_join_the_masses_of_their_pairs():
    pairs = (Pair(-1, 1), Pair(0, 1), Pair(1, 0, offset=1))
    chain = Chain(CUBIC, 4, "periodic", sites=sites_at([1, 2, 3], pairs))
    assert contacts(chain).mass_pairs() == [(WALL, 3), (4, 5), (7, 0)]


@pytest.mark.parametrize("ends", ["fixed", "free"])
def test_a_contact_with_the_next_cell_needs_one(ends):
    chain = Chain(CUBIC, 4, ends, sites=sites_at([1, 3], [Pair(0, 1), Pair(0, 1, offset=1)]))
    for ask in (contacts, Chain.reduced_masses):
        with pytest.raises(ValueError, match="site 2 in cell 4"):
            ask(chain)
    assert contacts(chain, Topology(4, None)).mass_pairs() == [(2, 3), (6, 9)]
