"""Errors about folders and files of results."""

import errno

# Errors of the system that are about the path that was given.
OF_PATHS = (errno.ENOENT, errno.ENOTDIR, errno.EISDIR)


def is_of_file_system(error: Exception) -> bool:
    """Return whether an ``error`` is of the file system, as a full disk, and says nothing about a file's content."""
    return isinstance(error, OSError) and bool(error.errno) and error.errno not in OF_PATHS


class UnwrittenError(OSError):
    """A file that could not be written; the message is a sentence, and the number that of the system's error."""

    def __str__(self) -> str:
        return str(self.strerror)


class FolderError(ValueError):
    """An output folder that cannot be used as requested."""


class ResultFileError(FolderError):
    """A file whose content is not of the kind that its name indicates."""


class UnreadableFileError(OSError, ResultFileError):
    """A file of results that cannot be opened; the message is a sentence, and the number the system's, or 0."""

    def __str__(self) -> str:
        return str(self.strerror or self.args[0])
