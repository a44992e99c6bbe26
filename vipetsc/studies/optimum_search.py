"""The best design for an objective, or the Pareto front of two: the result is ``optimum.h5``.

Rank 0 asks the sampler for designs and reports their losses in that order; all ranks simulate the runs. The result of
a run is recorded at once, so a search that was stopped or killed repeats the same exchange and goes on.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case import Case, CaseError, LawCase, case_id
from vipetsc.case.amplitude import amplitude_of, has_free_amplitude
from vipetsc.case.keys import unit_of
from vipetsc.case.optimise import OptimiseCase
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import OPTIMUM, claimed, provenance
from vipetsc.io.netcdf import open_netcdf, tabulated, write_netcdf
from vipetsc.lattice.chain import cells_between
from vipetsc.parallel import StopRequest, on_root
from vipetsc.progress import Progress
from vipetsc.studies.linear_run import LinearRun, linear_case
from vipetsc.studies.objective import ObjectiveRuns
from vipetsc.studies.one_site import make_law
from vipetsc.studies.optimum_layout import LAYOUT
from vipetsc.studies.recorded_runs import run_in_memory
from vipetsc.studies.sampler import CmaEs, Nsga2, Sampler, front, knee, smooth
from vipetsc.studies.scattering_law import matched_clearances
from vipetsc.studies.sweep import is_whole

POPULATION = 24  # of NSGA-II
# Designs are compared at so many amplitudes, from the least over this to the largest times this.
CURVE_POINTS = 11
CURVE_SPREAD = 4.0
# Shown for every design with any objective: a large transfer may come with a large loss.
SHOWN = ("upper_share_at_end", "dissipated")


@dataclass
class Design:
    """A design that was tried: its ``values`` (variable) and its results.

    ``case`` and ``runs`` are None and empty for an impossible one; ``losses`` (objective) are small for a good one, NaN
    if it failed for a ``reason``. ``constraints`` are the values of what is bounded, ``excess`` is by how much they are
    out of bounds.
    """

    values: np.ndarray
    generation: int
    case: Case | None = None
    runs: Sequence[Case] = ()
    reason: str = ""
    losses: list[float] = field(default_factory=list)
    constraints: list[float] = field(default_factory=list)
    excess: float = 0.0


class OptimumSearch:
    """The ``designs`` tried so far, on one rank; 0 is the case to begin with, 1 the start if that differs.

    ``asked`` are those that are not judged yet, by ``objective``, the runs of all designs.
    """

    def __init__(self, plan: OptimiseCase, objective: ObjectiveRuns, sampler: Sampler, start: np.ndarray) -> None:
        self.plan = plan
        self.objective = objective
        self.sampler = sampler
        self.designs = [Design(plan.begin(), 0, plan.base, [*objective.runs(plan.base).values()])]
        first = self._design(start, 0)
        if first.case is None or case_id(first.case) != case_id(plan.base):
            self.designs.append(first)
        self.asked = self.designs

    def _design(self, values: np.ndarray, generation: int) -> Design:
        try:
            case = self.plan.design(values)
            return Design(values, generation, case, [*self.objective.runs(case).values()])
        except CaseError as error:
            return Design(values, generation, reason="; ".join(map(str, error.problems)))

    def runs(self) -> list[Case]:
        """The runs of the designs that are not judged yet."""
        return [run for design in self.asked for run in design.runs]

    def tell_and_ask(self) -> bool:
        """Judge the designs whose runs are recorded, report to the sampler, and ask for more; whether there are any."""
        for design in self.asked:
            options = self.plan.options
            design.losses = [np.nan] * len(options.objective)
            design.constraints = [np.nan] * len(options.constraint or [])
            if design.case:
                judgement = self.objective.judge(design.case)
                design.losses = judgement.losses
                design.constraints = judgement.constraints
                design.excess = judgement.excess
                design.reason = judgement.reason

        left = self.plan.options.budget - len(self.designs)
        if left <= 0:
            return False

        generation = self.asked[0].generation
        if generation:  # generation 0 is the case and the start, which the sampler did not ask for
            self._tell()
        points = self.sampler.ask()[:left]
        self.asked = [self._design(self.plan.space.from_unit(point), generation + 1) for point in points]
        self.designs += self.asked
        return True

    def _tell(self) -> None:
        """Give the sampler the losses of the designs that it asked for.

        One that misses a constraint is worse than all that miss none, the more so the more it misses (Deb 2000, Comput.
        Methods Appl. Mech. Eng. 186, 311); one that failed is worse than all others.
        """
        judged = self.feasible_losses()
        worst = np.max(judged, axis=0, initial=0.0, where=np.isfinite(judged)) + 1
        most = max(design.excess for design in self.designs)
        losses = []
        for design in self.asked:
            row = np.array(design.losses)
            if design.excess > 0:
                row = worst + design.excess
            losses.append(np.where(np.isfinite(row), row, worst + most))
        self.sampler.tell(np.array(losses))

    def losses(self) -> np.ndarray:
        """Losses of all designs (design, objective)."""
        return np.array([design.losses for design in self.designs])

    def feasible_losses(self) -> np.ndarray:
        """Losses of all designs (design, objective), NaN for those that miss a constraint."""
        is_feasible = np.array([design.excess == 0 for design in self.designs])
        return np.where(is_feasible[:, None], self.losses(), np.nan)

    def compared(self) -> dict[str, int]:
        """The numbers of the designs to be compared by name: the case, and the best or the front's ends and knee."""
        losses = self.feasible_losses()
        best = front(losses)
        if not best.size:
            return {"case": 0}
        if losses.shape[1] == 1:
            return {"case": 0, "best": int(best[0])}
        middle = int(best[knee(losses[best])])
        return {"case": 0, "best-1": int(best[0]), "best": middle, "best-2": int(best[-1])}


def run_search(
    plan: OptimiseCase,
    folder: str | Path,
    comm: MPI.Comm = MPI.COMM_WORLD,
    *,
    force: bool = False,
    resume: bool = False,
    stop: StopRequest | None = None,
    progress: bool = False,
) -> str:
    """Search for the best design of ``plan`` in ``folder``; returns a table of the results.

    Writes ``optimum.h5`` and ``best.toml``, for two objectives the front's knee, with ``best-1.toml`` and
    ``best-2.toml`` for its ends. The same files, to the bit, on any number of ranks and after any stop. All ranks of
    ``comm`` must call it. Raises StoppedError, FolderError if the folder holds anything but this search.
    """
    with claimed(comm, folder, OPTIMUM, plan.to_toml(), force=force, resume=resume) as claim:
        path = claim.folder / "optimum.h5"
        # A file that was cut off is written again, from the records of its runs.
        if not on_root(comm, lambda: is_whole(path, [])):
            _search(plan, claim.folder, comm, stop or StopRequest(), progress)
        claim.publish()

        def summary() -> str:
            with open_netcdf(claim.path / "optimum.h5", "search for an optimum", ("value", "summary")) as data:
                return str(data.attrs["summary"])

        return on_root(comm, summary)


def _search(plan: OptimiseCase, folder: Path, comm: MPI.Comm, stop: StopRequest, progress: bool) -> None:
    """Try designs until the budget is spent, compare the best one with the case, and write the results."""
    objective = ObjectiveRuns(plan, folder, comm, stop)
    bar = Progress(comm, plan.options.budget, "designs", show=progress)
    searches: list[OptimumSearch] = []  # one on rank 0, none on the others

    try:
        start = _start(plan, folder, comm, stop)
        on_root(comm, lambda: searches.append(OptimumSearch(plan, objective, _sampler(plan, start), start)))
        more = True
        while more:
            objective.make(on_root(comm, lambda: searches[0].runs()))
            more = on_root(comm, lambda: searches[0].tell_and_ask())
            bar.update(sum(len(search.designs) for search in searches))

        objective.make(on_root(comm, lambda: [run for row in _curves(searches[0]).values() for run in row]))
        objective.recorded.finish()
        on_root(comm, lambda: _write(searches[0], folder))
    finally:
        bar.close()


def _start(plan: OptimiseCase, folder: Path, comm: MPI.Comm, stop: StopRequest) -> np.ndarray:
    """The values (variable) at which the search begins; all ranks must call it. Raises StoppedError."""
    if plan.options.start == "case":
        return plan.begin()

    table = {key: value for key, value in plan.table.items() if key != "disorder"}
    law = make_law(LawCase.from_table(table | {"name": "law"}), folder / "law", comm, stop=stop)
    lattice = plan.base.lattice
    drive = plan.base.drive

    def matched() -> np.ndarray:
        data, result = run_in_memory(linear_case(plan.base), MPI.COMM_SELF, stop)
        linear = LinearRun.of(data, result.statistics, sites=(), names=())
        # The law's sites are in the order in which the wave meets them, the plan's are not.
        sites = np.array(plan.sites)
        order = np.argsort(cells_between(sites, drive.cell, lattice.cells, lattice.ends), kind="stable")
        clearance = np.empty(len(sites))
        clearance[order] = matched_clearances(law, linear, sites[order].tolist(), drive.amplitude)
        return plan.begin(clearance.tolist())

    return on_root(comm, matched)


def _sampler(plan: OptimiseCase, start: np.ndarray) -> Sampler:
    """The sampler of ``plan`` from the values ``start`` (variable) on."""
    options = plan.options
    point = plan.space.to_unit(start)
    if len(options.objective) == 2:
        return Nsga2(point, options.step, options.seed, options.population or POPULATION)

    variables = plan.variables()
    # Whole numbers need a least deviation, or the search would stay at one of them.
    steps = np.array([variable.step for variable in variables])
    # Of a row of sites, what they have in common is searched first.
    directions = np.eye(len(point))
    for row in {variable.row for variable in variables if variable.row}:
        members = np.array([variable.row == row for variable in variables])
        directions[np.ix_(members, members)] = smooth(int(members.sum()))
    return CmaEs(point, steps, directions, options.step, options.seed, options.population)


def _curves(search: OptimumSearch) -> dict[str, list[Case]]:
    """The runs of the compared designs over the amplitude."""
    options = search.plan.options
    case_amplitude = search.plan.amplitude
    amplitudes = options.curve
    if not amplitudes and has_free_amplitude(search.plan.base):
        asked = [a for table in options.measured for a in table.amplitudes or [case_amplitude]]
        amplitudes = np.geomspace(min(asked) / CURVE_SPREAD, max(asked) * CURVE_SPREAD, CURVE_POINTS).tolist()
    amplitudes = sorted({*amplitudes, case_amplitude})

    curves: dict[str, list[Case]] = {}
    for name, number in search.compared().items():
        case = search.designs[number].case
        if case:
            curves[name] = [search.plan.run(case, amplitude) for amplitude in amplitudes]
    return curves


def _write(search: OptimumSearch, folder: Path) -> None:
    """Write the best cases, then ``optimum.h5``, whose presence says that the search is complete."""
    sys.audit("vipetsc.conclude", str(folder))
    plan = search.plan
    cases: dict[str, Case] = {}
    for name, number in search.compared().items():
        case = search.designs[number].case
        if case:
            cases[name] = case
    for name, case in cases.items():
        if name != "case":
            best = case.model_copy(update={"name": f"{plan.name}-{name}"})
            write_text(folder / f"{name}.toml", best.to_toml())

    values = _design_values(search) | _comparison_values(search, [*cases.values()]) | _curve_values(search)
    runs = {case_id(run) for design in search.designs for run in design.runs}
    about = provenance(search.objective.recorded.comm) | {"case": plan.to_toml(), "runs": len(runs)}
    data = xr.Dataset(tabulated(LAYOUT, values), attrs=about)
    data["amplitude"].attrs["units"] = plan.amplitude_unit
    write_netcdf(folder / "optimum.h5", data.assign_attrs(summary=_summary(data, plan)))


def _design_values(search: OptimumSearch) -> dict[str, Any]:
    """Variables, and all designs with their results, by name in ``LAYOUT``."""
    designs = search.designs
    variables = search.plan.variables()
    objectives = search.plan.options.objective
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

    measured = [[search.objective.values(run) for run in design.runs] for design in designs]
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
    curves = _curves(search)
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


def _summary(data: xr.Dataset, plan: OptimiseCase) -> str:
    """A table of the results, with a line for every compared design."""
    unit = plan.amplitude_unit
    reasons = [reason for reason in data["reason"].values if reason]
    lines = [f"{data.sizes['design']} designs, {data.attrs['runs']} runs; {len(reasons)} designs failed"]
    if reasons:
        lines.append(f"  such as: {reasons[0]}")
    lines += [f"  {number}: {objective.describe(unit)}" for number, objective in enumerate(plan.options.objective, 1)]
    if "excess" in data:
        met = int(((data["excess"] == 0) & (data["reason"] == "")).sum())
        lines += [f"  {met} designs meet the constraints:", *(f"    {text}" for text in data["constraint"].values)]

    columns = [*data["objective"].values, "upper", "dissipated"]
    lines.append(f"  {'design':<8}{'number':>7}" + "".join(f"{name:>24}" for name in columns))
    for name, number in zip(data["compared"].values, data["comparison/number"].values, strict=True):
        row = [*data["value"].values[number], *(data[shown].values[number] for shown in SHOWN)]
        lines.append(f"  {name:<8}{number:>7}" + "".join(f"{value:>24.6g}" for value in row))
    return "\n".join(lines)
