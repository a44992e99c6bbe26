"""The curves of the verb ``nfrc``: shared over ranks, written as they grow, gone on with where they ended."""

import itertools
import json
import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case.nfrc import NfrcCase
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import BRANCHES, Claim, claimed, provenance
from vipetsc.io.netcdf import open_netcdf, variable, write_netcdf
from vipetsc.modes.problem import ContinuationError, FlowError
from vipetsc.modes.response.steady import Steady, SteadyPoint, SteadyStates
from vipetsc.parallel import StoppedError, StopRequest

SAVE_EVERY = 10.0  # s between two writings of a growing curve
MOST_RAMP = 10_000  # points on the way to the beginning of a range
FAILURES = (ContinuationError, FlowError, ArithmeticError, ValueError)
WAYS = "transmitted", "reflected", "upper", "lost"
KINDS = "regular", "fold"
# What is measured of a point: dimensions besides the point, units, text.
LAYOUT = {
    "frequency": ("", "rad/s", "frequency"),
    "amplitude": ("", "1", "amplitude: of a wave over the clearance of the first site, of a force in N"),
    "largest": ("site", "m", "largest relative displacement"),
    "share": ("way", "1", "energy that leaves or is lost, over what comes in"),
    "unstable": ("", "1", "perturbations that grow (Hill's method); -1: not told"),
    "growth": ("", "1", "largest growth rate over the frequency; 0 if none, NaN if not found"),
    "closed": ("site", "1", "share of the time in contact"),
    "episodes": ("", "1", "contact episodes a period"),
    "truncation": ("", "1", "estimated size of the harmonics left out, over those kept"),
    "harmonics": ("site order", "m", "harmonics Z of w = Re sum Z exp(i k Om t), real part"),
    "harmonics_imaginary": ("site order", "m", "harmonics of w, imaginary part"),
}


@dataclass(eq=False)
class Curve:
    """Steady states in order; ``over`` is "amplitude" or "frequency"; ``ending`` says how the curve ended."""

    name: str
    case: NfrcCase
    points: list[SteadyPoint] = field(default_factory=list)
    complete: bool = False
    ending: str = "not finished"

    def column(self, name: str) -> np.ndarray:
        """A measure of every point."""
        return np.array([p.measures[name] for p in self.points])

    def write(self, folder: Path, about: dict[str, Any]) -> None:
        """Write ``branch-<name>.h5`` and ``.csv``, each complete or as it was."""
        sys.audit("vipetsc.save", self.name)
        data = self.to_dataset()
        write_netcdf(folder / f"branch-{self.name}.h5", data.assign_attrs(about))
        count = len(self.points)
        flat = [n for n, (dims, *_) in LAYOUT.items() if dims in ("", "site", "way")]
        columns = {f"{n}_{i + 1}" if part.shape[1] > 1 else n: part[:, i] for n in flat
                   for part in [data[n].values.reshape(count, -1)] for i in range(part.shape[1])}  # fmt: skip
        columns["kind"] = np.array([p.kind for p in self.points])
        rows = zip(*(values.tolist() for values in columns.values()), strict=True)
        lines = [",".join(columns), *(",".join(map(str, row)) for row in rows)]
        write_text(folder / f"branch-{self.name}.csv", "\n".join(lines) + "\n")

    def to_dataset(self) -> xr.Dataset:
        """The curve as it is in its file."""
        chain, options, count = self.case.model().chain, self.case.nfrc, len(self.points)
        xi, tangent = (np.array([getattr(p, n) for p in self.points]).reshape(count, -1) for n in ("xi", "tangent"))
        kinds = np.array([KINDS.index(p.kind) for p in self.points], np.int8)
        up, down = (np.array(swept(self, sign), int) for sign in (1, -1))
        data = {
            "point": variable("point", np.arange(count), "1", "place along the curve"),
            "site": variable("site", np.array(chain.sites) + 1, "1", "cell of the site, from 1"),
            "order": variable("order", np.arange(options.harmonics + 1), "1", "harmonic"),
            "way": variable("way", np.array(WAYS), "1", "where energy goes"),
            "unknown": variable("unknown", np.arange(xi.shape[1]), "1", "unknown; the last is the parameter"),
            "clearance": variable("site", np.array(chain.clearances), "m", "clearance"),
            "kind": variable("point", kinds, "1", "kind of point",
                             flag_values=np.arange(2, dtype=np.int8), flag_meanings=" ".join(KINDS)),
            "xi": variable(("point", "unknown"), xi, "1", "unknowns"),
            "tangent": variable(("point", "unknown"), tangent, "1", "unit tangent"),
            "next_step": variable("point", np.array([p.step for p in self.points]), "1", "arclength of the next step"),
            "up": variable("up", np.arange(len(up)), "1", "place on the way up"),
            "down": variable("down", np.arange(len(down)), "1", "place on the way down"),
            "up_point": variable("up", up, "1", "points passed if the parameter grows slowly; not neighbours: a jump"),
            "down_point": variable("down", down, "1", "points passed if the parameter falls slowly"),
        }  # fmt: skip
        for name, (dims, units, text) in LAYOUT.items():
            shape = [count, *(data[dim].size for dim in dims.split())]
            data[name] = variable(["point", *dims.split()], self.column(name).reshape(shape), units, text)
        about = {"name": self.name, "case": self.case.to_toml(), "over": options.over, "ending": self.ending}
        return xr.Dataset(data, attrs=about | {"complete": int(self.complete), "warnings": json.dumps([])})

    @classmethod
    def read(cls, path: Path, case: NfrcCase) -> "Curve":
        """The curve of a file; raises OSError or ValueError if it holds none."""
        with open_netcdf(path, "branch", ("xi", "tangent", "next_step")) as file:
            data, about = file.load(), file.attrs
        columns = {name: data[name].values for name in LAYOUT}
        points = [
            SteadyPoint(xi, tangent, float(step), KINDS[kind], {name: values[i] for name, values in columns.items()})
            for i, (xi, tangent, step, kind) in enumerate(
                zip(*(data[n].values for n in ("xi", "tangent", "next_step", "kind")), strict=True)
            )
        ]
        return cls(str(about["name"]), case, points, bool(about["complete"]), str(about["ending"]))

    def summary(self) -> list[tuple[str, str]]:
        """What is printed of it."""
        over = self.case.nfrc.over
        unit = "rad/s" if over == "frequency" else ("clearances" if self.case.nfrc.source == "wave" else "N")
        rows = [("curve", self.name), ("points", f"{len(self.points)}; {self.ending}")]
        if self.points:
            p, folds = self.column(over), [point.measures[over] for point in self.points if point.kind == "fold"]
            rows.append(("folds", ", ".join(f"{at:.6g}" for at in folds) + f" {unit}" if folds else "none"))
            jumps = [f"{p[a]:.5g} {way}" for way, s in (("up", 1), ("down", -1)) for a, b in _jumps(swept(self, s))]
            rows.append(("jumps", ", ".join(jumps) or "none"))
            stable = self.column("unstable") == 0
            rows.append(("stable", f"{stable.sum()} of {len(stable)} points"))
            if self.case.nfrc.infinite:
                error = np.nanmax(np.abs(self.column("share").sum(axis=1) - 1))
                rows.append(("T + R + U + L - 1", f"{error:.1e}"))
        return rows


def _jumps(path: list[int]) -> Iterator[tuple[int, int]]:
    yield from ((a, b) for a, b in itertools.pairwise(path) if abs(a - b) > 1)


def swept(curve: Curve, sign: int) -> list[int]:
    """Points that a slow sweep of the parameter passes, up (``sign`` 1) from the first stable state, or then down (-1).

    At a fold, or where a state becomes unstable, it jumps to the stable state with the parameter's value whose largest
    relative displacement at the first site is nearest; it ends where there is none.
    """
    if not curve.points:
        return []
    p, size = sign * curve.column(curve.case.nfrc.over), curve.column("largest")[:, 0]
    kinds, stable = np.array([point.kind for point in curve.points]), curve.column("unstable") == 0
    beside = np.append(stable[1:], False) | np.insert(stable[:-1], 0, False)
    stable |= (kinds == "fold") & beside
    if not stable.any():
        return []
    path = [int(np.argmin(np.where(stable, p, np.inf))) if sign > 0 else swept(curve, 1)[-1]]
    passed = set(path)
    while True:
        i = path[-1]
        ahead = [j for j in (i - 1, i + 1) if 0 <= j < len(p) and j not in passed and p[j] > p[i] and stable[j]]
        if not ahead:
            ends = np.array([[j, j + 1] if p[j] <= p[j + 1] else [j + 1, j] for j in range(len(p) - 1)])
            low, high = ends.T if len(ends) else np.zeros((2, 0), int)
            (over,) = np.nonzero((p[low] <= p[i]) & (p[high] > p[i]) & stable[low] & stable[high])
            ahead = [int(high[j]) for j in over if not {int(low[j]), int(high[j])} & passed]
        if not ahead:
            return path
        path.append(min(ahead, key=lambda j: abs(size[j] - size[i])))
        passed.add(path[-1])


def claim_curves(
    case: NfrcCase, folder: Path, comm: MPI.Comm, force: bool, resume: bool
) -> AbstractContextManager[Claim]:
    """Claim ``folder`` for the curves of ``case``, as ``claimed``; to resume them, ``points`` may be others."""

    def difference(earlier: str) -> str | None:
        before = NfrcCase.from_toml(earlier)
        same = before.model_copy(update={"nfrc": before.nfrc.model_copy(update={"points": case.nfrc.points})}) == case
        return None if same else "--resume needs the case its curves were begun with, but for nfrc.points"

    further = difference if resume else None
    return claimed(comm, folder, BRANCHES, case.to_toml(), force=force, resume=resume, difference=further)


def follow_curves(
    case: NfrcCase, folder: Path, comm: MPI.Comm, resume: bool = False, stop: StopRequest | None = None
) -> list[Curve]:
    """All curves of ``case``, written into ``folder``; rank r follows every size-th one, each on one rank alone.

    One that fails is written as far as it came and says why in its ``ending``. A ``stop`` ends each at its next point;
    ``resume`` goes on from there to the same bits. Returns all curves on rank 0, an empty list on the others.
    """
    about, mine = provenance(comm), {}
    for job in range(comm.rank, len(case.curves()), comm.size):
        name, restitution, fixed = case.curves()[job]
        path, curve = folder / f"branch-{name}.h5", Curve(name, case)
        if resume and path.exists():
            curve = Curve.read(path, case)
        if not curve.complete:
            try:
                _grow(curve, SteadyStates(case, restitution, fixed), folder, about, stop or StopRequest())
            except StoppedError as stopped:
                curve.ending = str(stopped)
            except FAILURES as error:
                curve.ending = f"failed: {error}"
            if curve.points:
                curve.write(folder, about)
        mine[job] = curve
    gathered = {job: curve for part in comm.gather(mine) or [] for job, curve in part.items()}
    return [gathered[job] for job in sorted(gathered)]


def _grow(curve: Curve, states: SteadyStates, folder: Path, about: dict[str, Any], stop: StopRequest) -> None:
    """Go on with a curve until it ends; raises StoppedError on request, ContinuationError if it cannot go on."""
    regular = [point for point in curve.points if point.kind == "regular"]
    if not regular:
        start = _first(states)
        regular = curve.points = [replace(start, measures=states.measured(start.xi))]
    steady = Steady(states, regular[-1], max(curve.case.nfrc.points - len(regular), 0))
    saved = time.monotonic()
    for point in steady:
        sys.audit("vipetsc.step")
        curve.points.append(replace(point, measures=states.measured(point.xi)))
        if point.kind == "fold" or steady.finished:
            continue
        if stop.requested or time.monotonic() - saved > SAVE_EVERY:
            curve.write(folder, about)
            saved = time.monotonic()
        if stop.requested:
            raise StoppedError(f"stopped on request after {len(curve.points)} points; resume goes on")
    curve.ending, curve.complete = steady.ending, steady.finished


def _first(states: SteadyStates) -> SteadyPoint:
    """The state at the beginning of the range, by way of growing amplitudes from one that touches no contact."""
    options = states.options
    low = options.range[0] / states.scale
    omega, amplitude = states.parameters(low)
    linear = states.linear(omega)
    z = amplitude * float((np.abs(linear[:, 1]) / [clearance for _, clearance in states.forces.contacts]).max())
    if z < 1:
        guess = states.balance.pack(amplitude * linear) / states.clearance
    else:
        below = options.model_copy(update={"over": "amplitude", "range": [1e-3 * amplitude, amplitude]})
        ramp = SteadyStates(states.case.model_copy(update={"nfrc": below}), states.restitution, omega)
        points = list(Steady(ramp, _first(ramp), MOST_RAMP))
        if not points or not np.isclose(points[-1].xi[-1] * ramp.scale, amplitude):
            raise ContinuationError(
                f"growing amplitudes do not reach {amplitude:g}: begin nfrc.range or nfrc.fixed lower"
            )
        guess = points[-1].xi[:-1]
    xi = states.at(np.append(guess, low), low)
    return SteadyPoint(xi, states.tangent(xi, np.eye(len(xi))[-1]), options.first_step)
