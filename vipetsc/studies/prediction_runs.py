"""The runs of a prediction and their records: the linear lattice, one site of each kind, the case to compare with.

The result of a run is recorded at once. Energies of bands are those of linear modes at the last sample.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case import Case
from vipetsc.case.law import NO_SITES
from vipetsc.case.predict import PredictCase
from vipetsc.io.records import Record
from vipetsc.lattice import pass_bands
from vipetsc.parallel import StopRequest, StudyError
from vipetsc.spectra import ModalParts
from vipetsc.studies.pair_motion import ContactSpan, PairMotion
from vipetsc.studies.rays import BINS
from vipetsc.studies.recorded_runs import RecordedRuns
from vipetsc.studies.response import Burst, SiteRun
from vipetsc.studies.ring import Ring
from vipetsc.studies.site_waves import SiteWaves

# Kinds of runs, as the records name them.
LINEAR = "linear"
SITE = "site"
MEMBER = "member"

# Runs of one site, by z, the largest linear relative displacement over the clearance: z - 1 of those near the onset,
# and the z from which on the others are log-spaced. Half and twice as many near the onset change energies that are
# predicted for two sites by 0.025 and 0.019 decades, the first three by 0.004; 2.3 and 5.6 in place of HIGH change them
# by 0.055 and 0.073, and their difference from those of runs, 0.189 decades, to 0.175 and 0.196.
NEAR_ONSET = (5e-4, 2e-3, 7e-3, 0.02, 0.05, 0.1, 0.2, 0.35, 0.55, 0.8, 1.2)
HIGH = 2.8
BEYOND = 1.01  # the bins of z reach this many times the largest z of any amplitude


class Job(NamedTuple):
    """A run to be simulated: its ``kind``, and its amplitude in N or, of the one site, its z and its kind of site."""

    kind: str
    at: float
    of: int = 0


class LinearWave(NamedTuple):
    """The wave of 1 N at one site: its ``burst``, w (time) in m as ``displacement`` and its ``peak`` in m.

    ``waves`` are those at the site of a lattice with dashpots.
    """

    burst: Burst
    displacement: np.ndarray
    peak: float
    waves: SiteWaves | None


class Records(NamedTuple):
    """Records of the runs of a prediction: the ``linear`` one, those of one site by z, those to compare with.

    Of the runs of one site there is a list for each kind of ``sites``; ``largest`` is their largest z.
    """

    linear: Record
    sites: list[list[Record]]
    members: list[Record]
    largest: float


def onset_of(linear: Record) -> float:
    """Return the amplitude in N whose linear wave just touches a site, from the ``linear`` run's record.

    Raises StudyError if that run moves no site.
    """
    reached = max(linear["reached"])
    if not reached > 0:
        raise StudyError("the linear wave moves no site before the run ends; set a later time.end, or other sites")
    return float(1 / reached)


def amplitudes_of(case: PredictCase, linear: Record) -> np.ndarray:
    """Return the amplitudes (amplitude,) in N, in rising order."""
    if case.predict.amplitudes:
        return np.unique(case.predict.amplitudes)
    onset = onset_of(linear)
    return np.geomspace(onset, case.predict.span * onset, case.predict.count)


def site_points(case: PredictCase, largest: float) -> list[float]:
    """Return z of the runs of one site, up to the largest that is needed; ``largest`` is ``BEYOND`` times that one."""
    # Above the onset the response changes with the logarithm of z.
    high = np.geomspace(HIGH, largest / BEYOND, case.predict.points - len(NEAR_ONSET))
    return [1 + z for z in NEAR_ONSET] + np.unique(high).tolist()


class PredictionRuns:
    """The runs of a prediction over the ranks of ``comm``, one rank a run, and their records in ``folder``."""

    def __init__(self, case: PredictCase, folder: Path, comm: MPI.Comm, stop: StopRequest, progress: bool) -> None:
        self.case = case
        self.model = case.model()
        self.recorded = RecordedRuns("prediction-runs", folder, comm, stop).read()
        self.rings = [Ring(case, self.recorded, kind) for kind in range(len(case.kinds.kinds))]
        self.linear_waves: dict[int, LinearWave] = {}
        self.progress = progress

    def make_all(self) -> Records:
        """Return the records of all runs; simulate the missing ones. Collective; raises RuntimeError if one fails."""
        # The linear run comes first: it says which z the amplitudes reach, and so which runs of one site are needed.
        linear = self.make([Job(LINEAR, 1.0)])[0]
        amplitudes = amplitudes_of(self.case, linear)
        largest = max(float(amplitudes[-1] * max(linear["reached"])), HIGH) * BEYOND
        points = site_points(self.case, largest)
        kinds = range(len(self.rings))
        # The runs of all kinds together: they keep more ranks busy than those of one.
        runs = self.make([Job(SITE, z, kind) for kind in kinds for z in points], largest)
        sites = [runs[kind * len(points) : (kind + 1) * len(points)] for kind in kinds]
        members: list[Record] = []
        if self.case.predict.simulate:
            members = self.make([Job(MEMBER, amplitude) for amplitude in amplitudes.tolist()])
        return Records(linear, sites, members, largest)

    def make(self, jobs: Sequence[Job], largest: float = 0.0) -> list[Record]:
        """Return records of ``jobs``; the missing ones are simulated now. Collective; raises RuntimeError if one fails.

        ``largest`` is the largest z of the one site's runs, whose sums are over bins up to it.
        """

        def work(key: Any) -> Record:
            job = Job(*key)
            if job.kind == LINEAR:
                record = self._linear(job.at)
            elif job.kind == SITE:
                record = self._site(job.at, job.of, largest)
            else:
                record = self._member(job.at)
            return {"kind": job.kind, "at": job.at, "of": job.of} | record

        self.recorded.make(jobs, work, what=f"{jobs[0].kind} runs", progress=self.progress)
        return [self.recorded.records[job] for job in jobs]

    def _linear(self, amplitude: float) -> Record:
        """Return the lattice without contacts: the largest w at the sites over the clearances, work, energies."""
        chain = self.model.chain
        linear = self.case.varied(without=("output",), drive={"amplitude": amplitude}, contacts=NO_SITES)
        run, statistics = self._run(linear)
        motion = PairMotion.between(run, chain.sites.cells.tolist(), chain.sites.pairs)
        reached = motion.reached(chain.sites.gaps)
        return {"reached": reached} | self._energies(run, statistics)

    def _site(self, z: float, kind: int, largest: float) -> Record:
        """Return the record of one site of a ``kind`` under a burst that reaches ``z`` clearances."""
        ring = self.rings[kind]
        linear = self._linear_wave(kind)
        clearance = ring.setting.clearance
        amplitude = ring.amplitude(z, linear.peak)
        run = ring.run_at_site(amplitude, with_site=True)
        motion = ring.motion(run)

        span = ContactSpan.of(run)
        touched = SiteRun(
            amplitude=amplitude,
            clearance=clearance,
            displacement=motion.displacement[:, 0],
            dissipated=run["energy/dissipated"].values,
            last_contact=span.last,
        )
        record = {"z": z, "amplitude": amplitude, "largest": largest} | linear.burst.sums(touched, largest)
        if linear.waves:
            force = linear.waves.force(motion, amplitude * linear.displacement, span.first, span.last)
            record["spectrum"] = linear.waves.sent_by_bins(force, BINS).tolist()
        return record

    def _linear_wave(self, kind: int) -> LinearWave:
        """Return the linear wave at one site of a ``kind`` under 1 N; simulated once."""
        if kind not in self.linear_waves:
            ring = self.rings[kind]
            motion = ring.motion(ring.run_at_site(1.0, with_site=False))
            w = motion.displacement[:, 0]
            is_damped = self.model.chain.is_damped
            self.linear_waves[kind] = LinearWave(
                burst=Burst(
                    self.model.chain.cell, drive=self.model.drive.frequency, time=motion.time, w=w, pair=ring.kind.pair
                ),
                displacement=w,
                peak=ring.peak_of(motion),
                waves=SiteWaves(self.model, ring.setting, ring.kind.pair) if is_damped else None,
            )
        return self.linear_waves[kind]

    def _member(self, amplitude: float) -> Record:
        """Return the case under ``amplitude``, for the comparison."""
        first_and_last = {"stride": self.model.samples - 1}
        run, statistics = self._run(
            self.case.varied(without=("output",), drive={"amplitude": amplitude}, output=first_and_last)
        )
        return {"dissipated": statistics["dissipated"], "episodes": statistics["episodes"]} | self._energies(
            run, statistics
        )

    def _run(self, case: Case) -> tuple[xr.Dataset, dict[str, Any]]:
        """Return a run of ``case`` in memory, and its statistics."""
        data, result = self.recorded.run_in_memory(case)
        return data, result.statistics

    def _energies(self, run: xr.Dataset, statistics: dict[str, Any]) -> Record:
        """Return energies in J of a ``run``: work, bands at the end, and what dashpots took, if there are any."""
        record = {"work": statistics["work"], "bands": self._band_energies(run)}
        if self.model.chain.is_damped:
            record["dashpots"] = statistics["dissipated_by_damping"]
        return record

    def _band_energies(self, run: xr.Dataset) -> list[float]:
        """Return the energy in J of the pass bands at the last sample; modes in gaps count to the band below."""
        modes = ModalParts.of(self.model.chain.without_dashpots()).modes
        u, v = (run[name].values[-1:] for name in ("displacement", "velocity"))
        energy = np.abs(modes.amplitudes(u, v)[0]) ** 2 / 2
        lower_edges = [band.low for band in pass_bands(self.model.chain.cell)[1:]]
        # A mode at a band's edge counts to that band, whatever its last digits are.
        band = np.searchsorted(lower_edges, modes.frequency * (1 + 1e-9))
        return [float(e) for e in np.bincount(band, energy, len(lower_edges) + 1)]
