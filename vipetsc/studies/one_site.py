"""The runs of the scattering law: one site in an infinite lattice, ever finer in z; a case in, ``law.h5`` out.

**Geometry.** The lattice is a ring of N cells, driven at one, with the site d cells on. The burst lasts T_b; v is the
speed of its slow waves (all but 1e-3 of the energy in its band is faster), V the largest group velocity of any band. A
run ends at t_e = d/v + s T_b (s = ``law.settle``): at d/v + T_b the slow waves' end has passed, the rest of the time is
for contacts to die away. Nothing comes round: what the drive sends the other way reaches the site from behind after
(N - d)/V, what leaves the site is back after N/V more than the way to it, so N >= d + V t_e makes the ring infinite.
Waves need not have separated in space: Bloch amplitudes tell band and direction of each at an instant
(``spectra.directions``), and are constant once the last contact has ended.

**Shares.** E0 (band, direction) are the energies of the run without a site under 1 N, E those of a run under the
amplitude A, over A^2; E_in is what of E0, in the drive's band and forward (the way from the drive to the site), is fast
enough to have arrived. The share of a band and direction is (E - E0)/E_in, plus 1 in the drive's band forward: T. It is
R backward, and U in the bands above. The drive works as without a site, for the burst is over before a wave is back
(d >= V T_b/2). So with the dissipated energy and what a closed contact holds, over A^2 E_in, they sum to 1, to the
ledger's accuracy, and T = 1 where nothing is touched. The drive is in the midst of the lattice, not at a wall.

**z** is the largest |w| of the linear wave at the site over the clearance. The bilinear law scales exactly: with a
given z, shares do not depend on the clearance. Hertz's does through its stiffness kc D^(1/2): the law is that of one
clearance, by default the geometric mean of the sites'.

**Refinement.** z = 1, then two points an octave; the point in the middle (in log z) of two is made, and if T, R, U or
the dissipated share lies further from the line between them than the tolerance and than its scatter, or T falls from 1
between them, both halves are treated likewise, until they are finer than asked for. Mean and deviation at z are those
of runs spread evenly over z (1 +- min(jitter, (z - 1)/10)).
"""

import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import xarray as xr
from scipy.interpolate import CubicHermiteSpline

from vipetsc.case.law import LawCase
from vipetsc.io.folder import LAW, claimed, provenance
from vipetsc.io.netcdf import tabulated, write_netcdf
from vipetsc.io.records import Record
from vipetsc.parallel import StopRequest, on_root
from vipetsc.spectra.directions import by_direction, wave_energies
from vipetsc.studies.recorded_runs import RecordedRuns, run_in_memory
from vipetsc.studies.scattering_law import FORWARD, LAYOUT, NEAR, OF_POINT, ScatteringLaw

LINEAR = 0.0  # the z of the run without a site
STEP = np.sqrt(2.0)  # between neighbouring points to begin with
JUDGED = "transmitted", "reflected", "upper", "dissipated"


def make_law(
    case: LawCase,
    folder: str | Path,
    comm: MPI.Comm = MPI.COMM_WORLD,
    *,
    force: bool = False,
    resume: bool = False,
    stop: StopRequest | None = None,
    progress: bool = False,
) -> ScatteringLaw:
    """Take the scattering law of ``case`` on all ranks of ``comm``, and leave ``law.h5`` in ``folder``.

    Runs that are there are not made again: a law that was stopped or killed goes on, to the same bits on any number of
    ranks. ``force`` begins anew, ``resume`` needs one to go on with.

    Raises FolderError if the folder holds anything but this law, RuntimeError if a run does not come out, StoppedError
    on a request to ``stop``.
    """
    stop = stop or StopRequest()
    with claimed(comm, folder, LAW, case.to_toml(), force=force, resume=resume) as claim:
        path = claim.folder / "law.h5"
        if not on_root(comm, path.exists):
            runs = ScatteringRuns(case, claim.folder, comm, stop)
            grid = refine(runs, progress)
            runs.recorded.finish()
            on_root(comm, lambda: write_netcdf(path, runs.dataset(grid)))
        claim.publish()
        return on_root(comm, lambda: ScatteringLaw.read(claim.path / "law.h5"))


class ScatteringRuns:
    """The runs of a law, made by its ``recorded`` by z."""

    def __init__(self, case: LawCase, folder: Path, comm: MPI.Comm, stop: StopRequest) -> None:
        self.case, self.setting, self.cell = case, case.one_site(), case.lattice.unit_cell()
        self.recorded = RecordedRuns("law", folder, comm, stop)
        self.records = self.recorded.known
        self.recorded.make([LINEAR], lambda z: self._linear())
        linear = self.records[LINEAR]
        self.peak, self.reference = linear["peak"], np.array(linear["energy"])
        self.arrived = float(self.reference[self.setting.band, FORWARD] - linear["under_way"])

    def make(self, points: Iterable[float], progress: bool = False) -> None:
        """Make the runs with a site at ``points`` that are missing; raises RuntimeError if one fails. Collective."""
        self.recorded.make(points, self._scattered, what="runs of the law", progress=progress)

    def _run(self, z: float, **output: Any) -> xr.Dataset:
        """A run in memory, without a site for z = 0."""
        setting = self.setting
        case = self.case.varied(
            without=("output",),
            lattice={"cells": setting.cells, "ends": "periodic"},
            contacts={"sites": [setting.site + 1] if z else [], "clearance": [setting.clearance] if z else []},
            drive={"cell": 1, "amplitude": self.amplitude(z) if z else 1.0},
            time={"end": setting.end},
            output={"stride": setting.samples} | output,
        )
        return run_in_memory(case, self.recorded.team, self.recorded.stop)[0]

    def amplitude(self, z: float) -> float:
        """Of the drive in N, for a largest linear relative displacement of ``z`` clearances."""
        return z * self.setting.clearance / self.peak

    def _linear(self) -> Record:
        """The run without a site: the wave at the site over time, and its energies at the end."""
        setting, drive, cell = self.setting, self.case.model().drive, self.cell
        energy, speed = wave_energies(cell, *_last(self._run(LINEAR)))
        late = (speed * setting.towards > 0) & (np.abs(speed) * (setting.end - drive.duration) < setting.distance)
        at_site = self._run(LINEAR, stride=1, window=[setting.site + 1] * 2)
        moved = (at_site[name].values[:, 0] for name in ("displacement", "velocity"))
        w, rate = (field[:, cell.resonator] - field[:, cell.host] for field in moved)
        times = at_site["time"].values
        return {
            "peak": largest_between(times, w, rate),
            "time": times.tolist(),
            "envelope": np.hypot(w, rate / drive.frequency).tolist(),
            "energy": by_direction(energy, setting.towards * speed).tolist(),
            "under_way": float(energy[late[:, setting.band], setting.band].sum()),
        }

    def _scattered(self, z: Any) -> Record:
        """A run with the site; energies over the amplitude's square."""
        setting, run, square, cell = self.setting, self._run(z), self.amplitude(z) ** 2, self.cell
        u, v = _last(run)
        energy, speed = wave_energies(cell, u, v)
        near = (np.arange(-NEAR, NEAR + 1) + setting.site) % setting.cells
        onset, separation = run["impacts/onset"].values, run["impacts/separation"].values
        linear = self.records[LINEAR]
        ended = float(np.nanmax(separation)) if len(onset) else np.nan
        release = np.interp(ended, linear["time"], linear["envelope"]) * self.amplitude(z) / setting.clearance
        return {
            "energy": (by_direction(energy, setting.towards * speed) / square).tolist(),
            "dissipated": float(run["energy/dissipated"][-1]) / square,
            "contact": float(run["energy/contact"][-1]) / square,
            "near": float((cell.masses * v[near] ** 2).sum()) / square,
            "episodes": len(onset),
            "onset": float(onset.min()) if len(onset) else np.nan,
            "separation": ended,
            "release": float(release),
        }

    def jittered(self, z: float) -> list[float]:
        """The runs that stand for the point ``z``; none for z = 1, which nothing touches."""
        options = self.case.law
        width = min(options.jitter, (z - 1) / 10)
        spread = np.linspace(-1, 1, options.samples) if options.samples > 1 else np.zeros(1)
        return [*dict.fromkeys((z * (1 + width * spread)).tolist())] if z > 1 else []

    def outcomes(self, z: float) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Mean and deviation of what the runs at the point ``z`` make of the wave, by name."""
        records = [self.records[run] for run in self.jittered(z)]
        band, unit = self.setting.band, self.arrived
        rows = []
        for record in records or [{"energy": self.reference}]:
            share = (np.array(record["energy"]) - self.reference) / unit
            share[band, FORWARD] += 1
            row = {"share": share, "transmitted": share[band, 0], "reflected": share[band, 1]}
            row |= {"upper": share[band + 1 :].sum()}
            row |= {name: record.get(name, 0.0) / unit for name in ("dissipated", "contact", "near")}
            row |= {name: record.get(name, np.nan) for name in ("onset", "separation", "release")}
            rows.append(row | {"episodes": record.get("episodes", 0)})
        columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
        mean, deviation = ({n: reduce(c, axis=0) for n, c in columns.items()} for reduce in (np.mean, np.std))
        return mean, deviation

    def dataset(self, grid: dict[float, float]) -> xr.Dataset:
        """The content of ``law.h5`` at the points of ``grid``, which gives the interpolation error seen there."""
        linear, points = self.records[LINEAR], sorted(grid)
        means, deviations = zip(*map(self.outcomes, points), strict=True)
        values: dict[str, Any] = {"z": points, "band": np.arange(1, len(self.reference) + 1)}
        values |= {"direction": ["forward", "backward"], "time": linear["time"], "envelope": linear["envelope"]}
        values |= {"amplitude": [self.amplitude(z) for z in points], "interpolation_error": [*map(grid.get, points)]}
        values |= {name: np.array([mean[name] for mean in means]) for name in (*OF_POINT, "near", "episodes")}
        values |= {f"{name}_scatter": np.array([row[name] for row in deviations]) for name in OF_POINT}
        data = xr.Dataset(tabulated(LAYOUT, values), attrs=provenance(self.recorded.comm) | self._about())
        law = ScatteringLaw.of(data)
        best = law.matched() if law.efficiency().any() else (np.nan, np.nan)
        data.attrs |= dict(zip(("matched_z", "matched_transmitted"), best, strict=True))
        return data.assign(tabulated(LAYOUT, {"efficiency": law.efficiency()}))

    def _about(self) -> dict[str, Any]:
        """The attributes of ``law.h5`` that tell of the runs without a site."""
        setting, linear, case = self.setting, self.records[LINEAR], self.case
        time, energy = np.array(linear["time"]), np.square(linear["envelope"])
        burst = np.linspace(0, 1, 1001)
        lengths = [
            _deviation(time, energy),
            case.model().drive.duration * _deviation(burst, np.sin(np.pi * burst) ** 4),
        ]
        return {
            "case": case.to_toml(), "drive_band": setting.band + 1, "clearance": setting.clearance, "peak": self.peak,
            "cells": setting.cells, "distance": setting.distance, "end": setting.end, "slow": setting.slow,
            "under_way": linear["under_way"] / self.arrived, "arrival": float(time[np.argmax(energy)]),
            "spread": lengths[0] / lengths[1],
        }  # fmt: skip


def refine(runs: ScatteringRuns, progress: bool = False) -> dict[float, float]:
    """Make the points of the law: the distance of each from the line between the neighbours it came between (NaN)."""
    options = runs.case.law
    first = np.geomspace(1, options.largest, 1 + max(int(np.ceil(np.log(options.largest) / np.log(STEP))), 1)).tolist()
    grid, halves = dict.fromkeys(first, np.nan), list(itertools.pairwise(first))
    runs.make([run for z in first for run in runs.jittered(z)], progress)
    while halves:
        middles = {float(np.sqrt(low * high)): (low, high) for low, high in halves}
        runs.make([run for z in middles for run in runs.jittered(z)], progress)
        halves = []
        for z, (low, high) in middles.items():
            (mean, deviation), (left, _), (right, _) = map(runs.outcomes, (z, low, high))
            off = {name: float(np.abs(mean[name] - (left[name] + right[name]) / 2)) for name in JUDGED}
            grid[z] = max(off.values())
            bent = any(off[name] > max(options.tolerance, float(deviation[name])) for name in JUDGED)
            bent |= bool(left["transmitted"] > 1 - options.tolerance >= right["transmitted"])  # the onset
            if bent and z / low > 1 + options.finest:
                halves += [(low, z), (z, high)]
    return grid


def largest_between(times: np.ndarray, w: np.ndarray, rate: np.ndarray) -> float:
    """Largest |w| at or between samples at ``times``, from the cubic through ``w`` with slopes ``rate``."""
    curve = CubicHermiteSpline(times, w, rate)
    turns = curve.derivative().roots(extrapolate=False)
    return float(np.abs(curve(np.concatenate([times, turns[np.isfinite(turns)]]))).max())


def _deviation(x: np.ndarray, weight: np.ndarray) -> float:
    """Standard deviation of ``x`` under ``weight``."""
    mean = np.average(x, weights=weight)
    return float(np.sqrt(np.average((x - mean) ** 2, weights=weight)))


def _last(run: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    return run["displacement"].values[-1], run["velocity"].values[-1]
