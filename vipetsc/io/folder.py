"""Output folders: their claim by one command, and the provenance that every output carries.

Names that begin with a dot are not results: ``.lock`` while a command works in the folder, ``.new`` for results that
will replace the present ones, ``.*.part`` for a file being written. When new results are complete, they are swapped
with the old ones in three steps, and after a kill the next command goes on from the step that was reached: ``.new``
becomes ``.ready``; the old ones are moved to ``.replaced.old``, and ``.ready`` becomes ``.moving``; what is in
``.moving`` is moved to the folder itself.
"""

import os
import platform
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from textwrap import shorten
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import h5py
import numpy as np

import vipetsc
from vipetsc.io.atomic import discard, write_text
from vipetsc.io.lock import FolderError, locked, remove_temporary_files
from vipetsc.io.names import readable
from vipetsc.parallel import on_root

FORMAT_VERSION = 1
MOST_NAMED = 6  # keys of another case that a message names: more do not help to tell which case it is
NEW, READY, MOVING, OLD = ".new", ".ready", ".moving", ".replaced.old"

Difference = Callable[[str], str | None]
"""Takes the text of an earlier case; returns why its results are not the wanted ones, or None if they are."""


@dataclass(frozen=True)
class FolderKind:
    """Kind of a folder of results; patterns of names are those of ``Path.glob``.

    Attributes
    ----------
    noun
        What messages call one result.
    results
        Patterns of the files that show that a folder holds results of this kind.
    companions
        Patterns of the files that are replaced together with the results.
    marker
        Name of the file with the case of the results.
    free
        Section of the case that may change while the results stay valid; empty for none.
    """

    noun: str
    results: tuple[str, ...]
    companions: tuple[str, ...] = ("figures", "curves")
    marker: str = "case.toml"
    free: str = ""


RUN = FolderKind(
    noun="run",
    results=("run.h5", "parts"),
    companions=("summary.json", "analysis.h5", "run.xdmf", "curves", "figures"),
    free="analysis",
)
BRANCHES = FolderKind(noun="branch", results=("branch-*.h5",), companions=("branch-*.csv", "figures", "curves"))
SEARCH = FolderKind(noun="search", results=("design.h5",))
LAW = FolderKind(noun="law", results=("law.h5", "law-runs*.jsonl"))
SWEEP = FolderKind(
    noun="sweep",
    results=("index.json", "members*.jsonl"),
    # Every folder: members with fields, figures, curves, and others that are there (the manual says so).
    companions=("*/", "ensemble.h5", "backbone.h5"),
)
PREDICTION = FolderKind(noun="prediction", results=("prediction.h5", "prediction-runs*.jsonl"))
OPTIMUM = FolderKind(
    noun="optimum", results=("optimum.h5", "optimum-runs*.jsonl"), companions=("figures", "curves", "law", "best*.toml")
)
IDENTIFIED = FolderKind(
    noun="identification",
    results=("identified.h5", "identified-runs*.jsonl"),
    companions=("figures", "curves", "identified.toml"),
)
PAPER = FolderKind(noun="paper", results=("plan.json",), companions=(), marker="plan.json")
KINDS = (RUN, BRANCHES, SEARCH, LAW, PREDICTION, SWEEP, OPTIMUM, IDENTIFIED, PAPER)


class Claim:
    """The right to work in the output folder ``path``, for results of ``kind``, on all ranks of ``comm``.

    Results are written to ``folder``, which is ``path/.new`` if they are to replace others that stay until then, and
    ``path`` itself otherwise. ``going_on`` is whether ``folder`` holds earlier results of the same case.
    """

    def __init__(self, comm: MPI.Comm, path: Path, kind: FolderKind, folder: Path, going_on: bool) -> None:
        self.comm = comm
        self.path = path
        self.kind = kind
        self.folder = folder
        self.going_on = going_on

    def publish(self) -> None:
        """Replace earlier results by the new ones, which are complete; all ranks must call it."""

        def swap() -> None:
            # Results that an earlier swap has replaced, if a kill left any: new names must be free there.
            shutil.rmtree(self.path / OLD, ignore_errors=True)
            sys.audit("vipetsc.swap", str(self.path))
            # From this rename on the new results count: the next claim finishes a swap that a kill ends.
            os.replace(self.folder, self.path / READY)
            _finish_swap(self.path, self.kind)

        if self.folder != self.path:
            on_root(self.comm, swap)
            self.folder = self.path


@contextmanager
def claimed(
    comm: MPI.Comm,
    path: str | Path,
    kind: FolderKind,
    text: str,
    *,
    force: bool = False,
    resume: bool = False,
    difference: Difference | None = None,
) -> Iterator[Claim]:
    """Claim the folder ``path`` for results of ``kind``: start new results, or continue those of the same case.

    All ranks must call it. A missing folder is created; leftovers of a killed command are removed, and a swap that it
    began is finished.

    Parameters
    ----------
    text
        The resolved case, which is stored in the folder.
    force
        Start again: earlier results, perhaps of another case, stay until the new ones are published. The next call
        without ``force`` continues the new ones.
    resume
        Only continue existing results.
    difference
        What makes results those of another case; by default any key that changed, but for the section that is free.

    Raises
    ------
    FolderError
        If the path is a file, another process works in it, it holds files that are no results of ``kind``, or results
        of another case without ``force``, or there is nothing to ``resume``.
    """
    path = Path(path)
    with locked(comm, path):
        folder, going_on = on_root(comm, lambda: _claim(path, kind, text, force, resume, difference))
        yield Claim(comm, path, kind, folder, going_on)


def _claim(
    path: Path, kind: FolderKind, text: str, force: bool, resume: bool, difference: Difference | None
) -> tuple[Path, bool]:
    """The folder to work in, and whether it holds results of the same case; see ``claimed``."""
    sys.audit("vipetsc.claim", str(path))

    # A swap that was cut off is finished first, unless the results are another verb's.
    foreign = _holds_another_kind(path, kind)
    if not foreign:
        _finish_swap(path, kind)
    # An empty folder is no result.
    filled = any(not entry.is_dir() or _results(entry) for entry in _results(path))
    if foreign or (filled and not (path / kind.marker).exists()):
        raise FolderError(f"{path}: contains files that are not a {kind.noun}'s of this kind; choose another --out")
    if resume and not filled:
        raise FolderError(f"{path}: contains no {kind.noun} to resume; omit --resume")

    aside = path / NEW
    going_on = filled and not force
    if going_on:
        # Results begun with --force are continued if they are of this case, else those that they were to replace.
        folder = path
        if (aside / kind.marker).exists() and not _problem(aside, kind, text, difference):
            folder = aside
        problem = _problem(folder, kind, text, difference)
        if problem:
            raise FolderError(f"{path}: {problem}")
    else:
        discard(aside)
        folder = path
        if filled:
            # Until the new results are complete, the old ones stay where they are.
            folder = aside
        folder.mkdir(exist_ok=True)

    # Keys that leave continued results valid may have changed: the text is then replaced by the present one.
    if not going_on or _text_of(folder / kind.marker) != text:
        write_text(folder / kind.marker, text)
    remove_temporary_files(folder)
    return folder, going_on


def _holds_another_kind(path: Path, kind: FolderKind) -> bool:
    """Whether ``path`` holds results of a kind other than ``kind``, published or in a swap."""
    patterns = [pattern for other in KINDS if other is not kind for pattern in other.results]
    matches = [folder.glob(pattern) for folder in (path, path / READY, path / MOVING) for pattern in patterns]
    return any(any(files) for files in matches)


def _results(folder: Path) -> list[Path]:
    """The files and folders in ``folder`` whose names do not begin with a dot."""
    return [entry for entry in folder.iterdir() if not entry.name.startswith(".")]


def _problem(folder: Path, kind: FolderKind, text: str, difference: Difference | None) -> str | None:
    """Message why the results in ``folder`` are not results of ``text``; None if they are."""
    earlier = _text_of(folder / kind.marker)
    if difference:
        return difference(earlier)
    if earlier == text:
        return None

    remedy = "replace it with --force, or choose another folder with --out"
    try:
        # Key by key: a reader cannot see in two files of a hundred lines which one has changed.
        then = dict(_keys(tomllib.loads(earlier)))
        now = dict(_keys(tomllib.loads(text)))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        return f"its {kind.marker} cannot be read ({error}); {remedy}"

    differing = []
    for key in then | now:
        if then.get(key) != now.get(key) and key.partition(".")[0] != kind.free:
            values = [_shown(case.get(key, "nothing")) for case in (then, now)]
            differing.append(f"{key} = {values[0]} there, {values[1]} here")
    if not differing:
        return None

    shown = "; ".join(differing[:MOST_NAMED])
    if len(differing) > MOST_NAMED:
        shown += f"; and {len(differing) - MOST_NAMED} more"
    return f"contains another {kind.noun}: {shown}; {remedy}"


def _shown(value: Any) -> str:
    """A value as a message shows it; of one long word, such as a hash, its beginning."""
    text = str(value)
    if len(text) > 60 and " " not in text:
        return f"{text[:16]}..."
    return shorten(text, 60)


def _text_of(path: Path) -> str:
    """The text of a file; where another program damaged it, bytes that are no UTF-8 become replacement characters."""
    return path.read_text(encoding="utf-8", errors="replace")


def _keys(table: dict[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """The keys of a case with their sections, and their values."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _keys(value, f"{path}{key}.")
        else:
            yield path + key, value


def _finish_swap(path: Path, kind: FolderKind) -> None:
    """Finish a swap from the step at which a kill ended it, if one was begun; remove results that were replaced."""
    ready = path / READY
    moving = path / MOVING
    old = path / OLD
    # Earlier results are moved first, and ``ready`` becomes ``moving`` when all of them are gone. A kill before that
    # leaves earlier results in ``path``, which are still to be moved; a kill after it leaves new ones, which must stay.
    if ready.is_dir():
        old.mkdir(exist_ok=True)
        for pattern in (kind.marker, *kind.results, *kind.companions):
            for entry in list(path.glob(pattern)):
                if not entry.name.startswith("."):
                    os.replace(entry, old / entry.name)
        os.replace(ready, moving)

    if moving.is_dir():
        for entry in moving.iterdir():
            os.replace(entry, path / entry.name)
        moving.rmdir()
    for leftover in path.glob(".*.old"):
        shutil.rmtree(leftover, ignore_errors=True)


def provenance(comm: MPI.Comm) -> dict[str, Any]:
    """Record of versions, date, host, command and number of ranks, as attributes that every output carries.

    Two runs of one command differ in it.
    """
    return origin() | {"ranks": comm.size}


def origin() -> dict[str, Any]:
    """The record of ``provenance`` without the ranks, for results that one rank computes alone.

    ``petsc_options`` are those of PETSc's database, given on the command line; those of a case are in the case's text.
    """
    options = PETSc.Options().getAll()
    given = " ".join(f"-{name} {value}".strip() for name, value in sorted(options.items()))

    return {
        "format_version": FORMAT_VERSION,
        "vipetsc_version": vipetsc.__version__,
        "revision": revision(),
        "petsc_version": ".".join(map(str, PETSc.Sys.getVersion())),
        "mpi_version": MPI.Get_library_version().split(",")[0].strip(),
        "hdf5_version": h5py.version.hdf5_version,
        "numpy_version": np.__version__,
        "python_version": platform.python_version(),
        "command": " ".join(["vipetsc", *map(readable, sys.argv[1:])]),
        "petsc_options": given or "none",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": platform.node(),
    }


@cache
def revision() -> str:
    """The commit of the package's sources by git, with a "+" if they were changed since; else "none"."""
    root = Path(vipetsc.__file__).parents[1]
    # An installed package may lie in a repository that is not its own.
    if not ((root / ".git").exists() and (root / "pyproject.toml").exists()):
        return "none"
    command = ["git", "-C", str(root), "describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*"]
    try:
        described = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return "none"
    return described.stdout.strip()
