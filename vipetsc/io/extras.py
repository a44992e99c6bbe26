"""Packages that one verb alone needs, and that an installation may lack."""

from importlib import import_module

from vipetsc.io.errors import FolderError

# The oldest versions that were tried, as in pyproject.toml, by the name of the package.
OLDEST = {"cma": "4.0", "pymoo": "0.6.2", "jinja2": "3.1", "shtab": "1.7"}


def require(package: str, verb: str) -> None:
    """Raise FolderError, before anything is written, if the ``package`` that ``verb`` needs cannot be imported."""
    try:
        import_module(package)
    except ImportError as error:
        remedy = f"pip install '{package}>={OLDEST[package]}'"
        raise FolderError(f"{verb} needs {package}, which is not installed ({error}): {remedy}") from None
