"""Verbs on the program itself: chapters of the manual, the schema of case files, completion in a shell."""

import argparse
import itertools
import json
from typing import TYPE_CHECKING, Any

from vipetsc.case import CaseError, Problem
from vipetsc.cli.arguments import argument
from vipetsc.cli.chapters import chapter, contents, parts, studies
from vipetsc.cli.messages import echo
from vipetsc.cli.verb import DONE, PlainVerb
from vipetsc.io.extras import require
from vipetsc.parallel import StopRequest, on_root
from vipetsc.wording import nearest

if TYPE_CHECKING:
    from mpi4py import MPI


def manual(options: argparse.Namespace, comm: "MPI.Comm", stop: StopRequest) -> int:
    """Print a chapter of the manual in Markdown, or a list of them; raises CaseError for an unknown topic."""
    if options.topic is None:
        echo(comm, on_root(comm, contents))
        echo(comm, "vipetsc manual TOPIC prints one in Markdown; in a clone, scripts/manual makes pages for a browser")
        return DONE

    names = on_root(comm, lambda: [*itertools.chain(*parts().values()), *studies()])
    if options.topic not in names:
        remedy = "no such chapter; vipetsc manual lists them"
        near = nearest(options.topic, names)
        if near:
            remedy += f"; did you mean {near}?"
        raise CaseError([Problem("TOPIC", options.topic, remedy)], "manual")
    echo(comm, on_root(comm, lambda: chapter(options.topic)))
    return DONE


def schema(options: argparse.Namespace, comm: "MPI.Comm", stop: StopRequest) -> int:
    """Print the JSON schema of case files, with the names of laws and other parts that a case's [plugins] register."""
    echo(comm, on_root(comm, lambda: json.dumps(schema_of(options.case), indent=2)))
    return DONE


def schema_of(path: str | None) -> dict[str, Any]:
    """Return JSON schema of case files that name the same modules as the file ``path``, or none; raises CaseError."""
    from vipetsc.case.keys import json_schema
    from vipetsc.case.parts import module_names, with_sources
    from vipetsc.case.reading import read_toml

    given: dict[str, Any] = {}
    if path is not None:
        given = read_toml(path)
    table, problems = with_sources(given)
    if problems:
        raise CaseError(problems, str(path))
    return json_schema(module_names(table))


def completion(options: argparse.Namespace, comm: "MPI.Comm", stop: StopRequest) -> int:
    """Print a script by which the shell completes verbs, options and files."""
    require("shtab", "completion")
    import shtab

    # Kinds of completion by the names and flags of arguments, the same for all verbs.
    kinds = {"case": shtab.FILE, "path": shtab.FILE, "--out": shtab.DIRECTORY}
    echo(comm, on_root(comm, lambda: shtab.complete(options.parser(kinds), options.shell)))
    return DONE


MANUAL = PlainVerb(
    name="manual",
    text="print a chapter of the manual as plain text",
    example="manual case-file",
    arguments=(argument("topic", nargs="?", metavar="TOPIC", help="a chapter; default: list the chapters"),),
    function=manual,
    is_answer=True,
)

SCHEMA = PlainVerb(
    name="schema",
    text="print the JSON schema of case files, for editors",
    example="schema > vipetsc.schema.json",
    arguments=(
        argument("case", nargs="?", metavar="CASE", help="a case file, whose [plugins] register names that it may use"),
    ),
    function=schema,
    is_answer=True,
)

COMPLETION = PlainVerb(
    name="completion",
    text="print a script with which a shell completes verbs, options and files",
    example="completion bash > ~/.local/share/bash-completion/completions/vipetsc",
    arguments=(argument("shell", choices=("bash", "zsh"), help="the shell"),),
    function=completion,
    is_answer=True,
)
