"""The verb ``sweep``: every combination in the section [sweep] of a case."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vipetsc.case import Sweep
from vipetsc.cli.arguments import STUDY_ARGUMENTS, case_with
from vipetsc.cli.drawing import Pictures
from vipetsc.cli.messages import duration, table
from vipetsc.cli.verb import Outcome, Rows, StudyVerb, Work
from vipetsc.io.folder import FolderError
from vipetsc.io.kinds import SWEEP
from vipetsc.wording import counted

if TYPE_CHECKING:
    from vipetsc.studies.sweep import SweepResult

MOST_ESTIMATED = 50  # members whose time ``validate`` estimates, 10 ms each


def simulate_members(plan: Sweep, work: Work) -> Outcome:
    """Simulate the missing members, and collect the measures of all members."""
    from vipetsc.studies.sweep import run_sweep

    result = run_sweep(plan, work.folder, work.comm, **work.keywords)
    work.warn(result.warnings)
    work.report(sweep_table(result))
    return Outcome(complete=result.complete, failures=failure_of(result))


def failure_of(result: "SweepResult") -> list[str]:
    """Return the sentence of a sweep of which members failed, with the first of them; nothing where none did."""
    if not result.failures:
        return []
    first = result.failures[0]
    return [f"{result.failed} of {result.status.size} members failed, first {first['place']}: {first['reason']}"]


def sweep_rows(plan: Sweep, ranks: int) -> Rows:
    """Return rows of ``validate`` with the number of members, how many of those tried are not valid, and their time."""
    from vipetsc.dynamics.plan import RunPlan, estimate

    tried = plan.tried()
    impossible = sum(member.case is None for member in tried)
    counts = " x ".join(map(str, plan.shape))
    of = str(len(tried))
    if len(tried) == plan.count:
        of = "them"
    rows = [("sweep", f"{plan.count} members ({counts}), {impossible} of {of} impossible")]

    # Members at equal distances stand for all of them.
    possible = [member.case for member in tried if member.case]
    some = possible[:: max(1, len(possible) // MOST_ESTIMATED)]
    if some:
        mean = sum(estimate(RunPlan.of(case)).seconds for case in some) / len(some)
        seconds = mean * plan.count * len(possible) / len(tried) / ranks
        rows.append(("sweep takes", f"about {duration(seconds)} on {counted(ranks, 'rank')}, and its measures"))
    return rows


def sweep_table(result: "SweepResult") -> str:
    """Return ending of a sweep as a table: how its members ended, times, the first failures."""
    # A sweep of the command line always has a folder.
    assert result.folder
    complete, scaled, failed, missing = (result.count(status) for status in range(4))
    counts = f"{complete} simulated, {scaled} scaled from a linear run, {failed} failed"
    rows = [
        ("members", f"{result.status.size}: {counts}"),
        ("computed now", f"{result.computed} in {result.seconds:.1f} s"),
        ("ranks busy", ", ".join(f"{100 * busy:.0f} %" for busy in result.busy)),
    ]
    if missing:
        rows.append(("missing", f"{missing}; stopped on request; the same command continues"))
    else:
        rows.append(("leaves", str(result.folder / "ensemble.h5")))

    rows += [("failed", f"member {row['place']}: {row['reason']}") for row in result.failures]
    return table(rows)


def relate_to_branches(folders: Sequence[Path]) -> None:
    """Check that ``folders`` hold finished sweeps or branches, and relate the sweeps to the branches.

    The relation, ``backbone.h5``, is written to the folder of the sweep. Raises FolderError for a folder that holds
    neither.
    """
    from vipetsc.studies.backbone import relate_folders

    # All folders are checked before a file is written into one of them.
    for folder in folders:
        if not (folder / "ensemble.h5").exists() and not any(folder.glob("branch-*.h5")):
            raise FolderError(f"{folder}: contains neither a finished sweep nor branches")
    relate_folders(folders)


def begin_with_a_sweep(folders: Sequence[Path]) -> bool:
    """Return whether the first of ``folders`` holds a sweep; others may hold branches, or sweeps for its pages."""
    return (folders[0] / "ensemble.h5").exists()


PICTURES = Pictures(SWEEP, prepare=relate_to_branches, recognise=begin_with_a_sweep)

VERB = StudyVerb(
    name="sweep",
    text="simulate every combination of the values in [sweep]",
    example="sweep runs/examples/interband-amplitudes.toml --set sweep.ranks=1",
    arguments=(case_with("sweep"), *STUDY_ARGUMENTS),
    case=Sweep,
    study=simulate_members,
    table=sweep_rows,
    results=SWEEP,
    pictures=PICTURES,
    takes_petsc_options=True,
)
