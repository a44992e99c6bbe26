"""Wavenumber entropy and partition as variables of an analysis."""

from __future__ import annotations

from typing import Any

import numpy as np

from vipetsc.io.netcdf import Variables, variable
from vipetsc.spectra import entropy, partition

# Averages of the wavenumber entropy: all in bit.
AVERAGES = {
    "energy_weighted": "mean over time of the energy-weighted entropy",
    "masked": "mean entropy where the wave is louder than 1 % of its loudest",
    "joint": "mean over time of the entropy over cells and wavenumbers together",
    "error": "deviation over the cells of the masked time mean",
}


def entropy_variables(host: np.ndarray, time: np.ndarray, start: int, maps: bool) -> Variables:
    """Entropy over wavenumbers of the host velocity (snapshot, cell) in m/s, averaged from snapshot ``start`` on.

    ``time`` (snapshot) in s; with ``maps`` the local entropy and its weight (snapshot, cell) as well.
    """
    measured = entropy(host, start)
    at, long_name = "entropy/snapshot", "energy-weighted mean entropy of a snapshot"
    data = {
        at: variable(at, time, "s", "time of a snapshot"),
        "entropy/history": variable(at, measured.snapshot, "bit", long_name),
    }
    for name, text in AVERAGES.items():
        data[f"entropy/{name}"] = variable((), getattr(measured, name), "bit", text)
    if maps:
        text = "entropy over wavenumbers at a cell"
        data["entropy/local"] = variable((at, "cell"), measured.local, "bit", text)
        data["entropy/weight"] = variable((at, "cell"), measured.weight, "m2/s2", "wavelet energy at a cell")
    return data


def partition_variables(velocity: np.ndarray, masses: np.ndarray, time: np.ndarray, maps: bool) -> Variables:
    """Kinetic energy of ``velocity`` (snapshot, cell, dof) in m/s by wavenumber bins; ``masses`` (dof) in kg.

    ``time`` (snapshot) in s; with ``maps`` the energy of each bin in space and time as well.
    """
    measured = partition(velocity, masses, fields=maps)
    bins = len(measured.energy)
    at, by, bound = "partition/snapshot", "partition/bin", "partition/bound"
    table: dict[str, tuple[Any, ...]] = {
        at: (at, time, "s", "time of a snapshot"),
        by: (by, np.arange(1, bins + 1), "1", "wavenumber bin"),
        bound: (bound, np.arange(bins + 1), "1", "bound of a bin"),
        "partition/bounds": (bound, np.arange(bins + 1) * np.pi / bins, "rad/cell", "bounds of the bins"),
        "partition/energy": ((by, at), measured.energy, "J", "kinetic energy of a bin"),
        "partition/kinetic": (at, measured.kinetic, "J", "kinetic energy"),
        "partition/reconstructed": (at, measured.reconstructed, "J", "kinetic energy of the bins' sum"),
        "partition/error": (at, measured.error, "1", "relative error of the reconstructed kinetic energy"),
        "partition/cross_share": (at, measured.cross_share, "1", "share of the energy between bins"),
    }
    if maps:
        table["partition/kinetic_energy"] = (by, at, "cell"), measured.field, "J", "kinetic energy of a bin in a cell"
    return {name: variable(*row) for name, row in table.items()}
