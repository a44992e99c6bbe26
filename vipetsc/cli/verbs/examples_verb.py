"""The verb ``examples``: the case files that come with the program, listed and copied."""

import argparse
import difflib
import tomllib
from collections.abc import Iterable
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vipetsc.case import CaseError, Problem
from vipetsc.case.parts import relative_modules
from vipetsc.case.reading import relative_names
from vipetsc.cli.arguments import argument
from vipetsc.cli.messages import echo, echo_paths
from vipetsc.cli.verb import DONE, PlainVerb
from vipetsc.io.atomic import atomic_write
from vipetsc.io.folder import FolderError
from vipetsc.io.lock import locked
from vipetsc.parallel import ALONE, StopRequest, on_root

if TYPE_CHECKING:
    from mpi4py import MPI

FOLDER = Path(str(files("vipetsc") / "examples"))


class Example(NamedTuple):
    """A case file of the package: the ``sentence`` in its first line, and the ``verbs`` that it has sections for.

    The ``name`` is its path in the folder of examples, without ``.toml``.
    """

    name: str
    sentence: str
    verbs: list[str]


def examples(options: argparse.Namespace, comm: "MPI.Comm", stop: StopRequest) -> int:
    """Print a list of the case files of the package, or copy those that are named."""
    shipped = on_root(comm, shipped_examples)
    if not (options.name or options.all or options.out or options.force):
        echo(comm, _listed(shipped.values()))
        echo(comm, "vipetsc examples NAME copies a case file, with the files that it names, into the current folder")
        return DONE

    names = options.name
    if options.all:
        names = list(shipped)
    chosen = on_root(comm, lambda: _chosen(shipped, names))
    echo_paths(comm, on_root(comm, lambda: copy_examples(chosen, options.out or Path(), force=options.force)))
    return DONE


def shipped_examples() -> dict[str, Example]:
    """Return the case files of the package by their names."""
    # Imported here: the classes of cases take a second to load, and the parser, which loads this module, needs none.
    from vipetsc.case.verb_cases import verbs_of

    shipped = {}
    # The files of the folder itself come before those of the gallery in it.
    for path in (*sorted(FOLDER.glob("*.toml")), *sorted(FOLDER.glob("*/*.toml"))):
        name = path.relative_to(FOLDER).with_suffix("").as_posix()
        first_line, _, _ = path.read_text(encoding="utf-8").partition("\n")
        shipped[name] = Example(name, first_line.removeprefix("# "), verbs_of(path))
    return shipped


def _listed(shipped: Iterable[Example]) -> str:
    """Return the ``shipped`` case files as lines of name, verbs and sentence."""
    rows = [(one.name, ", ".join(one.verbs), one.sentence) for one in shipped]
    name_width = max(len(name) for name, _, _ in rows)
    verb_width = max(len(verbs) for _, verbs, _ in rows)
    return "\n".join(f"  {name:<{name_width}}  {verbs:<{verb_width}}  {text}" for name, verbs, text in rows)


def _chosen(shipped: dict[str, Example], names: list[str]) -> list[Example]:
    """Return the examples with these ``names``, with or without ``.toml``; raises CaseError for others."""
    problems = []
    if not names:
        problems.append(Problem("NAME", None, "name the case files to copy, or take --all"))

    chosen = []
    for name in names:
        stem = name.removesuffix(".toml")
        if stem in shipped:
            chosen.append(shipped[stem])
            continue
        remedy = "`vipetsc examples` lists them"
        near = difflib.get_close_matches(stem, shipped, n=3, cutoff=0.6)
        if near:
            remedy = f"did you mean {' or '.join(near)}?"
        problems.append(Problem("NAME", name, f"no such case file; {remedy}"))
    if problems:
        raise CaseError(problems, "examples")
    return chosen


def copy_examples(chosen: Iterable[Example], folder: Path, *, force: bool = False) -> list[Path]:
    """Copy case files, and the data files and modules that they read, into ``folder``; on one rank.

    Returns the copies. Raises FolderError, with nothing written, where another file of the name is in the folder and
    ``force`` is not given, and where ``folder`` is a file.
    """
    contents: dict[Path, bytes] = {}
    for example in chosen:
        case_file = FOLDER / f"{example.name}.toml"
        table = tomllib.loads(case_file.read_text(encoding="utf-8"))
        needed = [*relative_names(table), *relative_modules(table)]
        for path in (case_file, *(case_file.parent / name for name in needed)):
            # A file that is not there is the result of another command, as a branch from whose motion a run begins.
            if path.exists():
                contents[folder / path.relative_to(FOLDER)] = path.read_bytes()

    # A file with the same content is a copy already, and loses nothing.
    others = [path for path, content in contents.items() if path.exists() and not _holds(path, content)]
    if others and not force:
        raise FolderError(f"{', '.join(map(str, others))}: exists and differs; --force replaces it")
    # This rank alone is here: with the ranks' communicator the lock would wait for all of them.
    with locked(ALONE, *{path.parent for path in contents}):
        for path, content in contents.items():
            with atomic_write(path) as aside:
                aside.write_bytes(content)
    return list(contents)


def _holds(path: Path, content: bytes) -> bool:
    """Return whether ``path`` is a file with this ``content``."""
    return path.is_file() and path.read_bytes() == content


VERB = PlainVerb(
    name="examples",
    text="the case files that come with the program: a list of them, or copies",
    example="examples three-mass --out my-cases",
    arguments=(
        argument("name", nargs="*", metavar="NAME", help="case files to copy; a list of all if left out"),
        argument("--all", action="store_true", help="copy all of them"),
        argument("--out", type=Path, metavar="DIR", help="folder of the copies; the current one if left out"),
        argument("--force", action="store_true", help="replace files of these names in the folder"),
    ),
    function=examples,
    is_answer=True,
)
