"""Verbs on the program itself: chapters of the manual, the schema of case files, completion in a shell."""

import argparse
import itertools
import json
import re
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from vipetsc.case import CaseError, Problem, keys
from vipetsc.cli.arguments import argument
from vipetsc.cli.messages import echo
from vipetsc.cli.verb import DONE, PlainVerb
from vipetsc.io.extras import require
from vipetsc.parallel import StopRequest, on_root
from vipetsc.wording import nearest

if TYPE_CHECKING:
    from mpi4py import MPI
# The chapter that no file holds: it is made from the schema of case files.
KEYS = "case-keys"


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
    """Print a script by which the shell completes verbs, options, files, topics, examples, figures and keys."""
    require("shtab", "completion")
    echo(comm, on_root(comm, lambda: _completion_script(options)))
    return DONE


def _completion_script(options: argparse.Namespace) -> str:
    """Return the script of ``options.shell``; its lists of proposals are those of this version."""
    import shtab

    from vipetsc.case.keys import key_paths
    from vipetsc.cli.verbs.examples_verb import shipped_examples
    from vipetsc.figures.registry import FIGURES

    # Kinds of completion by the names and flags of arguments, the same for all verbs.
    kinds: dict[str, Any] = {"case": shtab.FILE, "path": shtab.FILE, "--out": shtab.DIRECTORY}
    proposals = {
        "topic": [*itertools.chain(*parts().values()), *studies()],
        "name": [*shipped_examples()],
        "--fig": [*FIGURES],
        "--set": key_paths(),
    }
    functions: dict[str, list[str]] = {"bash": [], "zsh": []}
    for argument_name, listed in proposals.items():
        function = f"_vipetsc_{argument_name.strip('-')}_words"
        kinds[argument_name] = dict.fromkeys(functions, function)
        functions["bash"].append(f"{function}() {{ compgen -W '{' '.join(listed)}' -- \"$1\"; }}")
        functions["zsh"].append(f"{function}() {{ compadd -- {' '.join(listed)}; }}")
    preamble = "\n".join(functions[options.shell])
    return str(shtab.complete(options.parser(kinds), options.shell, preamble=preamble))


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
    text="print a script with which a shell completes verbs, options, files and names",
    example="completion bash > ~/.local/share/bash-completion/completions/vipetsc",
    arguments=(argument("shell", choices=("bash", "zsh"), help="the shell"),),
    function=completion,
    is_answer=True,
)


def parts() -> dict[str, list[str]]:
    """Return the names of the manual's chapters by the title of their part, as its index lists them."""
    sections = re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", chapter("index"), flags=re.M | re.S)
    listed = {title: re.findall(r"^\| \[[^]]*\]\(([\w-]+)\.md\)", text, flags=re.M) for title, text in sections}
    # The index has no link to the chapter without a file.
    listed["Reference"].append(KEYS)
    return {title: names for title, names in listed.items() if names}


def studies() -> list[str]:
    """Return names of the gallery's pages."""
    return re.findall(r"\]\((gallery/\S+)\.md\)", chapter("gallery"))


def chapter(name: str) -> str:
    """Return the Markdown of the chapter ``name``, from its file or from the schema."""
    if name == KEYS:
        return keys.chapter()
    return (files("vipetsc") / "manual" / f"{name}.md").read_text(encoding="utf-8")


def title(name: str) -> str:
    """Return the title of the chapter ``name``."""
    return chapter(name).partition("\n")[0].removeprefix("# ")


def contents() -> str:
    """Return names and titles of the chapters, part by part, as lines of text."""
    listed = parts()
    width = max(map(len, itertools.chain(*listed.values())))
    lines = []
    for part, names in listed.items():
        lines.append(part)
        for name in names:
            lines.append(f"  {name:<{width}}  {title(name)}")
    return "\n".join(lines)
