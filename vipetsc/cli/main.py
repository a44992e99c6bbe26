"""The parser of the command line, and its exit codes."""

import argparse
import sys
from collections.abc import Mapping
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any, NoReturn, TextIO

import vipetsc
from vipetsc.case import CaseError, Problem
from vipetsc.cli.arguments import COMMON_ARGUMENTS
from vipetsc.cli.messages import code_of, discard, echo, reporting
from vipetsc.cli.verb import BAD_INPUT, FAILED, STOPPED
from vipetsc.cli.verbs.verb_list import VERBS
from vipetsc.io.errors import FolderError, ResultFileError, is_of_file_system
from vipetsc.parallel import ALONE, StoppedError, StopRequest, StudyError, all_meet, on_root
from vipetsc.register import PartError
from vipetsc.wording import nearest

if TYPE_CHECKING:
    from mpi4py import MPI

# s within which all ranks that were stopped must meet. If one of them was killed they never do, and the launcher kills
# the others within this time.
PATIENCE = 5.0
ABOUT_THE_PROGRAM = "-h", "--help", "--version"


class Parser(argparse.ArgumentParser):
    """An argument parser that prints on rank 0 of ``comm`` only, keeps its ``error_in_print``, and ends all ranks."""

    comm: "MPI.Comm" = ALONE
    error_in_print: OSError | None = None

    def say(self, text: str, stream: TextIO | None) -> None:
        """Print ``text`` to a ``stream`` on rank 0; to none if that was closed, for which Python has None."""
        if self.comm.rank != 0 or stream is None:
            return
        try:
            print(text, end="", file=stream, flush=True)
        except OSError as error:
            discard(stream)
            self.error_in_print = error

    def print_help(self, file: Any = None) -> None:
        """Print the help on rank 0, to stdout or another ``file``."""
        self.say(self.format_help(), file or sys.stdout)

    def error(self, message: str) -> NoReturn:
        """End the program for bad input, with the usage and a ``message`` on stderr."""
        self.say(self.format_usage(), sys.stderr)
        self.exit(BAD_INPUT, f"{self.prog}: error: {message}\n")

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """End the program with ``status``; if that is 0, with the code of a failure to print the help."""
        self.say(message or "", sys.stderr)
        sys.exit(status or on_root(self.comm, lambda: code_of("stdout", self.error_in_print)))


class ShowVersion(argparse.Action):
    """Print the version and end."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        """Print on rank 0; argparse's own action prints on every rank."""
        assert isinstance(parser, Parser)
        parser.say(f"vipetsc {vipetsc.__version__}\n", sys.stdout)
        parser.exit()


def main(arguments: list[str], petsc: Mapping[str, str] | None = None, comm: "MPI.Comm | None" = None) -> int:
    """Run the verb named in ``arguments`` on all ranks of ``comm``, by default all that there are.

    ``petsc`` are options for its case. Returns the exit code.
    """
    if comm is None:
        from mpi4py import MPI

        comm = MPI.COMM_WORLD
    has_verb = bool(arguments) and (arguments[0] in ABOUT_THE_PROGRAM or not arguments[0].startswith("-"))
    if not has_verb:
        arguments = ["run", *arguments]  # of the built-in case

    parser = _parser(called=arguments[0], comm=comm)
    try:
        " ".join(arguments).encode()
    except UnicodeEncodeError:
        parser.error("an argument is not text in UTF-8, which files of results could not hold; rename the file")
    if arguments[0] not in (*VERBS, *ABOUT_THE_PROGRAM):
        parser.error(_without_verb(arguments[0]))
    options = parser.parse_args(arguments)
    # --list asks for an answer, which --quiet does not silence.
    is_answer = VERBS[options.verb].is_answer or getattr(options, "list", False)
    try:
        with reporting(comm, options, is_answer) as outputs:
            code = _call(options, petsc or {}, comm)
            # Rank 0 prints for all, and all end with one code.
            lost = on_root(comm, lambda: [code_of(output.title, output.error) for output in outputs])
    except FolderError as error:
        # The file of --log cannot be written, so that nothing else is set up to report it.
        if comm.rank == 0:
            print(f"vipetsc: {error}", file=sys.stderr, flush=True)
        return BAD_INPUT

    return code or next(filter(None, lost), 0)


def _without_verb(word: str) -> str:
    """Return what is said of a first ``word`` that is not a verb."""
    if word.endswith(".toml"):
        return f"a verb comes before the case file: vipetsc run {word}"
    listed = f"the verbs are {', '.join(VERBS)}"
    near = nearest(word, VERBS)
    if near:
        return f"{word!r} is not a verb; did you mean {near}? ({listed})"
    return f"{word!r} is not a verb; {listed}"


def _call(options: argparse.Namespace, petsc: Mapping[str, str], comm: "MPI.Comm") -> int:
    """Call the verb on all ranks, listen for requests to stop, and report invalid input; returns the exit code."""
    verb = VERBS[options.verb]
    try:
        # Refused rather than ignored: a result is that of its case file, which would not name these options.
        if petsc and not verb.takes_petsc_options:
            raise CaseError([Problem(f"-{name}", None, f"{verb.name} does not accept PETSc options") for name in petsc])
        if petsc:
            options.set = [*options.set, *(f"petsc.{name}={value}" for name, value in petsc.items())]
        if getattr(options, "force", False) and getattr(options, "resume", False):
            raise FolderError("--force and --resume exclude each other: one starts again, the other continues")
        if getattr(options, "force", False) and getattr(options, "extend", False):
            raise FolderError("--force and --extend exclude each other: one starts again, the other goes on")

        # A verb that never looks at the request has nothing to save, and is ended by the signal at once.
        with StopRequest().listening() as stop, nullcontext() if verb.is_stoppable else stop.at_once():
            return int(verb.call(options, comm, stop))

    except ResultFileError as error:
        text = f"vipetsc: {error}"
        if is_of_file_system(error):
            echo(comm, f"{text}; after the cause is removed, the same command continues", sys.stderr)
            return FAILED
        if hasattr(options, "force"):
            text += "; move it away, or start again with --force"
        echo(comm, text, sys.stderr)
        return BAD_INPUT
    except (CaseError, FolderError, PartError) as error:
        # Every rank gets here: bad input is found on one rank and raised on all.
        echo(comm, f"vipetsc: {error}", sys.stderr)
        return BAD_INPUT
    except StudyError as error:
        echo(comm, f"vipetsc: {error}", sys.stderr)
        return FAILED
    except StoppedError as error:
        # A launcher also asks the other ranks to stop when one was killed. Then they do not all meet, and no message
        # claims that somebody asked for it.
        if all_meet(comm, PATIENCE):
            text = f"vipetsc: {error}"
            if getattr(options, "force", False):
                text += "; leave out --force, which would start again"
            echo(comm, text, sys.stderr)
        return STOPPED


def _parser(complete: Mapping[str, Any] | None = None, called: str | None = None, comm: "MPI.Comm" = ALONE) -> Parser:
    """Return the parser of all verbs.

    ``complete`` says how a shell completes arguments (values of ``shtab``), by the arguments' names or flags. If the
    verb that is ``called`` is known, it alone gets its arguments, since to declare those of all verbs takes longer than
    to parse a command. It prints on one rank of ``comm``.
    """
    parser = Parser(
        prog="vipetsc",
        description="Waves in phononic lattices with vibro-impacts. Without a verb, the built-in four-band case runs.",
        epilog="PETSc options follow --, as in: vipetsc run CASE -- -ts_rk_type 5dp -log_view",
    )
    parser.comm = comm
    parser.add_argument("--version", action=ShowVersion, nargs=0, help="show program's version number and exit")

    subparsers = parser.add_subparsers(dest="verb", required=True, metavar="VERB")
    for verb in VERBS.values():
        verb_parser = subparsers.add_parser(
            verb.name,
            help=verb.text,
            description=verb.text,
            epilog=f"example: vipetsc {verb.example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        verb_parser.comm = comm
        # The verb `completion` makes a parser of its own with this function, to describe it to a shell.
        verb_parser.set_defaults(parser=_parser)
        if called not in (None, verb.name):
            continue

        for flag, keywords in (*verb.arguments, *COMMON_ARGUMENTS):
            added = verb_parser.add_argument(flag, **keywords)
            if complete and flag in complete:
                added.complete = complete[flag]  # type: ignore[attr-defined]
    return parser
