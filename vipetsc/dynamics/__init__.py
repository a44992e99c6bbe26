"""Time integration of lattices, on PETSc."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vipetsc.dynamics.result import Result
    from vipetsc.dynamics.run import simulate


def __getattr__(name: str) -> object:
    """Load a run when it is first used: its options and its memory are checked without compiled kernels."""
    if name in ("Result", "simulate"):
        return getattr(import_module("vipetsc.dynamics.run"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
