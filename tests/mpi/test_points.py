"""Motion of points and contact forces: the same bits on any number of ranks, whichever of them write."""

from __future__ import annotations

import pytest

from tests.conftest import in_parallel, small_case
from tests.mpi.test_granular import CHAIN, RING
from tests.mpi.test_partition import runs_alike
from vipetsc.case import Case

# On 2 and 3 ranks, 24 cells are cut after 12; 8, 16: masses on both sides of the cuts, with and without a site.
PLACES = [(1, 1), (8, 2), (9, 3), (12, 4), (12, 2), (13, 1), (13, 3), (24, 4)]
POINTS = [{"name": f"c{cell}m{mass}", "cell": cell, "mass": mass} for cell, mass in PLACES]


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("writer", ["gather", in_parallel])
@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_same_bits_of_points_and_forces(folder, engine, writer):
    """Sites in no order of their cells, dashpots, a ring; fields of a window that leaves some of the points out."""
    case = small_case(
        lattice={"ends": "periodic", "damping": {"mass": 5.0, "stiffness": 1e-6}},
        contacts={"sites": [13, 6, 12]},
        time={"end": 0.03, "engine": engine},
        output={"points": POINTS, "forces": True, "window": [5, 15], "stride": 2, "writer": writer},
    )
    runs_alike(folder, case)


@pytest.mark.parallel(2)
@pytest.mark.parametrize("table", [CHAIN, RING], ids=["chain", "ring"])
def test_same_bits_of_points_whose_contacts_join_ranks(folder, table):
    """A contact with the next cell acts on points of two ranks, whichever of them owns it; one is pressed at rest."""
    points = [{"name": f"c{cell}m{mass}", "cell": cell, "mass": mass} for cell in (1, 2, 4, 5, 7) for mass in (1, 2)]
    output = {"points": points, "forces": True, "fields": []}
    runs_alike(folder, Case.from_table(table | {"output": output}))
