"""Verbs, arguments and exit codes; no numerics."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from mpi4py import MPI

import vipetsc
from vipetsc.case import Case, CaseError, Sweep
from vipetsc.case.reading import read_toml
from vipetsc.cli.tables import bands_table, doctor_table, run_table, sweep_table, validate_table
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import FolderError
from vipetsc.parallel import StopRequest, on_root

T = TypeVar("T")
DONE, FAILED, BAD_INPUT = 0, 1, 2


class Parser(argparse.ArgumentParser):
    """An argument parser that speaks on rank 0 only and lets all ranks leave together."""

    def _print_message(self, message: str, file=None) -> None:
        if message and MPI.COMM_WORLD.rank == 0:
            super()._print_message(message, file)


def main(arguments: list[str]) -> int:
    """Run the verb named in ``arguments`` on all ranks; returns the exit code."""
    options = _parser().parse_args(_with_verb(arguments))
    try:
        return options.verb(options, MPI.COMM_WORLD)
    except (CaseError, FolderError) as error:
        _say(MPI.COMM_WORLD, f"vipetsc: {error}", sys.stderr)
        return BAD_INPUT


def _with_verb(arguments: list[str]) -> list[str]:
    """No verb means the built-in case, as ``run``."""
    if arguments and arguments[0] in {*VERBS, "-h", "--help", "--version"}:
        return arguments
    if arguments and not arguments[0].startswith("-"):
        return arguments  # argparse names the verbs
    return ["run", *arguments]


def _parser() -> Parser:
    parser = Parser(
        prog="python -m vipetsc",
        description="Waves in phononic lattices with vibro-impacts. Without a verb: the built-in four-band case.",
        epilog="PETSc options go after --, as in: python -m vipetsc run CASE -- -ts_rk_type 5dp -log_view",
    )
    parser.add_argument("--version", action="version", version=f"vipetsc {vipetsc.__version__}")
    verbs = parser.add_subparsers(dest="name", required=True, metavar="VERB")
    for name, (function, text, arguments) in VERBS.items():
        verb = verbs.add_parser(name, help=text, description=text)
        verb.set_defaults(verb=function)
        for argument in arguments:
            argument(verb)
    return parser


def _case(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("case", nargs="?", metavar="CASE", help="case file (TOML); the built-in one if left out")
    _overrides(parser)


def _overrides(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="change one value; may be repeated"
    )


def _out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="output folder; one in runs/ named after the case if left out"
    )


def _folder(parser: argparse.ArgumentParser) -> None:
    _out(parser)
    parser.add_argument("--force", action="store_true", help="replace the results in the output folder")


def _resume(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--resume", action="store_true", help="go on with the unfinished run in the output folder")


def _json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")


def _plot(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "path", type=Path, nargs="+", metavar="PATH", help="folder of a run or a search, or its run.h5, design.h5;"
        " or folders of branches, whose branches of one name share a page"
    )  # fmt: skip
    parser.add_argument("--fig", action="append", metavar="NAME", help="only this figure; may be repeated")
    parser.add_argument("--format", action="append", choices=("png", "pdf"), help="png if left out; may be repeated")


def _load(options: argparse.Namespace, comm: MPI.Comm) -> Case:
    """The case, read on rank 0 alone."""

    def read() -> Case:
        if options.case is None:
            return Case.builtin(options.set)
        return _read(options.case, lambda path: Case.load(path, options.set))

    return on_root(comm, read)


def _read(path: str, load: Callable[[str], T]) -> T:
    """What ``load`` makes of the case file ``path``; raises FolderError if it cannot be read."""
    try:
        return load(path)
    except OSError as error:
        raise FolderError(f"{path}: {error.strerror}; a case file (TOML) is needed") from None


def _say(comm: MPI.Comm, text: str, file=None) -> None:
    if comm.rank == 0:
        print(text, file=file or sys.stdout, flush=True)


def run(options: argparse.Namespace, comm: MPI.Comm) -> int:
    """One simulation, its analysis and pictures."""
    from vipetsc.dynamics import simulate

    if options.force and options.resume:
        raise FolderError("--force and --resume exclude each other: begin anew, or go on")
    case = _load(options, comm)
    for warning in on_root(comm, case.warnings):
        _say(comm, f"vipetsc: warning: {warning}", sys.stderr)
    folder = options.out or Path("runs") / case.name
    stop = StopRequest().install()
    result = simulate(case, folder, comm, force=options.force, resume=options.resume, stop=stop, progress=True)
    _say(comm, run_table(result))
    if result.resumable:
        return FAILED
    if case.output.fields and result.statistics["samples"] > 1:
        _analyse_and_draw(case, folder, comm)
    return DONE if result.complete else FAILED


def _analyse_and_draw(case: Case, folder: Path, comm: MPI.Comm) -> None:
    from vipetsc.cli.plot import draw_source
    from vipetsc.studies.reanalyse import measure_run

    on_root(comm, lambda: measure_run(folder))
    if case.output.figures:
        _name(draw_source("run", [folder], None, ("png",), comm), comm)


def sweep(options: argparse.Namespace, comm: MPI.Comm) -> int:
    """Every combination in the section [sweep] of a case; goes on where it was stopped."""
    from vipetsc.cli.plot import draw_source
    from vipetsc.studies.sweep import run_sweep

    plan = on_root(comm, lambda: _read(options.case, lambda path: Sweep.load(path, options.set)))
    folder = options.out or Path("runs") / plan.name
    result = run_sweep(plan, folder, comm, force=options.force, stop=StopRequest().install(), progress=True)
    _say(comm, sweep_table(result))
    if plan.figures and (folder / "ensemble.h5").exists():
        _name(draw_source("sweep", [folder], None, ("png",), comm), comm)
    return DONE if result.complete else FAILED


def nnm(options: argparse.Namespace, comm: MPI.Comm) -> int:
    """Nonlinear normal modes: the branches of a case, their files and pictures."""
    from vipetsc.case.nnm import NnmCase
    from vipetsc.cli.branches import BranchLog, branch_table
    from vipetsc.cli.plot import draw_source
    from vipetsc.modes.follow import follow_all, prepare_folder

    if options.force and options.resume:
        raise FolderError("--force and --resume exclude each other: begin anew, or go on")

    case = on_root(comm, lambda: _read(options.case, lambda path: NnmCase.load(path, options.set)))
    folder = options.out or Path("runs") / case.name

    on_root(comm, lambda: prepare_folder(case, folder, options.force, options.resume))
    branches = follow_all(case, folder, comm, options.resume, BranchLog(sys.stderr))
    for branch in branches:
        _say(comm, branch_table(branch))

    _name(draw_source("branches", [folder], None, ("png",), comm), comm)
    failed = comm.bcast(any(b.ending.startswith("failed") for b in branches))
    return FAILED if failed else DONE


def validate(options: argparse.Namespace, comm: MPI.Comm) -> int:
    """Check a case and print what follows from it."""
    case = _load(options, comm)
    _say(comm, on_root(comm, lambda: validate_table(case, comm.size)))

    def swept() -> str:
        if options.case is None or "sweep" not in read_toml(options.case):
            return ""
        plan = Sweep.load(options.case, options.set)
        members = plan.members()
        counts = " x ".join(map(str, plan.shape))
        impossible = sum(member.case is None for member in members)
        return f"  sweep        {len(members)} members ({counts}), {impossible} of them impossible"

    if about := on_root(comm, swept):
        _say(comm, about)
    for warning in on_root(comm, case.warnings):
        _say(comm, f"warning: {warning}")
    return DONE


def bands(options: argparse.Namespace, comm: MPI.Comm) -> int:
    """Pass bands, gaps and group velocities of a case's cell; a table and a picture."""
    case = _load(options, comm)

    folder = options.out or Path("runs") / f"{case.name}-bands"

    def report() -> str:
        from vipetsc.figures import draw_bands

        cell = case.unit_cell()
        folder.mkdir(parents=True, exist_ok=True)
        table = bands_table(cell) | {"picture": str(draw_bands(cell, folder / "bands.png", case.drive.frequency))}
        text = json.dumps(table, indent=2)
        write_text(folder / "bands.json", text + "\n")
        return text if options.json else f"{bands_table(cell, as_text=True)}\n  {table['picture']}"

    _say(comm, on_root(comm, report))
    return DONE


def design(options: argparse.Namespace, comm: MPI.Comm) -> int:
    """The (lambda, eta) search of the four-band cell: ``design.h5``, its pictures, a table of the optima."""
    from vipetsc.case.design import DesignCase

    def seek() -> str:
        from vipetsc.figures import draw
        from vipetsc.studies.design import search_design

        try:
            case = DesignCase.load(options.case, options.set)
        except OSError as error:
            raise FolderError(f"{options.case}: {error.strerror}; a case file (TOML) is needed") from None
        folder = options.out or Path("runs") / case.name
        table = search_design(case, folder, options.force)
        return "\n".join([table, *(f"  {path}" for path in draw("design", [folder]))])

    _say(comm, on_root(comm, seek))
    return DONE


def analyse(options: argparse.Namespace, comm: MPI.Comm) -> int:
    """Measures of runs already made; of a sweep, those whose fields were kept, and its ensemble."""
    from vipetsc.studies.reanalyse import reanalyse_folders

    for path in reanalyse_folders(options.path, comm):
        _say(comm, f"  {path}")
    return DONE


def plot(options: argparse.Namespace, comm: MPI.Comm) -> int:
    """Pictures of what folders hold again, from their files."""
    from vipetsc.cli.plot import draw_folders

    return _name(draw_folders(options.path, options.fig, tuple(options.format or ("png",)), comm), comm)


def _name(paths: list[Path], comm: MPI.Comm) -> int:
    for path in paths if comm.rank == 0 else ():
        _say(comm, f"  {path}")
    return DONE


def paper(options: argparse.Namespace, comm: MPI.Comm) -> int:
    """Every figure and claim of the paper: what is missing is computed, drawn, measured, and put into a report."""
    from vipetsc.paper.make import make_paper
    from vipetsc.paper.plan import FULL, QUICK, paper_plan
    from vipetsc.paper.tables import claims_table, plan_table

    plan = paper_plan(QUICK if options.quick else FULL)
    folder = options.out or Path("runs") / ("paper-quick" if options.quick else "paper")
    if options.list:
        _say(comm, on_root(comm, lambda: plan_table(plan.only(options.only), folder, comm.size)))
        return DONE
    stop = StopRequest().install()
    result = make_paper(plan, folder, comm, only=options.only, stop=stop, tell=lambda text: _say(comm, f"  {text}"))
    if result.stopped:
        _say(comm, "stopped on request; the same command goes on")
        return FAILED
    _say(comm, claims_table(result.claims))
    _say(comm, f"  {len(result.made)} steps made, {len(result.drawn)} pictures drawn\n  {folder / 'report.html'}")
    return DONE if result.complete else FAILED


def doctor(options: argparse.Namespace, comm: MPI.Comm) -> int:
    """Versions, MPI, HDF5 and ranks; what is missing and how to get it."""
    text, healthy = doctor_table(comm)
    _say(comm, text)
    return DONE if healthy else FAILED


def _runs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", type=Path, nargs="+", metavar="PATH", help="folder of a run or of a sweep, or a run.h5")


def _paper(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="ID", help="only what these figures (fig05) and claims (C7) need"
    )
    parser.add_argument("--quick", action="store_true", help="coarse grids: minutes, marked on every picture")
    parser.add_argument("--list", action="store_true", help="what is done, what is left and how long it takes")
    parser.add_argument("--out", type=Path, metavar="DIR", help="runs/paper, or runs/paper-quick, if left out")


def _swept(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("case", metavar="CASE", help="case file (TOML) with a section [sweep]")
    _overrides(parser)


def _branches(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("case", metavar="CASE", help="case file (TOML) with a section [nnm]")
    _overrides(parser)


VERBS: dict[str, tuple[Callable, str, tuple[Callable, ...]]] = {
    "run": (run, "one simulation, its analysis and pictures", (_case, _folder, _resume)),
    "validate": (validate, "check a case; print band edges, frequency, end time, size and cost", (_case,)),
    "bands": (bands, "pass bands, gaps and group velocities of a cell", (_case, _out, _json)),
    "sweep": (sweep, "every combination in [sweep]; goes on where it was", (_swept, _folder)),
    "nnm": (nnm, "nonlinear normal modes: frequency-energy branches", (_branches, _folder, _resume)),
    "design": (design, "the (lambda, eta) search of the four-band cell", (_case, _folder)),
    "analyse": (analyse, "measures of runs already made, from their files", (_runs,)),
    "plot": (plot, "pictures of a finished run again, from its files", (_plot,)),
    "paper": (paper, "every figure and claim of the paper, and a report", (_paper,)),
    "doctor": (doctor, "versions and what is missing", ()),
}
