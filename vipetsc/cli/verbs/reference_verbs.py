"""Verbs on the program itself: chapters of the manual, the schema of case files, completion in a shell."""

import argparse
import json
import re
from importlib.resources import files

from mpi4py import MPI

from vipetsc.case import CaseError, Problem
from vipetsc.cli.arguments import argument
from vipetsc.cli.messages import echo
from vipetsc.cli.verb import DONE, PlainVerb
from vipetsc.parallel import StopRequest, on_root

KEYS = "case-keys"  # the chapter that is written from the schema


def chapters(index: str = "index") -> dict[str, str]:
    """Names and titles of the manual's chapters, or of the pages that another ``index`` than its own leads to."""
    names = re.findall(r"\]\((\S+)\.md\)", chapter(index))
    if index == "index":
        # No file holds this chapter, and no index names it.
        names.append(KEYS)
    return {name: chapter(name).partition("\n")[0].removeprefix("# ") for name in sorted(names)}


def chapter(name: str) -> str:
    """The text of a chapter; the one of all keys is written from their schema."""
    if name == KEYS:
        from vipetsc.case.keys import chapter as all_keys

        return all_keys()
    return (files("vipetsc") / "manual" / f"{name}.md").read_text(encoding="utf-8")


def manual(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """Print a chapter of the manual as plain text, or a list of them."""
    titles, studies = on_root(comm, lambda: (chapters(), chapters("gallery")))
    if options.topic is None:
        width = max(map(len, titles))
        echo(comm, "\n".join(f"  {name:<{width}}  {title}" for name, title in titles.items()))
        echo(comm, "vipetsc manual TOPIC shows one")
    elif options.topic in titles | studies:
        echo(comm, on_root(comm, lambda: plain(chapter(options.topic))))
    else:
        names = ", ".join(titles | studies)
        raise CaseError([Problem("TOPIC", options.topic, f"no chapter; there are {names}")], "manual")
    return DONE


def plain(text: str) -> str:
    """Markdown for a terminal: links and pictures by their words, tables in columns."""
    # Pictures before links, whose pattern matches those too.
    text = re.sub(r"!\[([^\]]*)\]\([^)]*\)", r"[picture: \1]", text)
    text = re.sub(r"\[([^\]]+)\]\((?!http)(?:\.\./)?(\w[\w/-]*)\.md\)", r"\1 (manual \2)", text)
    return re.sub(r"(?m)(^\|.*\n)+", lambda rows: _columns(rows[0]), text)


def _columns(rows: str) -> str:
    """The rows of a table in columns of equal width; the last one is free."""
    # An escaped bar is text of a cell.
    cells = [[cell.strip() for cell in re.split(r"(?<!\\)\|", row.strip("|"))] for row in rows.splitlines()]
    cells = [row for row in cells if not all(re.fullmatch(r":?-+:?", cell) for cell in row)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(cells[0]) - 1)]

    lines = []
    for row in cells:
        # Not strict: the last column has no width.
        padded = [f"{cell:<{width}}" for cell, width in zip(row, widths, strict=False)]
        lines.append("  ".join([*padded, row[-1]]).rstrip())
    return "\n".join(lines) + "\n"


def schema(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """Print the JSON schema of case files."""
    from vipetsc.case.keys import json_schema

    echo(comm, on_root(comm, lambda: json.dumps(json_schema(), indent=2)))
    return DONE


def completion(options: argparse.Namespace, comm: MPI.Comm, stop: StopRequest) -> int:
    """Print a script by which the shell completes verbs, options and files."""
    import shtab

    # By the names and flags of arguments, whichever verb takes them.
    kinds = {"case": shtab.FILE, "path": shtab.FILE, "--out": shtab.DIRECTORY}
    echo(comm, on_root(comm, lambda: shtab.complete(options.parser(kinds), options.shell)))
    return DONE


MANUAL = PlainVerb(
    name="manual",
    text="a chapter of the manual, as plain text",
    example="manual case-file",
    arguments=(argument("topic", nargs="?", metavar="TOPIC", help="a chapter; a list of them if left out"),),
    function=manual,
    is_answer=True,
)

SCHEMA = PlainVerb(
    name="schema",
    text="the JSON schema of case files, for editors",
    example="schema > vipetsc.schema.json",
    function=schema,
    is_answer=True,
)

COMPLETION = PlainVerb(
    name="completion",
    text="what a shell needs to complete verbs, options and files",
    example="completion bash > ~/.local/share/bash-completion/completions/vipetsc",
    arguments=(argument("shell", choices=("bash", "zsh"), help="the shell whose completions are printed"),),
    function=completion,
    is_answer=True,
)
