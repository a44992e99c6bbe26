"""Output folders: their claim by one command, and the provenance that every output carries.

Names that begin with a dot are not results: ``.lock`` while a command works in the folder, ``.*.part`` for a file being
written. ``--force`` moves earlier results of the folder NAME to NAME.old, beside it. They are removed when the new ones
are complete, and stay if the command dies before.
"""

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
from typing import TYPE_CHECKING, Any

import numpy as np

import vipetsc
from vipetsc.io.atomic import discard, write_text
from vipetsc.io.kinds import KINDS, ResultKind
from vipetsc.io.lock import FolderError, locked, remove_temporary_files
from vipetsc.parallel import on_root
from vipetsc.plugins import without_folders
from vipetsc.process import say
from vipetsc.sources import source_key

if TYPE_CHECKING:
    from mpi4py import MPI

MOST_NAMED = 6  # keys of another case that a message names: more do not help to tell which case it is
# The file in NAME.old by which it is known as a folder of earlier results, and not one of the user's.
REPLACED = ".replaced"
# What verbs leave beside the results themselves in a folder of any kind, as patterns of ``Path.glob``.
ACCOMPANYING = (
    "figures", "curves", "law", "summary.json", "end-state", "analysis.h5", "run.xdmf", "branch-*.csv", "backbone.h5",
    "best*.toml", "identified.toml",
)  # fmt: skip

Difference = Callable[[str], str | None]
"""Takes the text of an earlier case; returns why its results are not the wanted ones, or None if they are."""
Obstacle = Callable[[Any, Any], str | None]
"""Takes what ``ResultKind.grows`` was and is; returns why results cannot go on from their end, or None if they can."""


@dataclass(frozen=True)
class Claim:
    """The right to work in the output folder ``folder``, on all ranks of ``comm``.

    ``going_on`` is whether it holds earlier results of the same case.
    """

    comm: "MPI.Comm"
    folder: Path
    going_on: bool

    def publish(self) -> None:
        """Remove earlier results that ``--force`` has set aside, since the new ones are complete. Collective."""

        def remove() -> None:
            sys.audit("vipetsc.publish", str(self.folder))
            old = set_aside_in(self.folder)
            if (old / REPLACED).exists():
                discard(old)

        on_root(self.comm, remove)


def set_aside_in(folder: Path) -> Path:
    """Return the folder to which ``--force`` moves the earlier results of ``folder``."""
    folder = folder.resolve()
    return folder.with_name(f"{folder.name}.old")


@contextmanager
def claimed(
    comm: "MPI.Comm",
    path: str | Path,
    kind: ResultKind,
    text: str,
    *,
    force: bool = False,
    resume: bool = False,
    difference: Difference | None = None,
    extend: Obstacle | None = None,
) -> Iterator[Claim]:
    """Claim the folder ``path`` for results of ``kind``: start new results, or continue those of the same case.

    All ranks must call it. A missing folder is created; leftovers of a killed command are removed.

    Parameters
    ----------
    text
        The resolved case, which is stored in the folder.
    force
        Start again: earlier results, perhaps of another case, are moved to the folder NAME.old until the new ones are
        published. The next call without ``force`` continues the new ones.
    resume
        Only continue existing results.
    difference
        What makes results those of another case; by default any key that changed, but for the section that is free.
    extend
        Go on with existing results, unless there is an obstacle, though the key of ``kind`` that grows is larger.

    Raises
    ------
    FolderError
        If the path is a file, another process works in it, it holds files that are no results of ``kind``, or results
        of another case without ``force``, or there is nothing to ``resume`` or to ``extend``.
    """
    path = Path(path)
    with locked(comm, path):
        going_on = on_root(comm, lambda: _claim(path, kind, text, force, resume, difference, extend))
        yield Claim(comm, path, going_on)


def _claim(
    path: Path,
    kind: ResultKind,
    text: str,
    force: bool,
    resume: bool,
    difference: Difference | None,
    extend: Obstacle | None,
) -> bool:
    """Prepare the folder ``path``; returns whether it holds results of the same case. See ``claimed``."""
    sys.audit("vipetsc.claim", str(path))

    # An empty folder is no result.
    filled = any(not entry.is_dir() or _results(entry) for entry in _results(path))
    if _holds_another_kind(path, kind) or (filled and not (path / kind.marker).exists()):
        others = [other.noun for other in KINDS if other != kind and other.is_in(path)]
        content = f"results of the kind {others[0]}" if others else "other files"
        raise FolderError(f"{path}: contains {content}; choose another --out for results of the kind {kind.noun}")
    if resume and not filled:
        raise FolderError(f"{path}: contains no {kind.noun} to resume; leave out --resume")
    if extend and not filled:
        raise FolderError(f"{path}: contains no {kind.noun} to extend; leave out --extend")

    going_on = filled and not force
    if going_on:
        problem = _problem(path, kind, text, difference, extend)
        old = set_aside_in(path)
        if problem and (old / REPLACED).exists():
            problem += f"; the results that it was to replace are in {old}"
        if problem:
            raise FolderError(f"{path}: {problem}")
    elif filled:
        _set_aside(path, kind)

    # Keys that leave continued results valid may have changed: the text is then replaced by the present one.
    if not going_on or _text_of(path / kind.marker) != text:
        write_text(path / kind.marker, text)
    remove_temporary_files(path)
    for leftover in path.glob(".*.old"):
        shutil.rmtree(leftover, ignore_errors=True)
    return going_on


def _set_aside(path: Path, kind: ResultKind) -> None:
    """Move the results in ``path`` to NAME.old, or remove them if results that are complete are there already."""
    old = set_aside_in(path)
    if old.exists() and not (old / REPLACED).exists() and (not old.is_dir() or any(old.iterdir())):
        remedy = "rename or remove it"
        raise FolderError(f"{old}: is in the way, since --force keeps earlier results there until it is done; {remedy}")
    sys.audit("vipetsc.aside", str(path))
    old.mkdir(exist_ok=True)
    (old / REPLACED).touch()

    patterns = [*kind.results, *ACCOMPANYING]
    if kind.has_folders:
        patterns.append("*/")
    entries = {entry for pattern in patterns for entry in path.glob(pattern) if not entry.name.startswith(".")}

    # The marker is moved last: where it is there, an earlier ``--force`` has moved all results, and did not come to its
    # end. What it has left is not complete, and goes.
    is_unfinished = (old / kind.marker).exists()
    for entry in (*sorted(entries), path / kind.marker):
        if not is_unfinished:
            shutil.move(entry, old / entry.name)
        elif entry.is_dir() and not entry.is_symlink():
            shutil.rmtree(entry)
        else:
            entry.unlink()
    say(f"earlier results stay in {old} until the new ones are complete")


def _holds_another_kind(path: Path, kind: ResultKind) -> bool:
    """Return whether ``path`` holds results of a kind other than ``kind``."""
    return any(other.is_in(path) for other in KINDS if other != kind)


def _results(folder: Path) -> list[Path]:
    """Return the files and folders in ``folder`` whose names do not begin with a dot."""
    return [entry for entry in folder.iterdir() if not entry.name.startswith(".")]


def _problem(
    folder: Path, kind: ResultKind, text: str, difference: Difference | None, extend: Obstacle | None
) -> str | None:
    """Return the message why the results in ``folder`` are not results of ``text``; None if they are."""
    earlier = _text_of(folder / kind.marker)
    if difference:
        return difference(earlier)
    if earlier == text:
        return None

    remedy = "replace it with --force, or choose another folder with --out"
    try:
        # Key by key: a reader cannot see in two files of a hundred lines which one has changed.
        then = dict(_keys(without_folders(tomllib.loads(earlier))))
        now = dict(_keys(without_folders(tomllib.loads(text))))
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        return f"its {kind.marker} cannot be read ({error}); {remedy}"

    keys = [key for key in then | now if then.get(key) != now.get(key) and key.partition(".")[0] != kind.free]
    if not keys:
        return None
    if keys == [kind.grows] and extend:
        return extend(then[kind.grows], now[kind.grows])
    if keys == [kind.grows] and now[kind.grows] > then[kind.grows]:
        remedy = f"go on from its end with --extend, {remedy}"
    elif extend:
        remedy = f"--extend takes a later {kind.grows} and changes nothing else; choose another folder with --out"

    differing = []
    for key in keys:
        values = [_shown(case.get(key, "nothing")) for case in (then, now)]
        differing.append(f"{key} = {values[0]} there, {values[1]} here")
    shown = "; ".join(differing[:MOST_NAMED])
    if len(differing) > MOST_NAMED:
        shown += f"; and {len(differing) - MOST_NAMED} more"
    return f"contains another {kind.noun}: {shown}; {remedy}"


def _shown(value: Any) -> str:
    """Return a value as a message shows it; of one long word, such as a hash, its beginning."""
    text = str(value)
    if len(text) > 60 and " " not in text:
        return f"{text[:16]}..."
    return shorten(text, 60)


def _text_of(path: Path) -> str:
    """Return the text of a file; bytes that are not UTF-8, in a damaged one, become replacement characters."""
    return path.read_text(encoding="utf-8", errors="replace")


def _keys(table: dict[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the keys of a case with their sections, and their values."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _keys(value, f"{path}{key}.")
        else:
            yield path + key, value


def provenance(comm: "MPI.Comm") -> dict[str, Any]:
    """Return record of versions, date, host, command and number of ranks, as attributes that every output carries.

    Two runs of one command differ in it.
    """
    return origin() | {"ranks": comm.size}


def origin() -> dict[str, Any]:
    """Return the record of ``provenance`` without the ranks, for results that one rank computes alone.

    ``petsc_options`` are those of PETSc's database, given on the command line; those of a case are in the case's text.
    """
    # Of what has computed, all of it loaded.
    from mpi4py import MPI
    from petsc4py import PETSc

    import h5py

    options = PETSc.Options().getAll()
    given = " ".join(f"-{name} {value}".strip() for name, value in sorted(options.items()))

    return {
        "vipetsc_version": vipetsc.__version__,
        "revision": revision(),
        "source": source_key(),
        "petsc_version": ".".join(map(str, PETSc.Sys.getVersion())),
        "mpi_version": MPI.Get_library_version().split(",")[0].strip(),
        "hdf5_version": h5py.version.hdf5_version,
        "numpy_version": np.__version__,
        "python_version": platform.python_version(),
        # HDF5 stores text as UTF-8, which has not every name of a file.
        "command": " ".join(["vipetsc", *sys.argv[1:]]).encode("utf-8", "replace").decode(),
        "petsc_options": given or "none",
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "host": platform.node(),
    }


@cache
def revision() -> str:
    """Return the commit of the package's sources by git, with a "+" if they were changed since; else "none"."""
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
