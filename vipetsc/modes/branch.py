"""A branch: its points in order, special ones among them, and the files that hold it."""

import csv
import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import numpy as np
import xarray as xr

from vipetsc.io.atomic import write_text
from vipetsc.io.netcdf import open_netcdf, variable, write_netcdf
from vipetsc.modes.point import Point
from vipetsc.modes.regions import slope_laws, tell_regions

KINDS = ("regular", "fold-energy", "fold-frequency", "branch-point", "symmetry-breaking", "period-doubling", "grazing")
# Quantities of a point: name in the files, type, unit, description.
QUANTITIES: dict[str, tuple[str, type, str, str]] = {
    "energy": ("energy", float, "J", "energy"),
    "frequency": ("frequency", float, "Hz", "frequency"),
    "period": ("period", float, "s", "period"),
    "slope": ("slope", float, "Hz/J", "slope df/dE of the branch"),
    "multiplier": ("multiplier_max", float, "1", "largest modulus of a Floquet multiplier"),
    "residual": ("residual", float, "1", "scaled residual of the shooting equations"),
    "closed": ("closed", float, "1", "fraction of the time with a contact closed"),
    "energy_tangent": ("rise", float, "J", "dE along the tangent"),
    "step": ("step", float, "1", "arclength of the step that led here"),
    "episodes": ("contacts", int, "1", "contact episodes in the arc that is shot"),
    "newton": ("newton", int, "1", "Newton steps"),
    "index": ("number", int, "1", "number of the regular point, or of the one after a special point"),
    "resonance": ("resonance", int, "1", "k of the k:1 internal resonance at an energy fold; 0 elsewhere"),
}
REGION = "region of the backbone: 1 linear, 2 grazing, 3 vibro-impact, 4 smooth limit; 0 not told"


@dataclass(eq=False)
class Branch:
    """Points of a branch, special points in their places; ``next_step`` and ``case`` allow to go on later.

    ``findings`` are sentences about the branch: jumps, retracing, return to the linear mode.
    """

    name: str
    case: str
    dofs: int
    points: list[Point] = field(default_factory=list)
    next_step: float = 0.0
    complete: bool = False
    ending: str = "not finished"
    findings: list[str] = field(default_factory=list)
    orbits: list[tuple[Point, tuple[np.ndarray, np.ndarray]]] = field(default_factory=list)
    comparisons: dict[str, xr.Variable] = field(default_factory=dict)

    def regular(self) -> list[Point]:
        """The points of the continuation itself."""
        return self.special("regular")

    def special(self, kind: str) -> list[Point]:
        """The points of one kind."""
        return [p for p in self.points if p.kind == kind]

    def column(self, name: str) -> np.ndarray:
        """One quantity of every point (points,)."""
        return np.array([getattr(p, name) for p in self.points], QUANTITIES[name][1])

    def regions(self) -> np.ndarray:
        """Region of every point (points,), see ``regions``."""
        return tell_regions(*(self.column(name) for name in ("energy", "slope", "episodes", "closed")))

    def fits(self) -> dict[str, dict[str, float]]:
        """Power laws of the slope over the energy in regions II (its falling part), III and IV."""
        regular = np.array([p.kind == "regular" for p in self.points], bool)
        columns = self.column("energy"), self.column("slope"), self.regions()
        return slope_laws(*(column[regular] for column in columns))

    def write(self, folder: Path, about: dict[str, Any]) -> None:
        """Write ``branch-<name>.h5`` and ``.csv``, each complete or as it was; ``about`` are further attributes."""
        write_netcdf(folder / f"branch-{self.name}.h5", self.to_dataset().assign_attrs(about))
        write_text(folder / f"branch-{self.name}.csv", self.to_csv())

    def to_csv(self) -> str:
        """The branch as CSV text, a row a point; numbers in full precision."""
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        traces = ["half_trace"] if self.dofs == 2 else [f"half_trace_{i}" for i in range(1, self.dofs)]
        names = ["energy", "frequency", "period", *(f"x{i + 1}" for i in range(self.dofs)), *traces]
        table.writerow([*names, "multiplier_max", "slope", "contacts", "region", "kind"])
        for p, region in zip(self.points, self.regions(), strict=True):
            numbers = [p.energy, p.frequency, p.period, *p.x.tolist(), *p.half_traces.tolist()]
            numbers += [p.multiplier, float(p.slope)]
            table.writerow([*map(repr, numbers), p.episodes, int(region), p.kind])
        return text.getvalue()

    def to_dataset(self) -> xr.Dataset:
        """The branch as it is in its file."""
        count, n = len(self.points), self.dofs
        kinds = np.array([KINDS.index(p.kind) for p in self.points], np.int8)
        flags = {"flag_values": np.arange(len(KINDS), dtype=np.int8), "flag_meanings": " ".join(KINDS)}
        x = np.array([p.x for p in self.points]).reshape(count, n)
        tangent = np.array([p.tangent for p in self.points], float).reshape(count, n + 1)
        traces = np.array([p.half_traces for p in self.points], complex).reshape(count, n - 1)
        at_rest = "initial displacement (velocity in m/s for maps from the centre)"
        data = {
            "point": variable("point", np.arange(count), "1", "place along the branch"),
            "dof": variable("dof", np.arange(1, n + 1), "1", "degree of freedom, from 1"),
            "pair": variable("pair", np.arange(1, n), "1", "pair of Floquet multipliers, the trivial one left out"),
            "region": variable("point", self.regions().astype(np.int64), "1", REGION),
            "kind": variable("point", kinds, "1", "kind of point", **flags),
            "initial": variable(("point", "dof"), x, "m", at_rest),
            "tangent": variable(("point", "dof"), tangent[:, :-1], "m", "tangent of the branch: initial values"),
            "tangent_period": variable("point", tangent[:, -1], "s", "tangent of the branch: period"),
            "half_trace": variable(("point", "pair"), traces.real, "1", "Floquet half-trace, real part"),
            "half_trace_imaginary": variable(("point", "pair"), traces.imag, "1", "Floquet half-trace, imaginary part"),
        }
        for name, (stored, _, units, text) in QUANTITIES.items():
            data[stored] = variable("point", self.column(name), units, text)
        attributes = {"name": self.name, "case": self.case, "complete": int(self.complete), "ending": self.ending}
        attributes |= {"next_step": self.next_step, "findings": "\n".join(self.findings), "fits": self.fits()}
        return xr.Dataset(data | self._orbit_variables() | self.comparisons, attrs=attributes)

    def _orbit_variables(self) -> dict[str, xr.Variable]:
        if not self.orbits:
            return {}
        points, orbits = zip(*self.orbits, strict=True)
        displacement, velocity = zip(*orbits, strict=True)
        samples, axes = len(displacement[0]), ("orbit", "phase", "dof")
        return {
            "orbit": variable("orbit", np.arange(len(points)), "1", "stored orbit"),
            "phase": variable("phase", np.arange(samples) / samples, "1", "time over the period"),
            "orbits/energy": variable("orbit", [p.energy for p in points], "J", "energy"),
            "orbits/period": variable("orbit", [p.period for p in points], "s", "period"),
            "orbits/number": variable("orbit", [p.index for p in points], "1", "number of the regular point"),
            "orbits/displacement": variable(axes, displacement, "m", "displacement"),
            "orbits/velocity": variable(axes, velocity, "m/s", "velocity"),
        }

    @classmethod
    def read(cls, path: Path) -> Self:
        """The branch in an HDF5 file, without its orbits; raises OSError or ValueError if it holds none."""
        with open_netcdf(path, "branch", ("point", "tangent", "half_trace", "next_step")) as file:
            data, about = file.load(), file.attrs
        traces = data["half_trace"].values + 1j * data["half_trace_imaginary"].values
        tangents = np.column_stack([data["tangent"].values, data["tangent_period"].values])
        columns = {name: data[stored].values.tolist() for name, (stored, *_) in QUANTITIES.items()}
        del columns["frequency"]  # a property
        points = [
            Point(
                x=data["initial"].values[i],
                half_traces=traces[i] if np.any(traces[i].imag != 0) else traces[i].real,
                tangent=tangents[i],
                kind=KINDS[kind],
                **{name: column[i] for name, column in columns.items()},
            )
            for i, kind in enumerate(data["kind"].values)
        ]
        return cls(
            name=str(about["name"]),
            case=str(about["case"]),
            dofs=data.sizes["dof"],
            points=points,
            next_step=float(about["next_step"]),
            complete=bool(about["complete"]),
            ending=str(about["ending"]),
            findings=[line for line in str(about["findings"]).split("\n") if line],
        )
