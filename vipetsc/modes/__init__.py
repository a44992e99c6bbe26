"""Nonlinear normal modes of conservative systems with contacts: shooting, continuation, stability, branch files.

The pieces, as a loop of one's own uses them::

    corrector = Corrector(Shooting(Dop853Flow(system), MAPS["quarter"]))
    for point in Continuation(corrector, linear_start(corrector, mode, energy), StepControl()):
        ...

PETSc is loaded when the first of these names is used; ``options`` and ``system`` do without it.
"""

from importlib import import_module

_HOMES = {
    "Branch": "branch",
    "Dop853Flow": "orbit",
    "ContactPair": "system",
    "Continuation": "continuation",
    "ContinuationError": "continuation",
    "Corrector": "shooting",
    "Guards": "continuation",
    "Locator": "special",
    "MAPS": "shooting",
    "Newmark": "newmark",
    "Point": "point",
    "Shooting": "shooting",
    "SmoothSpring": "system",
    "StepControl": "continuation",
    "System": "system",
    "Tsrk": "tsrk",
    "follow_all": "follow",
    "linear_start": "point",
    "switch": "switching",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(import_module(f"vipetsc.modes.{_HOMES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
