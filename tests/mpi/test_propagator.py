"""Runs by the propagator have the same bits on any number of ranks."""

from __future__ import annotations

import pytest

from tests.conftest import on_two, small_case
from tests.mpi.test_partition import runs_alike
from vipetsc.case import Case


@pytest.mark.parallel([2, 3, 4])
@pytest.mark.parametrize("ends", [*on_two("fixed", "free"), "periodic"])
@pytest.mark.parametrize("law", ["hertz", *on_two("bilinear")])
def test_same_bits_with_clusters_across_borders(folder, ends, law):
    """A run with clusters of sites across every border has the same bits on any number of ranks."""
    # 24 cells are cut after cell 12 on 2 ranks, after 8 and 16 on 3, and after 6, 12 and 18 on 4.
    case = small_case(
        lattice={"ends": ends},
        contacts={"law": law, "sites": [1, 6, 7, 12, 13, 16, 17, 24]},
        time={"end": 0.03, "engine": "propagator"},
    )
    runs_alike(folder, case)


@pytest.mark.parallel([2, 4])
def test_same_bits_where_the_band_is_wider_than_a_rank(folder):
    """The matrix of one sample interval has a band wider than the cells of a rank, with samples 0.8 ms apart."""
    case = small_case(
        lattice={"cells": 11},
        contacts={"sites": [3, 8]},
        drive={"cell": 6, "mass": 3},
        time={"end": 0.04, "sample_interval": 8e-4, "engine": "propagator"},
    )
    runs_alike(folder, case)


@pytest.mark.parallel([2, 3])
@pytest.mark.parametrize("disorder", [*on_two({}), {"seed": 2, "cells": {"masses[1]": {"relative": 0.02}}}])
def test_same_bits_with_dashpots(folder, disorder):
    """Runs with dashpots, and the energies of the dashpots, have the same bits, for equal and for different cells."""
    damping = {"mass": 10.0, "stiffness": 5e-6}
    sections = {"lattice": {"cells": 60, "damping": damping}, "time": {"end": 0.02, "engine": "propagator"}}
    if disorder:
        sections["disorder"] = disorder
    runs_alike(folder, small_case(contacts={"sites": [1, 7, 20, 21, 30, 31, 41]}, **sections))


@pytest.mark.parallel([2, 3])
def test_same_bits_with_dashpots_far_from_contacts(folder):
    """Ranks that no contact and no drive is within reach of take part in a run with dashpots, to the same bits."""
    lattice = {"cells": 60, "damping": {"mass": 10.0, "stiffness": 5e-6}, "ends": "free"}
    runs_alike(folder, small_case(lattice=lattice, time={"end": 0.02, "engine": "propagator"}))


@pytest.mark.parallel([2, 3])
def test_same_bits_diatomic_and_driven_in_the_middle(folder):
    """A run of another cell, driven near the border of two ranks, has the same bits on any number of ranks."""
    table = {
        "lattice": {"preset": "diatomic", "cells": 31},
        "contacts": {"sites": [8, 15, 16, 31], "clearance": 4e-5},
        "drive": {"amplitude": 40.0, "cycles": 10, "cell": 16, "mass": 2},
        "time": {"end": 0.05, "engine": "propagator"},
    }
    runs_alike(folder, Case.from_table(table))
