"""Files that are complete or absent: written under a temporary name, and renamed when complete."""

import os
import platform
import re
import secrets
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from vipetsc.io.errors import UnwrittenError
from vipetsc.wording import system_number, system_reason


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path that replaces ``path`` when the block succeeds and vanishes when it fails.

    Raises an OSError that names ``path`` if the temporary file cannot be written or renamed.
    """
    # Processes of two hosts with a common file system, or of two containers, may have the same number: the host's name
    # and a random word tell them apart.
    aside = path.with_name(f".{path.name}.{platform.node()}-{os.getpid()}-{secrets.token_hex(4)}.part")
    sys.audit("vipetsc.write", str(path))
    # Renamed only when it is complete: a kill leaves the earlier file, and the temporary one for the next claim.
    try:
        yield aside
        sys.audit("vipetsc.replace", str(path))
        os.replace(aside, path)
    except OSError as error:
        raise unwritten(path, error) from error
    finally:
        # One that cannot be removed is left to the next claim: its error would hide the first one.
        with suppress(OSError):
            aside.unlink()


def remove_abandoned(folder: Path) -> None:
    """Remove temporary files of ``atomic_write`` from ``folder`` whose processes on this host have ended.

    It is for commands that hold no lock on the folder: other commands may be writing there at the same time.
    """
    # The pattern covers the whole name: that of another host may begin with that of this one, a dash and a number.
    of_this_host = re.compile(rf"\..*\.{re.escape(platform.node())}-(\d+)-[0-9a-f]+\.part", re.DOTALL)
    for path in folder.glob(".*.part"):
        named = of_this_host.fullmatch(path.name)
        if named and not _is_running(int(named[1])):
            with suppress(OSError):
                path.unlink()


def _is_running(process: int) -> bool:
    """Return whether there is a ``process`` of that number on this host."""
    try:
        # The signal 0 is not sent: the system only looks whether it could be.
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        # The process is another user's.
        pass
    return True


def unwritten(path: Path, error: Exception) -> UnwrittenError:
    """Return an error with the number of ``error``, of Python or HDF5, that names the file that was not written."""
    remedy = "after the cause is removed, the same command continues"
    return UnwrittenError(system_number(error), f"{path} could not be written: {system_reason(error)}; {remedy}")


def discard(folder: Path) -> None:
    """Remove ``folder`` if it exists; a kill leaves it whole, or under a name that begins with a dot."""
    aside = folder.with_name(f".{folder.name}.old")
    # A call that was killed may have left one, onto which the folder could not be renamed.
    shutil.rmtree(aside, ignore_errors=True)
    if folder.is_dir():
        os.replace(folder, aside)
        shutil.rmtree(aside, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` in UTF-8, whole or not at all; raises OSError as ``atomic_write``."""
    with atomic_write(path) as aside:
        aside.write_text(text, encoding="utf-8")
