"""``ensemble.h5``: what was measured of every member of a sweep, over the swept keys, with power-law fits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

import vipetsc
from vipetsc.case import Sweep, SweepMember
from vipetsc.case.sweep import coordinate
from vipetsc.io.atomic import atomic_write
from vipetsc.io.store import Coordinates
from vipetsc.spectra import from_peak, normalised

FORMAT_VERSION = 1
COMPLETE, SCALED, FAILED = 0, 1, 2
STATUS = ("complete", "scaled", "failed")

# Scalars of a member's analysis.h5 and its statistics: unit, description.
MEASURES = {
    "ibtet": ("1", "inter-band energy transfer"),
    "entropy/energy_weighted": ("bit", "mean over time of the energy-weighted entropy"),
    "entropy/masked": ("bit", "mean entropy where the wave is louder than 1 % of its loudest"),
    "entropy/joint": ("bit", "mean over time of the entropy over cells and wavenumbers together"),
    "entropy/error": ("bit", "deviation over the cells of the masked time mean"),
}
STATISTICS = {
    "contact_episodes": ("1", "contact episodes"),
    "dissipated_fraction": ("1", "dissipated energy over the drive's work"),
    "work": ("J", "work done by the drive"),
    "ledger_error": ("1", "largest error of the energy ledger over the work"),
}
SERIES = {"entropy/snapshot": ("s", "time of a snapshot"), "entropy/history": ("bit", "entropy of a snapshot")}
FITTED = ("ibtet", "entropy/energy_weighted", "entropy/masked", "entropy/joint")
AMPLITUDE = "drive.amplitude"


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
    values, series, parts = _read(plan, members, outcomes, folder)
    path = folder / "ensemble.h5"
    with atomic_write(path) as aside, h5py.File(aside, "w") as file:
        coordinates = Coordinates(file)
        dimensions = _put_axes(plan, coordinates)
        status = np.array([o.status for o in outcomes], np.int8).reshape(plan.shape)
        coordinates.put("status", dimensions, status, "1", "how the member ended")
        file["status"].attrs["flag_values"] = np.arange(len(STATUS), dtype=np.int8)
        file["status"].attrs["flag_meanings"] = " ".join(STATUS)
        for name, (unit, text) in (MEASURES | STATISTICS).items():
            if not np.all(np.isnan(values[name])) or name in STATISTICS:
                coordinates.put(name, dimensions, values[name], unit, text)
        if series:
            length = next(iter(series.values())).shape[-1]
            coordinates.add("snapshot", np.arange(length), "1", "number of a snapshot")
            for name, (unit, text) in SERIES.items():
                target = "entropy/time" if name == "entropy/snapshot" else name
                coordinates.put(target, (*dimensions, "snapshot"), series[name], unit, text)
        if parts is not None:
            names, shares = parts
            coordinates.add("part", np.arange(1, len(names) + 1), "1", "part of the frequency axis")
            text = "mean share of a pass band or gap after the wave's arrival"
            coordinates.put("bands/share", (*dimensions, "part"), shares, "1", text)
            file["bands/share"].attrs["parts"] = list(names)
        _put_fits(plan, values, dimensions, coordinates)
        file.attrs["format_version"] = FORMAT_VERSION
        file.attrs["vipetsc_version"] = vipetsc.__version__
        file.attrs["case"] = plan.to_toml()
        file.attrs["failed"] = [f"{m.index}: {o.reason}" for m, o in _failed(members, outcomes)]
    return path


def _failed(members: Sequence[SweepMember], outcomes: Sequence[Outcome]) -> Iterator[tuple[SweepMember, Outcome]]:
    return ((m, o) for m, o in zip(members, outcomes, strict=True) if o.status == FAILED)


def _put_axes(plan: Sweep, coordinates: Coordinates) -> tuple[str, ...]:
    """A scale for each axis, further keys of the axis over it; returns the dimensions' names."""
    names, dimensions = plan.names(), []
    for axis in plan.axes:
        first = axis.keys[0]
        for key, values in zip(axis.keys, axis.values, strict=True):
            data = coordinate(values)
            if data.dtype == object:
                data = data.astype(h5py.string_dtype())
            if key == first:
                coordinates.add(names[key], data, UNITS.get(key, "1"), key)
            else:
                coordinates.put(names[key], (names[first],), data, UNITS.get(key, "1"), key)
        dimensions.append(names[first])
    return tuple(dimensions)


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


def _read(plan: Sweep, members: Sequence[SweepMember], outcomes: Sequence[Outcome], folder: Path) -> tuple:
    """Scalars (name -> array of the sweep's shape), histories padded with NaN, and shares of the parts."""
    count = len(members)
    values = {name: np.full(count, np.nan) for name in (*MEASURES, *STATISTICS)}
    histories: dict[str, list[np.ndarray]] = {name: [np.zeros(0)] * count for name in SERIES}
    shares, names = [np.zeros(0)] * count, None
    seen: dict[str, int] = {}
    for i, (member, outcome) in enumerate(zip(members, outcomes, strict=True)):
        if outcome.status == FAILED:
            continue
        statistics = outcome.statistics
        work = statistics["work"]
        values["contact_episodes"][i] = statistics["episodes"]
        values["work"][i] = work
        values["dissipated_fraction"][i] = statistics["dissipated"] / work if work else np.nan
        values["ledger_error"][i] = statistics["ledger_error"]
        twin = seen.setdefault(member.id, i)
        if twin != i:
            for name in MEASURES:
                values[name][i] = values[name][twin]
            for found in histories.values():
                found[i] = found[twin]
            shares[i] = shares[twin]
            continue
        with h5py.File(folder / member.id / "analysis.h5") as file:
            for name in MEASURES:
                values[name][i] = file[name][()] if name in file else np.nan
            for name, found in histories.items():
                found[i] = file[name][...] if name in file else np.zeros(0)
            if "bands/share" in file:
                shares[i] = file["bands/share"][...]
                own = tuple(file["bands/energy"].attrs["parts"])
                names = own if names in (None, own) else ()
    shape = plan.shape
    shaped = {name: found.reshape(shape) for name, found in values.items()}
    series = {name: _padded(found, shape) for name, found in histories.items() if any(f.size for f in found)}
    # Cells whose bands overlap differently have no common parts.
    parts = (names, _padded(shares, shape)) if names else None
    return shaped, series, parts


def _padded(rows: Sequence[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
    longest = max(len(row) for row in rows)
    table = np.full((len(rows), longest), np.nan)
    for i, row in enumerate(rows):
        table[i, : len(row)] = row
    return table.reshape(*shape, longest)


def _put_fits(
    plan: Sweep, values: dict[str, np.ndarray], dimensions: tuple[str, ...], coordinates: Coordinates
) -> None:
    """Power laws over the amplitude from the peak on; entropies are normalised to [.01, 1] first, as the paper's."""
    along = next((i for i, axis in enumerate(plan.axes) if AMPLITUDE in axis.keys), None)
    if along is None:
        return
    axis = plan.axes[along]
    amplitude = np.array(axis.values[axis.keys.index(AMPLITUDE)], float)
    others = tuple(d for i, d in enumerate(dimensions) if i != along)
    for name in FITTED:
        curves = np.moveaxis(values[name], along, -1)
        if np.all(np.isnan(curves)):
            continue
        shape = curves.shape[:-1]
        rows = [fit_curve(amplitude, curve, name != "ibtet") for curve in curves.reshape(-1, len(amplitude))]
        for key, (unit, text) in FIT.items():
            table = np.array([row[key] for row in rows]).reshape(shape)
            coordinates.put(f"fits/{name}/{key}", others, table, unit, text)


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
    law = from_peak(x, normalised(y) if normalise else y)
    line, curved = law.log_log, law.nonlinear
    low, high = line.exponent_interval
    row |= {"exponent": line.exponent, "exponent_low": low, "exponent_high": high, "factor": line.factor}
    row |= {"r2_log_log": line.r2_adjusted, "r2_nonlinear": curved.r2_adjusted}
    return row | {"exponent_nonlinear": curved.exponent, "factor_nonlinear": curved.factor}
