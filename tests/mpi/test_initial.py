"""Runs that begin in motion have the same bits on any number of ranks."""

from __future__ import annotations

import pytest

from tests.conftest import on_two, small_case
from tests.mpi.test_partition import runs_alike

PACKET = {"kind": "packet", "band": 2, "wavenumber": "pi/2", "cell": 12, "width": 2, "amplitude": 2e-3}
MODE = {"kind": "mode", "number": 40, "energy": 0.5}


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("engine", ["ts", "propagator"])
@pytest.mark.parametrize(("initial", "ends"), [(PACKET, "periodic"), *on_two((PACKET, "fixed"), (MODE, "free"))])
def test_same_bits_with_closed_contacts_across_borders(folder, engine, initial, ends):
    # On 2 and 3 ranks, 24 cells are cut after 12; 8, 16.
    case = small_case(
        lattice={"ends": ends},
        contacts={"sites": [6, 8, 9, 12, 13, 16, 17], "clearance": 1e-3, "stiffness": 1e5},
        drive={"amplitude": 0.0},
        initial=initial,
        time={"engine": engine, "end": 0.02},
    )
    runs_alike(folder, case)
