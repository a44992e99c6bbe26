"""Waves in phononic lattices with local vibro-impacts, on PETSc and MPI.

    Case      a case to simulate: ``Case(lattice=..., contacts=..., drive=..., time=...)``, ``Case.load("file.toml")``
    Sweep     many cases in one: the same tables, and ``sweep=...`` with the values of the swept keys
    simulate  one run of a case, in memory or in a folder
    sweep     every member of a sweep, in memory or in a folder
    analyse   the measures of a run: spectra, energies of the pass bands, entropy
    follow    solutions of your own equations F(x, p) = 0: folds, branch points, the branches that cross there
    open      result files as xarray datasets
    impacts   the impacts of a run as a table of pandas: a row for each, with its loss, impulse and what it moved
    plot      a picture of results, by the name that the command ``plot`` gives it, as a figure of matplotlib
    CaseError raised for an invalid case: key, value and remedy of every problem
    register  contact laws, dissipation factors, waveforms, measures and figures of a user's module, by name

This example simulates a shorter version of the built-in lattice, and prints the largest speed of each mass in each
cell:

    from vipetsc import Case, simulate

    case = Case(lattice={"cells": 100}, contacts={"sites": [20, 30]}, drive={"amplitude": 40.0, "cycles": 10})
    result = simulate(case, progress=True)
    print(result.sentence, abs(result.dataset["velocity"]).max("time"))

All keys, their units and their defaults are in the manual (``vipetsc manual case-file``, ``vipetsc manual case-keys``).
"""

from importlib import import_module

__version__ = "0.1.0"
__all__ = [
    "Case",
    "CaseError",
    "Sweep",
    "analyse",
    "follow",
    "impacts",
    "install_abort_hook",
    "open",
    "plot",
    "register",
    "simulate",
    "sweep",
]

MODULES = {
    "Case": ("vipetsc.case", "Case"),
    "CaseError": ("vipetsc.case", "CaseError"),
    "Sweep": ("vipetsc.case", "Sweep"),
    "analyse": ("vipetsc.studies.analysis", "analyse"),
    "follow": ("vipetsc.modes.user_equations", "follow"),
    "impacts": ("vipetsc.io.impacts", "impacts"),
    "install_abort_hook": ("vipetsc.parallel", "install_abort_hook"),
    "open": ("vipetsc.io.read", "open_results"),
    "plot": ("vipetsc.studies.pictures", "plot"),
    "register": ("vipetsc", "register"),
    "simulate": ("vipetsc.studies.simulation", "simulate"),
    "sweep": ("vipetsc.studies.sweep", "run_sweep"),
}


def __getattr__(name: str) -> object:
    """Load a name when it is first used: importing the package must not start PETSc, whose options come first."""
    if name in MODULES:
        module, attribute = MODULES[name]
        # ``register`` is a module of the package, the others are names in one.
        if module == __name__:
            return import_module(f"{module}.{attribute}")
        return getattr(import_module(module), attribute)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """Return all names, including those that are loaded late, for completion and ``help``."""
    return sorted({*globals(), *__all__})
