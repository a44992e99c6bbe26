"""Records of verbs, from which the parser, completion, checks and tests take their lists.

A ``PlainVerb`` is a function. A ``StudyVerb`` computes results of a case into a folder. All verbs of this kind run in
the same frame: the case is read, its PETSc options are checked, its warnings are printed, the folder is locked, the
study computes, the pictures are drawn, and the exit code says how the study ended.
"""

import argparse
import os
import re
import sys
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vipetsc.case import CaseFile
from vipetsc.cli.arguments import Argument
from vipetsc.cli.drawing import Pictures, draw_pictures
from vipetsc.cli.messages import echo, echo_paths, echo_warnings
from vipetsc.io.kinds import ResultKind
from vipetsc.io.lock import locked
from vipetsc.parallel import StopRequest, on_every_rank, on_root

if TYPE_CHECKING:
    from mpi4py import MPI

    import xarray as xr

# Exit codes.
DONE = 0
FAILED = 1
BAD_INPUT = 2  # as argparse exits for wrong arguments
STOPPED = os.EX_TEMPFAIL  # asks a batch script to queue the job again

Rows = list[tuple[str, str]]
Function = Callable[[argparse.Namespace, "MPI.Comm", StopRequest], int]


@dataclass(frozen=True, kw_only=True)
class Verb(ABC):
    """A verb of the command line.

    ``text`` is its line in the help, ``example`` a call that the help shows, without the program's name. ``results``
    is the kind of its folder, for verbs that write results and can continue them. A verb that ``is_stoppable`` saves
    its state on a request to stop; other verbs end at once. The output of a verb that ``is_answer`` is what the user
    asked for, and is printed even with ``--quiet``. A verb that ``takes_petsc_options`` puts PETSc options on the
    command line into its case.
    """

    name: str
    text: str
    example: str
    arguments: tuple[Argument, ...] = ()
    results: ResultKind | None = None
    is_stoppable: bool = False
    is_answer: bool = False
    takes_petsc_options: bool = False

    @abstractmethod
    def call(self, options: argparse.Namespace, comm: "MPI.Comm", stop: StopRequest) -> int:
        """Do what ``options`` ask for; returns the exit code. All ranks must call it."""


@dataclass(frozen=True, kw_only=True)
class PlainVerb(Verb):
    """A verb that is a ``function`` of the parsed options, the ranks and a request to stop."""

    function: Function

    def call(self, options: argparse.Namespace, comm: "MPI.Comm", stop: StopRequest) -> int:
        """Call the function; returns its exit code."""
        return self.function(options, comm, stop)


@dataclass
class Work:
    """Arguments of a study besides its case: the parsed ``options``, the ``folder`` of its results, the ranks ``comm``.

    ``stop`` is a request to stop, which the study looks at. ``warned`` are the warnings that were printed.
    """

    options: argparse.Namespace
    folder: Path
    comm: "MPI.Comm"
    stop: StopRequest
    warned: list[str] = field(default_factory=list)

    @property
    def keywords(self) -> dict[str, Any]:
        """The keywords that every study takes: ``force``, ``resume``, ``stop``, ``progress``."""
        asked = {"force": self.options.force, "resume": self.options.resume}
        return asked | {"stop": self.stop, "progress": True}

    def report(self, text: str) -> None:
        """Print ``text`` on rank 0, as an answer."""
        echo(self.comm, text)

    def warn(self, sentences: Iterable[str]) -> None:
        """Print those ``sentences`` on rank 0, as warnings, that were not printed before."""
        new = [sentence for sentence in dict.fromkeys(sentences) if sentence not in self.warned]
        echo_warnings(self.comm, new)
        self.warned += new


@dataclass(frozen=True)
class Outcome:
    """The ending of a study, the same on all ranks.

    ``complete`` says that all requested results exist, ``drawable`` that the folder has results that can be drawn.
    ``failures`` name missing results, each with the reason, and are printed last.
    """

    complete: bool = True
    drawable: bool = True
    failures: Sequence[str] = ()


def study_of(name: str, shown: Callable[[Any], str]) -> Callable[[Any, Work], Outcome]:
    """Return ``study`` of a verb that calls the function called ``name``, as "module:function", and prints its result.

    ``shown`` gives the text of the result. The module is imported when the verb is called: most calls are of others.
    """

    def study(case: Any, work: Work) -> Outcome:
        module, _, function = name.partition(":")
        result = getattr(import_module(module), function)(case, work.folder, work.comm, **work.keywords)
        work.report(shown(result))
        return Outcome()

    return study


def summary(data: "xr.Dataset") -> str:
    """Return the table of results that a study keeps in its file."""
    return str(data.attrs["summary"])


def default_folder(name: str, verb: str) -> Path:
    """Return the output folder of a ``verb`` for a case of that ``name``: one file may have sections of several verbs.

    It is ``runs/NAME`` of a run, ``runs/NAME-VERB`` of every other verb unless a word of the name is the verb, as in
    "nnm-hertz".
    """
    if verb == "run" or verb in re.split(r"[\W_]+", name):
        return Path("runs") / name
    return Path("runs") / f"{name}-{verb}"


@dataclass(frozen=True, kw_only=True)
class StudyVerb(Verb):
    """A verb that computes results of a ``case`` into a folder.

    ``study`` computes, prints the results, and returns how it ended; all ranks call it. ``table`` gives the rows that
    ``validate`` prints of a case on a number of ranks. ``pictures`` are drawn of the results, if there are any.
    ``load`` reads the case from the parsed options, for a verb whose case depends on more than ``CASE`` and ``--set``.
    """

    case: type[CaseFile]
    study: Callable[[Any, Work], Outcome]
    table: Callable[[Any, int], Rows]
    results: ResultKind
    pictures: Pictures | None = None
    load: Callable[[argparse.Namespace], CaseFile] | None = None
    is_stoppable: bool = True

    def call(self, options: argparse.Namespace, comm: "MPI.Comm", stop: StopRequest) -> int:
        """Compute, draw and report; returns the exit code."""
        # The case is read before anything is written: one that is refused leaves no folder behind.
        case = on_root(comm, lambda: self.checked_case(options))
        # One rank has read the case, and has imported the modules that it names; the others do now.
        on_every_rank(comm, case.import_plugins)

        folder = options.out or default_folder(case.name, self.name)
        work = Work(options, folder, comm, stop)
        # Computed on rank 0 alone: warnings need the bands of the cell, which take a moment.
        work.warn(on_root(comm, case.warnings))

        outcome = self.compute_and_draw(case, work)

        # Last, where a user sees them, and on stderr, so that --quiet does not silence them.
        for failure in outcome.failures:
            echo(comm, f"vipetsc: {failure}", sys.stderr)
        return DONE if outcome.complete and not outcome.failures else FAILED

    def compute_and_draw(self, case: CaseFile, work: Work) -> Outcome:
        """Compute the results of the case and draw their pictures; all ranks of ``work`` must call it."""
        folder = work.folder
        comm = work.comm
        # A study locks its folder too, as the same process may; this lock lasts until the pictures are drawn.
        with locked(comm, folder):
            outcome = self.study(case, work)
            # After a request to stop nothing is drawn: what was computed is saved, and the next command draws it.
            work.stop.check(comm)
            if self.pictures and case.wants_pictures and outcome.drawable:
                with work.stop.at_once():
                    drawn = draw_pictures(self.pictures, [folder], comm, afresh=False)
                echo_paths(comm, drawn)
        return outcome

    def checked_case(self, options: argparse.Namespace) -> CaseFile:
        """Read the case, on one rank; raises CaseError, also for PETSc options that time stepping does not know."""
        # Imported here: verbs such as `manual` and `schema` need neither PETSc nor compiled kernels.
        from vipetsc.dynamics.plan import check_petsc_options

        case = self.load(options) if self.load else self.case.load(options.case, options.set)
        for run in case.runs():
            check_petsc_options(run)
        return case
