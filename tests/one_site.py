"""Cases of the scattering law of one site, and of predictions, that tests share."""

from __future__ import annotations

from typing import Any

from tests.conftest import with_sections
from tests.models import THREE_MASS_CELL
from vipetsc.case import LawCase
from vipetsc.case.predict import PredictCase

LATTICES = {
    "four-band": {"preset": "four-band"},
    "diatomic": {"preset": "diatomic"},
    "three-mass": {"cell": THREE_MASS_CELL},
}
# A scattering law of few points, each from one run.
COARSE = {"largest": 2.0, "samples": 1, "tolerance": 0.3, "finest": 0.2}

PREDICTION: dict[str, Any] = {
    "name": "small",
    "lattice": {"preset": "four-band", "cells": 120},
    "contacts": {"sites": [40, 70], "clearance": [2e-3, 1.8e-3]},
    "drive": {"cycles": 15, "band": 2, "at": "max-group-velocity"},
    "predict": {"points": 16, "amplitudes": [5.0, 30.0, 120.0, 600.0]},
}


def law_case(lattice: str = "four-band", law: dict[str, Any] = COARSE, **sections: dict[str, Any]) -> LawCase:
    """The case of the scattering law of a lossless site under a short burst; ``sections`` update its table."""
    contacts: dict[str, Any] = {"sites": [2], "clearance": 1e-3, "restitution": 1.0}
    if lattice == "three-mass":
        # Presets have a contact stiffness of their own, other cells have none.
        contacts["stiffness"] = 5e6
    table = {
        "lattice": LATTICES[lattice],
        "contacts": contacts,
        "drive": {"cycles": 8, "band": 2, "at": "max-group-velocity"},
        "time": {"rtol": 1e-9},
        "law": law,
    }
    return LawCase.from_table(with_sections(table, sections))


def prediction_case(**sections: dict[str, Any]) -> PredictCase:
    """The case of a prediction for two sites of a four-band lattice; ``sections`` update its table."""
    return PredictCase.from_table(with_sections(PREDICTION, sections))
