"""Errors about folders and files of results."""

import errno

DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def is_disk_full(error: Exception) -> bool:
    """Whether an ``error`` says that nothing else can be written either."""
    return getattr(error, "errno", None) in DISK_FULL


class FolderError(ValueError):
    """An output folder that cannot be used as requested."""


class ResultFileError(FolderError):
    """A file whose content is not of the kind that its name indicates."""


class UnreadableFileError(OSError, ResultFileError):
    """A file of results that cannot be opened."""
