"""The runs of the scattering law: one site in an infinite lattice, refined in z; the result is ``law.h5``.

``studies.ring`` has the geometry: a lattice that is infinite while a run lasts. Waves need not have separated in space
at the end: Bloch amplitudes give band and direction of each at an instant (``spectra.directions``), and are constant
once the last contact has ended.

**Fractions.** E0 (band, direction) are the energies of the run without a site under 1 N, E those of a run under the
amplitude A, over A^2. Forward is the direction from the drive towards the site. E_in is the energy that arrives: the
part of E0 in the drive's band, forward, whose waves are fast enough to be past the site at the end. The fraction of a
band and direction is (E - E0)/E_in; in the drive's band forward, 1 is added to it. It is called T in the drive's band
forward, R in this band backward, and U in all bands above. With the dissipated energy and what a closed contact holds,
over A^2 E_in, the fractions sum to 1, to the ledger's accuracy, since the drive does the same work as without a site;
T = 1 where nothing is touched.

**Dashpots.** In a lattice with dashpots the energies are those that flow past the site (``studies.site_waves``), and
E_in is what arrives there: what dashpots take before and after is in no fraction. What they take at the site, where the
waves overlap, is a fraction of its own: 1 less all others. It goes to zero with the dashpots, to the accuracy of the
contact's force.

**z** is the largest |w| of the linear wave at the site over the clearance. The bilinear law scales exactly: with a
given z, the fractions do not depend on the clearance. Hertz's does through its stiffness kc D^(1/2): the law is that of
one clearance, by default the geometric mean of the sites'.

**Refinement.** The first points are z = 1 and, up to the largest z, two in each octave. Then the point in the middle
(in log z) of each two neighbours is computed. If T, R, U or the dissipated fraction there differs from the mean of both
neighbours by more than the tolerance and the scatter, or if T falls from 1 between them, both halves are treated
likewise, until they are finer than asked for. Mean and deviation at z are those of runs spread evenly over z (1 +-
min(jitter, (z - 1)/10)).
"""

import itertools
from collections.abc import Callable, Iterable
from functools import cached_property
from pathlib import Path
from typing import Any, Unpack

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case.amplitude import amplitude_unit
from vipetsc.case.law import LawCase
from vipetsc.io.folder import provenance
from vipetsc.io.kinds import LAW
from vipetsc.io.netcdf import tabulated
from vipetsc.io.records import Record
from vipetsc.parallel import StopRequest
from vipetsc.spectra.directions import by_direction, wave_energies
from vipetsc.studies.pair_motion import ContactSpan, PairMotion
from vipetsc.studies.recorded_runs import RecordedRuns
from vipetsc.studies.ring import Ring
from vipetsc.studies.scattering_law import BACKWARD, DAMPED, FORWARD, LAYOUT, NEAR, POINT_LAYOUT, ScatteringLaw
from vipetsc.studies.site_waves import SiteWaves
from vipetsc.studies.study import How, Study, StudyWork

LINEAR = 0.0  # the z of the run without a site
# Ratio of neighbouring points to begin with: two an octave. What is added between them decides: with ratios of 2 and 4
# a law up to z = 16 has 35 and 33 points in place of 39, and the same errors; with 2^(1/4) 79, and half the errors.
STEP = np.sqrt(2.0)
REFINED = ("transmitted", "reflected", "upper", "dissipated")  # what is to lie near the line between two points


def make_law(case: LawCase, folder: str | Path, comm: MPI.Comm = MPI.COMM_WORLD, **how: Unpack[How]) -> ScatteringLaw:
    """Compute the scattering law of ``case`` on all ranks of ``comm``, and write ``law.h5`` to ``folder``.

    ``how`` it is computed, and what it raises, is in ``Study.run``.
    """
    LawCase.expect(case, "make_law")
    return STUDY.run(case, folder, comm, **how)


def _make(case: LawCase, work: StudyWork) -> Callable[[], xr.Dataset]:
    """Refine the law; returns the function that gives its dataset."""
    runs = ScatteringRuns(case, work.folder, work.comm, work.stop)
    errors = refine(runs, work.progress)
    runs.recorded.finish()
    return lambda: runs.dataset(errors)


STUDY = Study(LAW, "law.h5", make=_make, read=lambda folder: ScatteringLaw.read(folder / "law.h5"))


class ScatteringRuns:
    """The runs of a law, ``recorded`` by their z. All ranks of ``comm`` must construct one."""

    def __init__(self, case: LawCase, folder: Path, comm: MPI.Comm, stop: StopRequest) -> None:
        self.case = case
        self.cell = case.lattice.unit_cell()
        self.recorded = RecordedRuns("law-runs", folder, comm, stop).read()
        self.ring = Ring(case, self.recorded)
        self.setting = self.ring.setting

        # All runs with a site are measured against the one without.
        linear_run = self._linear_at_site if self.cell.is_damped else self._linear
        self.recorded.make([LINEAR], lambda z: linear_run())
        linear = self.records[LINEAR]
        self.peak = linear["peak"]
        self.reference = np.array(linear["energy"])
        self.arrived = float(self.reference[self.setting.band, FORWARD] - linear["under_way"])

    @property
    def records(self) -> dict[Any, Record]:
        """Records of the runs, by z."""
        return self.recorded.records

    @cached_property
    def site_waves(self) -> SiteWaves:
        """The waves at the site of a lattice with dashpots."""
        return SiteWaves(self.case.model(), self.setting, self.ring.kind.pair)

    def make(self, points: Iterable[float], progress: bool = False) -> None:
        """Simulate the missing runs with a site at ``points``; raises RuntimeError if one fails. Collective."""
        work = self._scattered_at_site if self.cell.is_damped else self._scattered
        self.recorded.make(points, work, what="runs of the law", progress=progress)

    def amplitude(self, z: float) -> float:
        """Return the amplitude of the drive in N, for a largest linear relative displacement of ``z`` clearances."""
        return self.ring.amplitude(z, self.peak)

    def _linear(self) -> Record:
        """Return the run without a site: the wave at the site over time, and its energies at the end."""
        setting = self.setting
        run = self.ring.run_to_end(1.0, with_site=False)
        energy, speed = wave_energies(self.cell, *_last_state(run))
        since_burst = setting.end - self.case.model().drive.duration
        # Waves towards the site that have not reached it, had they left when the burst ended.
        late = (speed * setting.towards > 0) & (np.abs(speed) * since_burst < setting.distance)

        # The run is simulated twice: its last sample in all cells and all samples of the site fit where all would not.
        motion = self.ring.motion(self.ring.run_at_site(1.0, with_site=False))
        return self._arrival(motion) | {
            "energy": by_direction(energy, setting.towards * speed).tolist(),
            "under_way": float(energy[late[:, setting.band], setting.band].sum()),
        }

    def _linear_at_site(self) -> Record:
        """Return the run without a site in a lattice with dashpots: the wave there, and the energies that pass."""
        waves = self.site_waves
        motion = self.ring.motion(self.ring.run_at_site(1.0, with_site=False))
        return self._arrival(motion) | {
            "displacement": motion.displacement[:, 0].tolist(),
            "energy": waves.energies().tolist(),
            "under_way": waves.late(self.setting.end - self.case.model().drive.duration),
            "taken_before": waves.taken_before(),
        }

    def _arrival(self, motion: PairMotion) -> Record:
        """Return the wave at the site, from the ``motion`` under 1 N without the site."""
        w = motion.displacement[:, 0]
        rate = motion.velocity[:, 0]
        of_wall = {"wall_peak": self.ring.wall_peak()} if self.case.drive.end else {}
        return of_wall | {
            "peak": self.ring.peak_of(motion),
            "time": motion.time.tolist(),
            "envelope": np.hypot(w, rate / self.case.model().drive.frequency).tolist(),
        }

    def _scattered(self, z: Any) -> Record:
        """Return a run with the site; energies over the amplitude's square."""
        setting = self.setting
        amplitude = self.amplitude(z)
        square = amplitude**2
        run = self.ring.run_to_end(amplitude, with_site=True)
        u, v = _last_state(run)
        energy, speed = wave_energies(self.cell, u, v)
        # What still moves near the site at the end is counted among what leaves: this shows how much it is.
        near = (np.arange(-NEAR, NEAR + 1) + setting.site) % setting.cells
        return {
            "energy": (by_direction(energy, setting.towards * speed) / square).tolist(),
            "near": float((self.cell.masses * v[near] ** 2).sum()) / square,
        } | self._contact(run, amplitude)

    def _scattered_at_site(self, z: Any) -> Record:
        """Return a run with the site in a lattice with dashpots; energies over the amplitude's square."""
        amplitude = self.amplitude(z)
        square = amplitude**2
        run = self.ring.run_at_site(amplitude, with_site=True, neighbours=NEAR)
        motion = self.ring.motion(run)
        contact = self._contact(run, amplitude)
        linear = amplitude * np.array(self.records[LINEAR]["displacement"])
        force = self.site_waves.force(motion, linear, contact["onset"], contact["separation"])

        energy = self.site_waves.energies(force / amplitude)
        sent_out = float((energy - self.reference).sum())
        # The site gives no energy of its own: what waves have lost there, and the contact has neither dissipated nor
        # kept, is the dashpots'.
        last = run["velocity"].values[-1]
        return {
            "energy": energy.tolist(),
            "near": float((self.cell.masses * last**2).sum()) / square,
            "dashpots": -sent_out - contact["dissipated"] - contact["contact"],
        } | contact

    def _contact(self, run: xr.Dataset, amplitude: float) -> Record:
        """Return times, forces and losses of the contact in a ``run`` under ``amplitude`` in N, and energies."""
        square = amplitude**2
        span = ContactSpan.of(run)
        linear = self.records[LINEAR]
        release = np.interp(span.last, linear["time"], linear["envelope"]) * amplitude / self.setting.clearance
        return {
            "dissipated": float(run["energy/dissipated"][-1]) / square,
            "contact": float(run["energy/contact"][-1]) / square,
            "episodes": run.sizes["episode"],
            "onset": span.first,
            "separation": span.last,
            "release": float(release),
        }

    def jittered(self, z: float) -> list[float]:
        """Return the runs that represent the point ``z``; none for z = 1, where nothing is touched."""
        if z <= 1:
            return []
        options = self.case.law
        # Narrower near the onset, so that all runs of a point touch the stop.
        width = min(options.jitter, (z - 1) / 10)
        spread = np.zeros(1)
        if options.samples > 1:
            spread = np.linspace(-1, 1, options.samples)
        return [*dict.fromkeys((z * (1 + width * spread)).tolist())]

    def outcomes(self, z: float) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Return mean and deviation over the runs at ``z``: by name, "share" (band, direction), others numbers."""
        untouched = {"energy": self.reference}
        records = [self.records[run] for run in self.jittered(z)] or [untouched]
        rows = [self._outcome(record) for record in records]

        mean: dict[str, np.ndarray] = {}
        deviation: dict[str, np.ndarray] = {}
        for name in rows[0]:
            column = np.array([row[name] for row in rows])
            mean[name] = np.mean(column, axis=0)
            deviation[name] = np.std(column, axis=0)
        return mean, deviation

    def _outcome(self, record: Record) -> dict[str, Any]:
        """Return fractions and times of one run by name: the fields of ``ScatteringOutcome``, "near" and "episodes"."""
        band = self.setting.band
        fraction = (np.array(record["energy"]) - self.reference) / self.arrived
        # The reference holds the whole transmitted wave: where nothing is touched the difference is 0, and T is 1.
        fraction[band, FORWARD] += 1
        return {
            "share": fraction,
            "transmitted": fraction[band, FORWARD],
            "reflected": fraction[band, BACKWARD],
            "upper": fraction[band + 1 :].sum(),
            "dissipated": record.get("dissipated", 0.0) / self.arrived,
            "contact": record.get("contact", 0.0) / self.arrived,
            "dashpots": record.get("dashpots", 0.0) / self.arrived,
            "near": record.get("near", 0.0) / self.arrived,
            "onset": record.get("onset", np.nan),
            "separation": record.get("separation", np.nan),
            "release": record.get("release", np.nan),
            "episodes": record.get("episodes", 0),
        }

    def dataset(self, errors: dict[float, float]) -> xr.Dataset:
        """Return the content of ``law.h5`` at the points that have interpolation ``errors``."""
        linear = self.records[LINEAR]
        points = sorted(errors)
        outcomes = [self.outcomes(z) for z in points]
        peak = self.peak
        if "wall_peak" in linear:
            peak = linear["wall_peak"]

        values: dict[str, Any] = {
            "z": points,
            "band": np.arange(1, len(self.reference) + 1),
            "direction": ["forward", "backward"],
            "time": linear["time"],
            "envelope": linear["envelope"],
            "amplitude": [self.ring.amplitude(z, peak) for z in points],
            "interpolation_error": [errors[z] for z in points],
        }
        of_points = [name for name in POINT_LAYOUT if name not in DAMPED or self.cell.is_damped]
        for name in (*of_points, "near", "episodes"):
            values[name] = np.array([mean[name] for mean, _ in outcomes])
        for name in of_points:
            values[f"{name}_scatter"] = np.array([deviation[name] for _, deviation in outcomes])
        data = xr.Dataset(tabulated(LAYOUT, values), attrs=provenance(self.recorded.comm) | self._about())

        data["amplitude"].attrs["units"] = amplitude_unit(self.case)

        law = ScatteringLaw.of(data)
        efficiency = law.efficiency()
        z, transmitted = law.matched() if efficiency.any() else (np.nan, np.nan)
        data.attrs["matched_z"] = z
        data.attrs["matched_transmitted"] = transmitted
        return data.assign(tabulated(LAYOUT, {"efficiency": efficiency}))

    def _about(self) -> dict[str, Any]:
        """Return the attributes of ``law.h5`` that describe the runs without a site."""
        setting = self.setting
        linear = self.records[LINEAR]
        time = np.array(linear["time"])
        energy = np.square(linear["envelope"])

        # The burst's own length, as deviation of sin^4: the square of its Hann window.
        burst = np.linspace(0, 1, 1001)
        sent = self.case.model().drive.duration * _deviation(burst, np.sin(np.pi * burst) ** 4)
        of_dashpots = {"taken_before": linear["taken_before"]} if self.cell.is_damped else {}
        return of_dashpots | {
            "case": self.case.to_toml(),
            "drive_band": setting.band + 1,
            "clearance": setting.clearance,
            "peak": self.peak,
            "cells": setting.cells,
            "distance": setting.distance,
            "end": setting.end,
            "slow": setting.slow,
            "under_way": linear["under_way"] / self.arrived,
            "arrival": float(time[np.argmax(energy)]),
            "spread": _deviation(time, energy) / sent,
        }


def refine(runs: ScatteringRuns, progress: bool = False) -> dict[float, float]:
    """Compute the points of the law; returns the distance of each from the line between its neighbours, by z.

    It is NaN for the first points, which are not between others.
    """
    options = runs.case.law
    intervals = max(int(np.ceil(np.log(options.largest) / np.log(STEP))), 1)
    first = np.geomspace(1, options.largest, 1 + intervals).tolist()
    runs.make([run for z in first for run in runs.jittered(z)], progress)

    errors = dict.fromkeys(first, np.nan)
    # Round by round rather than depth first: each round is a list of runs that all ranks divide.
    halves = list(itertools.pairwise(first))
    while halves:
        middles = {float(np.sqrt(low * high)): (low, high) for low, high in halves}
        # All runs of a round together: they keep more ranks busy than those of one point.
        runs.make([run for z in middles for run in runs.jittered(z)], progress)

        halves = []
        for z, (low, high) in middles.items():
            errors[z], bent = _distance_from_line(runs, z, low, high)
            if bent and z / low > 1 + options.finest:
                halves += [(low, z), (z, high)]
    return errors


def _distance_from_line(runs: ScatteringRuns, z: float, low: float, high: float) -> tuple[float, bool]:
    """Return largest distance at ``z`` from the line between ``low`` and ``high``, and whether points are needed."""
    tolerance = runs.case.law.tolerance
    mean, deviation = runs.outcomes(z)
    left, _ = runs.outcomes(low)
    right, _ = runs.outcomes(high)

    largest = 0.0
    bent = False
    for name in REFINED:
        distance = float(np.abs(mean[name] - (left[name] + right[name]) / 2))
        largest = max(largest, distance)
        if distance > max(tolerance, float(deviation[name])):
            bent = True
    # The middle may miss the onset, at which T begins to fall from 1.
    if left["transmitted"] > 1 - tolerance >= right["transmitted"]:
        bent = True
    return largest, bent


def _deviation(x: np.ndarray, weight: np.ndarray) -> float:
    """Return standard deviation of ``x`` under ``weight``."""
    mean = np.average(x, weights=weight)
    return float(np.sqrt(np.average((x - mean) ** 2, weights=weight)))


def _last_state(run: xr.Dataset) -> tuple[np.ndarray, np.ndarray]:
    """Return the displacement and velocity (cell, dof) at the last sample."""
    return run["displacement"].values[-1], run["velocity"].values[-1]
