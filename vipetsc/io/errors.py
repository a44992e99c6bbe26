"""What a user has asked of a folder or a file of results that it cannot do."""


class FolderError(ValueError):
    """An output folder that cannot be used as asked."""


class ResultFileError(FolderError):
    """A file that is not of the kind of results that its name says."""


class UnreadableFileError(OSError, ResultFileError):
    """A file of results that cannot be opened."""
