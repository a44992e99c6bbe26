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
    """A packet or a mode that closes contacts on both sides of a border evolves alike on any number of ranks."""
    # 24 cells are cut after cell 12 on 2 ranks, and after cells 8 and 16 on 3.
    case = small_case(
        lattice={"ends": ends},
        contacts={"sites": [6, 8, 9, 12, 13, 16, 17], "clearance": 1e-3, "stiffness": 1e5},
        drive={"amplitude": 0.0},
        initial=initial,
        time={"engine": engine, "end": 0.008},
    )
    runs_alike(folder, case)


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("engine", ["ts", "propagator"])
def test_struck_masses_of_any_rank_have_the_same_bits(folder, engine):
    """Struck masses are in the first cell, in the last cell and on both sides of a border between ranks."""
    strikes = [{"cell": 12, "mass": 2, "velocity": -0.4}, {"cell": 13, "velocity": 0.2}, {"cell": 24, "velocity": -0.3}]
    case = small_case(
        contacts={"sites": [6, 12, 13], "clearance": 1e-5},
        drive={"amplitude": 0.0},
        initial={"kind": "velocity", "cell": 1, "velocity": 0.5, "more": strikes},
        time={"engine": engine, "end": 0.01},
    )
    runs_alike(folder, case)
