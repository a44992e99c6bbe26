"""Prediction of a run with any number of sites from the response of one: the result is ``prediction.h5``.

Runs: the linear lattice under 1 N (onset, work, energies by band); one site in an infinite lattice (``studies.ring``)
at ``predict.points`` amplitudes, dense near the onset (``studies.response``); then, to compare, the case itself at
every amplitude. The result of a run is recorded at once. ``studies.composition`` composes the sites. Energies of bands
are those of linear modes at the last sample, over the drive's work.
"""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case import Case
from vipetsc.case.amplitude import amplitude_unit
from vipetsc.case.kinds import NO_SITES
from vipetsc.case.predict import PredictCase
from vipetsc.io.folder import PREDICTION, claimed, provenance
from vipetsc.io.netcdf import open_netcdf, tabulated, write_netcdf
from vipetsc.io.records import Record
from vipetsc.lattice import pass_bands
from vipetsc.parallel import StopRequest, on_root
from vipetsc.spectra import ModalParts
from vipetsc.studies.composition import Network
from vipetsc.studies.pair_motion import PairMotion
from vipetsc.studies.recorded_runs import RecordedRuns
from vipetsc.studies.response import Burst, SiteResponse, SiteResponses, SiteRun
from vipetsc.studies.ring import Ring

LINEAR, SITE, MEMBER = "linear", "site", "member"
# Largest linear relative displacement over clearance, less 1, of the runs near the onset; others are log-spaced above.
NEAR_ONSET = (5e-4, 2e-3, 7e-3, 0.02, 0.05, 0.1, 0.2, 0.35, 0.55, 0.8, 1.2)
HIGH = 2.8
BEYOND = 1.01  # the one site's runs reach this many times the largest z of any amplitude
LAYOUT = {
    "amplitude": ("amplitude", "N", "amplitude of the drive; in m of a moved wall"),
    "band": ("band", "1", "pass band, from 1"),
    "site": ("site", "1", "contact site"),
    "sites/cell": ("site", "1", "cell (1-based) of a site"),
    "sites/kind": ("site", "1", "kind of a site, from 1: sites of one kind have the response of one run alone"),
    "predicted/bands": ("amplitude band", "1", "energy of a pass band at the end over the work"),
    "predicted/upper": ("amplitude", "1", "energy of the bands above the driven one at the end over the work"),
    "predicted/other": ("amplitude", "1", "energy of all bands except the driven one at the end over the work"),
    "predicted/dissipated": ("amplitude", "1", "dissipated energy over the work"),
    "predicted/z": (
        "amplitude site",
        "1",
        "largest relative displacement of the wave that arrives at a site, over its clearance",
    ),
    "predicted/change": ("amplitude", "1", "change by the last iteration over the linear wave"),
}
MEASURED = ("bands", "upper", "other", "dissipated")
LAYOUT |= {f"simulated/{name}": LAYOUT[f"predicted/{name}"] for name in MEASURED}
LAYOUT["simulated/contact_episodes"] = ("amplitude", "1", "contact episodes; NaN where a run failed")


class Job(NamedTuple):
    """A run to be simulated: its ``kind``, and its amplitude in N or, of the one site, its z and its kind of site."""

    kind: str
    at: float
    of: int = 0


class Records(NamedTuple):
    """Records of the runs of a prediction: the ``linear`` one, those of one site by z, those to compare with.

    Of the runs of one site there is a list for each kind of ``sites``; ``largest`` is their largest z.
    """

    linear: Record
    sites: list[list[Record]]
    members: list[Record]
    largest: float


def predict(
    case: PredictCase,
    folder: str | Path,
    comm: MPI.Comm = MPI.COMM_WORLD,
    *,
    force: bool = False,
    resume: bool = False,
    stop: StopRequest | None = None,
    progress: bool = False,
) -> xr.Dataset:
    """Predict ``case`` on all ranks of ``comm``, and write ``prediction.h5`` to ``folder``; returns its content.

    Recorded runs are not simulated again; ``force`` starts again, ``resume`` requires existing runs. Raises
    FolderError if the folder contains anything else, RuntimeError if a required run fails, StoppedError on a
    request to ``stop``.
    """
    with claimed(comm, folder, PREDICTION, case.to_toml(), force=force, resume=resume) as claim:
        path = claim.folder / "prediction.h5"
        # Rank 0 looks for all ranks: one that saw no file would begin the runs alone.
        if not on_root(comm, path.exists):
            stop = stop or StopRequest()
            runs = PredictionRuns(case, claim.folder, comm, stop, progress)
            records = runs.make_all()
            about = provenance(comm)
            runs.recorded.finish()
            # Composing takes seconds, and nobody looks at requests to stop; the runs are recorded.
            with stop.at_once():
                on_root(comm, lambda: write_netcdf(path, composed(case, records).assign_attrs(about)))

        claim.publish()
        return on_root(comm, lambda: read_prediction(claim.path))


def read_prediction(folder: str | Path) -> xr.Dataset:
    """The content of ``prediction.h5`` in ``folder``; raises OSError or ValueError if it is none."""
    with open_netcdf(Path(folder) / "prediction.h5", "prediction", ("predicted", "onset_amplitude")) as data:
        return data.load()


def amplitudes_of(case: PredictCase, linear: Record) -> np.ndarray:
    """The amplitudes in N, in rising order."""
    if case.predict.amplitudes:
        return np.unique(case.predict.amplitudes)
    onset = 1 / max(linear["reached"])
    return np.geomspace(onset, case.predict.span * onset, case.predict.count)


def site_points(case: PredictCase, largest: float) -> list[float]:
    """z of the runs of one site, up to ``largest``."""
    high = np.geomspace(HIGH, largest / BEYOND, case.predict.points - len(NEAR_ONSET))
    return [1 + z for z in NEAR_ONSET] + np.unique(high).tolist()


class PredictionRuns:
    """The runs of a prediction over the ranks of ``comm``, one rank a run, and their records in ``folder``."""

    def __init__(self, case: PredictCase, folder: Path, comm: MPI.Comm, stop: StopRequest, progress: bool) -> None:
        self.case = case
        self.model = case.model()
        self.recorded = RecordedRuns("prediction-runs", folder, comm, stop).read()
        self.rings = [Ring(case, self.recorded, kind) for kind in range(len(case.kinds.kinds))]
        self.bursts: dict[int, tuple[Burst, float]] = {}
        self.progress = progress

    def make_all(self) -> Records:
        """The records of all runs; the missing ones are simulated now. Collective; raises RuntimeError if one fails."""
        # The linear run comes first: it says which z the amplitudes reach, and so which runs of one site are needed.
        linear = self.make([Job(LINEAR, 1.0)])[0]
        amplitudes = amplitudes_of(self.case, linear)
        largest = max(float(amplitudes[-1] * max(linear["reached"])), HIGH) * BEYOND
        points = site_points(self.case, largest)
        kinds = range(len(self.rings))
        # The runs of all kinds together: they keep more ranks busy than those of one.
        made = self.make([Job(SITE, z, kind) for kind in kinds for z in points], largest)
        sites = [made[kind * len(points) : (kind + 1) * len(points)] for kind in kinds]
        members: list[Record] = []
        if self.case.predict.simulate:
            members = self.make([Job(MEMBER, amplitude) for amplitude in amplitudes.tolist()])
        return Records(linear, sites, members, largest)

    def make(self, jobs: Sequence[Job], largest: float = 0.0) -> list[Record]:
        """The records of ``jobs``; the missing ones are simulated now. Collective; raises RuntimeError if one fails.

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
        """The lattice without contacts: the largest w at the sites over the clearances, work, energies."""
        chain = self.model.chain
        linear = self.case.varied(without=("output",), drive={"amplitude": amplitude}, contacts=NO_SITES)
        run, statistics = self._run(linear)
        motion = PairMotion.between(run, chain.sites, chain.contact_pairs)
        reached = motion.reached(self.model.gaps or [(gap, gap) for gap in chain.clearances])
        return {"reached": reached, "work": statistics["work"], "bands": self._band_energies(run)}

    def _site(self, z: float, kind: int, largest: float) -> Record:
        """Record of one site of a ``kind`` under a burst that reaches ``z`` clearances: sums over its contact."""
        ring = self.rings[kind]
        burst, peak = self._burst(kind)
        clearance = ring.setting.clearance
        amplitude = ring.amplitude(z, peak)
        run = ring.run_at_site(amplitude, with_site=True)
        w = ring.motion(run).displacement[:, 0]
        separation = run["impacts/separation"].values
        touched = SiteRun(
            amplitude=amplitude,
            clearance=clearance,
            displacement=w,
            dissipated=run["energy/dissipated"].values,
            last_contact=float(np.nanmax(separation)) if len(separation) else np.nan,
        )
        return {"z": z, "amplitude": amplitude, "largest": largest} | burst.sums(touched, largest)

    def _burst(self, kind: int) -> tuple[Burst, float]:
        """The linear wave at one site of a ``kind`` under 1 N, and its peak in m; simulated once."""
        if kind not in self.bursts:
            ring = self.rings[kind]
            motion = ring.motion(ring.run_at_site(1.0, with_site=False))
            w = motion.displacement[:, 0]
            burst = Burst(self.model.chain.cell, self.model.drive.frequency, motion.time, w, ring.kind.pair)
            self.bursts[kind] = burst, ring.peak_of(motion)
        return self.bursts[kind]

    def _member(self, amplitude: float) -> Record:
        """The case under ``amplitude``, for the comparison."""
        first_and_last = {"stride": self.model.samples - 1}
        run, statistics = self._run(
            self.case.varied(without=("output",), drive={"amplitude": amplitude}, output=first_and_last)
        )
        return {
            "work": statistics["work"],
            "dissipated": statistics["dissipated"],
            "episodes": statistics["episodes"],
            "bands": self._band_energies(run),
        }

    def _run(self, case: Case) -> tuple[xr.Dataset, dict[str, Any]]:
        """A run of ``case`` in memory, and its statistics."""
        data, result = self.recorded.run_in_memory(case)
        return data, result.statistics

    def _band_energies(self, run: xr.Dataset) -> list[float]:
        """Energy in J of the pass bands at the last sample; modes in gaps count to the band below."""
        modes = ModalParts.of(self.model.chain).modes
        u, v = (run[name].values[-1:] for name in ("displacement", "velocity"))
        energy = np.abs(modes.amplitudes(u, v)[0]) ** 2 / 2
        lower_edges = [band.low for band in pass_bands(self.model.chain.cell)[1:]]
        # A mode at a band's edge counts to that band, whatever its last digits are.
        band = np.searchsorted(lower_edges, modes.frequency * (1 + 1e-9))
        return [float(e) for e in np.bincount(band, energy, len(lower_edges) + 1)]


def composed(case: PredictCase, records: Records) -> xr.Dataset:
    """The content of ``prediction.h5``, without its provenance."""
    begin = time.process_time()
    model = case.model()
    cell = model.chain.cell
    linear = records.linear
    amplitudes = amplitudes_of(case, linear)
    driven = next(i for i, band in enumerate(pass_bands(cell)) if model.drive.frequency <= band.high)
    onset = 1 / max(linear["reached"])

    kinds = case.kinds
    responses = [
        SiteResponse.of(rows, cell, model.drive.frequency, records.largest, kind.pair)
        for rows, kind in zip(records.sites, kinds.kinds, strict=True)
    ]
    every_site = SiteResponses(of_kind=tuple(responses), kind=np.array(kinds.of))
    predicted = _predicted(Network(model), every_site, amplitudes, linear, driven)
    values = {f"predicted/{name}": value for name, value in predicted.items()}
    values |= {
        "amplitude": amplitudes,
        "band": np.arange(1, cell.dofs + 1),
        "site": np.arange(1, len(model.chain.sites) + 1),
        "sites/cell": np.array(model.chain.sites) + 1,
        "sites/kind": np.array(kinds.of) + 1,
    }
    about: dict[str, Any] = {"case": case.to_toml(), "onset_amplitude": onset, "drive_band": driven + 1}
    of_sites = [record for rows in records.sites for record in rows]
    in_runs = sum(record["cpu_seconds"] for record in [linear, *of_sites])
    about["cpu_seconds"] = in_runs + time.process_time() - begin

    if records.members:
        simulated = _simulated(records.members, driven)
        values |= {f"simulated/{name}": value for name, value in simulated.items()}
        about |= errors(values)
    data = xr.Dataset(tabulated(LAYOUT, values), attrs=about)
    data["amplitude"].attrs["units"] = amplitude_unit(case)
    return data


def _predicted(
    network: Network, sites: SiteResponses, amplitudes: np.ndarray, linear: Record, driven: int
) -> dict[str, np.ndarray]:
    """Predicted values at every amplitude, by their names in ``LAYOUT``; ``driven`` is the drive's band from 0."""
    onset = 1 / max(linear["reached"])
    untouched = np.array(linear["bands"]) / linear["work"]
    rows: dict[str, list[Any]] = {"bands": [], "dissipated": [], "z": [], "change": []}
    for amplitude in amplitudes:
        work = linear["work"] * amplitude**2
        bands = untouched.copy()
        dissipated = 0.0
        z = amplitude * np.array(linear["reached"])
        change = 0.0
        if amplitude > onset:
            composition = network.compose(float(amplitude), sites)
            bands += composition.into / work
            dissipated = composition.dissipated / work
            z = composition.z
            change = composition.change
        # Energies add up to the work, so the driven band has what other bands and the loss leave.
        bands[driven] = 1 - dissipated - np.delete(bands, driven).sum()

        rows["bands"].append(bands)
        rows["dissipated"].append(dissipated)
        rows["z"].append(z)
        rows["change"].append(change)
    predicted = {name: np.array(column) for name, column in rows.items()}
    return predicted | _sums(predicted["bands"], driven)


def _simulated(members: Sequence[Record], driven: int) -> dict[str, np.ndarray]:
    """Simulated values at every amplitude, by their names in ``LAYOUT``."""
    work = np.array([member["work"] for member in members])
    bands = np.array([member["bands"] for member in members]) / work[:, None]
    measured = {
        "bands": bands,
        "dissipated": np.array([member["dissipated"] for member in members]) / work,
        "contact_episodes": np.array([float(member["episodes"]) for member in members]),
    }
    return measured | _sums(bands, driven)


def _sums(bands: np.ndarray, driven: int) -> dict[str, np.ndarray]:
    """Energy (amplitude) of the bands above the ``driven`` one, and of all others but it."""
    return {"upper": bands[:, driven + 1 :].sum(axis=1), "other": np.delete(bands, driven, axis=1).sum(axis=1)}


def errors(values: dict[str, np.ndarray]) -> dict[str, float]:
    """Errors of a prediction, judged by simulations with contacts.

    Root mean square and worst, in decades, of the energies of upper and other bands; worst of the dissipated fraction.
    """
    touched = values["simulated/contact_episodes"] > 0
    summary: dict[str, float] = {}
    for name in ("upper", "other"):
        pair = np.array([values[f"{kind}/{name}"] for kind in ("predicted", "simulated")])
        comparable = touched & (pair > 0).all(axis=0)
        if comparable.any():
            decades = np.abs(np.diff(np.log10(pair[:, comparable]), axis=0))
            summary[f"rms_{name}"] = float(np.sqrt(np.mean(decades**2)))
            summary[f"worst_{name}"] = float(decades.max())
    lost = np.abs(values["predicted/dissipated"] - values["simulated/dissipated"])
    return summary | {"worst_dissipated": float(lost.max())}
