"""Arguments and exit codes of the command line."""

import argparse
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mpi4py import MPI

import vipetsc
from vipetsc.case import CaseError, Problem
from vipetsc.cli import export, movie, reference, verbs
from vipetsc.cli.messages import told
from vipetsc.io.folder import FolderError
from vipetsc.parallel import StoppedError, StopRequest

Verb = Callable[[argparse.Namespace, MPI.Comm, StopRequest], int]
# Verbs that look at a request to stop, to save first; others end where they are.
STOPPABLE = ("run", "sweep", "nnm", "nfrc", "law", "optimise", "predict", "paper")
# Verbs whose answer is what was asked for, and stays with --quiet.
ASKED = ("validate", "bands", "manual", "schema", "completion", "doctor")
WITH_PETSC_OPTIONS = ("run", "sweep", "validate")

# Names and options of ``add_argument``; one that a verb describes differently has a second entry.
ARGUMENTS: dict[str, tuple[str, dict[str, Any]]] = {
    "case": ("case", {"nargs": "?", "metavar": "CASE", "help": "case file (TOML); the built-in one if left out"}),
    "swept": ("case", {"metavar": "CASE", "help": "case file (TOML) with a section [sweep]"}),
    "searched": ("case", {"metavar": "CASE", "help": "case file (TOML) with a section [optimise]"}),
    "modal": ("case", {"metavar": "CASE", "help": "case file (TOML) with a section [nnm]"}),
    "member": ("--member", {"metavar": "ID", "help": "make a member of a sweep (CASE is its file or folder) again,"
                            " whole: its name, or its number from 0"}),
    "set": ("--set", {"action": "append", "default": [], "metavar": "SECTION.KEY=VALUE",
                      "help": "change one value; may be repeated"}),
    "out": ("--out", {"type": Path, "metavar": "DIR", "help": "output folder; one in runs/ if left out"}),
    "force": ("--force", {"action": "store_true", "help": "begin anew, and replace the results in the output folder"}),
    "resume": ("--resume", {"action": "store_true", "help": "go on with what is in the output folder, nothing else"}),
    "json": ("--json", {"action": "store_true", "help": "print JSON instead of a table"}),
    "modes": ("--modes", {"type": int, "metavar": "N", "help": "also the N linear modes of the finite lattice"
                          " that are nearest to a frequency, and their shapes"}),
    "near": ("--near", {"type": float, "metavar": "OMEGA", "help": "that frequency in rad/s; 0 if left out"}),
    "runs": ("path", {"type": Path, "nargs": "+", "metavar": "PATH",
                      "help": "folder of a run or of a sweep, or a run.h5"}),
    "path": ("path", {"type": Path, "nargs": "+", "metavar": "PATH",
                      "help": "folder of a run, a search or a law, or its run.h5, design.h5, law.h5; or folders of"
                              " branches, whose branches of one name share a page"}),
    "results": ("path", {"type": Path, "nargs": "+", "metavar": "PATH", "help": "folder or file of results"}),
    "fig": ("--fig", {"action": "append", "metavar": "NAME", "help": "only this figure; may be repeated"}),
    "format": ("--format", {"action": "append", "choices": ("png", "pdf", "gif", "mp4"),
                            "help": "png if left out, of movies gif, and mp4 with ffmpeg; may be repeated"}),
    "movie": ("--movie", {"nargs": "?", "choices": ("energy", "velocity"), "const": "energy",
                          "help": "a movie of a run: energy of the bands by cell, or velocity of the hosts"}),
    "speed": ("--speed", {"type": movie.positive, "metavar": "X", "help": "of a movie: seconds of the run in a second;"
                          " 10 s for all if left out"}),
    "from": ("--from", {"type": float, "metavar": "T", "dest": "start", "help": "of a movie: its first instant in s"}),
    "to": ("--to", {"type": float, "metavar": "T", "dest": "stop", "help": "of a movie: its last instant in s"}),
    "cells": ("--cells", {"type": movie.window, "metavar": "A:B", "help": "of a movie: the first and the last cell"}),
    "rate": ("--rate", {"type": movie.positive, "metavar": "N", "help": "of a movie: frames a second, 15 if left out"}),
    "width": ("--width", {"type": int, "metavar": "PIXELS", "help": "of a movie: 960 if left out"}),
    "only": ("--only", {"nargs": "+", "default": [], "metavar": "ID",
                        "help": "only what these figures (fig05) and claims (C7) need"}),
    "quick": ("--quick", {"action": "store_true", "help": "coarse grids: minutes, marked on every picture"}),
    "quiet": ("--quiet", {"action": "store_true", "help": "tell warnings and errors alone"}),
    "verbose": ("--verbose", {"action": "store_true", "help": "tell every phase and all statistics"}),
    "log": ("--log", {"type": Path, "metavar": "FILE", "help": "add what is told to FILE, with the time"}),
    "shell": ("shell", {"choices": ("bash", "zsh"), "help": "the shell whose completions are printed"}),
    "topic": ("topic", {"nargs": "?", "metavar": "TOPIC", "help": "a chapter; a list of them if left out"}),
    "list": ("--list", {"action": "store_true", "help": "what is done, what is left and how long it takes"}),
}  # fmt: skip

VERBS: dict[str, tuple[Verb, str, str]] = {
    "run": (verbs.run, "one simulation, its analysis and pictures", "case member set out force resume"),
    "validate": (verbs.validate, "check a case; print band edges, frequency, end time, size and cost", "case set"),
    "bands": (verbs.bands, "pass bands, gaps and group velocities of a cell", "case modes near set out json"),
    "sweep": (verbs.sweep, "every combination in [sweep]; goes on where it was", "swept set out force resume"),
    "nnm": (verbs.nnm, "nonlinear normal modes: frequency-energy branches", "modal set out force resume"),
    "nfrc": (verbs.nfrc, "steady states under a wave or a force, with stability", "case set out force resume"),
    "law": (verbs.law, "the scattering law of one site, refined; goes on where it was", "case set out force resume"),
    "optimise": (
        verbs.optimise,
        "the best design for an objective; goes on where it was",
        "searched set out force resume",
    ),
    "predict": (verbs.predict, "several sites from the answer of one, beside simulations", "case set out force resume"),
    "design": (verbs.design, "the (lambda, eta) search of the four-band cell", "case set out force resume"),
    "analyse": (verbs.analyse, "measures of runs already made, from their files", "runs set"),
    "plot": (
        movie.plot,
        "pictures of a finished run again, from its files; movies",
        "path fig format movie speed from to cells rate width",
    ),
    "export": (export.export, "XDMF (ParaView) beside a run, and curves of any results as CSV", "results"),
    "paper": (verbs.paper, "every figure and claim of the paper, and a report", "only quick list out"),
    "manual": (reference.manual, "a chapter of the manual, as plain text", "topic"),
    "schema": (reference.schema, "the JSON schema of case files, for editors", ""),
    "completion": (reference.completion, "what a shell needs to complete verbs, options and files", "shell"),
    "doctor": (verbs.doctor, "versions and what is missing", ""),
}


EXAMPLES = {
    "run": "run runs/diatomic.toml --set drive.amplitude=0.8 --out runs/soft",
    "validate": "validate runs/three-mass.toml",
    "bands": "bands runs/three-mass.toml --json",
    "sweep": "sweep runs/interband-amplitudes.toml --set sweep.ranks=1",
    "nnm": "nnm runs/nnm-hertz.toml --quiet --log nnm.log",
    "nfrc": "nfrc runs/nfrc.toml",
    "law": "law runs/law.toml --set law.tolerance=0.02",
    "optimise": "optimise runs/optimise-clearances.toml --set optimise.budget=40",
    "predict": "predict runs/predict.toml",
    "design": "design runs/design.toml --set design.lambda.count=10",
    "analyse": "analyse runs/four-band --set analysis.band_stride=1",
    "plot": "plot runs/four-band --fig dispersion --format pdf",
    "export": "export runs/four-band",
    "paper": "paper --quick --only fig09 C7",
    "manual": "manual case-file",
    "schema": "schema > vipetsc.schema.json",
    "completion": "completion bash > ~/.local/share/bash-completion/completions/vipetsc",
    "doctor": "doctor",
}
EVERY_VERB = "quiet verbose log"


class Parser(argparse.ArgumentParser):
    """An argument parser that prints on rank 0 only and lets all ranks leave together."""

    def _print_message(self, message: str, file: Any = None) -> None:
        if message and MPI.COMM_WORLD.rank == 0:
            super()._print_message(message, file)


def main(arguments: list[str], petsc: Mapping[str, str] | None = None) -> int:
    """Run the verb named in ``arguments`` on all ranks, with ``petsc`` options in its case; returns the exit code."""
    if not arguments or (arguments[0].startswith("-") and arguments[0] not in ("-h", "--help", "--version")):
        arguments = ["run", *arguments]  # of the built-in case
    options = _parser().parse_args(arguments)
    try:
        with told(MPI.COMM_WORLD, options, asked=options.verb in ASKED or getattr(options, "list", False)):
            return _call(options, petsc or {})
    except FolderError as error:  # the file of --log
        if MPI.COMM_WORLD.rank == 0:
            print(f"vipetsc: {error}", file=sys.stderr, flush=True)
        return verbs.BAD_INPUT


def _call(options: argparse.Namespace, petsc: Mapping[str, str]) -> int:
    """The exit code of the verb, called with a request to stop at hand; what is bad input is told."""
    try:
        if petsc and options.verb not in WITH_PETSC_OPTIONS:
            raise CaseError([Problem(f"-{name}", None, f"{options.verb} takes no PETSc options") for name in petsc])
        if petsc:
            options.set = [*options.set, *(f"petsc.{name}={value}" for name, value in petsc.items())]
        if getattr(options, "force", False) and getattr(options, "resume", False):
            raise FolderError("--force and --resume exclude each other: begin anew, or go on")
        with StopRequest().listening(at_once=options.verb not in STOPPABLE) as stop:
            return int(options.function(options, MPI.COMM_WORLD, stop))
    except (CaseError, FolderError) as error:
        verbs.echo(MPI.COMM_WORLD, f"vipetsc: {error}", sys.stderr)
        return verbs.BAD_INPUT
    except StoppedError as error:
        how = "; leave out --force, which begins anew" if getattr(options, "force", False) else ""
        verbs.echo(MPI.COMM_WORLD, f"vipetsc: {error}{how}", sys.stderr)
        return verbs.STOPPED


def _parser(complete: Mapping[str, Any] | None = None) -> Parser:
    """The parser of all verbs; ``complete`` tells a shell how arguments are completed, by their names here."""
    parser = Parser(
        prog="vipetsc",
        description="Waves in phononic lattices with vibro-impacts. Without a verb: the built-in four-band case.",
        epilog="PETSc options go after --, as in: vipetsc run CASE -- -ts_rk_type 5dp -log_view",
    )
    parser.add_argument("--version", action="version", version=f"vipetsc {vipetsc.__version__}")
    subparsers = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    for name, (function, text, keys) in VERBS.items():
        example = f"example: vipetsc {EXAMPLES[name]}" if name in EXAMPLES else None
        verb = subparsers.add_parser(
            name, help=text, description=text, epilog=example, formatter_class=argparse.RawDescriptionHelpFormatter
        )
        verb.set_defaults(function=function, parser=_parser)
        for key in (*keys.split(), *EVERY_VERB.split()):
            flag, details = ARGUMENTS[key]
            argument = verb.add_argument(flag, **details)
            if complete and flag in complete:
                argument.complete = complete[flag]  # type: ignore[attr-defined]
    return parser
