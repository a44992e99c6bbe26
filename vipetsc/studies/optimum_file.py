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
from vipetsc.studies.optimum_layout import LAYOUT
from vipetsc.studies.sampler import front

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
    """The runs of the compared designs over the amplitude."""
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
    """The content of ``optimum.h5`` of a search that has ended; writes its best cases to ``folder``."""
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
    """The numbers of runs and of cases whose frequency responses were followed, for all designs."""
    options = search.plan.options
    kinds = {case_id(run): isinstance(run, NfrcCase) for design in search.designs for run in design.runs}
    counts = {}
    if options.measures_runs:
        counts["runs"] = len(kinds) - sum(kinds.values())
    if options.measures_responses:
        counts["responses"] = sum(kinds.values())
    return counts


def _design_values(search: OptimumSearch) -> dict[str, Any]:
    """Variables, and all designs with their results, by name in ``LAYOUT``."""
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
    """Mean of what is called ``name`` over the runs of a design; NaN if one failed, or there are none."""
    if not rows:
        return np.nan
    return np.mean([row.get(name, np.nan) for row in rows])


def _comparison_values(search: OptimumSearch, cases: Sequence[Case]) -> dict[str, Any]:
    """Sites and clearances of the compared designs, whose ``cases`` are given, by name in ``LAYOUT``."""
    compared = search.compared()
    chains = [case.model().chain for case in cases]
    return {
        "compared": [*compared],
        "comparison/number": [*compared.values()],
        "site": np.arange(1, len(search.plan.sites) + 1),
        "comparison/cell": [np.add(chain.sites, 1) for chain in chains],
        "comparison/clearance": [chain.clearances for chain in chains],
    }


def _curve_values(search: OptimumSearch) -> dict[str, Any]:
    """Values of the compared designs over the amplitude, by name in ``LAYOUT``."""
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
    """Frequency responses of the compared designs, without scatter or with the first sample, by name in ``LAYOUT``."""
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
    """A table of the results, with a line for every compared design."""
    unit = plan.amplitude_unit
    reasons = [reason for reason in data["reason"].values if reason]
    counts = [f"{data.attrs[name]} {text}" for name, text in COUNTED.items() if name in data.attrs]
    lines = [f"{data.sizes['design']} designs, {', '.join(counts)}; {len(reasons)} designs failed"]
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
