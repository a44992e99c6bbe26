"""A short lattice with one contact whose breathers many tests follow."""

from __future__ import annotations

from typing import Any

from tests.models import CLEARANCE
from vipetsc.case import NnmCase
from vipetsc.lattice import Chain, four_band
from vipetsc.lattice.sites import sites_at

# A breather of 1600 rad/s, in the gap between bands 2 and 3, decays within few cells.
BREATHER_CELLS = 14
BREATHER_SITE = 5
BREATHER_FREQUENCY = 1600.0


def breather_chain(ends: str = "fixed", sites: tuple[int, ...] = (BREATHER_SITE,)) -> Chain:
    """The calibrated four-band lattice of 14 cells with contacts at ``sites``."""
    cell = four_band("calibrated")
    return Chain(cell, BREATHER_CELLS, ends, sites_at(sites, cell.pair, clearances=CLEARANCE))


def breather_case(**nnm: Any) -> NnmCase:
    """The case of a branch of two points from the breather at ``BREATHER_FREQUENCY``, condensed onto its contact.

    ``nnm`` updates the section of that name.
    """
    section: dict[str, Any] = {
        "system": "condensed",
        "start_frequency": [BREATHER_FREQUENCY],
        "truncation": 1e-7,
        "tolerance": 1e-11,
        "points": 2,
    }
    table = {
        "name": "cells",
        "lattice": {"preset": "four-band", "reading": "calibrated", "cells": BREATHER_CELLS},
        "contacts": {"law": "hertz", "sites": [BREATHER_SITE + 1], "clearance": CLEARANCE},
        "nnm": section | nnm,
    }
    return NnmCase.from_table(table)
