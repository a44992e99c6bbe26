"""A run with any number of sites predicted from the answer of one: a case in, ``prediction.h5`` out.

Runs: the linear lattice under 1 N (onset, work, energies by band); one site in an infinite lattice (the geometry of
``studies.one_site``) at ``predict.points`` amplitudes, dense near the onset (``studies.response``); then, to compare,
the case itself at every amplitude. What a run came to is recorded at once. ``studies.composition`` composes the sites.
Energies of bands are those of linear modes at the last sample, over the drive's work.
"""

import time
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case.predict import PredictCase
from vipetsc.io.folder import PREDICTION, claimed, provenance
from vipetsc.io.netcdf import open_netcdf, tabulated, write_netcdf
from vipetsc.io.records import Record
from vipetsc.lattice import pass_bands
from vipetsc.parallel import StopRequest, on_root
from vipetsc.spectra import ModalParts
from vipetsc.studies.composition import Network
from vipetsc.studies.one_site import largest_between
from vipetsc.studies.recorded_runs import RecordedRuns, run_in_memory
from vipetsc.studies.response import Burst, SiteResponse

RECORDS, PARTS = "prediction.jsonl", "prediction-*.jsonl"
LINEAR, SITE, MEMBER = "linear", "site", "member"
# Largest linear relative displacement over clearance, less 1, of the runs near the onset; others are log-spaced above.
NEAR = 5e-4, 2e-3, 7e-3, 0.02, 0.05, 0.1, 0.2, 0.35, 0.55, 0.8, 1.2
HIGH = 2.8
LAYOUT = {
    "amplitude": ("amplitude", "N", "amplitude of the drive"),
    "band": ("band", "1", "pass band, from 1"),
    "site": ("site", "1", "contact site"),
    "sites/cell": ("site", "1", "cell (1-based) of a site"),
    "predicted/bands": ("amplitude band", "1", "energy of a pass band at the end over the work"),
    "predicted/upper": ("amplitude", "1", "energy of the bands above the driven one at the end over the work"),
    "predicted/other": ("amplitude", "1", "energy of all bands but the driven one at the end over the work"),
    "predicted/dissipated": ("amplitude", "1", "dissipated energy over the work"),
    "predicted/z": ("amplitude site", "1", "largest relative displacement that arrives at a site over its clearance"),
    "predicted/change": ("amplitude", "1", "change by the last iteration over the linear wave"),
}
MEASURED = ("bands", "upper", "other", "dissipated")
LAYOUT |= {f"simulated/{name}": LAYOUT[f"predicted/{name}"] for name in MEASURED}
LAYOUT["simulated/contact_episodes"] = ("amplitude", "1", "contact episodes; NaN where a run failed")
Job = tuple[str, float]  # what is run, and its amplitude in N or, of the one site, its z


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
    """Predict ``case`` on all ranks of ``comm``, and leave ``prediction.h5`` in ``folder``; its content on all ranks.

    Runs that are there are not made again; ``force`` begins anew, ``resume`` needs some to go on with. Raises
    FolderError if the folder holds anything but this prediction, RuntimeError if a run that it needs does not come
    out, StoppedError on a request to ``stop``.
    """
    with claimed(comm, folder, PREDICTION, case.to_toml(), force=force, resume=resume) as claim:
        path = claim.folder / "prediction.h5"
        if not on_root(comm, path.exists):
            study = PredictionRuns(case, claim.folder, comm, stop or StopRequest(), progress)
            linear = study.make([(LINEAR, 1.0)])[0]
            amplitudes = amplitudes_of(case, linear)
            largest = max(float(amplitudes[-1] * max(linear["reached"])), HIGH) * 1.01
            study.largest = largest
            answers = study.make([(SITE, z) for z in site_points(case, largest)])
            members = study.make([(MEMBER, a) for a in amplitudes.tolist()]) if case.predict.simulate else []

            about = provenance(comm)

            def write() -> None:
                write_netcdf(path, composed(case, linear, answers, members, largest).assign_attrs(about))

            study.recorded.finish()
            on_root(comm, write)
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
    high = np.geomspace(HIGH, largest / 1.01, case.predict.points - len(NEAR))
    return [1 + z for z in NEAR] + np.unique(high).tolist()


class PredictionRuns:
    """The runs of a prediction over the ranks of ``comm``, one rank a run, and their records in ``folder``.

    The one site's have ``largest`` as the largest z.
    """

    def __init__(self, case: PredictCase, folder: Path, comm: MPI.Comm, stop: StopRequest, progress: bool) -> None:
        self.case, self.recorded, self.progress = case, RecordedRuns("prediction", folder, comm, stop), progress
        self.setting, self.model, self.largest = case.one_site(), case.model(), 0.0

    def make(self, jobs: Sequence[Job]) -> list[Record]:
        """The records of ``jobs``, the missing ones made now. Collective; raises RuntimeError if one fails."""
        kinds = {LINEAR: self._linear, SITE: self._site, MEMBER: self._member}

        def work(job: Any) -> Record:
            return {"kind": job[0], "at": job[1]} | kinds[job[0]](job[1])

        self.recorded.make(jobs, work, what=f"{jobs[0][0]} runs", progress=self.progress)
        return [self.recorded.known[job] for job in jobs]

    def _run(self, changes: dict[str, dict[str, Any]]) -> tuple[xr.Dataset, dict[str, Any]]:
        """A run in memory of the case with ``changes`` to its sections, and its statistics."""
        varied = self.case.varied(name=self.case.name, without=("output",), **changes)
        data, result = run_in_memory(varied, self.recorded.team, self.recorded.stop)
        return data, result.statistics

    def _moved(self, run: xr.Dataset, places: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """w (time, place) and its rate at ``places`` of a run's cells."""
        cell = self.model.chain.cell
        fields = (run[name].values[:, places] for name in ("displacement", "velocity"))
        w, rate = (field[..., cell.resonator] - field[..., cell.host] for field in fields)
        return w, rate

    def _bands(self, run: xr.Dataset) -> list[float]:
        """Energy in J of the pass bands at the last sample; modes in gaps count to the band below."""
        modes = ModalParts.of(self.model.chain).modes
        u, v = (run[name].values[-1:] for name in ("displacement", "velocity"))
        energy = np.abs(modes.amplitudes(u, v)[0]) ** 2 / 2
        lows = [band.low for band in pass_bands(self.model.chain.cell)[1:]]
        places = np.searchsorted(lows, modes.frequency * (1 + 1e-9))
        return [float(e) for e in np.bincount(places, energy, len(lows) + 1)]

    def _linear(self, amplitude: float) -> Record:
        """The lattice without contacts: the largest w at the sites over the clearances, work, energies."""
        run, statistics = self._run({"drive": {"amplitude": amplitude}, "contacts": {"sites": [], "clearance": []}})
        w, rate = self._moved(run, self.model.chain.sites)
        largest = [largest_between(run["time"].values, *pair) for pair in zip(w.T, rate.T, strict=True)]
        reached = [w / gap for w, gap in zip(largest, self.model.chain.clearances, strict=True)]
        return {"reached": reached, "work": statistics["work"], "bands": self._bands(run)}

    def _one(self, amplitude: float, clearance: Sequence[float]) -> tuple[xr.Dataset, np.ndarray, np.ndarray]:
        """A run of one site, or none, in a lattice that is infinite while it lasts, with w there and its rate."""
        setting = self.setting
        place = [setting.site + 1]
        changes: dict[str, dict[str, Any]] = {
            "lattice": {"cells": setting.cells, "ends": "periodic"},
            "contacts": {"sites": place if clearance else [], "clearance": list(clearance)},
            "drive": {"cell": 1, "amplitude": amplitude},
            "time": {"end": setting.end},
            "output": {"window": place * 2},
        }
        run, _ = self._run(changes)
        w, rate = self._moved(run, [0])
        return run, w[:, 0], rate[:, 0]

    @cached_property
    def _burst(self) -> tuple[Burst, float]:
        """The linear wave at the one site under 1 N, and its largest |w| in m."""
        run, w, rate = self._one(1.0, ())
        times = run["time"].values
        cell, drive = self.model.chain.cell, self.model.drive.frequency
        return Burst(cell, drive, times, w), largest_between(times, w, rate)

    def _site(self, z: float) -> Record:
        """One site under a burst that reaches ``z`` clearances: sums over its time in contact."""
        (burst, peak), clearance = self._burst, self.setting.clearance
        amplitude = z * clearance / peak
        run, w, _ = self._one(amplitude, [clearance])
        ends = run["impacts/separation"].values
        end = float(np.nanmax(ends)) if len(ends) else np.nan
        sums = burst.sums(amplitude, clearance, self.largest, w, run["energy/dissipated"].values, end)
        return {"z": z, "amplitude": amplitude, "largest": self.largest} | sums

    def _member(self, amplitude: float) -> Record:
        """The case under ``amplitude``: what is compared."""
        stride = self.model.samples - 1
        run, told = self._run({"drive": {"amplitude": amplitude}, "output": {"stride": stride}})
        row = {name: told[name] for name in ("work", "dissipated", "episodes")}
        return row | {"bands": self._bands(run)}


def composed(
    case: PredictCase, linear: Record, answers: list[Record], members: list[Record], largest: float
) -> xr.Dataset:
    """The content of ``prediction.h5``, without its provenance."""
    begin, model = time.process_time(), case.model()
    amplitudes, cell = amplitudes_of(case, linear), model.chain.cell
    drive = next(i for i, band in enumerate(pass_bands(cell)) if model.drive.frequency <= band.high)
    network, onset = Network(model), 1 / max(linear["reached"])
    response = SiteResponse.of(answers, cell, model.drive.frequency, largest)
    rest, rows = np.array(linear["bands"]) / linear["work"], []
    for amplitude in amplitudes:
        made = network.compose(float(amplitude), response) if amplitude > onset else None
        work = linear["work"] * amplitude**2
        lost, z = (made.dissipated / work, made.z) if made else (0.0, amplitude * np.array(linear["reached"]))
        bands = rest + (made.into / work if made else 0)
        bands[drive] = 1 - lost - np.delete(bands, drive).sum()
        rows.append((bands, lost, z, made.change if made else 0.0))
    predicted = dict(zip(("bands", "dissipated", "z", "change"), map(np.array, zip(*rows, strict=True)), strict=True))
    values = {f"predicted/{name}": value for name, value in (predicted | _sums(predicted["bands"], drive)).items()}
    values |= {"amplitude": amplitudes, "band": np.arange(1, cell.dofs + 1)}
    values |= {"site": np.arange(1, len(model.chain.sites) + 1), "sites/cell": np.array(model.chain.sites) + 1}
    about: dict[str, Any] = {"case": case.to_toml(), "onset_amplitude": onset, "drive_band": drive + 1}
    about["cpu_seconds"] = sum(r["cpu_seconds"] for r in [linear, *answers]) + time.process_time() - begin
    if members:
        work = np.array([m["work"] for m in members])
        simulated = np.array([m["bands"] for m in members]) / work[:, None]
        lost = np.array([m["dissipated"] for m in members]) / work
        measured = {"bands": simulated, "dissipated": lost} | _sums(simulated, drive)
        values |= {f"simulated/{name}": value for name, value in measured.items()}
        values["simulated/contact_episodes"] = np.array([float(m["episodes"]) for m in members])
        about |= errors(values)
    return xr.Dataset(tabulated(LAYOUT, values), attrs=about)


def _sums(bands: np.ndarray, drive: int) -> dict[str, np.ndarray]:
    return {"upper": bands[:, drive + 1 :].sum(axis=1), "other": np.delete(bands, drive, axis=1).sum(axis=1)}


def errors(values: dict[str, np.ndarray]) -> dict[str, float]:
    """Of a prediction beside simulations with contacts: rms and worst in decades of upper and other bands, loss."""
    some = values["simulated/contact_episodes"] > 0
    told: dict[str, float] = {}
    for name in ("upper", "other"):
        pair = np.array([values[f"{kind}/{name}"] for kind in ("predicted", "simulated")])
        use = some & (pair > 0).all(axis=0)
        off = np.abs(np.diff(np.log10(pair[:, use]), axis=0))
        told |= {f"rms_{name}": float(np.sqrt(np.mean(off**2))), f"worst_{name}": float(off.max())} if use.any() else {}
    off = np.abs(values["predicted/dissipated"] - values["simulated/dissipated"])
    return told | {"worst_dissipated": float(off.max())}
