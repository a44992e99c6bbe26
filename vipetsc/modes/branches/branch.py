"""A branch: its points in order, special ones among them, its regions and power laws, and the files that hold it."""

import json
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import xarray as xr

from vipetsc.io.atomic import write_text
from vipetsc.io.netcdf import Variables, open_netcdf, variable, write_netcdf
from vipetsc.modes.point import QUANTITIES, Point
from vipetsc.spectra import doubt, power_law

KINDS = ("regular", "fold-energy", "fold-frequency", "branch-point", "symmetry-breaking", "period-doubling", "grazing")
REGION = "region of the backbone: 1 linear, 2 grazing, 3 vibro-impact, 4 smooth limit; 0 not told"

MULTIPLIERS = {
    "multiplier": "largest Floquet multipliers, real part; NaN where fewer converged",
    "multiplier_imaginary": "largest Floquet multipliers, imaginary part",
    "multiplier_residual": "residual of the multiplier's vector over its size",
}

# Fraction of the time in contact from which the clearance counts as negligible (region IV).
SMOOTH_LIMIT = 0.95
# Change of the slope's local exponent per e-fold of energy below which the grazing peak is over (region III).
SETTLED = 0.5
# Local exponents below this still belong to the fall from the grazing peak; no limit law is so steep.
STEEP = -2.0
# Points that a local exponent needs.
FEWEST = 5
# Factors of power laws stay below this and above its inverse.
MOST = float(np.exp(500.0))


@dataclass(eq=False)
class Branch:
    """Points of a branch, special points in their places; ``next_step`` and ``case`` allow to go on later.

    ``findings`` are sentences about the branch: jumps, retracing, return to the linear mode; ``extra`` are further
    variables of its file: orbits, comparisons with other flows.
    """

    name: str
    case: str
    dofs: int
    points: list[Point] = field(default_factory=list)
    next_step: float = 0.0
    complete: bool = False
    ending: str = "not finished"
    findings: list[str] = field(default_factory=list)
    extra: Variables = field(default_factory=dict)

    def regular(self) -> list[Point]:
        """The points of the continuation itself."""
        return [p for p in self.points if p.kind == "regular"]

    def column(self, name: str) -> np.ndarray:
        """One quantity of every point (points,)."""
        return np.array([getattr(p, name) for p in self.points], QUANTITIES[name][1])

    def regions(self) -> np.ndarray:
        """Region of every point (points,), see ``tell_regions``."""
        return tell_regions(*(self.column(name) for name in ("energy", "slope", "episodes", "closed")))

    def tongues(self) -> list[int]:
        """k of the k:1 internal resonances whose tongues the branch passes, each with an energy fold at its tip."""
        return sorted({p.resonance for p in self.points} - {0, 1})

    def fits(self) -> dict[str, dict[str, float]]:
        """Power laws of the slope over the energy in regions II (its falling part), III and IV."""
        regular = np.array([p.kind == "regular" for p in self.points], bool)
        columns = self.column("energy"), self.column("slope"), self.regions()
        return slope_laws(*(column[regular] for column in columns))

    def write(self, folder: Path, about: dict[str, Any]) -> None:
        """Write ``branch-<name>.h5`` and ``.csv``, each complete or as it was; ``about`` are further attributes."""
        sys.audit("vipetsc.save", self.name)
        write_netcdf(folder / f"branch-{self.name}.h5", self.to_dataset().assign_attrs(about))
        write_text(folder / f"branch-{self.name}.csv", self.to_csv())

    def to_csv(self) -> str:
        """The branch as CSV text, a row a point; numbers in full precision."""
        pairs = len(self.points[0].half_traces) if self.points else self.dofs - 1
        traces = ["half_trace"] if self.dofs == 2 else [f"half_trace_{i + 1}" for i in range(pairs)]
        names = ["energy", "frequency", "period", *(f"x{i + 1}" for i in range(self.dofs)), *traces]
        lines = [",".join([*names, "multiplier_max", "slope", "contacts", "region", "kind"])]
        for p, region in zip(self.points, self.regions(), strict=True):
            numbers = [p.energy, p.frequency, p.period, *p.x.tolist(), *p.half_traces.tolist(), p.multiplier, p.slope]
            lines.append(",".join([*map(repr, numbers), str(p.episodes), str(region), p.kind]))
        return "\n".join(lines) + "\n"

    def to_dataset(self) -> xr.Dataset:
        """The branch as it is in its file."""
        kinds = np.array([KINDS.index(p.kind) for p in self.points], np.int8)
        flags = {"flag_values": np.arange(len(KINDS), dtype=np.int8), "flag_meanings": " ".join(KINDS)}
        data = {
            "point": variable("point", np.arange(len(self.points)), "1", "place along the branch"),
            "region": variable("point", self.regions().astype(np.int64), "1", REGION),
            "kind": variable("point", kinds, "1", "kind of point", **flags),
            **self.unknowns(),
            **_multipliers(self.points),
        }
        for name, (stored, _, units, text) in QUANTITIES.items():
            data[stored] = variable("point", self.column(name), units, text)
        attributes = {"name": self.name, "case": self.case, "complete": int(self.complete), "ending": self.ending}
        attributes |= {"next_step": self.next_step, "warnings": json.dumps(self.findings), "fits": self.fits()}
        attributes["tongues"] = len(self.tongues())
        return xr.Dataset(data | self.extra, attrs=attributes)

    def unknowns(self) -> Variables:
        """Initial values, tangents and half-traces of the points."""
        count, n = len(self.points), self.dofs
        x = np.array([p.x for p in self.points]).reshape(count, n)
        tangent = np.array([p.tangent for p in self.points], float).reshape(count, n + 1)
        pairs = len(self.points[0].half_traces) if self.points else n - 1
        traces = np.array([p.half_traces for p in self.points], complex).reshape(count, pairs)
        at_rest = "initial displacement (velocity in m/s for maps from the centre)"
        return {
            "dof": variable("dof", np.arange(1, n + 1), "1", "degree of freedom, from 1"),
            "pair": variable("pair", np.arange(1, pairs + 1), "1", "pair of multipliers, the trivial one left out"),
            "initial": variable(("point", "dof"), x, "m", at_rest),
            "tangent": variable(("point", "dof"), tangent[:, :-1], "m", "tangent of the branch: initial values"),
            "tangent_period": variable("point", tangent[:, -1], "s", "tangent of the branch: period"),
            "half_trace": variable(("point", "pair"), traces.real, "1", "Floquet half-trace, real part"),
            "half_trace_imaginary": variable(("point", "pair"), traces.imag, "1", "Floquet half-trace, imaginary part"),
        }

    @classmethod
    def read(cls, path: Path) -> Self:
        """The branch in an HDF5 file, without its orbits; raises OSError or ValueError if it holds none."""
        with open_netcdf(path, "branch", ("point", "tangent", "half_trace", "next_step")) as file:
            data, about = file.load(), file.attrs
        traces = data["half_trace"].values + 1j * data["half_trace_imaginary"].values
        columns: dict[str, Any] = {name: data[stored].values.tolist() for name, (stored, *_) in QUANTITIES.items()}
        del columns["frequency"]  # a property
        columns["x"], columns["kind"] = data["initial"].values, [KINDS[kind] for kind in data["kind"].values]
        columns["tangent"] = np.column_stack([data["tangent"].values, data["tangent_period"].values])
        columns["half_traces"] = [c if np.any(c.imag != 0) else c.real for c in traces]
        points = [Point(**dict(zip(columns, row, strict=True))) for row in zip(*columns.values(), strict=True)]
        return cls(dofs=data.sizes["dof"], points=with_multipliers(points, data), **cls.told(about))

    @staticmethod
    def told(about: dict[Any, Any]) -> dict[str, Any]:
        """What the attributes of a file tell of its branch."""
        named: dict[str, Any] = {key: str(about[key]) for key in ("name", "case", "ending")}
        named |= {"next_step": float(about["next_step"]), "complete": bool(about["complete"])}
        return named | {"findings": json.loads(about.get("warnings", "[]"))}


def _multipliers(points: list[Point]) -> Variables:
    """The largest multipliers of the points, if any point has some."""
    most = max((len(p.multipliers) for p in points), default=0)
    if not most:
        return {}
    largest = np.full((len(points), most, 2), np.nan, complex)
    for row, p in zip(largest, points, strict=True):
        row[: len(p.multipliers)] = p.multipliers
    parts = largest[..., 0].real, largest[..., 0].imag, largest[..., 1].real
    axes, numbers = ("point", "multiplier_number"), np.arange(1, most + 1)
    data = {"multiplier_number": variable("multiplier_number", numbers, "1", "number of a multiplier, largest first")}
    named = zip(parts, MULTIPLIERS.items(), strict=True)
    return data | {name: variable(axes, part, "1", text) for part, (name, text) in named}


def with_multipliers(points: list[Point], data: xr.Dataset) -> list[Point]:
    """The points with the multipliers of their file."""
    if "multiplier" not in data:
        return points
    real, imaginary, residual = (data[name].values for name in MULTIPLIERS)
    rows = (row[np.isfinite(row[:, 0])] for row in np.stack([real + 1j * imaginary, residual], axis=-1))
    return [replace(p, multipliers=row) for p, row in zip(points, rows, strict=True)]


def tell_regions(energy: np.ndarray, slope: np.ndarray, episodes: np.ndarray, closed: np.ndarray) -> np.ndarray:
    """Region 1-4 of every point of a branch (points,), in its order; 0 for a nonlinear branch without contacts.

    I: no contact. II: grazing, from the first contact over the peak of the slope until its steep fall has ended:
    until the local exponent d ln(df/dE)/d ln E changes by less than ``SETTLED`` per e-fold of energy and is above
    ``STEEP``. III: vibro-impact. IV: smooth limit, from where a contact is closed for 95 % of the time on. A
    branch on which the slope keeps changing sign (internal resonances) has its peak after its last energy fold.
    Without an exponent that settles, II lasts. ``energy`` in J, ``slope`` in Hz/J, ``episodes`` contact episodes of the
    arc, ``closed`` the fraction of the time with a contact closed.
    """
    region = np.ones(len(energy), np.int8)
    touched = np.nonzero(episodes > 0)[0]
    if not touched.size:
        smooth = np.nanmax(np.abs(slope) * energy, initial=0.0) > 1e-6
        return region * (0 if smooth else 1)
    first = touched[0]
    region[first:] = 2
    folds = np.nonzero(np.diff(np.sign(np.diff(energy[first:]))) != 0)[0]
    start = first + (folds[-1] + 2 if folds.size else 0)
    tail = slope[start:]
    if len(tail) < FEWEST or not np.all(np.isfinite(tail) & (tail > 0)):
        return region
    start += int(np.argmax(tail))
    if len(energy) - start < FEWEST:
        return region
    exponent = np.gradient(np.log(slope[start:]), np.log(energy[start:]))
    growth = np.gradient(exponent, np.log(energy[start:]))
    settled = np.nonzero((np.abs(growth[1:]) <= SETTLED) & (exponent[1:] >= STEEP))[0]
    if settled.size:
        third = start + 1 + settled[0]
        region[third:] = 3
        smooth_limit = np.nonzero(closed[third:] >= SMOOTH_LIMIT)[0]
        if smooth_limit.size:
            region[third + smooth_limit[0] :] = 4
    return region


def slope_laws(energy: np.ndarray, slope: np.ndarray, region: np.ndarray) -> dict[str, dict[str, float]]:
    """df/dE = factor E^exponent in regions II (its falling part), III and IV, where it is without ``doubt``.

    A vertical piece of a branch has none: its exponent leaves the range of numbers, or its adjusted R^2 is none.
    """
    laws = {}
    for number, label in ((2, "II"), (3, "III"), (4, "IV")):
        e, s = energy[region == number], slope[region == number]
        if number == 2 and e.size:
            backwards = np.nonzero(~(s > 0))[0]
            begin = backwards[-1] + 1 if backwards.size else 0
            begin += int(np.argmax(s[begin:])) if s[begin:].size else 0
            e, s = e[begin:], s[begin:]
        usable = np.isfinite(s) & (s > 0) & (e > 0)
        if usable.sum() < 4 or np.ptp(e[usable]) == 0:
            continue
        law = power_law(e[usable], s[usable])
        if not doubt(usable.sum(), law.r2_adjusted) and 1 / MOST <= law.factor <= MOST:
            laws[label] = {"exponent": law.exponent, "factor": law.factor, "adjusted_r2": law.r2_adjusted}
            laws[label]["points"] = int(usable.sum())
    return laws
