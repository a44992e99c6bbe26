"""Wavenumber partition and entropy of one run, as groups of its ``analysis.h5``."""

from __future__ import annotations

from collections.abc import Collection

import h5py
import numpy as np

from vipetsc.io.run_file import RunFile
from vipetsc.spectra import entropy, partition
from vipetsc.studies.datasets import put

SNAPSHOTS = 500  # at most this many of a run's samples are transformed; averages over time need no more
MOST_CELLS = 40_000  # longer lattices take minutes: their spectra are left to those who window the record


def put_wavelets(
    run: RunFile, velocity: np.ndarray, out: h5py.File, measures: Collection[str], arrival: float | None
) -> list[str]:
    """Write ``/partition`` and ``/entropy`` of the host velocity as far as ``measures`` asks; returns what is left out.

    ``velocity`` (t, cell, dof) in m/s; ``arrival`` in s as for ``analyse``.
    """
    nt, cells = velocity.shape[:2]
    if cells > MOST_CELLS:
        return [f"partition, entropy: more than {MOST_CELLS} cells were recorded"]
    stride = -(-nt // (SNAPSHOTS + 1))
    time = run.field_time[::stride]
    host = run.model.chain.cell.host
    maps = "maps" in measures
    if "entropy" in measures:
        reason = "the largest host velocity at the first site in the linear run"
        if arrival is None:
            arrival, reason = _estimate(run), "half the burst and the way to the first site at the group velocity"
        # A record that ends before keeps its last snapshot.
        start = min(int(np.searchsorted(time, arrival)), len(time) - 1)
        _put_entropy(np.ascontiguousarray(velocity[::stride, :, host]), time, start, out, maps)
        out["entropy"].attrs["start"] = time[start]
        out["entropy"].attrs["starts_when"] = reason
    if "partition" in measures:
        _put_partition(velocity[::stride], run.masses, time, out, maps)
    return []


def _estimate(run: RunFile) -> float:
    model = run.model
    site = run.leading_site
    distance = 0 if site is None else abs(int(run.site_cells[site]) - 1 - model.drive_cell)
    return 0.5 * model.drive.duration + distance / model.speed


def _put_entropy(host: np.ndarray, time: np.ndarray, start: int, out: h5py.File, maps: bool) -> None:
    found = entropy(host, start)
    group = out.create_group("entropy")
    put(group, "snapshot", time, "s", "time of a snapshot")
    put(group, "history", found.snapshot, "bit", "energy-weighted mean entropy of a snapshot", "snapshot")
    averages = {
        "energy_weighted": (found.energy_weighted, "mean over time of the energy-weighted entropy"),
        "masked": (found.masked, "mean entropy where the wave is louder than 1 % of its loudest"),
        "joint": (found.joint, "mean over time of the entropy over cells and wavenumbers together"),
        "error": (found.error, "deviation over the cells of the masked time mean"),
    }
    for name, (value, text) in averages.items():
        put(group, name, value, "bit", text)
    if maps:
        put(group, "local", found.local, "bit", "entropy over wavenumbers at a cell", "snapshot", "cell")
        put(group, "weight", found.weight, "m2/s2", "wavelet energy at a cell", "snapshot", "cell")


def _put_partition(velocity: np.ndarray, masses: np.ndarray, time: np.ndarray, out: h5py.File, maps: bool) -> None:
    found = partition(velocity, masses, fields=maps)
    group = out.create_group("partition")
    bins = len(found.energy)
    put(group, "snapshot", time, "s", "time of a snapshot")
    put(group, "bin", np.arange(1, bins + 1), "1", "wavenumber bin")
    put(group, "bound", np.arange(bins + 1), "1", "bound of a bin")
    put(group, "bounds", np.arange(bins + 1) * np.pi / bins, "rad/cell", "bounds of the bins", "bound")
    put(group, "energy", found.energy, "J", "kinetic energy of a bin", "bin", "snapshot")
    put(group, "kinetic", found.kinetic, "J", "kinetic energy", "snapshot")
    put(group, "reconstructed", found.reconstructed, "J", "kinetic energy of the bins' sum", "snapshot")
    put(group, "error", found.error, "1", "relative error of the reconstructed kinetic energy", "snapshot")
    put(group, "cross_share", found.cross_share, "1", "share of the energy between bins", "snapshot")
    if maps:
        text = "kinetic energy of a bin in a cell"
        put(group, "kinetic_energy", found.field, "J", text, "bin", "snapshot", "cell")
