"""Verbs of studies that leave one file: what ``validate`` says of their cases, and what they print.

``law``, ``predict``, ``optimise``, ``identify`` and ``design`` are rows: their functions are those that users call.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from vipetsc.case import DesignCase, LawCase
from vipetsc.case.amplitude import amplitude_unit
from vipetsc.case.identify import IdentifyCase
from vipetsc.case.optimise import OptimiseCase
from vipetsc.case.predict import PredictCase
from vipetsc.cli.arguments import CASE, STUDY_ARGUMENTS, case_with
from vipetsc.cli.case_rows import lattice_rows
from vipetsc.cli.drawing import Pictures
from vipetsc.cli.messages import first_few, table
from vipetsc.cli.verb import Rows, StudyVerb, study_of, summary
from vipetsc.io.kinds import IDENTIFIED, LAW, OPTIMUM, PREDICTION, SEARCH
from vipetsc.wording import counted

if TYPE_CHECKING:
    import xarray as xr


def law_rows(case: LawCase, ranks: int) -> Rows:
    """Return a row of ``validate`` with the range of the law, and the site, the ring and the samples of its runs."""
    site = case.one_site()
    where = f"a clearance of {site.clearance:.5g} m {site.distance} cells from the drive"
    return [("law", f"z to {case.law.largest:g}, {where}; ring of {site.cells} cells, {site.samples} samples")]


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
        amplitudes = f"{counted(len(options.amplitudes), 'amplitude')}, {low:g} to {high:g} {amplitude_unit(case)}"
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


def optimise_rows(plan: OptimiseCase, ranks: int) -> Rows:
    """Return rows of ``validate``: number of designs, variables, frequency responses that are measured, objectives."""
    responses: Rows = []
    if plan.options.measures_responses:
        case = plan.responses(plan.base)
        low, high = case.nfrc.range
        curves = counted(len(case.every_curve()), "curve")
        responses = [("responses", f"{curves} of each design over the {case.nfrc.over}, {low:g} to {high:g}")]
    variables = first_few([variable.name for variable in plan.variables()])
    return [
        ("optimise", f"{plan.options.budget} designs of {variables}"),
        *responses,
        *(("objective", objective.describe(plan.amplitude_unit)) for objective in plan.options.objective),
        *(("constraint", constraint.describe(plan.amplitude_unit)) for constraint in plan.options.constraint or []),
    ]


def identify_rows(plan: IdentifyCase, ranks: int) -> Rows:
    """Return rows of ``validate``: the parameters and the number of starts, and each record with its sensors."""
    parameters = first_few([parameter.name for parameter in plan.parameters])
    rows = [("identify", f"{parameters}; starts: {plan.options.starts}")]
    for record in plan.options.records:
        sensors = first_few([sensor.name for sensor in record.sensors])
        begin = ""
        if record.initial == "estimate":
            begin = "; its initial state is estimated"
        rows.append(("record", f"{record.file}: {sensors}{begin}"))
    return rows


def design_rows(case: DesignCase, ranks: int) -> Rows:
    """Return a row of ``validate`` with the size of the grid, and the readings in which it is searched."""
    search = case.design
    cells = f"{len(search.lam.values())} lambda x {len(search.eta.values())} eta"
    return [("design", f"{cells}, {search.wavenumbers} wavenumbers, {' and '.join(search.readings)}")]


LAWS = StudyVerb(
    name="law",
    text="compute the scattering law of one site with adaptive refinement",
    example="law runs/examples/law.toml --set law.tolerance=0.02",
    arguments=(CASE, *STUDY_ARGUMENTS),
    case=LawCase,
    study=study_of("vipetsc.studies.one_site:make_law", lambda law: table(law.summary())),
    table=law_rows,
    results=LAW,
    pictures=Pictures(LAW),
)
PREDICT = StudyVerb(
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
OPTIMISE = StudyVerb(
    name="optimise",
    text="search for the best design for an objective",
    example="optimise runs/examples/optimise-clearances.toml --set optimise.budget=40",
    arguments=(case_with("optimise"), *STUDY_ARGUMENTS),
    case=OptimiseCase,
    study=study_of("vipetsc.studies.optimum_search:run_search", summary),
    table=optimise_rows,
    results=OPTIMUM,
    pictures=Pictures(OPTIMUM),
)
IDENTIFY = StudyVerb(
    name="identify",
    text="find parameters from measured records",
    example="identify runs/examples/identify.toml",
    arguments=(case_with("identify"), *STUDY_ARGUMENTS),
    case=IdentifyCase,
    study=study_of("vipetsc.studies.identification:run_identification", summary),
    table=identify_rows,
    results=IDENTIFIED,
    pictures=Pictures(IDENTIFIED),
)
DESIGN = StudyVerb(
    name="design",
    text="repeat the paper's (lambda, eta) search for the four-band cell",
    example="design runs/examples/design.toml --set design.lambda.count=10",
    arguments=(CASE, *STUDY_ARGUMENTS),
    case=DesignCase,
    study=study_of("vipetsc.paper.cell_search:search_design", summary),
    table=design_rows,
    results=SEARCH,
    pictures=Pictures(SEARCH),
    is_stoppable=False,  # it takes seconds, and has nothing to save before its end
)
