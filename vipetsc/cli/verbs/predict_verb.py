"""The verb ``predict``: several sites composed from the response of one, compared with simulations."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from vipetsc.case.amplitude import amplitude_unit
from vipetsc.case.predict import PredictCase
from vipetsc.cli.arguments import CASE, STUDY_ARGUMENTS
from vipetsc.cli.case_rows import lattice_rows
from vipetsc.cli.drawing import Pictures
from vipetsc.cli.verb import Rows, StudyVerb, study_of
from vipetsc.io.kinds import PREDICTION

if TYPE_CHECKING:
    import xarray as xr

SUMMARY = {
    "rms_upper": "rms error of the upper bands (decades)",
    "rms_other": "rms error of all bands except the driven one (decades)",
    "worst_dissipated": "largest error of the dissipated fraction",
    "worst_dashpots": "largest error of the fraction that dashpots take",
    "cpu_seconds": "CPU time without the simulations (s)",
}


def predict_rows(case: PredictCase, ranks: int) -> Rows:
    """Return the rows of ``validate``: lattice, amplitudes, runs that predictions are composed of, comparison."""
    options = case.predict
    if options.amplitudes:
        low = min(options.amplitudes)
        high = max(options.amplitudes)
        amplitudes = f"{len(options.amplitudes)} amplitudes, {low:g} to {high:g} {amplitude_unit(case)}"
    else:
        amplitudes = f"{options.count} amplitudes, from the first contact to {options.span:g} times its amplitude"

    site = case.one_site()
    where = f"a clearance of {site.clearance:.5g} m {site.distance} cells from the drive"
    ring = f"ring of {site.cells} cells, {site.samples} samples"
    comparison = "no simulation"
    if options.simulate:
        comparison = "a simulation at every amplitude"

    return [
        *lattice_rows(case),
        ("predict", amplitudes),
        ("composed of", f"{options.points} runs of one site with {where}; {ring}"),
        ("compared with", comparison),
    ]


def prediction_table(data: xr.Dataset) -> str:
    """Return predicted and simulated fractions of the energy at every amplitude, and their differences."""
    # Simulated columns need ``predict.simulate``, and the columns of dashpots need a lattice that has some.
    kinds = [kind for kind in ("predicted", "simulated") if f"{kind}/other" in data]
    quantities = [name for name in ("upper", "other", "dissipated", "dashpots") if f"predicted/{name}" in data]
    columns = [(kind, quantity) for quantity in quantities for kind in kinds]

    unit = data["amplitude"].attrs["units"]
    lines = [f"   amplitude ({unit})  " + "  ".join(f"{kind} {quantity}" for kind, quantity in columns)]
    for row, amplitude in enumerate(data["amplitude"].values):
        values = []
        for kind, quantity in columns:
            width = len(f"{kind} {quantity}")
            values.append(f"{float(data[f'{kind}/{quantity}'][row]):{width}.4f}")
        lines.append(f"{amplitude:16.5g}  " + "  ".join(values))

    lines.append(f"first contact ({unit}): {data.attrs['onset_amplitude']:.4g}")
    lines += [f"{text}: {data.attrs[key]:.4g}" for key, text in SUMMARY.items() if key in data.attrs]
    lines += [f"warning: {text}" for text in json.loads(data.attrs.get("warnings", "[]"))]
    return "\n".join(lines)


VERB = StudyVerb(
    name="predict",
    text="predict several sites from the response of one, and compare with simulations",
    example="predict runs/examples/predict.toml",
    arguments=(CASE, *STUDY_ARGUMENTS),
    case=PredictCase,
    study=study_of("vipetsc.studies.prediction:predict", prediction_table),
    table=predict_rows,
    results=PREDICTION,
    pictures=Pictures(PREDICTION),
)
