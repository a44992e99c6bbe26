"""Waves in phononic lattices whose cells carry vibro-impacts, on PETSc and MPI."""

import os
from importlib import import_module
from pathlib import Path

from vipetsc.compiled import kernel_cache

# Numba reads it when it is first imported; a folder that the user has chosen stays.
os.environ.setdefault("NUMBA_CACHE_DIR", str(kernel_cache(Path(__file__).parent)))

__version__ = "0.1.0"

_HOMES = {"Case": "vipetsc.case", "simulate": "vipetsc.dynamics"}

__all__ = ["Case", "simulate"]


def __getattr__(name: str) -> object:
    """Load a name when it is first used: PETSc must not start before its options are known."""
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
