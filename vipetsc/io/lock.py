"""Locks on folders, so that one command at a time works in a folder."""

import fcntl
import os
import platform
import secrets
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from vipetsc.io.errors import FolderError
from vipetsc.parallel import on_root

if TYPE_CHECKING:
    from mpi4py import MPI

LOCK = ".lock"
# The name of this process in a lock: two processes in containers on one host may have the same number.
TOKEN = secrets.token_hex(8)
# A command that ends removes a folder that it has created and left empty, perhaps while this one creates it.
ATTEMPTS = 100


@contextmanager
def locked(comm: "MPI.Comm", *paths: Path) -> Iterator[None]:
    """Keep other commands out of the folders ``paths`` within the block; those that are missing are created.

    All ranks must call it. Rank 0 locks the file ``.lock`` in each folder; the system releases the lock when the
    process ends, however it ends. The same process may take the lock again within the block. Folders that were created
    for the lock and stay empty are removed at the end. Where the file system has no locks, there is none, and no error.

    Raises FolderError on all ranks if a path is not a folder and cannot become one, or if another process, which it
    names, has the lock.
    """
    with ExitStack() as stack:
        on_root(comm, lambda: [stack.enter_context(_lock(path)) for path in paths])
        yield


@contextmanager
def _lock(path: Path) -> Iterator[None]:
    """Hold the lock of one folder on this rank; folders that were created for it and stayed empty are removed."""
    if path.exists() and not path.is_dir():
        raise FolderError(f"{path}: is a file, not a folder; choose another --out")
    for part in (path, *path.parents):
        # No folder can be created there, and the system only says that the file exists.
        if part.is_symlink() and not part.exists():
            target = os.readlink(part)
            raise FolderError(f"{path}: {part} is a link to {target}, which is missing; choose another --out")

    created: list[Path] = []
    descriptor = None
    try:
        descriptor = _acquire(path, created)
        if descriptor is not None:
            remove_temporary_files(path)
        yield
    finally:
        if descriptor is not None:
            _unlock(path, descriptor)
        for folder in created:
            with suppress(OSError):
                folder.rmdir()


def _unlock(path: Path, descriptor: int) -> None:
    """Give back the lock of a folder that ``descriptor`` holds."""
    # Removed while it is still locked: a process that has opened it by now gets the lock of a file without a name,
    # notices that, and tries again. A file that cannot be removed does not matter: nobody holds its lock.
    with suppress(OSError):
        (path / LOCK).unlink()
    os.close(descriptor)


def remove_temporary_files(folder: Path) -> None:
    """Remove temporary files, and locks that nobody holds, which killed commands have left in ``folder`` and below it.

    The caller has the lock of ``folder``. Another command may have the lock of a folder in it, for example of a member
    of a sweep: files there are left alone. What cannot be removed stays, since no reader takes it for a result.
    """
    _remove_parts(folder)

    for inner in filter(Path.is_dir, folder.iterdir()):
        descriptor = None
        if (inner / LOCK).exists():
            descriptor, _ = _try_to_lock(inner)
            if descriptor is None:
                continue
        _remove_parts(inner)
        if descriptor is not None:
            _unlock(inner, descriptor)


def _remove_parts(folder: Path) -> None:
    """Remove temporary files from ``folder``."""
    for temporary in folder.glob(".*.part"):
        with suppress(OSError):
            temporary.unlink()


def _acquire(path: Path, created: list[Path]) -> int | None:
    """Lock the folder ``path``, which is created where it is missing; the folders ``created`` are added to the list.

    Returns the descriptor of the file that is locked, or None if this process has the lock already or the file system
    has no locks. Raises FolderError if another process has the lock, or the folder cannot be created.
    """
    sys.audit("vipetsc.lock", str(path))
    reason = ""
    for _ in range(ATTEMPTS):
        created += [folder for folder in (path, *path.parents) if not folder.exists()]
        try:
            path.mkdir(parents=True, exist_ok=True)
            descriptor, holder = _try_to_lock(path)
        except (FileNotFoundError, FileExistsError) as error:
            reason = str(error.strerror)
            continue
        except OSError as error:
            reason = str(error.strerror)
            break
        if holder is None:
            return descriptor
        remedy = "wait until it has ended, or choose another --out"
        raise FolderError(f"{path}: {holder} is working in it; {remedy}")
    raise FolderError(f"{path}: cannot be created or locked: {reason}; choose another --out")


def _try_to_lock(path: Path) -> tuple[int | None, str | None]:
    """Return the descriptor of the locked file, and the other process that has the lock; one of them or both are None.

    Both are None if this process has the lock already, or the file system has no locks.
    """
    while True:
        descriptor = os.open(path / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            # The last word in the file is the token of the process that has the lock.
            holder, _, token = os.read(descriptor, 1000).decode().strip().rpartition(" ")
            os.close(descriptor)
            # If the error is not that the file is locked, the file system has no locks, and work goes on without one.
            if token == TOKEN or not isinstance(error, BlockingIOError):
                return None, None
            return None, holder or "another process"

        # A holder that ended after the file was opened has removed it, and a lock on a file without a name keeps nobody
        # out.
        try:
            if _is_file(descriptor, path / LOCK):
                os.ftruncate(descriptor, 0)
                os.write(descriptor, f"process {os.getpid()} on {platform.node()} {TOKEN}\n".encode())
                return descriptor, None
        except OSError:
            # A process that goes on would keep the lock without knowing it.
            os.close(descriptor)
            raise
        os.close(descriptor)


def _is_file(descriptor: int, path: Path) -> bool:
    """Return whether the open file of a ``descriptor`` is the one of that name."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
