"""Errors about folders and files of results."""

import errno

DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)  # of an OSError after which nothing else can be written either


class FolderError(ValueError):
    """An output folder that cannot be used as requested."""


class ResultFileError(FolderError):
    """A file whose content is not of the kind that its name indicates."""


class UnreadableFileError(OSError, ResultFileError):
    """A file of results that cannot be opened."""
