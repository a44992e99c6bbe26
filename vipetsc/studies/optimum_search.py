"""The best design for an objective, or the Pareto front of two: the result is ``optimum.h5``.

For one objective the sampler is CMA-ES, an evolution strategy that adapts the covariance of the designs that it tries;
for two it is NSGA-II, a genetic algorithm that keeps designs that no other is better than in both. The search begins
with the case, or with clearances that the scattering law of one site gives for the linear wave (``start``).

Rank 0 asks the sampler for designs and reports their losses in that order; all ranks simulate the runs. The result of
a run is recorded at once, so a search that was stopped or killed repeats the same exchange and goes on.
"""

from pathlib import Path

from mpi4py import MPI

import numpy as np

from vipetsc.case import LawCase
from vipetsc.case.optimise import OptimiseCase
from vipetsc.io.folder import OPTIMUM, claimed
from vipetsc.io.netcdf import open_netcdf
from vipetsc.lattice.chain import cells_between
from vipetsc.parallel import StopRequest, on_root
from vipetsc.progress import Progress
from vipetsc.studies.designs import OptimumSearch
from vipetsc.studies.linear_run import LinearRun, linear_case
from vipetsc.studies.objective import ObjectiveRuns
from vipetsc.studies.one_site import make_law
from vipetsc.studies.optimum_file import curves_of, write_optimum
from vipetsc.studies.recorded_runs import run_in_memory
from vipetsc.studies.sampler import CmaEs, Nsga2, Sampler, smooth
from vipetsc.studies.scattering_law import matched_clearances
from vipetsc.studies.sweep import is_whole

POPULATION = 24  # of NSGA-II: a front of as many designs, and generations enough within the default budget of 100


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
    OptimiseCase.expect(plan, "run_search")
    with claimed(comm, folder, OPTIMUM, plan.to_toml(), force=force, resume=resume) as claim:
        path = claim.folder / "optimum.h5"
        # A file that was cut off is written again, from the records of its runs.
        if not on_root(comm, lambda: is_whole(path, [])):
            _search(plan, claim.folder, comm, stop or StopRequest(), progress)
        claim.publish()

        def summary() -> str:
            with open_netcdf(claim.folder / "optimum.h5", "search for an optimum", ("value", "summary")) as data:
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
            # One rank has the sampler: its random numbers and ties must not differ between ranks.
            objective.make(on_root(comm, lambda: searches[0].runs()))
            more = on_root(comm, lambda: searches[0].tell_and_ask())
            bar.update(sum(len(search.designs) for search in searches))

        objective.make(on_root(comm, lambda: [run for row in curves_of(searches[0]).values() for run in row]))
        objective.recorded.finish()
        on_root(comm, lambda: write_optimum(searches[0], folder))
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
        population = options.population or POPULATION
        return Nsga2(point, step=options.step, seed=options.seed, population=population)

    variables = plan.variables()
    # Variables that are whole numbers have a least deviation, or the search would stay at one of them.
    steps = np.array([variable.step for variable in variables])
    # Of a row of sites, what they have in common is searched first.
    directions = np.eye(len(point))
    for row in {variable.row for variable in variables if variable.row}:
        members = np.array([variable.row == row for variable in variables])
        directions[np.ix_(members, members)] = smooth(int(members.sum()))
    return CmaEs(point, steps, directions, step=options.step, seed=options.seed, population=options.population)
