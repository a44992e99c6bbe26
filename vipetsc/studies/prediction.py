"""Prediction of a run with any number of sites from the response of one: the result is ``prediction.h5``.

Runs: the linear lattice under 1 N (onset, work, energies by band); one site in an infinite lattice (``studies.ring``)
at ``predict.points`` amplitudes, dense near the onset (``studies.response``); then, to compare, the case itself at
every amplitude (``studies.prediction_runs``). ``studies.composition`` composes the sites. The onset is the amplitude
whose linear wave just touches a site: 1 N over the largest of w/D under 1 N, with the clearance D of a site. Energies
of bands are those of linear modes at the last sample, over the drive's work.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Unpack

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case.amplitude import amplitude_unit
from vipetsc.case.predict import PredictCase
from vipetsc.io.folder import provenance
from vipetsc.io.kinds import PREDICTION
from vipetsc.io.netcdf import open_netcdf, tabulated
from vipetsc.io.records import Record
from vipetsc.lattice import Chain, pass_bands
from vipetsc.studies.composition import CLOSE, Network
from vipetsc.studies.prediction_runs import PredictionRuns, Records, amplitudes_of, onset_of
from vipetsc.studies.response import SiteResponse, SiteResponses
from vipetsc.studies.study import How, Study, StudyWork

# Defect of the energies over the work above which a prediction warns. That of sites some cells apart is 0.02 at most,
# while 20 neighbouring sites have 0.4.
LARGEST_DEFECT = 0.1
LAYOUT = {
    "amplitude": ("amplitude", "N", "amplitude of the drive; in m of a moved wall"),
    "band": ("band", "1", "pass band, from 1"),
    "site": ("site", "1", "contact site"),
    "sites/cell": ("site", "1", "cell (1-based) of a site"),
    "sites/kind": ("site", "1", "kind of a site, from 1: sites of one kind have the response of one run alone"),
    "predicted/bands": ("amplitude band", "1", "energy of a pass band at the end over the work"),
    "predicted/upper": ("amplitude", "1", "energy of the bands above the driven one at the end over the work"),
    "predicted/other": ("amplitude", "1", "energy of all bands except the driven one at the end over the work"),
    "predicted/dissipated": ("amplitude", "1", "energy dissipated in contacts over the work"),
    "predicted/dashpots": ("amplitude", "1", "energy that all dashpots take over the work"),
    "predicted/absorbed": ("amplitude", "1", "energy that the dashpots of absorbing ends take over the work"),
    "predicted/z": (
        "amplitude site",
        "1",
        "largest relative displacement of the wave that arrives at a site, over its clearance",
    ),
    "predicted/change": ("amplitude", "1", "change by the last iteration over the linear wave"),
    "predicted/solved": ("amplitude", "1", "1 if the equations of the last iteration were solved to their tolerance"),
    "predicted/defect": (
        "amplitude",
        "1",
        "energy that sites take from the drive's wave, less what they dissipate and send into bands, over the work",
    ),
}
MEASURED = ("bands", "upper", "other", "dissipated", "dashpots", "absorbed")
LAYOUT |= {f"simulated/{name}": LAYOUT[f"predicted/{name}"] for name in MEASURED}
LAYOUT["simulated/contact_episodes"] = ("amplitude", "1", "contact episodes")


def predict(case: PredictCase, folder: str | Path, comm: MPI.Comm = MPI.COMM_WORLD, **how: Unpack[How]) -> xr.Dataset:
    """Predict ``case`` on all ranks of ``comm``, and write ``prediction.h5`` to ``folder``; returns its content.

    ``how`` it is computed, and what it raises, is in ``Study.run``.
    """
    PredictCase.expect(case, "predict")
    return STUDY.run(case, folder, comm, **how)


def _make(case: PredictCase, work: StudyWork) -> Callable[[], xr.Dataset]:
    """Simulate all runs; returns the function that composes the prediction."""
    runs = PredictionRuns(case, work.folder, work.comm, work.stop, work.progress)
    records = runs.make_all()
    about = provenance(work.comm)
    runs.recorded.finish()
    return lambda: composed(case, records).assign_attrs(about)


def read_prediction(folder: str | Path) -> xr.Dataset:
    """Return the content of ``prediction.h5`` in ``folder``; raises OSError or ValueError if it is none."""
    with open_netcdf(Path(folder) / "prediction.h5", "prediction", ("predicted", "onset_amplitude")) as data:
        return data.load()


STUDY = Study(PREDICTION, "prediction.h5", make=_make, read=read_prediction)


def composed(case: PredictCase, records: Records) -> xr.Dataset:
    """Return the content of ``prediction.h5``, without its provenance."""
    begin = time.process_time()
    model = case.model()
    cell = model.chain.cell
    linear = records.linear
    amplitudes = amplitudes_of(case, linear)
    driven = next(i for i, band in enumerate(pass_bands(cell)) if model.drive.frequency <= band.high)
    onset = onset_of(linear)

    kinds = case.kinds
    responses = [
        SiteResponse.of(rows, cell, drive=model.drive.frequency, largest=records.largest, pair=kind.pair)
        for rows, kind in zip(records.sites, kinds.kinds, strict=True)
    ]
    every_site = SiteResponses(of_kind=tuple(responses), kind=np.array(kinds.of))
    predicted = _predicted(Network(model), every_site, amplitudes, linear, driven)
    values = {f"predicted/{name}": value for name, value in predicted.items()}
    values |= {
        "amplitude": amplitudes,
        "band": np.arange(1, cell.dofs + 1),
        "site": np.arange(1, len(model.chain.sites) + 1),
        "sites/cell": model.chain.sites.cells + 1,
        "sites/kind": np.array(kinds.of) + 1,
    }
    about: dict[str, Any] = {"case": case.to_toml(), "onset_amplitude": onset, "drive_band": driven + 1}
    of_sites = [record for rows in records.sites for record in rows]
    in_runs = sum(record["cpu_seconds"] for record in [linear, *of_sites])
    about["cpu_seconds"] = in_runs + time.process_time() - begin

    if records.members:
        simulated = _simulated(records.members, driven, model.chain)
        values |= {f"simulated/{name}": value for name, value in simulated.items()}
        about |= errors(values)
    about["warnings"] = prediction_warnings(values)
    data = xr.Dataset(tabulated(LAYOUT, values), attrs=about)
    data["amplitude"].attrs["units"] = amplitude_unit(case)
    return data


def prediction_warnings(values: dict[str, np.ndarray]) -> list[str]:
    """Return sentences on predictions that have not converged; ``values`` (amplitude,) by name in ``LAYOUT``."""
    warnings = []
    change = values["predicted/change"]
    moving = change > CLOSE
    if moving.any():
        warnings.append(
            f"at {int(moving.sum())} of {len(change)} amplitudes the iteration still changes the waves, by"
            f" {float(change.max()):.2g} of the linear one at most: sites that are close together feel each other too"
            " strongly for it"
        )
    unsolved = int(np.sum(values["predicted/solved"] == 0))
    if unsolved:
        warnings.append(f"at {unsolved} of {len(change)} amplitudes the linear equations of its last step are unsolved")
    defect = np.abs(values["predicted/defect"])
    open_budget = int(np.sum(defect > LARGEST_DEFECT))
    if open_budget:
        warnings.append(
            f"at {open_budget} of {len(change)} amplitudes the energy that the sites take from the drive's wave is not"
            f" that which their runs alone give, by {float(defect.max()):.2g} of the work at most: the sites are too"
            " close together to be composed"
        )
    return warnings


def _predicted(
    network: Network, sites: SiteResponses, amplitudes: np.ndarray, linear: Record, driven: int
) -> dict[str, np.ndarray]:
    """Return predicted values at every amplitude, named as in ``LAYOUT``; ``driven`` is the drive's band from 0."""
    onset = onset_of(linear)
    untouched = np.array(linear["bands"]) / linear["work"]
    losses = network.losses
    absorbed_before = 0.0
    rows: dict[str, list[Any]] = {"bands": [], "dissipated": [], "z": [], "change": [], "solved": [], "defect": []}
    if losses:
        absorbed_before = losses.absorbed_without_contacts() / linear["work"]
        rows["dashpots"] = []
    if losses and losses.has_ends:
        rows["absorbed"] = []

    for amplitude in amplitudes:
        work = linear["work"] * amplitude**2
        bands = untouched.copy()
        dissipated = 0.0
        absorbed = absorbed_before
        z = amplitude * np.array(linear["reached"])
        change = 0.0
        solved = True
        defect = 0.0
        if amplitude > onset:
            composition = network.compose(float(amplitude), sites)
            bands += composition.into / work
            dissipated = composition.dissipated / work
            absorbed += composition.absorbed / work
            z = composition.z
            change = composition.change
            solved = composition.solved
            defect = composition.defect / work

        # Energies add up to the work: one of them is what the others leave.
        if losses:
            bands = np.maximum(bands, 0.0)
            rows["dashpots"].append(1 - dissipated - bands.sum())
        else:
            bands[driven] = 1 - dissipated - np.delete(bands, driven).sum()
        if losses and losses.has_ends:
            rows["absorbed"].append(absorbed)

        rows["bands"].append(bands)
        rows["dissipated"].append(dissipated)
        rows["z"].append(z)
        rows["change"].append(change)
        rows["solved"].append(int(solved))
        rows["defect"].append(defect)
    predicted = {name: np.array(column) for name, column in rows.items()}
    return predicted | _sums(predicted["bands"], driven)


def _simulated(members: Sequence[Record], driven: int, chain: Chain) -> dict[str, np.ndarray]:
    """Return simulated values at every amplitude of a ``chain``, by their names in ``LAYOUT``."""
    work = np.array([member["work"] for member in members])
    bands = np.array([member["bands"] for member in members]) / work[:, None]
    measured = {
        "bands": bands,
        "dissipated": np.array([member["dissipated"] for member in members]) / work,
        "contact_episodes": np.array([float(member["episodes"]) for member in members]),
    }
    if chain.is_damped:
        measured["dashpots"] = np.array([member["dashpots"] for member in members]) / work
        # A run says what all dashpots take together.
        if not chain.cell.is_damped:
            measured["absorbed"] = measured["dashpots"]
    return measured | _sums(bands, driven)


def _sums(bands: np.ndarray, driven: int) -> dict[str, np.ndarray]:
    """Return the energy (amplitude) of the bands above the ``driven`` one, and of all others but it."""
    return {"upper": bands[:, driven + 1 :].sum(axis=1), "other": np.delete(bands, driven, axis=1).sum(axis=1)}


def errors(values: dict[str, np.ndarray]) -> dict[str, float]:
    """Return errors of a prediction by its simulations, with ``values`` (amplitude,) by name in ``LAYOUT``.

    ``rms_`` and ``worst_`` of ``upper`` and ``other`` are in decades of the energies of these bands, over the
    amplitudes with contacts. ``worst_dissipated`` and ``worst_dashpots`` are differences of fractions of the work, over
    all amplitudes.
    """
    touched = values["simulated/contact_episodes"] > 0
    summary: dict[str, float] = {}
    for name in ("upper", "other"):
        pair = np.array([values[f"{kind}/{name}"] for kind in ("predicted", "simulated")])
        # Decades need positive energies; without contacts the predicted energies are those of the linear run.
        comparable = touched & (pair > 0).all(axis=0)
        if comparable.any():
            decades = np.abs(np.diff(np.log10(pair[:, comparable]), axis=0))
            summary[f"rms_{name}"] = float(np.sqrt(np.mean(decades**2)))
            summary[f"worst_{name}"] = float(decades.max())
    for name in ("dissipated", "dashpots"):
        if f"simulated/{name}" in values:
            difference = np.abs(values[f"predicted/{name}"] - values[f"simulated/{name}"])
            summary[f"worst_{name}"] = float(difference.max())
    return summary
