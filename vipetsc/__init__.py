"""Waves in phononic lattices whose cells carry vibro-impacts, on PETSc and MPI."""

from importlib import import_module

__version__ = "0.1.0"

_HOMES = {"Case": "vipetsc.case", "simulate": "vipetsc.dynamics"}

__all__ = ["Case", "simulate"]


def __getattr__(name: str) -> object:
    """Load a name when it is first used: PETSc must not start before its options are known."""
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
