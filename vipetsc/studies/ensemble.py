"""``ensemble.h5``: what was measured of every member of a sweep, over the swept keys, with power-law fits."""

import json
import sys
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
from vipetsc.spectra import FEWEST, doubt, normalised, power_law
from vipetsc.studies.analysis import LAYOUT

FORMAT_VERSION = 1
STATUS = ("complete", "scaled", "failed", "missing")  # missing: not reached before a stop
COMPLETE, SCALED, FAILED, MISSING = range(4)
AMPLITUDE = "drive.amplitude"
FITTED = ("ibtet", "entropy/energy_weighted", "entropy/masked", "entropy/joint")

# Further dimension, units and description of what is known of a member: statistics of its run, then of its analysis.
STATISTICS = {
    "contact_episodes": ("", "1", "contact episodes"),
    "dissipated_fraction": ("", "1", "dissipated energy over the drive's work"),
    "work": ("", "J", "work done by the drive"),
    "ledger_error": ("", "1", "largest error of the energy ledger over the work"),
}
MEASURES = {name: LAYOUT[name] for name in (*FITTED, "ibtet_whole", "entropy/error")} | {
    "entropy/history": ("snapshot", "bit", "entropy of a snapshot"),
    "entropy/snapshot": ("snapshot", "s", "time of a snapshot"),
    "bands/share": ("part", "1", "mean share of a pass band or gap after the wave's arrival"),
}
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
    "is_power_law": (
        "1",
        f"1 where the log-log line is a power law: {FEWEST} points or more, adjusted R^2 not below 0",
    ),
}


@dataclass(frozen=True)
class Outcome:
    """How a member ended: the index of its ``status`` in ``STATUS``, why, and its run's statistics."""

    status: int
    reason: str = ""
    statistics: dict[str, Any] = field(default_factory=dict)


def assemble(
    plan: Sweep, members: Sequence[SweepMember], outcomes: Sequence[Outcome], folder: Path, warnings: Sequence[str] = ()
) -> None:
    """Write ``folder/ensemble.h5`` from the members' files, with ``warnings`` about them, whole or not at all.

    A dimension for every axis, named after its first key, with a coordinate for every key; NaN where a member
    failed. The file depends on the members alone, not on when or on how many ranks they were made.
    """
    sys.audit("vipetsc.merge", str(folder))
    rows = _rows(members, outcomes, folder)
    names, data = plan.names(), {}
    for axis in plan.axes:
        for key, values in axis.items():
            data[names[key]] = variable(names[next(iter(axis))], coordinate(values), UNITS.get(key, "1"), key)
    dims = tuple(names[next(iter(axis))] for axis in plan.axes)

    status = np.array([outcome.status for outcome in outcomes], np.int8).reshape(plan.shape)
    flags = {"flag_values": np.arange(MISSING, dtype=np.int8), "flag_meanings": " ".join(STATUS[:MISSING])}
    data["status"] = variable(dims, status, "1", "how the member ended", **flags)
    parts = {row["parts"] for row in rows if "parts" in row}
    for name, (further, *texts) in (STATISTICS | MEASURES).items():
        table = _table(rows, name, plan.shape)
        if further == "part" and len(parts) != 1:  # cells whose bands overlap differently have no common parts
            continue
        if name in STATISTICS or table.ndim > len(dims) or not np.isnan(table).all():
            data[name] = variable((*dims, *further.split()), table, *texts)
    if "entropy/history" in data:
        number = np.arange(data["entropy/history"].shape[-1])
        data["snapshot"] = variable("snapshot", number, "1", "number of a snapshot")
        data["entropy/time"] = data.pop("entropy/snapshot")
    if "bands/share" in data:
        data["bands/share"].attrs["parts"] = list(parts.pop())
        number = np.arange(1, data["bands/share"].shape[-1] + 1)
        data["part"] = variable("part", number, "1", "part of the frequency axis")
    failed = [f"{m.index}: {o.reason}" for m, o in zip(members, outcomes, strict=True) if o.status == FAILED]
    about = {"format_version": FORMAT_VERSION, "vipetsc_version": vipetsc.__version__}
    about |= {"case": plan.to_toml(), "failed": failed, "warnings": json.dumps(warnings)}
    data |= _fits(data, names[AMPLITUDE]) if AMPLITUDE in names else {}
    write_netcdf(folder / "ensemble.h5", xr.Dataset(data, attrs=about))


def _rows(members: Sequence[SweepMember], outcomes: Sequence[Outcome], folder: Path) -> list[dict[str, Any]]:
    """What is known of every member by name; empty for those that failed. Equal members are read once."""
    measures: dict[str, dict[str, Any]] = {}
    rows: list[dict[str, Any]] = []
    for identity, outcome in zip((member.id for member in members), outcomes, strict=True):
        if outcome.status == FAILED:
            rows.append({})
            continue
        if identity not in measures:
            # With h5py, since a sweep may have thousands of members and xarray takes 30 ms to open a file.
            with h5py.File(folder / identity / "analysis.h5") as file:
                row = {name: file[name][()] for name in MEASURES if name in file}
                row |= {"parts": tuple(file["bands/energy"].attrs["parts"])} if "bands/share" in row else {}
                measures[identity] = row
        known = outcome.statistics
        row = {"contact_episodes": known["episodes"], "ledger_error": known["ledger_error"], "work": known["work"]}
        row["dissipated_fraction"] = known["dissipated"] / known["work"] if known["work"] else np.nan
        rows.append(measures[identity] | row)
    return rows


def _table(rows: Sequence[dict[str, Any]], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """What ``name`` is of all members in the sweep's ``shape``; lists have a further axis, padded with NaN."""
    values = [np.asarray(row.get(name, np.nan), float) for row in rows]
    longest = max((value.shape for value in values), key=lambda one: (len(one), one))
    table = np.full((len(rows), *longest), np.nan)
    for i, value in enumerate(values):
        table[(i, *map(slice, value.shape))] = value
    return table.reshape(*shape, *longest)


def _fits(data: Variables, along: str) -> Variables:
    """Power laws over the amplitude, the coordinate ``along``, from the peak on.

    Entropies are normalised to [.01, 1] first, as the paper's.
    """
    fits: Variables = {}
    amplitude = data[along].values.astype(float)
    for name in FITTED:
        if name in data:
            curves = data[name].transpose(..., *data[along].dims)
            rows = [fit_curve(amplitude, y, name != "ibtet") for y in curves.values.reshape(-1, len(amplitude))]
            for key, about in FIT.items():
                table = np.array([row[key] for row in rows]).reshape(curves.shape[:-1])
                fits[f"fits/{name}/{key}"] = variable([*map(str, curves.dims[:-1])], table, *about)
    return fits


def fit_curve(amplitude: np.ndarray, curve: np.ndarray, normalise: bool) -> dict[str, float]:
    """The entries of ``FIT`` for one curve over ``amplitude`` in N, a fit from its peak on; NaN where there is none."""
    row = dict.fromkeys(FIT, np.nan)
    valid = np.isfinite(curve)
    order = np.argsort(np.abs(amplitude[valid]), kind="stable")
    x, y = np.abs(amplitude[valid])[order], curve[valid][order]
    if len(y) < 3 or np.ptp(y) == 0:
        return row
    peak = int(np.argmax(y))
    row |= {"peak_amplitude": x[peak], "peak": y[peak], "points": len(y) - peak, "is_power_law": 0.0}
    if row["points"] < 3:
        return row
    y = normalised(y) if normalise else y
    line, curved = power_law(x[peak:], y[peak:]), power_law(x[peak:], y[peak:], "nonlinear")
    low, high = line.exponent_interval
    row |= {"exponent": line.exponent, "exponent_low": low, "exponent_high": high, "factor": line.factor}
    row["is_power_law"] = float(not doubt(row["points"], line.r2_adjusted))
    row |= {"r2_log_log": line.r2_adjusted, "r2_nonlinear": curved.r2_adjusted}
    return row | {"exponent_nonlinear": curved.exponent, "factor_nonlinear": curved.factor}
