"""The results of a search: ``optimum.h5``, the best cases, and the comparison of these with the initial one."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from vipetsc.case import Case, case_id
from vipetsc.case.amplitude import amplitude_of, has_free_amplitude
from vipetsc.case.keys import unit_of
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.optimise import OptimiseCase
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import provenance
from vipetsc.io.netcdf import tabulated
from vipetsc.studies.designs import OptimumSearch
from vipetsc.studies.sampler import front
from vipetsc.wording import counted

LAYOUT = {
    "design": ("design", "1", "number of a design; 0 is the initial case"),
    "variable": ("variable", "1", "what varies"),
    "objective": ("objective", "1", "objective"),
    "unit": ("variable", "1", "unit of the variable"),
    "low": ("variable", "1", "lower bound"),
    "high": ("variable", "1", "upper bound"),
    "choices": ("variable", "1", "values that the variable may take, as JSON; empty for one between bounds"),
    "generation": ("design", "1", "generation; 0 contains the case and the initial design"),
    "parameter": (
        "design variable",
        "1",
        "value of a variable, in its unit; of one with choices the number of the value, from 1",
    ),
    "value": ("design objective", "1", "value of an objective; NaN for a design that failed"),
    "constraint": ("constraint", "1", "what is bounded"),
    "constrained": ("design constraint", "1", "value of what is bounded, in its unit; NaN for a design that failed"),
    "excess": ("design", "1", "by how much bounds are missed, over the bounds; 0 for a design that misses none"),
    "upper_share_at_end": (
        "design",
        "1",
        "energy of the bands above the driven one at the end over the work, mean over its runs",
    ),
    "dissipated": ("design", "1", "dissipated energy over the work, mean over its runs"),
    "reason": ("design", "1", "reason why a design failed"),
    "front": ("front", "1", "number of a design on the Pareto front"),
    "compared": ("compared", "1", "compared designs"),
    "comparison/number": ("compared", "1", "number of a compared design"),
    "site": ("site", "1", "contact site"),
    "comparison/cell": ("compared site", "1", "cell (1-based) of a site"),
    "comparison/clearance": ("compared site", "m", "clearance"),
    "band": ("band", "1", "pass band"),
    "amplitude": ("amplitude", "N", "amplitude of the drive, or of the motion at t = 0"),
    "curve/bands": ("compared amplitude band", "1", "energy of a pass band at the end over the work"),
    "curve/upper_share_at_end": (
        "compared amplitude",
        "1",
        "energy of the bands above the driven one at the end over the work",
    ),
    "curve/transmitted": ("compared amplitude", "1", "energy beyond the last site at the end over the work"),
    "curve/dissipated": ("compared amplitude", "1", "dissipated energy over the work"),
    "response/line": ("response/line", "1", "line of a frequency response of a compared design"),
    "response/name": ("response/line", "1", "name of its curve, as that of the file that nfrc writes"),
    "response/compared": ("response/line", "1", "name of the compared design"),
    "response/point": ("response/point", "1", "point of a line, one line after the other"),
    "response/of": ("response/point", "1", "line of a point, from 0"),
    "response/parameter": ("response/point", "1", "parameter that varies along the curves, in its unit"),
    "response/unstable": ("response/point", "1", "number of growing perturbations; -1: undecided"),
    "response/value": ("response/point objective", "1", "what the objective measures; NaN for an objective of runs"),
    "curve/value": ("compared amplitude objective", "1", "measure of the objective"),
}
"""Dimensions, unit and text of every variable, by its name."""
# Designs are compared at CURVE_POINTS amplitudes, log-spaced from the smallest one at which they are measured over
# CURVE_SPREAD to the largest times CURVE_SPREAD: for a single amplitude over 24 dB, in steps of 2.4 dB. Two designs are
# compared, four of a front: 22 or 44 runs, besides the hundred designs of the default budget.
CURVE_POINTS = 11
CURVE_SPREAD = 4.0
SAME = 1e-9  # relative difference up to which two amplitudes are one
# Shown for every design with any objective: a large transfer may come with a large loss.
SHOWN = ("upper_share_at_end", "dissipated")
# What a search did, by the attribute that counts it.
COUNTED = {"runs": "runs", "responses": "frequency responses"}


def curves_of(search: OptimumSearch) -> dict[str, list[Case]]:
    """Return the runs of the compared designs over the amplitude."""
    options = search.plan.options
    case_amplitude = search.plan.amplitude
    amplitudes = options.curve
    if not amplitudes and has_free_amplitude(search.plan.base):
        asked = [amplitude for table in options.measured for amplitude in table.amplitudes or [case_amplitude]]
        # By size: the sign of a drive's amplitude is a phase, and only that of the case may be negative.
        sizes = np.abs(asked)
        curve = np.geomspace(sizes.min() / CURVE_SPREAD, sizes.max() * CURVE_SPREAD, CURVE_POINTS)
        amplitudes = np.copysign(curve, max(asked)).tolist()
    # The case's own amplitude is always among them: the bars of energies are drawn there. It is in the middle of the
    # curve of one amplitude, but for rounding, and would be simulated twice.
    others = {amplitude for amplitude in amplitudes if not np.isclose(amplitude, case_amplitude, rtol=SAME, atol=0.0)}
    amplitudes = sorted(others | {case_amplitude})

    curves: dict[str, list[Case]] = {}
    if not options.measures_runs:
        return curves
    for name, number in search.compared().items():
        case = search.designs[number].case
        if case:
            curves[name] = [search.plan.run(case, amplitude) for amplitude in amplitudes]
    return curves


def optimum_of(search: OptimumSearch, folder: Path) -> xr.Dataset:
    """Return the content of ``optimum.h5`` of a search that has ended; writes its best cases to ``folder``."""
    plan = search.plan
    cases: dict[str, Case] = {}
    for name, number in search.compared().items():
        case = search.designs[number].case
        if case:
            cases[name] = case
    for name, case in cases.items():
        if name != "case":
            best = case.model_copy(update={"name": f"{plan.name}-{name}"})
            write_text(folder / f"{name}.toml", plan.text_of(best))

    values = _design_values(search) | _comparison_values(search, [*cases.values()])
    if plan.options.measures_runs:
        values |= _curve_values(search)
    if plan.options.measures_responses:
        values |= _response_values(search, cases)
    about = provenance(search.objective.recorded.comm) | {"case": plan.to_toml()} | _counts(search)
    data = xr.Dataset(tabulated(LAYOUT, values), attrs=about)
    if plan.options.measures_runs:
        data["amplitude"].attrs["units"] = plan.amplitude_unit
    return data.assign_attrs(summary=_summary(data, plan))


def _counts(search: OptimumSearch) -> dict[str, int]:
    """Return the numbers of runs and of cases whose frequency responses were followed, for all designs."""
    options = search.plan.options
    kinds = {case_id(run): isinstance(run, NfrcCase) for design in search.designs for run in design.runs}
    counts = {}
    if options.measures_runs:
        counts["runs"] = len(kinds) - sum(kinds.values())
    if options.measures_responses:
        counts["responses"] = sum(kinds.values())
    return counts


def _design_values(search: OptimumSearch) -> dict[str, Any]:
    """Return variables, and all designs with their results, by name in ``LAYOUT``."""
    designs = search.designs
    variables = search.plan.variables()
    objectives = search.plan.options.objective
    # Losses of objectives to be maximised are their negatives.
    signs = np.array([-1.0 if objective.goal == "maximise" else 1.0 for objective in objectives])
    values: dict[str, Any] = {
        "design": np.arange(len(designs)),
        "variable": [v.name for v in variables],
        "objective": [f"{number}: {objective.name}" for number, objective in enumerate(objectives, 1)],
        "low": [float(v.low) for v in variables],
        "high": [float(v.high) for v in variables],
        "unit": [unit_of(v.path, search.plan.table) or "1" for v in variables],
        "generation": [design.generation for design in designs],
        "parameter": [design.values for design in designs],
        "value": signs * search.losses(),
        "reason": [design.reason for design in designs],
        "front": front(search.feasible_losses()),
    }
    if any(variable.choices for variable in variables):
        values["choices"] = [json.dumps(v.choices) if v.choices else "" for v in variables]
    constraints = search.plan.options.constraint or []
    if constraints:
        values["constraint"] = [
            f"{number}: {table.describe(search.plan.amplitude_unit)}" for number, table in enumerate(constraints, 1)
        ]
        values["constrained"] = [design.constraints for design in designs]
        values["excess"] = [design.excess for design in designs]

    measured: list[list[dict[str, Any]]] = []
    for design in designs:
        # Frequency responses have no work, of which these would be fractions.
        runs = [run for run in design.runs if not isinstance(run, NfrcCase)]
        measured.append([search.objective.values(run) for run in runs])
    for name in SHOWN:
        values[name] = [_mean_of(name, rows) for rows in measured]
    return values


def _mean_of(name: str, rows: Sequence[Mapping[str, Any]]) -> Any:
    """Return the mean of what is called ``name`` over the runs of a design; NaN if one failed, or there are none."""
    if not rows:
        return np.nan
    return np.mean([row.get(name, np.nan) for row in rows])


def _comparison_values(search: OptimumSearch, cases: Sequence[Case]) -> dict[str, Any]:
    """Return sites and clearances of the compared designs, whose ``cases`` are given, by name in ``LAYOUT``."""
    compared = search.compared()
    chains = [case.model().chain for case in cases]
    return {
        "compared": [*compared],
        "comparison/number": [*compared.values()],
        "site": np.arange(1, len(search.plan.sites) + 1),
        "comparison/cell": [chain.sites.cells + 1 for chain in chains],
        "comparison/clearance": [chain.sites.clearances for chain in chains],
    }


def _curve_values(search: OptimumSearch) -> dict[str, Any]:
    """Return values of the compared designs over the amplitude, by name in ``LAYOUT``."""
    curves = curves_of(search)
    measured = [[search.objective.values(run) for run in runs] for runs in curves.values()]
    bands = len(search.plan.base.lattice.unit_cell().masses)
    names = [objective.name for objective in search.plan.options.objective]
    values: dict[str, Any] = {
        "amplitude": [amplitude_of(run) for run in curves["case"]],
        "band": np.arange(1, bands + 1),
        "curve/bands": [[row.get("bands", [np.nan] * bands) for row in rows] for rows in measured],
        "curve/value": [[[row.get(name, np.nan) for name in names] for row in rows] for rows in measured],
    }
    for name in (*SHOWN, "transmitted"):
        values[f"curve/{name}"] = [[row.get(name, np.nan) for row in rows] for rows in measured]
    return values


def _response_values(search: OptimumSearch, cases: Mapping[str, Case]) -> dict[str, Any]:
    """Return frequency responses of the compared designs, without scatter or of the first sample, by ``LAYOUT``."""
    objectives = search.plan.options.objective
    values: dict[str, Any] = {name: [] for name in LAYOUT if name.startswith("response/")}
    for compared, case in cases.items():
        for line in search.objective.curves(search.plan.responses(case, 0)):
            count = len(line["parameter"])
            values["response/of"] += [len(values["response/name"])] * count
            values["response/name"].append(line["name"])
            values["response/compared"].append(compared)
            values["response/parameter"] += line["parameter"]
            values["response/unstable"] += line["unstable"]
            of_objectives = [line["values"].get(objective.name, [np.nan] * count) for objective in objectives]
            values["response/value"] += np.transpose(of_objectives).tolist()

    values["response/line"] = np.arange(len(values["response/name"]))
    values["response/point"] = np.arange(len(values["response/of"]))
    # Every design may have failed: then there are no points, in the shape of some.
    values["response/value"] = np.reshape(values["response/value"], (-1, len(objectives)))
    return values


def _summary(data: xr.Dataset, plan: OptimiseCase) -> str:
    """Return a table of the results, with a line for every compared design."""
    unit = plan.amplitude_unit
    reasons = [reason for reason in data["reason"].values if reason]
    counts = [f"{data.attrs[name]} {text}" for name, text in COUNTED.items() if name in data.attrs]
    lines = [
        f"{counted(data.sizes['design'], 'design')}, {', '.join(counts)}; {counted(len(reasons), 'design')} failed"
    ]
    if reasons:
        lines.append(f"  such as: {reasons[0]}")
    lines += [f"  {number}: {objective.describe(unit)}" for number, objective in enumerate(plan.options.objective, 1)]
    if "excess" in data:
        met = int(((data["excess"] == 0) & (data["reason"] == "")).sum())
        lines += [f"  {met} designs meet the constraints:", *(f"    {text}" for text in data["constraint"].values)]

    shown = SHOWN if plan.options.measures_runs else ()
    columns = [*data["objective"].values, *(name.partition("_")[0] for name in shown)]
    # The name of an objective may be longer than its numbers; two blanks divide it from the column before.
    widths = [max(len(name) + 2, 24) for name in columns]
    titles = [f"{name:>{width}}" for name, width in zip(columns, widths, strict=True)]
    lines.append(f"  {'design':<8}{'number':>7}" + "".join(titles))
    for compared, number in zip(data["compared"].values, data["comparison/number"].values, strict=True):
        row = [*data["value"].values[number], *(data[name].values[number] for name in shown)]
        values = [f"{value:>{width}.6g}" for value, width in zip(row, widths, strict=True)]
        lines.append(f"  {compared:<8}{number:>7}" + "".join(values))
    return "\n".join(lines)
