"""A branch: its points in order, special ones among them, and the files that hold it."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vipetsc.io.atomic import atomic_write, write_text
from vipetsc.io.store import Coordinates
from vipetsc.modes.compare import Comparison
from vipetsc.modes.point import Point
from vipetsc.modes.portrait import Portrait
from vipetsc.modes.regions import regions, slope_law

KINDS = (
    "regular",
    "fold-energy",
    "fold-frequency",
    "branch-point",
    "symmetry-breaking",
    "period-doubling",
    "grazing",
)
_COLUMNS = {
    "energy": ("J", "energy"),
    "frequency": ("Hz", "frequency"),
    "period": ("s", "period"),
    "slope": ("Hz/J", "slope df/dE of the branch"),
    "multiplier_max": ("1", "largest modulus of a Floquet multiplier"),
    "residual": ("1", "scaled residual of the shooting equations"),
    "closed": ("1", "fraction of the time with a contact closed"),
    "rise": ("J", "dE along the tangent"),
    "step": ("1", "arclength of the step that led here"),
}
_COUNTS = {
    "contacts": "contact episodes in the arc that is shot",
    "newton": "Newton steps",
    "number": "number of the regular point, or of the one after a special point",
    "resonance": "k of the k:1 internal resonance at an energy fold; 0 elsewhere",
    "region": "region of the backbone: 1 linear, 2 grazing, 3 vibro-impact, 4 smooth limit; 0 not told",
}


@dataclass(eq=False)
class Branch:
    """Points of a branch, special points in their places; ``next_step`` and ``case`` allow to go on later.

    ``finding`` are sentences about the branch: jumps, retracing, return to the linear mode, how it ended.
    """

    name: str
    case: str
    dofs: int
    points: list[Point] = field(default_factory=list)
    next_step: float = 0.0
    complete: bool = False
    ending: str = "not finished"
    findings: list[str] = field(default_factory=list)
    orbits: list[tuple[Point, Portrait]] = field(default_factory=list)
    comparisons: list[Comparison] = field(default_factory=list)

    def regular(self) -> list[Point]:
        """The points of the continuation itself."""
        return [p for p in self.points if p.kind == "regular"]

    def special(self, kind: str) -> list[Point]:
        """The special points of one kind."""
        return [p for p in self.points if p.kind == kind]

    def column(self, name: str) -> np.ndarray:
        """One quantity of every point (points,), by its name in the files."""
        names = {"multiplier_max": "multiplier", "contacts": "episodes", "number": "index"}
        if name == "region":
            slope = self.column("slope")
            return regions(self.column("energy"), slope, self.column("contacts"), self.column("closed"))
        return np.array([getattr(p, names.get(name, name)) for p in self.points])

    def fits(self) -> dict[str, dict[str, float]]:
        """Power laws of the slope in regions II (its falling part), III and IV."""
        energy, slope, region = (self.column(n) for n in ("energy", "slope", "region"))
        regular = np.array([p.kind == "regular" for p in self.points], bool)
        found = {}
        for number, label in ((2, "II"), (3, "III"), (4, "IV")):
            inside = np.nonzero((region == number) & regular)[0]
            if number == 2 and inside.size:
                backwards = np.nonzero(~(slope[inside] > 0))[0]
                inside = inside[backwards[-1] + 1 if backwards.size else 0 :]
                inside = inside[int(np.argmax(slope[inside])) if inside.size else 0 :]
            law = slope_law(energy[inside], slope[inside])
            if law is not None:
                found[label] = {"exponent": law.exponent, "factor": law.factor, "adjusted_r2": law.r2_adjusted}
                found[label]["points"] = law.points
        return found

    def write(self, folder: Path, about: dict[str, Any]) -> None:
        """Write ``branch-<name>.h5`` and ``.csv``, each complete or as it was."""
        with atomic_write(folder / f"branch-{self.name}.h5") as aside, h5py.File(aside, "w") as file:
            self._fill(file, about)
        write_text(folder / f"branch-{self.name}.csv", self.to_csv())

    def to_csv(self) -> str:
        """The branch as CSV text, a row a point; numbers in full precision."""
        text = io.StringIO()
        table = csv.writer(text, lineterminator="\n")
        pairs = range(1, self.dofs)
        traces = ["half_trace"] if self.dofs == 2 else [f"half_trace_{i}" for i in pairs]
        initial = [f"x{i + 1}" for i in range(self.dofs)]
        table.writerow(
            [
                "energy",
                "frequency",
                "period",
                *initial,
                *traces,
                "multiplier_max",
                "slope",
                "contacts",
                "region",
                "kind",
            ]
        )
        for p, region in zip(self.points, self.column("region"), strict=True):
            half_traces = [
                repr(complex(c)) if np.iscomplexobj(p.half_traces) else repr(float(c)) for c in p.half_traces
            ]
            numbers = [repr(float(v)) for v in (p.energy, p.frequency, p.period, *p.x)]
            table.writerow(
                [*numbers, *half_traces, repr(p.multiplier), repr(float(p.slope)), p.episodes, int(region), p.kind]
            )
        return text.getvalue()

    def _fill(self, file: h5py.File, about: dict[str, Any]) -> None:
        put = Coordinates(file)
        put.add("point", np.arange(len(self.points)), "1", "place along the branch")
        put.add("dof", np.arange(1, self.dofs + 1), "1", "degree of freedom, from 1")
        put.add("pair", np.arange(1, self.dofs), "1", "pair of Floquet multipliers, the trivial one left out")
        for name, (unit, text) in _COLUMNS.items():
            put.put(name, ("point",), self.column(name).astype(float), unit, text)
        for name, text in _COUNTS.items():
            put.put(name, ("point",), self.column(name).astype(np.int64), "1", text)
        put.put("kind", ("point",), np.array([KINDS.index(p.kind) for p in self.points], np.int8), "1", "kind of point")
        file["kind"].attrs["flag_values"] = np.arange(len(KINDS), dtype=np.int8)
        file["kind"].attrs["flag_meanings"] = " ".join(KINDS)
        shape = (len(self.points), self.dofs)
        x = np.array([p.x for p in self.points]).reshape(shape)
        put.put("initial", ("point", "dof"), x, "m", "initial displacement (velocity in m/s for maps from the centre)")
        tangent = np.array([p.tangent for p in self.points]).reshape(len(self.points), self.dofs + 1)
        put.put("tangent", ("point", "dof"), tangent[:, :-1], "m", "tangent of the branch: initial values")
        put.put("tangent_period", ("point",), tangent[:, -1], "s", "tangent of the branch: period")
        c = np.array([p.half_traces for p in self.points], complex).reshape(len(self.points), self.dofs - 1)
        put.put("half_trace", ("point", "pair"), c.real, "1", "Floquet half-trace, real part")
        put.put("half_trace_imaginary", ("point", "pair"), c.imag, "1", "Floquet half-trace, imaginary part")
        if self.orbits:
            samples = len(self.orbits[0][1].time)
            put.add("orbit", np.arange(len(self.orbits)), "1", "stored orbit")
            put.add("phase", np.arange(samples) / samples, "1", "time over the period")
            put.put("orbits/energy", ("orbit",), np.array([p.energy for p, _ in self.orbits]), "J", "energy")
            put.put("orbits/period", ("orbit",), np.array([p.period for p, _ in self.orbits]), "s", "period")
            place = np.array([p.index for p, _ in self.orbits])
            put.put("orbits/number", ("orbit",), place, "1", "number of the regular point")
            axes = ("orbit", "phase", "dof")
            for name, unit in (("displacement", "m"), ("velocity", "m/s")):
                put.put(f"orbits/{name}", axes, np.array([getattr(o, name) for _, o in self.orbits]), unit, name)
        for c in self.comparisons:
            scale = f"compared_{c.name}"
            put.add(scale, c.number, "1", f"number of the point compared with {c.name}")
            put.put(f"flows/{c.name}/energy", (scale,), c.energy, "J", "energy of the branch")
            for name in ("energy_difference", "frequency_difference"):
                text = f"relative {name.replace('_', ' ')} of {c.name} at the same amplitude"
                put.put(f"flows/{c.name}/{name}", (scale,), getattr(c, name), "1", text)
        attributes = {
            "name": self.name,
            "case": self.case,
            "complete": int(self.complete),
            "ending": self.ending,
            "next_step": self.next_step,
            "findings": "\n".join(self.findings),
            "fits": self.fits(),
        }
        for key, value in (about | attributes).items():
            file.attrs[key] = json.dumps(value) if isinstance(value, dict) else value

    @classmethod
    def read(cls, path: Path) -> Branch:
        """The branch in an HDF5 file, without its orbits; raises OSError or KeyError if it holds none."""
        with h5py.File(path) as file:
            data = {name: file[name][...] for name in file if isinstance(file[name], h5py.Dataset)}
            attributes = dict(file.attrs)
        c = data["half_trace"] + 1j * data["half_trace_imaginary"]
        points = [
            Point(
                x=data["initial"][i],
                period=float(data["period"][i]),
                energy=float(data["energy"][i]),
                residual=float(data["residual"][i]),
                half_traces=c[i] if np.any(c[i].imag != 0) else c[i].real,
                multiplier=float(data["multiplier_max"][i]),
                episodes=int(data["contacts"][i]),
                closed=float(data["closed"][i]),
                newton=int(data["newton"][i]),
                tangent=np.append(data["tangent"][i], data["tangent_period"][i]),
                slope=float(data["slope"][i]),
                rise=float(data["rise"][i]),
                index=int(data["number"][i]),
                step=float(data["step"][i]),
                kind=KINDS[data["kind"][i]],
                resonance=int(data["resonance"][i]),
            )
            for i in range(len(data["point"]))
        ]
        findings = [line for line in str(attributes["findings"]).split("\n") if line]
        return cls(
            name=str(attributes["name"]),
            case=str(attributes["case"]),
            dofs=len(data["dof"]),
            points=points,
            next_step=float(attributes["next_step"]),
            complete=bool(attributes["complete"]),
            ending=str(attributes["ending"]),
            findings=findings,
        )
