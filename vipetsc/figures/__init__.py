"""Pictures, from files only; matplotlib is loaded when the first of these names is used."""

from importlib import import_module

_HOMES = {
    "FIGURES": "vipetsc.figures.registry",
    "draw": "vipetsc.figures.registry",
    "draw_bands": "vipetsc.figures.registry",
    "figure_names": "vipetsc.figures.registry",
    "rc_style": "vipetsc.figures.style",
    "save": "vipetsc.figures.drawing",
}

__all__ = ["FIGURES", "draw", "draw_bands", "figure_names", "rc_style", "save"]


def __getattr__(name: str) -> object:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
