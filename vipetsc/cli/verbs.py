"""The verbs: each takes the parsed options, the communicator and a request to stop, and returns the exit code.

All ranks call it. What a verb alone needs is imported inside it: compiled kernels and matplotlib take seconds to load.
"""

import argparse
import json
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

from mpi4py import MPI

from vipetsc.case import Case, CaseFile, DesignCase, LawCase, NnmCase, Sweep
from vipetsc.case.nfrc import NfrcCase
from vipetsc.case.optimise import OptimiseCase
from vipetsc.case.predict import PredictCase
from vipetsc.case.sweep import MOST_TRIED
from vipetsc.case.verb_cases import disorder_of, load_every
from vipetsc.cli import tables
from vipetsc.cli.lattice import damping_report, damping_table
from vipetsc.cli.messages import echo, logger
from vipetsc.cli.plot import draw_source
from vipetsc.io.atomic import write_text
from vipetsc.io.folder import origin
from vipetsc.io.lock import locked
from vipetsc.parallel import StopRequest, on_root

DONE, FAILED, BAD_INPUT, STOPPED = 0, 1, 2, os.EX_TEMPFAIL

AnyCase = TypeVar("AnyCase", bound=CaseFile)


def echo_paths(comm: MPI.Comm, paths: Iterable[Path]) -> None:
    """Print on rank 0 which files were written."""
    for path in paths:
        echo(comm, f"  {path}")


def echo_warnings(comm: MPI.Comm, warnings: Iterable[str]) -> None:
    """Print on rank 0 what is to be known about a result."""
    for warning in warnings:
        echo(comm, f"vipetsc: warning: {warning}", sys.stderr)


def _load(kind: type[AnyCase], options: argparse.Namespace, comm: MPI.Comm) -> AnyCase:
    """The case, read on rank 0 alone; raises CaseError on all ranks."""
    return on_root(comm, lambda: kind.load(options.case, options.set))


def _member(options: argparse.Namespace) -> Case:
    """The case of a member of a sweep, given by its case file or its folder; raises CaseError."""
    path = Path(options.case or "a sweep's case")
    plan = Sweep.load(path / "case.toml" if path.is_dir() else path)
    number = plan.number(options.member)
    name = f"{plan.name}-{plan.ids()[number]}"
    return plan.case(number).varied(name=name, without=("output",), overrides=options.set)


def _output(options: argparse.Namespace, name: str) -> Path:
    return options.out or Path("runs") / name


def run(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """One simulation, its analysis and pictures; or a member of a sweep again, with all its fields."""
    from vipetsc.dynamics import simulate
    from vipetsc.dynamics.cost import estimate
    from vipetsc.io.export import has_xdmf, write_xdmf
    from vipetsc.studies.reanalysis import is_measured, measure_run

    case = _load(Case, options, comm) if options.member is None else on_root(comm, lambda: _member(options))
    around = Path(options.case) if options.member else None  # a sweep, whose linear run tells when the wave arrives
    known = on_root(comm, case.warnings)
    echo_warnings(comm, known)
    folder = _output(options, case.name)
    with locked(comm, folder):
        result = simulate(case, folder, comm, force=options.force, resume=options.resume, stop=stop, progress=True)
        echo_warnings(comm, [warning for warning in result.warnings if warning not in known])
        echo(comm, tables.run_table(result, on_root(comm, lambda: estimate(case, comm.size).faster)))
        if comm.rank == 0:
            logger.debug("statistics %s", json.dumps(result.statistics))
        stop.check(comm)
        if case.output.fields and result.statistics["samples"] > 1:
            on_root(comm, lambda: is_measured(folder) or measure_run(folder, around))
            on_root(comm, lambda: has_xdmf(folder) or write_xdmf(folder))
            stop.check(comm)
            if case.output.figures:
                echo_paths(comm, draw_source("run", [folder], comm, afresh=False))
    return DONE if result.complete else FAILED


def sweep(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """Every combination in the section [sweep] of a case; goes on where it was stopped."""
    from vipetsc.dynamics.options import check_options
    from vipetsc.studies.sweep import run_sweep

    plan = _load(Sweep, options, comm)

    def check() -> None:
        for member in plan.members(MOST_TRIED):
            check_options(member.case)

    on_root(comm, check)
    folder = _output(options, plan.name)
    with locked(comm, folder):
        result = run_sweep(plan, folder, comm, force=options.force, stop=stop, resume=options.resume, progress=True)
        echo_warnings(comm, result.warnings)
        echo(comm, tables.sweep_table(result))
        stop.check(comm)
        if plan.table.get("output", {}).get("figures", True):
            echo_paths(comm, draw_source("sweep", [folder], comm, afresh=False))
    return DONE if result.complete else FAILED


def nnm(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """Nonlinear normal modes: the branches of a case, their files and pictures."""
    from vipetsc.modes.branches.follow import claim_branches, follow_all
    from vipetsc.modes.branches.lattice_follow import follower_of

    case = _load(NnmCase, options, comm)
    folder = _output(options, case.name)
    echo_warnings(comm, case.warnings())
    with claim_branches(case, folder, comm, options.force, options.resume) as claim:
        branches = follow_all(case, claim.folder, comm, claim.going_on, tables.branch_log(), stop, follower_of(case))
        for branch in branches:
            echo(comm, tables.branch_table(branch))
            for finding in branch.findings:
                echo(comm, f"vipetsc: warning: {branch.name}: {finding}", sys.stderr)
        stop.check(comm)
        claim.publish()
        echo_paths(comm, draw_source("branches", [folder], comm, afresh=False))
    failed = comm.bcast(any(branch.ending.startswith("failed") for branch in branches))
    return FAILED if failed else DONE


def nfrc(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """Steady states of sites under a wave or a force, with their stability: curves, their files and pictures."""
    from vipetsc.modes.response.nfrc import claim_curves, follow_curves

    case = _load(NfrcCase, options, comm)
    folder = _output(options, case.name)
    with claim_curves(case, folder, comm, options.force, options.resume) as claim:
        curves = follow_curves(case, claim.folder, comm, claim.going_on, stop)
        for curve in curves:
            echo(comm, tables.table(curve.summary()))
        stop.check(comm)
        failed = comm.bcast([f"{c.name}: {c.ending}" for c in curves if c.ending.startswith("failed")])
        if on_root(comm, lambda: any(claim.folder.glob("branch-*.h5"))):
            claim.publish()
            if case.output.figures:
                echo_paths(comm, draw_source("branches", [folder], comm, afresh=False))
    for sentence in failed:
        echo(comm, f"vipetsc: {sentence}", sys.stderr)
    return FAILED if failed else DONE


def validate(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """Check a case as every verb whose section it has, and print what follows from it."""
    from vipetsc.dynamics.options import check_options

    def report() -> str:
        cases = load_every(options.case, options.set)
        for case in cases:
            check_options(case)
        rows = [row for case in cases for row in tables.case_rows(case, comm.size)]
        rows += tables.disorder_rows(*disorder) if (disorder := disorder_of(options.case, options.set)) else []
        return "\n".join(
            [tables.table(rows)] + [f"warning: {warning}" for case in cases for warning in case.warnings()]
        )

    echo(comm, on_root(comm, report))
    return DONE


def bands(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """Pass bands, gaps and group velocities of a case's cell; a table and a picture."""
    case = _load(Case, options, comm)
    folder = _output(options, f"{case.name}-bands")

    def report() -> str:
        from vipetsc.figures.registry import draw_bands

        cell = case.lattice.unit_cell()
        numbers = tables.bands_table(cell) | damping_table(cell, case.drive.frequency or 0.0)
        with locked(MPI.COMM_SELF, folder):
            for leftover in folder.glob(".*.part"):  # of a command that was killed
                leftover.unlink()
            picture = draw_bands(cell, folder / "bands.png", case.drive.frequency)
            text = json.dumps(numbers | {"picture": str(picture)} | origin(), indent=2)
            write_text(folder / "bands.json", text + "\n")
        return text if options.json else f"{tables.bands_report(numbers)}{damping_report(numbers)}\n  {picture}"

    modes = tables.modes_told(case, options.modes, options.near, folder, comm)
    echo(comm, on_root(comm, report) + modes * (not options.json))
    return DONE


def design(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """The (lambda, eta) search of the four-band cell: ``design.h5``, its pictures, a table of the optima."""
    from vipetsc.paper.cell_search import search_design

    case = _load(DesignCase, options, comm)
    folder = _output(options, case.name)
    with locked(comm, folder):
        echo(comm, search_design(case, folder, comm, force=options.force, resume=options.resume))
        echo_paths(comm, draw_source("design", [folder], comm, afresh=False))
    return DONE


def law(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """The scattering law of one site: ``law.h5``, its picture, a table."""
    from vipetsc.dynamics.options import check_options
    from vipetsc.studies.one_site import make_law

    case = _load(LawCase, options, comm)
    on_root(comm, lambda: check_options(case))
    folder, flags = _output(options, f"{case.name}-law"), {"force": options.force, "resume": options.resume}
    with locked(comm, folder):
        result = make_law(case, folder, comm, **flags, stop=stop, progress=True)
        echo(comm, tables.table(result.summary()))
        if case.output.figures:
            echo_paths(comm, draw_source("law", [folder], comm, afresh=False))
    return DONE


def optimise(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """The best clearances, sites, restitution or cell for an objective: ``optimum.h5``, ``best.toml``, pictures."""
    from vipetsc.dynamics.options import check_options
    from vipetsc.studies.optimum_search import run_search

    plan = _load(OptimiseCase, options, comm)
    on_root(comm, lambda: check_options(plan.base))
    folder, flags = _output(options, plan.name), {"force": options.force, "resume": options.resume}
    with locked(comm, folder):
        echo(comm, run_search(plan, folder, comm, **flags, stop=stop, progress=True))
        stop.check(comm)
        if plan.base.output.figures:
            echo_paths(comm, draw_source("optimum", [folder], comm, afresh=False))
    return DONE


def predict(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """The case's transfer composed from the answer of one site, beside simulations: ``prediction.h5``, a picture."""
    from vipetsc.dynamics.options import check_options
    from vipetsc.studies.prediction import predict as predict_case

    case = _load(PredictCase, options, comm)
    on_root(comm, lambda: check_options(case))
    folder, flags = _output(options, case.name), {"force": options.force, "resume": options.resume}
    with locked(comm, folder):
        data = predict_case(case, folder, comm, **flags, stop=stop, progress=True)
        echo(comm, tables.prediction_table(data))
        if case.output.figures:
            echo_paths(comm, draw_source("prediction", [folder], comm, afresh=False))
    return DONE


def analyse(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """Measures of runs already made; of a sweep, those whose fields were kept, and its ensemble."""
    from vipetsc.studies.reanalysis import reanalyse_folders

    folders = on_root(comm, lambda: [p.parent if p.name == "run.h5" else p for p in options.path if p.exists()])
    with locked(comm, *folders):
        echo_paths(comm, reanalyse_folders(options.path, comm, options.set))
    return DONE


def paper(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """Every figure and claim of the paper: what is missing is computed, drawn, measured, and put into a report."""
    from vipetsc.paper.make import make_paper, plan_table
    from vipetsc.paper.plan import FULL, QUICK, paper_plan
    from vipetsc.paper.report import claims_table

    plan = paper_plan(QUICK if options.quick else FULL)
    folder = _output(options, "paper-quick" if options.quick else "paper")
    if options.list:
        echo(comm, on_root(comm, lambda: plan_table(plan.only(options.only), folder, comm.size)))
        return DONE
    result = make_paper(plan, folder, comm, only=options.only, stop=stop, tell=lambda text: echo(comm, f"  {text}"))
    for note in result.notes:
        echo(comm, f"vipetsc: {note}", sys.stderr)
    echo(comm, claims_table(result.claims))
    echo(comm, f"  {len(result.made)} steps made, {len(result.drawn)} pictures drawn\n  {folder / 'report.html'}")
    return DONE if result.complete else FAILED


def doctor(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """Versions, MPI, HDF5 and ranks; what is missing and how to get it."""
    from vipetsc.cli.doctor import doctor_table

    text, healthy = doctor_table(comm)
    echo(comm, text)
    return DONE if healthy else FAILED
