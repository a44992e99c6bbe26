"""Waves in phononic lattices whose cells carry vibro-impacts, on PETSc and MPI."""

from importlib import import_module

__version__ = "0.1.0"
__all__ = ["Case", "install_abort_hook", "open", "simulate"]


def __getattr__(name: str) -> object:
    """Load a name when it is first used: importing the package must not start PETSc, whose options come first."""
    modules = {
        "Case": ("vipetsc.case", "Case"),
        "install_abort_hook": ("vipetsc.parallel", "install_abort_hook"),
        "open": ("vipetsc.io.read", "open_results"),
        "simulate": ("vipetsc.dynamics.run", "simulate"),
    }
    if name in modules:
        module, attribute = modules[name]
        return getattr(import_module(module), attribute)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
