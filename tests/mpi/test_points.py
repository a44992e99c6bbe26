"""Motions of points and contact forces have the same bits on any number of ranks."""

from __future__ import annotations

from mpi4py import MPI

import pytest

from tests.conftest import small_case
from tests.mpi.test_granular import CHAIN, RING
from tests.mpi.test_partition import runs_alike
from tests.verify.test_lyapunov import EXPONENT_OF_CHAIN
from vipetsc.case import Case
from vipetsc.dynamics import simulate

# 24 cells are cut after cell 12 on 2 ranks, and after cells 8 and 16 on 3: these masses are on both sides of the cuts,
# in cells with a site and without one.
PLACES = [(1, 1), (8, 2), (9, 3), (12, 4), (12, 2), (13, 1), (13, 3), (24, 4)]
POINTS = [{"name": f"c{cell}m{mass}", "cell": cell, "mass": mass} for cell, mass in PLACES]


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_same_bits_of_points_and_forces(folder, engine):
    """Points and forces have the same bits in a ring with dashpots and with sites that are not sorted by cell.

    The window of the fields leaves some of the points out.
    """
    case = small_case(
        lattice={"ends": "periodic", "damping": {"mass": 5.0, "stiffness": 1e-6}},
        contacts={"sites": [13, 6, 12]},
        time={"end": 0.03, "engine": engine},
        output={"points": POINTS, "forces": True, "window": [5, 15], "stride": 2},
    )
    runs_alike(folder, case)


@pytest.mark.parallel(2)
@pytest.mark.parametrize("table", [CHAIN, RING], ids=["chain", "ring"])
def test_same_bits_of_points_whose_contacts_join_ranks(folder, table):
    """Points have the same bits where a contact between cells, open or pressed at rest, acts on masses of two ranks."""
    points = [{"name": f"c{cell}m{mass}", "cell": cell, "mass": mass} for cell in (1, 2, 4, 5, 7) for mass in (1, 2)]
    output = {"points": points, "forces": True, "fields": []}
    runs_alike(folder, Case.from_table(table | {"output": output}))


@pytest.mark.parallel(2)
@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_one_exponent_on_any_number_of_ranks(engine):
    """The Lyapunov exponent has the same bits where the companion's cells and contacts lie on two ranks."""
    case = Case.from_table(EXPONENT_OF_CHAIN | {"time": EXPONENT_OF_CHAIN["time"] | {"engine": engine}})
    together = simulate(case).statistics
    alone = simulate(case, comm=MPI.COMM_SELF).statistics
    assert together["episodes"] > 5
    assert together["lyapunov"] == alone["lyapunov"]
