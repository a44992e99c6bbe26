"""Output folders: the one way to claim one, and the provenance that every output carries."""

import platform
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI
from petsc4py import PETSc

import h5py
import numpy as np

import vipetsc
from vipetsc.io.atomic import write_text

FORMAT_VERSION = 1


class FolderError(ValueError):
    """An output folder that cannot be used as asked."""


@dataclass(frozen=True)
class FolderKind:
    """What a folder of results holds; patterns as of ``Path.glob``.

    ``noun``: one of them; ``results``: what shows that a folder holds some; ``unfinished``: what is there while they
    can be gone on with, and their name; ``replaced``: what goes when ``force`` begins anew (other results stay until
    new ones replace them); ``marker``: the file that names what the results are of.
    """

    noun: str
    results: tuple[str, ...]
    unfinished: tuple[str, str] | None = None
    replaced: tuple[str, ...] = ()
    marker: str = "case.toml"


RUN = FolderKind("run", ("run.h5", "parts"), ("parts", "unfinished run"), ("parts",))
BRANCHES = FolderKind("branch", ("branch-*.h5",), ("case.toml", "branches"), ("branch-*.*",))
SEARCH = FolderKind("search", ("design.h5",))
SWEEP = FolderKind("sweep", ("index.json", "linear"), None, ("*/", "index.json", "ensemble.h5", "backbone.h5"))
PAPER = FolderKind("paper", ("plan.json",), marker="plan.json")
KINDS = (RUN, BRANCHES, SEARCH, SWEEP, PAPER)


def claim_folder(
    path: Path,
    kind: FolderKind,
    text: str,
    *,
    force: bool = False,
    resume: bool | None = False,
    difference: Callable[[str], str | None] | None = None,
) -> bool:
    """Make ``path`` a folder for results of ``kind``, with ``text`` in its marker; returns whether they go on.

    Parameters
    ----------
    path, kind
        The folder, made if it is missing, and what it is to hold.
    text
        What the results are of, a resolved case.
    force
        Begin anew where results of the same kind are.
    resume
        Go on with results that are there and nothing else; None: go on if there are results of the same ``text``.
    difference
        Of the marker's text: why results begun with it are not those asked for, None if they are; by default any
        change of ``text``.

    Raises
    ------
    FolderError
        If it is a file, holds anything but results of ``kind``, or those where neither ``force`` nor ``resume``
        tells what to do with them.
    """
    sys.audit("vipetsc.claim", str(path))
    if path.exists() and not path.is_dir():
        raise FolderError(f"{path}: is a file, not a folder; choose another --out")
    marker = path / kind.marker
    unfinished, name = kind.unfinished or (kind.marker, kind.noun)
    begun = marker.exists() and any(path.glob(unfinished))
    if resume and not begun:
        raise FolderError(f"{path}: holds no {name} to resume; leave out --resume")
    foreign = [pattern for other in KINDS if other is not kind for pattern in other.results]
    filled = path.is_dir() and any(path.iterdir())
    if filled and (not marker.exists() or any(any(path.glob(pattern)) for pattern in foreign)):
        raise FolderError(f"{path}: holds files that are not a {kind.noun}'s of this kind; choose another --out")
    going_on = filled and not force and resume is not False
    if going_on:
        earlier = marker.read_text(encoding="utf-8")
        problem = difference(earlier) if difference else _difference(earlier, text, kind, resume)
        if problem:
            raise FolderError(f"{path}: {problem}")
    elif filled and not force:
        go_on = f"--resume goes on with the {name} in it, " if begun and kind.unfinished else ""
        raise FolderError(f"{path}: exists; {go_on}--force replaces what is in it, --out chooses another")
    elif filled:
        for old in [old for pattern in kind.replaced for old in path.glob(pattern)]:
            shutil.rmtree(old) if old.is_dir() else old.unlink()
    path.mkdir(parents=True, exist_ok=True)
    if not marker.exists() or marker.read_text(encoding="utf-8") != text:
        write_text(marker, text)
    return going_on


def _difference(earlier: str, text: str, kind: FolderKind, resume: bool | None) -> str | None:
    if earlier == text:
        return None
    if resume is None:
        return f"holds another {kind.noun}; --force replaces it, --out chooses another folder"
    lines = {line.strip() for line in set(earlier.splitlines()) ^ set(text.splitlines())}
    return f"--resume needs the case it was begun with; differing: {'; '.join(sorted(lines - {''}))}"


def provenance(comm: MPI.Comm) -> dict[str, Any]:
    """Versions, ranks and command, as every output carries them."""
    return {
        "format_version": FORMAT_VERSION,
        "vipetsc_version": vipetsc.__version__,
        "petsc_version": ".".join(map(str, PETSc.Sys.getVersion())),
        "mpi_version": MPI.Get_library_version().split(",")[0].strip(),
        "hdf5_version": h5py.version.hdf5_version,
        "numpy_version": np.__version__,
        "python_version": platform.python_version(),
        "ranks": comm.size,
        "command": " ".join(["vipetsc", *sys.argv[1:]]),
    }
