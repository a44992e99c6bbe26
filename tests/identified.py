"""Cases of the verb ``identify`` and records of simulated motions for them, for several test modules."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tests.conftest import run_of, with_sections
from vipetsc.case import Case

# Masses whose velocities are measured, one near each site.
POINTS = [{"name": "a", "cell": 2, "mass": 1}, {"name": "b", "cell": 3, "mass": 2}, {"name": "c", "cell": 5, "mass": 1}]


def lattice_table(**sections: dict[str, Any]) -> dict[str, Any]:
    """The table of a short four-band lattice with impacts at three sites under a burst; ``sections`` update it."""
    table: dict[str, Any] = {
        "name": "truth",
        "lattice": {"preset": "four-band", "cells": 6},
        "contacts": {"sites": [2, 3, 5], "clearance": [5e-4, 4e-4, 3e-4], "restitution": 0.7},
        "drive": {"cycles": 4, "amplitude": 60.0},
        "time": {"end": 0.02, "sample_interval": 2.5e-4, "engine": "propagator", "rtol": 1e-9},
        "output": {"points": POINTS},
    }
    return with_sections(table, sections)


def measured_table(
    folder: Path, table: dict[str, Any], noise: float = 0.0, seed: int = 1, quantity: str = "velocity"
) -> dict[str, Any]:
    """Write the motion of the points in a run of ``table`` into a file, and return the table of that record.

    ``noise`` is the standard deviation of normal errors, as a fraction of the root mean square of each point's motion.
    """
    points = table["output"]["points"]
    run = run_of(Case.from_table(table))
    values = run[f"points/{quantity}"].values
    size = np.sqrt(np.mean(values**2, axis=0))
    values = values + noise * size * np.random.default_rng(seed).standard_normal(values.shape)
    path = folder / f"{table['name']}-{quantity}-{seed}.csv"
    rows = np.column_stack([run["time"].values, values])
    names = ",".join(["t", *(point["name"] for point in points)])
    np.savetxt(path, rows, delimiter=",", header=names, comments="", fmt="%.17g")
    sensors = [
        {"quantity": quantity, "column": point["name"], "cell": point["cell"], "mass": point["mass"]}
        for point in points
    ]
    return {"file": str(path), "time": "t", "sensors": sensors}


def identify_table(
    table: dict[str, Any], record: dict[str, Any] | list[dict[str, Any]], **options: Any
) -> dict[str, Any]:
    """The table of an identification: ``table`` with records, and with clearances and restitution as unknowns."""
    records = record if isinstance(record, list) else [record]
    unknowns = [
        {"quantity": "clearance", "of": "each", "bounds": [5e-5, 3e-3], "start": [6.5e-4, 2.8e-4, 3.9e-4]},
        {"quantity": "restitution", "bounds": [0.2, 1.0], "start": 0.9},
    ]
    section = {"records": records, "unknowns": unknowns, "profile": 0} | options
    return table | {"name": "found", "identify": section}
