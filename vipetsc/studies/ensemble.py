"""``ensemble.h5``: what was measured of every member of a sweep, over the swept keys, with power-law fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import xarray as xr

import vipetsc
from vipetsc.case import Sweep, SweepMember
from vipetsc.case.sweep import coordinate
from vipetsc.io.netcdf import Variables, variable, write_netcdf
from vipetsc.spectra import from_peak, normalised
from vipetsc.studies.wavelets import AVERAGES

FORMAT_VERSION = 1
COMPLETE, SCALED, FAILED = 0, 1, 2
STATUS = ("complete", "scaled", "failed")

# Scalars of a member's analysis.h5 and its statistics: unit, description.
MEASURES = {"ibtet": ("1", "inter-band energy transfer")}
MEASURES |= {f"entropy/{name}": ("bit", text) for name, text in AVERAGES.items()}
STATISTICS = {
    "contact_episodes": ("1", "contact episodes"),
    "dissipated_fraction": ("1", "dissipated energy over the drive's work"),
    "work": ("J", "work done by the drive"),
    "ledger_error": ("1", "largest error of the energy ledger over the work"),
}
LISTS = "entropy/snapshot", "entropy/history", "bands/share"
FITTED = ("ibtet", "entropy/energy_weighted", "entropy/masked", "entropy/joint")
AMPLITUDE = "drive.amplitude"
UNITS = {
    AMPLITUDE: "N",
    "drive.frequency": "rad/s",
    "drive.wavenumber": "rad/cell",
    "time.end": "s",
    "time.sample_interval": "s",
    "contacts.clearance": "m",
    "contacts.modulus": "Pa",
    "contacts.radius": "m",
}
FIT = {
    "peak_amplitude": ("N", "amplitude of the largest value"),
    "peak": ("1", "largest value, not normalised"),
    "points": ("1", "points from the peak on"),
    "exponent": ("1", "exponent of the log-log line"),
    "exponent_low": ("1", "lower end of its 95 % confidence interval"),
    "exponent_high": ("1", "upper end of its 95 % confidence interval"),
    "factor": ("1", "factor of the log-log line at 1 N"),
    "r2_log_log": ("1", "adjusted R^2 of the log-log line"),
    "exponent_nonlinear": ("1", "exponent of the nonlinear fit"),
    "factor_nonlinear": ("1", "factor of the nonlinear fit at 1 N"),
    "r2_nonlinear": ("1", "adjusted R^2 of the nonlinear fit"),
}


@dataclass(frozen=True)
class Outcome:
    """How a member ended: ``status`` COMPLETE, SCALED or FAILED, why, and its statistics."""

    status: int
    reason: str
    statistics: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """The status in a word."""
        return STATUS[self.status]


def assemble(plan: Sweep, members: Sequence[SweepMember], outcomes: Sequence[Outcome], folder: Path) -> Path:
    """Write ``folder/ensemble.h5`` from the members' files, whole or not at all; returns its path.

    A dimension for every axis, named after its first key, with a coordinate for every key; NaN where a member
    failed. The file depends on the members alone, not on when or on how many ranks they were made.
    """
    rows = _rows(members, outcomes, folder)
    data = _axes(plan)
    dims = tuple(name for name, item in data.items() if item.dims == (name,))

    def table(name: str) -> np.ndarray:
        """Measure ``name`` of all members, padded with NaN to the longest if it is a list, in the sweep's shape."""
        values = [np.asarray(row.get(name, np.nan), float) for row in rows]
        shape = max((value.shape for value in values), key=lambda shape: (len(shape), shape))
        padded = np.full((len(rows), *shape), np.nan)
        for i, value in enumerate(values):
            padded[(i, *map(slice, value.shape))] = value
        return padded.reshape(*plan.shape, *shape)

    status = np.array([outcome.status for outcome in outcomes], np.int8).reshape(plan.shape)
    flags = {"flag_values": np.arange(len(STATUS), dtype=np.int8), "flag_meanings": " ".join(STATUS)}
    data["status"] = variable(dims, status, "1", "how the member ended", **flags)
    for name, (unit, text) in (MEASURES | STATISTICS).items():
        values = table(name)
        if name in STATISTICS or not np.all(np.isnan(values)):
            data[name] = variable(dims, values, unit, text)
    if any("entropy/history" in row for row in rows):
        history = table("entropy/history")
        data["snapshot"] = variable("snapshot", np.arange(history.shape[-1]), "1", "number of a snapshot")
        data["entropy/history"] = variable((*dims, "snapshot"), history, "bit", "entropy of a snapshot")
        data["entropy/time"] = variable((*dims, "snapshot"), table("entropy/snapshot"), "s", "time of a snapshot")
    # Cells whose bands overlap differently have no common parts.
    if len(names := {row["parts"] for row in rows if "parts" in row}) == 1:
        (parts,) = names
        long_name = "mean share of a pass band or gap after the wave's arrival"
        data["part"] = variable("part", np.arange(1, len(parts) + 1), "1", "part of the frequency axis")
        shares = table("bands/share")
        data["bands/share"] = variable((*dims, "part"), shares, "1", long_name, parts=list(parts))
    failed = [f"{m.index}: {o.reason}" for m, o in zip(members, outcomes, strict=True) if o.status == FAILED]
    about = {"format_version": FORMAT_VERSION, "vipetsc_version": vipetsc.__version__, "case": plan.to_toml()}
    path = folder / "ensemble.h5"
    write_netcdf(path, xr.Dataset(data | _fits(plan, data), attrs=about | {"failed": failed}))
    return path


def _rows(members: Sequence[SweepMember], outcomes: Sequence[Outcome], folder: Path) -> list[dict[str, Any]]:
    """What is known of every member by name; empty for those that failed. Equal members are read once."""
    read: dict[str, dict[str, Any]] = {}
    rows: list[dict[str, Any]] = []
    for member, outcome in zip(members, outcomes, strict=True):
        if outcome.status == FAILED:
            rows.append({})
            continue
        if member.id not in read:
            read[member.id] = _measures_in(folder / member.id / "analysis.h5")
        statistics, work = outcome.statistics, outcome.statistics["work"]
        row = {"contact_episodes": statistics["episodes"], "ledger_error": statistics["ledger_error"], "work": work}
        row["dissipated_fraction"] = statistics["dissipated"] / work if work else np.nan
        rows.append(read[member.id] | row)
    return rows


def _measures_in(path: Path) -> dict[str, Any]:
    """The measures of one member that an ensemble holds."""
    # With h5py, since a sweep may have thousands of members and xarray takes 30 ms to open a file.
    with h5py.File(path) as file:
        row = {name: file[name][()] for name in (*MEASURES, *LISTS) if name in file}
        if "bands/share" in row:
            row["parts"] = tuple(file["bands/energy"].attrs["parts"])
    return row


def _axes(plan: Sweep) -> Variables:
    """A coordinate for every key that varies, over the first key of its axis."""
    names, data = plan.names(), {}
    for axis in plan.axes:
        for key, values in zip(axis.keys, axis.values, strict=True):
            data[names[key]] = variable(names[axis.keys[0]], coordinate(values), UNITS.get(key, "1"), key)
    return data


def _fits(plan: Sweep, data: Variables) -> Variables:
    """Power laws over the amplitude from the peak on; entropies are normalised to [.01, 1] first, as the paper's."""
    axis = next((axis for axis in plan.axes if AMPLITUDE in axis.keys), None)
    if axis is None:
        return {}
    along = plan.axes.index(axis)
    amplitude = np.array(axis.values[axis.keys.index(AMPLITUDE)], float)
    fits = {}
    for name in FITTED:
        if name in data:
            curves = np.moveaxis(data[name].values, along, -1)
            others = tuple(str(dim) for i, dim in enumerate(data[name].dims) if i != along)
            rows = [fit_curve(amplitude, curve, name != "ibtet") for curve in curves.reshape(-1, len(amplitude))]
            for key, (unit, text) in FIT.items():
                table = np.array([row[key] for row in rows]).reshape(curves.shape[:-1])
                fits[f"fits/{name}/{key}"] = variable(others, table, unit, text)
    return fits


def fit_curve(amplitude: np.ndarray, curve: np.ndarray, normalise: bool) -> dict[str, float]:
    """The entries of ``FIT`` for one curve over ``amplitude`` in N; NaN where it has no power law."""
    row = dict.fromkeys(FIT, np.nan)
    there = np.isfinite(curve)
    x, y = np.abs(amplitude[there]), curve[there]
    if len(y) < 3 or np.ptp(y) == 0:
        return row
    row["peak_amplitude"], row["peak"] = x[np.argmax(y)], y.max()
    order = np.argsort(x, kind="stable")
    row["points"] = len(y) - int(np.argmax(y[order]))
    if row["points"] < 3:
        return row
    y = normalised(y) if normalise else y
    line, curved = from_peak(x, y), from_peak(x, y, "nonlinear")
    low, high = line.exponent_interval
    row |= {"exponent": line.exponent, "exponent_low": low, "exponent_high": high, "factor": line.factor}
    row |= {"r2_log_log": line.r2_adjusted, "r2_nonlinear": curved.r2_adjusted}
    return row | {"exponent_nonlinear": curved.exponent, "factor_nonlinear": curved.factor}
