"""``ensemble.h5``: the measures of all members of a sweep over the swept keys, with power-law fits."""

import json
import sys
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypedDict

import numpy as np
import xarray as xr

from vipetsc.case import Sweep
from vipetsc.case.disorder import SEED
from vipetsc.case.keys import unit_of
from vipetsc.case.sweep import coordinate
from vipetsc.io.folder import origin
from vipetsc.io.netcdf import Variables, variable, write_netcdf
from vipetsc.io.records import Line, Record
from vipetsc.spectra import FEWEST, doubt, normalised, power_law
from vipetsc.spectra.measures import MEASURES as REGISTRY
from vipetsc.spectra.measures import PART, power_of, row_of
from vipetsc.studies.linear_run import FITTED, LINEAR, MEASURES, MEMBER, MEMBERS, LinearRun, of_motion
from vipetsc.studies.recorded_runs import RecordPaths
from vipetsc.wording import counted, shortened

# Members of a curve, and points from its peak on, for which a power law is fitted: two lie on one of any kind.
LEAST_FITTED = 3
STATUS = ("complete", "scaled", "failed", "missing")  # missing: not reached before a stop
COMPLETE, SCALED, FAILED, MISSING = range(4)
AMPLITUDE = "drive.amplitude"

# Statistics of a member in the ensemble, in addition to the ``MEASURES`` of its analysis.
STATISTICS = {name: REGISTRY[name].row for name in ("contact_episodes", "dissipated_fraction", "work", "ledger_error")}
# Unit and text of what a fit consists of. {unit} stands for the unit of the amplitude, {measure} for that of the
# measure, {fitted} for that of the values to which the law is fitted.
FIT = {
    "peak_amplitude": ("{unit}", "amplitude of the largest value"),
    "peak": ("{measure}", "largest value, not normalised"),
    "points": ("1", "number of points from the peak on"),
    "exponent": ("1", "exponent of the log-log fit"),
    "exponent_low": ("1", "lower end of its 95 % confidence interval"),
    "exponent_high": ("1", "upper end of its 95 % confidence interval"),
    "factor": ("{fitted}", "value of the log-log fit at 1 {unit}"),
    "r2_log_log": ("1", "adjusted R^2 of the log-log fit"),
    "exponent_nonlinear": ("1", "exponent of the nonlinear fit"),
    "factor_nonlinear": ("{fitted}", "value of the nonlinear fit at 1 {unit}"),
    "r2_nonlinear": ("1", "adjusted R^2 of the nonlinear fit"),
    "is_power_law": ("1", f"1 where the fit is a power law: {FEWEST} points or more, an exponent that is not 0"),
}
# Groups of the fits: of the values as they are, and, for entropies, of values scaled to [0.01, 1] as the paper does.
FITS = "fits"
NORMALISED_FITS = "normalised_fits"
# The median, the quartiles, and at both ends those between which nine of ten samples lie: figures shade this band.
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


class LinearSource(NamedTuple):
    """Source of a scaled member: the ``name`` of a linear run, measured for the first ``site`` (cell).

    The member's wave is that of the run times the ``factor``.
    """

    name: str
    site: int
    factor: float


class FailedMember(TypedDict):
    """A member that failed: its ``place`` over the axes of the sweep, its name ``id``, and the ``reason``."""

    place: list[int]
    id: str
    reason: str


class Results:
    """Content of the records of the sweep ``plan`` in ``folder``, without those of other versions and sweeps.

    ``status`` (member): how each ended, an index of ``STATUS``; ``reasons`` of those that failed by number; ``tables``
    (member, or member and a list, padded with NaN) of what was measured by name, for the first of equal members;
    ``errors`` the largest sampling error of each measure over the members; ``used`` tolerances, engines and options of
    the analysis; ``linear`` runs by name; ``parts`` the names of the parts of the frequency axis by the number of a
    member, since the bands of each may overlap differently; ``lines`` the places of the records in their files.
    ``first`` (member) is the number of the first member that is equal. ``warnings`` by number are about the members,
    ``damaged`` names lines that could not be used.
    """

    def __init__(self, plan: Sweep, folder: Path) -> None:
        self.plan = plan
        self.folder = folder
        self.ids = plan.ids()
        self.paths = RecordPaths(folder, MEMBERS)
        self.files = self.paths.existing()
        self.status = np.full(plan.count, MISSING, np.int8)
        self.reasons: dict[int, str] = {}
        self.tables: dict[str, np.ndarray] = {}
        self.linear: dict[str, LinearRun] = {}
        self.lines: dict[str, Line] = {}
        self.parts: dict[int, tuple[str, ...]] = {}
        self.warnings: dict[int, list[str]] = {}
        self.damaged: list[str] = []
        self.cpu_seconds: dict[int, float] = {}
        self.used: dict[str, set[Any]] = {"rtol": set(), "engine": set(), "analysis": set()}
        self.errors: dict[str, float] = {}

        number_of: dict[str, int] = {}
        self.first = np.array([number_of.setdefault(name, number) for number, name in enumerate(self.ids)])
        sources = self._read(number_of)
        self._scale(sources)
        self.status = self.status[self.first]

    def _read(self, number_of: Mapping[str, int]) -> dict[int, LinearSource]:
        """Take all records; returns what scaled members were scaled from, by the members' numbers."""
        sources: dict[int, LinearSource] = {}
        for key, record, line in self.paths.read(self.damaged.append):
            number = number_of.get(str(key))
            if record["kind"] == LINEAR and "reason" not in record:
                # It may be measured for other sites than an earlier record of the same run.
                name = record["linear"]
                self.linear[name] = LinearRun.from_record(record).joined(self.linear.get(name))
            elif record["kind"] == MEMBER and number is not None:
                self._enter(number, record)
                if self.status[number] == SCALED:
                    sources[number] = LinearSource(record["linear"], record["site"], record.get("factor", 1.0))
            else:
                continue
            self.lines[str(key)] = line
        return sources

    def failures(self, most: int | None = None) -> list[FailedMember]:
        """Return the members that have failed, the first ``most`` of them if that is given."""
        return [
            FailedMember(
                place=[int(i) for i in np.unravel_index(number, self.plan.shape)],
                id=self.ids[number],
                reason=self.reasons[int(self.first[number])],
            )
            for number in np.flatnonzero(self.status == FAILED)[:most]
        ]

    def _enter(self, number: int, record: Record) -> None:
        """Take the ``record`` of a member."""
        self.status[number] = COMPLETE
        if "linear" in record:
            self.status[number] = SCALED
        self.reasons.pop(number, None)
        if "reason" in record:
            self.status[number] = FAILED
            self.reasons[number] = record["reason"]
            return

        statistics = record["statistics"]
        row = {
            "contact_episodes": statistics["episodes"],
            "ledger_error": statistics["ledger_error"],
            "work": statistics["work"],
            "dissipated_fraction": np.nan,
        }
        if statistics["work"]:
            row["dissipated_fraction"] = statistics["dissipated"] / statistics["work"]
        # Scaled members have no measures of their own: they get those of their linear run at the end.
        self._put(number, row | record.get("measures", {}))
        # An amplitude sweep goes below the onset on purpose.
        self.warnings[number] = [text for text in record["warnings"] if text != statistics.get("contact_note")]
        self.cpu_seconds[number] = record["cpu_seconds"]
        self.used["rtol"].add(record["rtol"])
        self.used["engine"].add(statistics["engine"])

    def _put(self, number: int | list[int], row: Record) -> None:
        """Enter the measures of a member, or of several equal ones, into the tables."""
        if row.get("parts"):
            self.parts |= dict.fromkeys(np.atleast_1d(number).tolist(), tuple(row["parts"]))
        if row.get("analysis"):
            self.used["analysis"].add(row["analysis"])
        for name, error in row.get("errors", {}).items():
            self.errors[name] = max(error, self.errors.get(name, 0.0))

        for name in row.keys() - {"parts", "analysis", "errors", "unsettled"}:
            value = np.asarray(row[name], float)
            if name not in self.tables:
                self.tables[name] = np.full((len(self.ids), *value.shape), np.nan)
            table = self.tables[name]
            if value.ndim and len(value) > table.shape[1]:
                missing_columns = len(value) - table.shape[1]
                table = np.pad(table, ((0, 0), (0, missing_columns)), constant_values=np.nan)
                self.tables[name] = table
            # The rest of the row stays NaN: lists of members may have different lengths.
            table[(number, *map(slice, value.shape))] = value

    def _scale(self, sources: Mapping[int, LinearSource]) -> None:
        """Give scaled members the measures of their linear runs; those whose record is lost are missing."""
        # All members of one source at once: a large sweep has thousands of each.
        members: dict[LinearSource, list[int]] = {}
        for number, source in sources.items():
            if self.status[number] == SCALED:
                members.setdefault(source, []).append(number)

        for source, numbers in members.items():
            run = self.linear.get(source.name)
            if run is None or source.site not in run.measures:
                self.status[numbers] = MISSING
                continue
            row = run.measures[source.site]
            for number in numbers:
                self.warnings[number] = [*self.warnings[number], *row.get("unsettled", [])]
            for name in of_motion(row):
                row = row | {name: np.asarray(row[name], float) * source.factor ** power_of(name)}
            self._put(numbers, row)
            if "bands/modal_energy" in run.measures[source.site]:
                energy = self.tables["bands/modal_energy"]
                # Energies grow with the square of the amplitude, as the work does.
                energy[numbers] *= self.tables["work"][numbers, None] / run.statistics["work"]

    def gaps(self) -> list[str]:
        """Return sentences on measures that only some of the members have that did not fail; the others' are NaN."""
        done = (self.status == COMPLETE) | (self.status == SCALED)
        names: dict[int, list[str]] = {}
        for name in _layout(self):
            if name in self.tables:
                rows = self.tables[name][self.first][done]
                without = int(np.isnan(rows).reshape(len(rows), -1).all(axis=1).sum())
                if 0 < without < len(rows):
                    names.setdefault(without, []).append(name)

        members = counted(int(done.sum()), "member")
        return [f"{number} of {members} have no value (NaN) of {shortened(names[number])}" for number in sorted(names)]

    def merge_files(self) -> None:
        """Merge the records of all ranks into one file, without outdated ones."""
        if self.damaged or self.files != [self.paths.merged]:
            self.paths.merge(self.lines.values())


def assemble(results: Results, warnings: Sequence[str] = ()) -> None:
    """Write ``ensemble.h5`` from the ``results`` of a sweep, with ``warnings`` about them, whole or not at all.

    A dimension for every axis, named after its first key, with a coordinate for every key; NaN where a member
    failed. The file depends on the members alone, not on when or on how many ranks they were simulated.
    """
    sys.audit("vipetsc.merge", str(results.folder))
    plan = results.plan
    data = _coordinates(plan) | _member_variables(results) | _measured_variables(results)
    data |= _fit_variables(results, data)

    about = origin()
    # Sorted, since the file must not depend on the order in which members were simulated.
    about |= {name: sorted(values) for name, values in results.used.items()}
    about |= {"case": plan.to_toml(), "failed": json.dumps(results.failures()), "warnings": json.dumps(warnings)}
    write_netcdf(results.folder / "ensemble.h5", xr.Dataset(data, attrs=about))


def _dimensions(plan: Sweep) -> tuple[str, ...]:
    """Return the name of each axis of the sweep: that of its first key."""
    names = plan.names()
    return tuple(names[next(iter(axis))] for axis in plan.axes)


def _coordinates(plan: Sweep) -> Variables:
    """Return the swept values of every key."""
    names = plan.names()
    data: Variables = {}
    for axis, dimension in zip(plan.axes, _dimensions(plan), strict=True):
        for key, values in axis.items():
            data[names[key]] = variable(dimension, coordinate(values), unit_of(key, plan.table) or "1", key)
    return data


def _member_variables(results: Results) -> Variables:
    """Return variables of how every member ended, and its name."""
    plan = results.plan
    dims = _dimensions(plan)
    flags = {"flag_values": np.arange(MISSING, dtype=np.int8), "flag_meanings": " ".join(STATUS[:MISSING])}
    ids = np.array(results.ids, dtype=object).reshape(plan.shape)
    return {
        "status": variable(dims, results.status.reshape(plan.shape), "1", "how the member ended", **flags),
        "member": variable(dims, ids, "1", "name of the member, and of its folder if it has one"),
    }


def _measured_variables(results: Results) -> Variables:
    """Return ``STATISTICS`` and the measures that some member has, with the coordinates that they need."""
    plan = results.plan
    dims = _dimensions(plan)
    parts = _joined(results.parts.values())
    data: Variables = {}
    for name, (further, *texts) in _layout(results).items():
        table = results.tables.get(name, np.full(plan.count, np.nan))
        if further == PART and table.ndim > 1:
            table = _over_parts(table, results.parts, parts)
        table = table[results.first]
        if name in STATISTICS or table.ndim > 1 or not np.isnan(table).all():
            error: dict[str, Any] = {}
            if name in results.errors:
                error["largest_sampling_error"] = results.errors[name]
            table = table.reshape(*plan.shape, *table.shape[1:])
            data[name] = variable((*dims, *further.split()), table, *texts, **error)

    # The times of snapshots may differ between members: the dimension that they have in common is the number.
    if "entropy/history" in data:
        number = np.arange(data["entropy/history"].shape[-1])
        data["snapshot"] = variable("snapshot", number, "1", "number of a snapshot")
        data["entropy/time"] = data.pop("entropy/snapshot")
    for name in [name for name, item in data.items() if PART in item.dims]:
        data[name].attrs["parts"] = parts
        if PART not in data:
            number = np.arange(1, len(parts) + 1)
            data["part"] = variable("part", number, "1", "part of the frequency axis")
    return data


def _joined(cuts: Iterable[tuple[str, ...]]) -> list[str]:
    """Return the names of all parts in ``cuts`` of the frequency axis, each behind the one that it follows in a cut.

    Bands that overlap are one part ("band 1+2") for some members, and two parts and a gap for others.
    """
    joined: list[str] = []
    # Sorted, since the file must not depend on the order in which members were simulated.
    for cut in sorted(set(cuts)):
        place = 0
        for name in cut:
            if name not in joined:
                joined.insert(place, name)
            place = joined.index(name) + 1
    return joined


def _over_parts(table: np.ndarray, cuts: Mapping[int, tuple[str, ...]], parts: list[str]) -> np.ndarray:
    """Return a ``table`` (member, part of the member) over all ``parts``; NaN for those that a member does not have.

    ``cuts`` are the names of the parts by the number of a member.
    """
    over_all = np.full((len(table), len(parts)), np.nan)
    for number, cut in cuts.items():
        over_all[number, [parts.index(name) for name in cut]] = table[number, : len(cut)]
    return over_all


def _layout(results: Results) -> dict[str, tuple[str, str, str]]:
    """Return rows of all that the ``results`` may hold, in an order that does not depend on that of the members."""
    of_points = sorted(of_motion(results.tables))
    return STATISTICS | MEASURES | {name: row_of(name) for name in of_points}


def _fit_variables(results: Results, data: Variables) -> Variables:
    """Return the power laws over the amplitude; statistics over samples of disorder, and power laws of their means."""
    plan = results.plan
    names = plan.names()
    fits: Variables = {}
    if AMPLITUDE in names:
        fits |= _fits(data, names[AMPLITUDE])
    if any(axis.keys() == {SEED} for axis in plan.axes):
        fits |= over_samples(data, names[SEED], [name for name in _layout(results) if name in data])
        if AMPLITUDE in names:
            amplitude = names[AMPLITUDE]
            means = {name: fits[f"statistics/{name}/mean"] for name in FITTED if name in data}
            fits_of_means = _fits(means | {amplitude: data[amplitude]}, amplitude)
            fits |= {f"statistics/{name}": fit for name, fit in fits_of_means.items()}
    return fits


def _fits(data: Variables, along: str) -> Variables:
    """Return power laws over the amplitude, the coordinate ``along``, from the peak on: ``FITS``, ``NORMALISED_FITS``.

    A curve that is scaled to [0.01, 1] has another exponent, which depends on the range of amplitudes: the lowest value
    that the sweep has becomes 0.01.
    """
    fits: Variables = {}
    for name in FITTED:
        if name in data:
            fits |= _fits_of(data[name], data[along], f"{FITS}/{name}", normalise=False)
            if name.startswith("entropy/"):
                fits |= _fits_of(data[name], data[along], f"{NORMALISED_FITS}/{name}", normalise=True)
    return fits


def _fits_of(item: xr.Variable, along: xr.Variable, prefix: str, normalise: bool) -> Variables:
    """Return the power laws of a measure, the ``item``, over the amplitudes ``along``, as variables ``prefix``/..."""
    curves = item.transpose(..., *along.dims)
    dims = [*map(str, curves.dims[:-1])]
    amplitude = along.values.astype(float)
    rows = [fit_curve(amplitude, curve, normalise) for curve in curves.values.reshape(-1, len(amplitude))]
    units = {"unit": along.attrs["units"], "measure": item.attrs["units"], "fitted": item.attrs["units"]}
    if normalise:
        units["fitted"] = "1"

    fits: Variables = {}
    for key, about in FIT.items():
        table = np.array([row[key] for row in rows]).reshape(curves.shape[:-1])
        unit, text = (part.format(**units) for part in about)
        fits[f"{prefix}/{key}"] = variable(dims, table, unit, text)
    return fits


def fit_curve(amplitude: np.ndarray, curve: np.ndarray, normalise: bool) -> dict[str, float]:
    """Return entries of ``FIT`` for one ``curve`` (amplitude,) over the ``amplitude`` (amplitude,); NaN without a fit.

    From the curve's peak on y = factor A^exponent, A the amplitude's size, by a straight line of log y over log A and
    by nonlinear least squares of y; with ``normalise`` y is scaled to [0.01, 1] first. A member without a drive, in a
    lattice that begins in motion, is none of the curve's points: a power law has no value at A = 0. There is no fit of
    a curve that is zero somewhere behind its peak.
    """
    row = dict.fromkeys(FIT, np.nan)
    valid = np.isfinite(curve) & (amplitude != 0)
    # The sign of the amplitude is a phase of the drive: the size orders the curve.
    order = np.argsort(np.abs(amplitude[valid]), kind="stable")
    x = np.abs(amplitude[valid])[order]
    y = curve[valid][order]
    # A constant has no peak to begin at.
    if len(y) < LEAST_FITTED or np.ptp(y) == 0:
        return row

    peak = int(np.argmax(y))
    row["peak_amplitude"] = x[peak]
    row["peak"] = y[peak]
    row["points"] = len(y) - peak
    row["is_power_law"] = 0.0
    if normalise:
        y = normalised(y)
    if row["points"] < LEAST_FITTED or not (y[peak:] > 0).all():
        return row

    line = power_law(x[peak:], y[peak:])
    # The paper gives both fits: the line weighs relative errors, the nonlinear fit the large values.
    curved = power_law(x[peak:], y[peak:], "nonlinear")
    low, high = line.exponent_interval
    return row | {
        "exponent": line.exponent,
        "exponent_low": low,
        "exponent_high": high,
        "factor": line.factor,
        "is_power_law": float(not doubt(row["points"], line.r2_adjusted)),
        "r2_log_log": line.r2_adjusted,
        "r2_nonlinear": curved.r2_adjusted,
        "exponent_nonlinear": curved.exponent,
        "factor_nonlinear": curved.factor,
    }


def over_samples(data: Variables, seed: str, names: Iterable[str]) -> Variables:
    """Return mean, deviation and ``QUANTILES`` of the variables ``names`` in ``data`` over the dimension ``seed``.

    They are called ``statistics/<name>/mean``, ``deviation`` and ``quantiles``, and are of the samples that have a
    value, whose number is ``statistics/<name>/samples``; ``statistics/samples`` is the number of those that did not
    fail. The variance of n samples is divided by n - 1.
    """
    # A failed member has NaN in every measure; the number of contact episodes is one that all others have.
    episodes = data["contact_episodes"]
    valid = np.isfinite(episodes.values).sum(axis=episodes.dims.index(seed))
    other_dims = [str(dim) for dim in episodes.dims if dim != seed]
    summary = {
        "quantile": variable("quantile", QUANTILES, "1", "fraction of the samples below the quantile"),
        "statistics/samples": variable(other_dims, valid, "1", "number of successful samples"),
    }
    for name in names:
        summary |= _statistics(f"statistics/{name}", data[name].transpose(seed, ...))
    return summary


def _statistics(prefix: str, item: xr.Variable) -> Variables:
    """Return mean, deviation and quantiles of an ``item`` over its first dimension, called ``prefix``/..."""
    dims = tuple(map(str, item.dims[1:]))
    units = item.attrs["units"]
    text = item.attrs["long_name"]
    # NumPy warns where all samples have failed, or one is left, of which there is no deviation: NaN says so.
    with warnings.catch_warnings(action="ignore", category=RuntimeWarning):
        mean = np.nanmean(item.values, axis=0)
        deviation = np.nanstd(item.values, axis=0, ddof=1)
        quantiles = np.nanquantile(item.values, QUANTILES, axis=0)
    count = np.isfinite(item.values).sum(axis=0)
    return {
        f"{prefix}/samples": variable(dims, count, "1", f"{text}: number of samples with a value"),
        f"{prefix}/mean": variable(dims, mean, units, f"{text}: mean over the samples"),
        f"{prefix}/deviation": variable(dims, deviation, units, f"{text}: standard deviation"),
        f"{prefix}/quantiles": variable(("quantile", *dims), quantiles, units, f"{text}: quantiles"),
    }
