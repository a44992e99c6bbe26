"""Folders that one command at a time works in."""

import fcntl
import os
import platform
import secrets
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from mpi4py import MPI

from vipetsc.parallel import on_root

LOCK = ".lock"
TOKEN = secrets.token_hex(8)  # this process: in two containers on one host, two may have the same number


class FolderError(ValueError):
    """An output folder that cannot be used as asked."""


@contextmanager
def locked(comm: MPI.Comm, *paths: Path) -> Iterator[None]:
    """Keep other commands out of the folders ``paths`` within the block; those that are missing are made.

    A lock lies on ``.lock`` in the folder, held by rank 0, and ends with its process, so that none is left behind;
    it may be taken again within the block by the same process. Folders that stay empty go again. All ranks must call
    it. Raises FolderError if another process has the lock, and names it.
    """
    with ExitStack() as stack:
        on_root(comm, lambda: [stack.enter_context(_lock(path)) for path in paths])
        yield


@contextmanager
def _lock(path: Path) -> Iterator[None]:
    if path.exists() and not path.is_dir():
        raise FolderError(f"{path}: is a file, not a folder; choose another --out")
    made = [folder for folder in (path, *path.parents) if not folder.exists()]
    descriptor = None
    try:
        path.mkdir(parents=True, exist_ok=True)
        descriptor = _acquire(path)
        yield
    finally:
        if descriptor is not None:
            (path / LOCK).unlink(missing_ok=True)
            os.close(descriptor)
        for folder in made:
            with suppress(OSError):
                folder.rmdir()


def _acquire(path: Path) -> int | None:
    """The descriptor that holds the lock; None if this process has it already, or the file system knows no locks."""
    sys.audit("vipetsc.lock", str(path))
    holder = f"process {os.getpid()} on {platform.node()}"
    while True:
        descriptor = os.open(path / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # One that ended meanwhile has removed the file that was opened.
            if (path / LOCK).exists() and os.path.samestat(os.fstat(descriptor), (path / LOCK).stat()):
                os.ftruncate(descriptor, 0)
                os.write(descriptor, f"{holder} {TOKEN}\n".encode())
                return descriptor
            os.close(descriptor)
        except OSError as error:
            other, _, token = os.read(descriptor, 1000).decode().strip().rpartition(" ")
            os.close(descriptor)
            if not isinstance(error, BlockingIOError) or token == TOKEN:
                return None
            message = f"{other or 'another process'} is working in it; wait until it has ended, or choose another --out"
            raise FolderError(f"{path}: {message}") from None
