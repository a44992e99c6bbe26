"""Runs of a strip: the mirror image and both engines."""

from __future__ import annotations

import numpy as np
import pytest

from tests.conftest import simulated
from vipetsc.case import Case

ROWS = 5


def table(engine, mirrored=False, ends="fixed"):
    """A square strip of 24 x 5 cells with three stops to the ground and one between rows, or its mirror image."""

    def at(i, j):
        return [i, ROWS + 1 - j if mirrored else j]

    return {
        "lattice": {"cells": 24, "ends": ends, "strip": {"rows": ROWS, "mass": 0.01, "stiffness": 1e4}},
        "contacts": {
            "places": [at(5, 1), at(6, 2), at(15, 3)],
            "clearance": 1e-4,
            "stiffness": 1e8,
            "restitution": 0.8,
        },
        "drive": {"amplitude": 20.0, "waveform": "harmonic", "frequency": 1000.0, "place": at(3, 2)},
        "time": {"end": 0.04, "engine": engine},
        "output": {"figures": False},
    }


def run(case_table):
    """The displacement of a run with impacts."""
    dataset, result = simulated(Case.from_table(case_table))
    assert result.statistics["episodes"] > 5, result.sentence
    assert result.statistics["engine"] == case_table["time"]["engine"]
    return dataset["displacement"].values


@pytest.mark.parametrize("ends", ["fixed", "periodic"])
def test_engines_and_mirror_images_agree(ends):
    runs = {
        (engine, mirrored): run(table(engine, mirrored, ends))
        for engine in ("ts", "propagator")
        for mirrored in (False, True)
    }
    size = np.abs(runs["ts", False]).max()
    for engine in ("ts", "propagator"):
        np.testing.assert_allclose(runs[engine, True][..., ::-1], runs[engine, False], rtol=0, atol=1e-11 * size)
    np.testing.assert_allclose(runs["ts", False], runs["propagator", False], rtol=0, atol=1e-8 * size)
