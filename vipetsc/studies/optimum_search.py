"""The best design for an objective, or the Pareto front of two: the result is ``optimum.h5``.

For one objective the sampler is CMA-ES, an evolution strategy that adapts the covariance of the designs that it tries;
for two it is NSGA-II, a genetic algorithm that keeps designs that no other is better than in both. The search begins
with the case, or with clearances that the scattering law of one site gives for the linear wave (``start``).

Rank 0 asks the sampler for designs and reports their losses in that order; all ranks simulate the runs. The result of
a run is recorded at once, so a search that was stopped or killed repeats the same exchange and goes on.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Unpack

from mpi4py import MPI

import numpy as np
import xarray as xr

from vipetsc.case import LawCase
from vipetsc.case.optimise import OptimiseCase
from vipetsc.io.extras import require
from vipetsc.io.kinds import OPTIMUM
from vipetsc.io.netcdf import open_netcdf
from vipetsc.lattice.topology import Topology
from vipetsc.parallel import on_root
from vipetsc.progress import Progress
from vipetsc.studies.designs import OptimumSearch
from vipetsc.studies.linear_run import LinearRun, linear_case
from vipetsc.studies.objective import ObjectiveRuns
from vipetsc.studies.one_site import make_law
from vipetsc.studies.optimum_file import curves_of, optimum_of
from vipetsc.studies.recorded_runs import run_in_memory
from vipetsc.studies.sampler import CmaEs, Nsga2, Sampler, smooth
from vipetsc.studies.scattering_law import matched_clearances
from vipetsc.studies.study import How, Study, StudyWork

POPULATION = 24  # of NSGA-II: a front of as many designs, and generations enough within the default budget of 100


def run_search(
    plan: OptimiseCase, folder: str | Path, comm: MPI.Comm = MPI.COMM_WORLD, **how: Unpack[How]
) -> xr.Dataset:
    """Search for the best design of ``plan`` in ``folder``; returns the content of ``optimum.h5``.

    Writes ``optimum.h5`` and ``best.toml``, for two objectives the front's knee, with ``best-1.toml`` and
    ``best-2.toml`` for its ends. The attribute ``summary`` is a table of the results. ``how`` it is computed, and what
    it raises, is in ``Study.run``.
    """
    OptimiseCase.expect(plan, "run_search")
    require("pymoo" if len(plan.options.objective) == 2 else "cma", "optimise")
    return STUDY.run(plan, folder, comm, **how)


def _make(plan: OptimiseCase, work: StudyWork) -> Callable[[], xr.Dataset]:
    """Try designs until the budget is spent, and compare the best one with the case.

    Returns the function that gives the results, for rank 0.
    """
    comm = work.comm
    objective = ObjectiveRuns(plan, work.folder, comm, work.stop)
    bar = Progress(comm, plan.options.budget, "designs", show=work.progress)
    searches: list[OptimumSearch] = []  # one on rank 0, none on the others

    try:
        start = _start(plan, work)
        on_root(comm, lambda: searches.append(OptimumSearch(plan, objective, _sampler(plan, start), start)))
        more = True
        while more:
            # One rank has the sampler: its random numbers and ties must not differ between ranks.
            objective.make(on_root(comm, lambda: searches[0].runs()))
            more = on_root(comm, lambda: searches[0].tell_and_ask())
            bar.update(sum(len(search.designs) for search in searches))

        objective.make(on_root(comm, lambda: [run for row in curves_of(searches[0]).values() for run in row]))
        objective.recorded.finish()
    finally:
        bar.close()
    return lambda: optimum_of(searches[0], work.folder)


def read_optimum(folder: str | Path) -> xr.Dataset:
    """Return the content of ``optimum.h5`` in ``folder``; raises OSError or ValueError if it is none."""
    with open_netcdf(Path(folder) / "optimum.h5", "search for an optimum", ("value", "summary")) as data:
        return data.load()


STUDY = Study(OPTIMUM, "optimum.h5", make=_make, read=read_optimum)


def _start(plan: OptimiseCase, work: StudyWork) -> np.ndarray:
    """Return the values (variable) at which the search begins; all ranks must call it. Raises StoppedError."""
    if plan.options.start == "case":
        return plan.begin()

    table = {key: value for key, value in plan.table.items() if key != "disorder"}
    law = make_law(LawCase.from_table(table | {"name": "law"}), work.folder / "law", work.comm, stop=work.stop)
    lattice = plan.base.lattice
    drive = plan.base.drive

    def matched() -> np.ndarray:
        data, result = run_in_memory(linear_case(plan.base), MPI.COMM_SELF, work.stop)
        linear = LinearRun.of(data, result.statistics, sites=(), names=())
        # The law's sites are in the order in which the wave meets them, the plan's are not.
        sites = np.array(plan.sites)
        order = np.argsort(Topology(lattice.cells, lattice.ends).distance(sites, drive.cell), kind="stable")
        clearance = np.empty(len(sites))
        clearance[order] = matched_clearances(law, linear, sites[order].tolist(), drive.amplitude)
        return plan.begin(clearance.tolist())

    return on_root(work.comm, matched)


def _sampler(plan: OptimiseCase, start: np.ndarray) -> Sampler:
    """Return the sampler of ``plan`` from the values ``start`` (variable) on."""
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
