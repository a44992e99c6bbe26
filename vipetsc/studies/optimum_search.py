"""The best design for an objective, or the front of two: a case with ``[optimise]`` in, ``optimum.h5`` out.

Rank 0 asks the sampler for designs and tells it their losses in that order; all ranks make the runs. What a run came
to is recorded at once, so a search that was stopped or killed asks and tells the same again, and goes on.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case import Case, CaseError, LawCase, case_id
from vipetsc.case.optimise import OptimiseCase
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import OPTIMUM, claimed, provenance
from vipetsc.io.netcdf import open_netcdf, tabulated, write_netcdf
from vipetsc.lattice.chain import cells_between
from vipetsc.parallel import Progress, StopRequest, on_root
from vipetsc.studies.linear_run import LinearRun, linear_case
from vipetsc.studies.objective import ObjectiveRuns
from vipetsc.studies.one_site import make_law
from vipetsc.studies.recorded_runs import run_in_memory
from vipetsc.studies.sampler import CmaEs, Nsga2, Sampler, front, knee, smooth
from vipetsc.studies.scattering_law import matched_clearances
from vipetsc.studies.sweep import is_whole

POPULATION = 24  # of NSGA-II
CURVE = 4.0, 11  # compared at amplitudes from the least over this to the largest times this, so many
SHOWN = "upper_share_at_end", "dissipated"  # of every design, whatever its objective: a transfer can be lost energy's

# Dimensions, units and description of every variable.
LAYOUT = {
    "design": ("design", "1", "number of a design; 0 is the case to begin with"),
    "variable": ("variable", "1", "what varies"),
    "objective": ("objective", "1", "what is to become large or small"),
    "unit": ("variable", "1", "unit of what varies"),
    "low": ("variable", "1", "lower bound"),
    "high": ("variable", "1", "upper bound"),
    "generation": ("design", "1", "generation; 0 holds the case and the start"),
    "parameter": ("design variable", "1", "what varies, in the unit of its variable"),
    "value": ("design objective", "1", "value of an objective; NaN for a design that failed"),
    "upper_share_at_end": ("design", "1", "energy of the bands above the driven one at the end, mean over its runs"),
    "dissipated": ("design", "1", "dissipated energy over the work, mean over its runs"),
    "reason": ("design", "1", "why a design failed"),
    "front": ("front", "1", "number of a design that no other is better than"),
    "compared": ("compared", "1", "designs that are compared"),
    "comparison/number": ("compared", "1", "number of a compared design"),
    "site": ("site", "1", "contact site"),
    "comparison/cell": ("compared site", "1", "cell (1-based) of a site"),
    "comparison/clearance": ("compared site", "m", "clearance"),
    "band": ("band", "1", "pass band"),
    "amplitude": ("amplitude", "N", "amplitude of the drive"),
    "curve/bands": ("compared amplitude band", "1", "energy of a pass band at the end over the work"),
    "curve/upper_share_at_end": ("compared amplitude", "1", "energy of the bands above the driven one at the end"),
    "curve/transmitted": ("compared amplitude", "1", "energy beyond the last site at the end over the work"),
    "curve/dissipated": ("compared amplitude", "1", "dissipated energy over the work"),
    "curve/value": ("compared amplitude objective", "1", "what the objective measures"),
}


@dataclass
class Design:
    """One that was tried: its ``values`` (variable), its case and runs, None if it is impossible, what came of it."""

    values: np.ndarray
    generation: int
    case: Case | None = None
    runs: Sequence[Case] = ()
    reason: str = ""
    losses: list[float] = field(default_factory=list)


class OptimumSearch:
    """The ``designs`` tried so far, on one rank; 0 is the case to begin with, 1 the start if that differs."""

    def __init__(self, plan: OptimiseCase, judge: ObjectiveRuns, sampler: Sampler, start: np.ndarray) -> None:
        self.plan, self.judge, self.sampler = plan, judge, sampler
        self.designs = [Design(plan.begin(), 0, plan.base, [*judge.runs(plan.base).values()])]
        other = self._design(start, 0)
        self.designs += [other] if other.case is None or case_id(other.case) != case_id(plan.base) else []
        self.asked = self.designs

    def _design(self, values: np.ndarray, generation: int) -> Design:
        try:
            case = self.plan.design(values)
            return Design(values, generation, case, [*self.judge.runs(case).values()])
        except CaseError as error:
            return Design(values, generation, reason="; ".join(map(str, error.problems)))

    def runs(self) -> list[Case]:
        """Those of the designs that are not judged yet."""
        return [run for design in self.asked for run in design.runs]

    def tell_and_ask(self) -> bool:
        """ObjectiveRuns the designs whose runs were made, tell the sampler, and ask for more; whether there are any."""
        for design in self.asked:
            design.losses = [np.nan] * len(self.plan.options.objective)
            if design.case:
                design.losses, design.reason = self.judge.losses(design.case)
        generation, left = self.asked[0].generation, self.plan.options.budget - len(self.designs)
        if left <= 0:
            return False
        if generation:
            # One that failed is told to be worse than all others.
            known = self.losses()
            worst = np.max(known, axis=0, initial=0.0, where=np.isfinite(known)) + 1
            told = np.array([design.losses for design in self.asked])
            self.sampler.tell(np.where(np.isfinite(told), told, worst))
        points = self.sampler.ask()[:left]
        self.asked = [self._design(self.plan.from_unit(point), generation + 1) for point in points]
        self.designs += self.asked
        return True

    def losses(self) -> np.ndarray:
        """Of all designs (design, objective)."""
        return np.array([design.losses for design in self.designs])

    def compared(self) -> dict[str, int]:
        """The numbers of the designs to be compared by name: the case, and the best or the front's ends and knee."""
        losses = self.losses()
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
    """Search for the best design of ``plan`` in ``folder``; returns a table of what was found.

    Leaves ``optimum.h5`` and ``best.toml``, of two objectives the front's knee, with ``best-1.toml`` and
    ``best-2.toml`` for its ends. The same files, to the bit, on any number of ranks and after any stop. All ranks of
    ``comm`` must call it. Raises StoppedError, FolderError if the folder holds anything but this search.
    """
    with claimed(comm, folder, OPTIMUM, plan.to_toml(), force=force, resume=resume) as claim:
        path = claim.folder / "optimum.h5"
        if not on_root(comm, lambda: is_whole(path, [])):
            _search(plan, claim.folder, comm, stop or StopRequest(), progress)
        claim.publish()

        def summary() -> str:
            with open_netcdf(claim.path / "optimum.h5", "search for an optimum", ("value", "summary")) as data:
                return str(data.attrs["summary"])

        return on_root(comm, summary)


def _search(plan: OptimiseCase, folder: Path, comm: MPI.Comm, stop: StopRequest, progress: bool) -> None:
    """Try designs until the budget is spent, compare the best with the case, and write what was found."""
    judge = ObjectiveRuns(plan, folder, comm, stop)
    bar = Progress(comm, plan.options.budget, "designs", show=progress)

    searches: list[OptimumSearch] = []  # on rank 0

    try:
        start = _start(plan, folder, comm, stop)
        on_root(comm, lambda: searches.append(OptimumSearch(plan, judge, _sampler(plan, start), start)))
        more = True
        while more:
            judge.make(on_root(comm, lambda: searches[0].runs()))
            more = on_root(comm, lambda: searches[0].tell_and_ask())
            bar.update(sum(len(search.designs) for search in searches))
        judge.make(on_root(comm, lambda: [run for row in _curves(searches[0]).values() for run in row]))
        judge.recorded.finish()
        on_root(comm, lambda: _write(searches[0], folder))
    finally:
        bar.close()


def _start(plan: OptimiseCase, folder: Path, comm: MPI.Comm, stop: StopRequest) -> np.ndarray:
    """The values (variable) at which the search begins; all ranks must call it. Raises StoppedError."""
    if plan.options.start == "case":
        return plan.begin()
    table = {key: value for key, value in plan.table.items() if key != "disorder"}
    law = make_law(LawCase.from_table(table | {"name": "law"}), folder / "law", comm, stop=stop)
    lattice, drive = plan.base.lattice, plan.base.drive

    def matched() -> np.ndarray:
        data, result = run_in_memory(linear_case(plan.base), MPI.COMM_SELF, stop)
        linear = LinearRun.of(data, result.statistics, (), ())
        sites = np.array(plan.sites)  # the law's are in the order in which the wave meets them
        order = np.argsort(cells_between(sites, drive.cell, lattice.cells, lattice.ends), kind="stable")
        clearance = np.empty(len(sites))
        clearance[order] = matched_clearances(law, linear, sites[order].tolist(), drive.amplitude)
        return plan.begin(clearance.tolist())

    return on_root(comm, matched)


def _sampler(plan: OptimiseCase, start: np.ndarray) -> Sampler:
    """The sampler of ``plan`` from the values ``start`` (variable) on."""
    options, point = plan.options, plan.to_unit(start)
    if len(options.objective) == 2:
        return Nsga2(point, options.step, options.seed, options.population or POPULATION)
    steps = np.array([1 / (v.high - v.low) if v.kind == "whole" else 0.0 for v in plan.variables()])
    directions, gaps = np.eye(len(point)), np.array([v.name.startswith("clearance") for v in plan.variables()])
    directions[np.ix_(gaps, gaps)] = smooth(int(gaps.sum()))
    return CmaEs(point, steps, directions, options.step, options.seed, options.population)


def _curves(search: OptimumSearch) -> dict[str, list[Case]]:
    """The runs of the compared designs over the amplitude."""
    options = search.plan.options
    asked = [a for o in options.objective for a in o.amplitudes or [search.judge.amplitude]]
    spread, count = CURVE
    amplitudes = options.curve or np.geomspace(min(asked) / spread, max(asked) * spread, count).tolist()
    amplitudes = sorted({*amplitudes, search.judge.amplitude})
    cases = {name: search.designs[number].case for name, number in search.compared().items()}
    return {
        name: [search.plan.run(case, amplitude) for amplitude in amplitudes] for name, case in cases.items() if case
    }


def _write(search: OptimumSearch, folder: Path) -> None:
    """The best cases, then ``optimum.h5``."""
    sys.audit("vipetsc.conclude", str(folder))
    plan, designs, judge = search.plan, search.designs, search.judge
    objectives, variables, compared = plan.options.objective, plan.variables(), search.compared()
    signs = np.array([-1.0 if objective.goal == "maximise" else 1.0 for objective in objectives])
    value = signs * search.losses()
    values: dict[str, Any] = {"design": np.arange(len(designs)), "variable": [v.name for v in variables]}
    values |= {"objective": [f"{number}: {o.name}" for number, o in enumerate(objectives, 1)]}
    values |= {"low": [float(v.low) for v in variables], "high": [float(v.high) for v in variables]}
    values |= {"unit": [v.unit for v in variables], "generation": [d.generation for d in designs]}
    values |= {"parameter": [d.values for d in designs], "value": value, "reason": [d.reason for d in designs]}
    of_design = [[judge.values(run) for run in design.runs] for design in designs]
    for name in SHOWN:
        values[name] = [np.mean([row.get(name, np.nan) for row in rows]) if rows else np.nan for rows in of_design]
    values["front"] = front(search.losses())
    cases = [case for number in compared.values() if (case := designs[number].case)]
    chains = [case.model().chain for case in cases]
    values |= {"compared": [*compared], "comparison/number": [*compared.values()]}
    values |= {"site": np.arange(1, len(plan.sites) + 1), "comparison/cell": [np.add(c.sites, 1) for c in chains]}
    values |= {"comparison/clearance": [c.clearances for c in chains]}
    curves = _curves(search)
    told = {name: [judge.values(run) for run in runs] for name, runs in curves.items()}
    values["amplitude"] = [run.drive.amplitude for run in curves["case"]]
    bands = len(plan.base.lattice.unit_cell().masses)
    values["band"] = np.arange(1, bands + 1)
    for name, none in {"bands": [np.nan] * bands, **dict.fromkeys((*SHOWN, "transmitted"), np.nan)}.items():
        values[f"curve/{name}"] = [[row.get(name, none) for row in rows] for rows in told.values()]
    asked = [objective.name for objective in objectives]
    values["curve/value"] = [[[row.get(name, np.nan) for name in asked] for row in rows] for rows in told.values()]
    for name, case in zip(compared, cases, strict=True):
        if name != "case":
            best = case.model_copy(update={"name": f"{plan.name}-{name}"})
            write_text(folder / f"{name}.toml", best.to_toml())
    runs = len({case_id(run) for design in designs for run in design.runs})
    data = xr.Dataset(
        tabulated(LAYOUT, values), attrs=provenance(judge.recorded.comm) | {"case": plan.to_toml(), "runs": runs}
    )
    write_netcdf(folder / "optimum.h5", data.assign_attrs(summary=_summary(data, plan)))


def _summary(data: xr.Dataset, plan: OptimiseCase) -> str:
    """What was found, in a table: a line for every compared design."""
    reasons = [reason for reason in data["reason"].values if reason]
    lines = [f"{data.sizes['design']} designs, {data.attrs['runs']} runs; {len(reasons)} designs failed"]
    lines += [f"  such as: {reasons[0]}"] if reasons else []
    lines += [f"  {number}: {objective.describe()}" for number, objective in enumerate(plan.options.objective, 1)]
    columns = [*data["objective"].values, "upper share", "dissipated"]
    lines.append(f"  {'design':<8}{'number':>7}" + "".join(f"{name:>24}" for name in columns))
    for name, number in zip(data["compared"].values, data["comparison/number"].values, strict=True):
        row = [*data["value"].values[number], *(data[shown].values[number] for shown in SHOWN)]
        lines.append(f"  {name:<8}{number:>7}" + "".join(f"{value:>24.6g}" for value in row))
    return "\n".join(lines)
