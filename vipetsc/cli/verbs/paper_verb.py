"""The verb ``paper``: every figure and claim of the paper."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from vipetsc.cli.arguments import argument, output_folder
from vipetsc.cli.messages import echo
from vipetsc.cli.verb import DONE, FAILED, PlainVerb
from vipetsc.io.extras import require
from vipetsc.io.kinds import PAPER
from vipetsc.parallel import StopRequest, on_root

if TYPE_CHECKING:
    from mpi4py import MPI


def paper(options: argparse.Namespace, comm: "MPI.Comm", stop: StopRequest) -> int:
    """Compute the missing results of the paper, draw its figures, evaluate its claims, and write a report."""
    from vipetsc.paper.make import make_paper, plan_table
    from vipetsc.paper.plan import FULL, QUICK, paper_plan
    from vipetsc.paper.report import claims_table

    plan = paper_plan(QUICK if options.quick else FULL)
    # A folder holds the paper on one grid only: by default the quick one has a folder of its own.
    folder = options.out or Path("runs") / ("paper-quick" if options.quick else "paper")
    # A list looks at the folder, and neither locks nor creates it.
    if options.list:
        echo(comm, on_root(comm, lambda: plan_table(plan.only(options.only), folder, comm.size)))
        return DONE

    require("jinja2", "paper")
    result = make_paper(plan, folder, comm, only=options.only, stop=stop, tell=lambda text: echo(comm, f"  {text}"))
    for note in result.notes:
        echo(comm, f"vipetsc: {note}", sys.stderr)
    echo(comm, claims_table(result.claims))
    echo(
        comm,
        f"  {len(result.new_steps)} steps computed, {len(result.drawn)} pictures drawn\n  {folder / 'report.html'}",
    )
    return DONE if result.complete else FAILED


VERB = PlainVerb(
    name="paper",
    text="reproduce every figure and claim of the paper, with a report",
    example="paper --quick --only fig09 C7",
    arguments=(
        argument(
            "--only",
            nargs="+",
            default=[],
            metavar="ID",
            help="only the steps that these figures (fig05) and claims (C7) need",
        ),
        argument(
            "--quick", action="store_true", help="coarse grids, which take minutes and are marked in every picture"
        ),
        argument("--list", action="store_true", help="list completed and remaining steps with their duration"),
        output_folder("runs/paper, with --quick runs/paper-quick"),
    ),
    function=paper,
    results=PAPER,
    is_stoppable=True,
)
