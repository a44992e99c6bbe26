"""Names of files that a case has."""

import errno
import hashlib
from pathlib import Path


def resolved_path(text: str) -> Path:
    """Return the path that ``text`` names, absolute and without links; raises OSError for one that leads to no file.

    A path that is not UTF-8 is refused, because files of results could not hold it.
    """
    try:
        path = Path(text).resolve()
        str(path).encode()
    # Python up to 3.12 raises RuntimeError for links that lead to each other; a NUL in the name is a ValueError, and so
    # is a character that cannot be encoded.
    except (RuntimeError, ValueError) as error:
        raise OSError(errno.EINVAL, str(error)) from None
    return path


def file_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
