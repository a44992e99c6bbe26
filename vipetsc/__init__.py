"""Waves in phononic lattices whose cells carry vibro-impacts, on PETSc and MPI."""

from importlib import import_module

__version__ = "0.1.0"
__all__ = ["Case", "simulate"]


def __getattr__(name: str) -> object:
    """Load a name when it is first used: importing the package must not start PETSc, whose options come first."""
    modules = {"Case": "vipetsc.case", "simulate": "vipetsc.dynamics.run"}
    if name in modules:
        return getattr(import_module(modules[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
